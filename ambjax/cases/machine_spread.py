"""The table [spread] of a machine: distributions of numbers of the rotor, and of each axis."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from ambjax.cases.axis_case import FROM_ROTOR
from ambjax.cases.reader import Case
from ambjax.cases.rotor_tables import COORDINATES, DAMPING, FREQUENCY, I_P, I_T, MASS, RIGID, BearingAxis
from ambjax.cases.table import Table
from ambjax.cases.variation import entries_of, is_distribution
from ambjax.ensemble.paths import Place, numbers_in, places, with_number
from ambjax.ensemble.spread import Spread, check_entries
from ambjax.numerics.records import leaf
from ambjax.world.rotor import Rotor

# First words of the paths of the rotor, of its start, and of those of one bearing or one axis.
OF_ROTOR, OF_START, OF_BEARING = ("rotor", "unbalance", "load", "base"), "initial", "bearing"
START = "initial.q."
# A table that a machine does not have.
ABSENT = "disturbance"
# Coordinates of the rigid rotor at t = 0.
OFFSET = leaf(unit="m", at_least=-10.0, at_most=10.0, doc="displacement of the centre of mass at t = 0")
TILT = leaf(unit="rad", at_least=-10.0, at_most=10.0, doc="tilt at t = 0")
# Numbers that all axes share, and those of the case of an axis that its machine replaces.
COMMON, NOT_OF_AXIS = "processor.", ("rotor.", "initial.", "disturbance.")


def axis_table(raw: dict[str, Any], axis: BearingAxis, name: str) -> dict[str, Any]:
    """Return the table [spread] of the case of one axis: the common paths, then those of its bearing and of the axis.

    `name`: of the bearing. Raises ValueError, one line, for a number that an axis does not have of its own.
    """
    table = raw.get("spread", {})
    if not isinstance(table, dict):
        return {"spread": table}
    own = table.get(OF_BEARING, {}).get(name, {}) if isinstance(table.get(OF_BEARING, {}), dict) else {}
    label = axis.name.removeprefix(f"{name}.")
    parts = [table, own, own.get(label, {})] if isinstance(own, dict) else [table]
    for key in (*OF_ROTOR, OF_START):
        if any(key in part for part in parts[1:]):
            raise ValueError(f"spread.{OF_BEARING}.{name}.{key}: it belongs to the whole rotor. Spread {key} instead.")
    merged: dict[str, Any] = {}
    for part in parts:
        merged = _joined(merged, part)
    dropped = (*OF_ROTOR, OF_START, OF_BEARING, "x", "y", "z")
    merged = {key: value for key, value in merged.items() if key not in dropped}
    if ABSENT in merged:
        raise ValueError(f"spread.{ABSENT}: the members of a machine do not vary it. Leave it out.")
    for key in FROM_ROTOR:
        if isinstance(merged.get("plant"), dict) and key in merged["plant"]:
            raise ValueError(f"spread.plant.{key}: the rotor gives it. Spread rotor.m instead.")
    return {"spread": merged} if merged else {}


def refuse_unused(spread: Spread, output: str) -> None:
    """Raise ValueError for a number of laws that an axis lacks because one law commands all. `output`: of that law."""
    unused = ("observer", "position", "model", *(["current"] if output == "voltage" else []))
    for path, _ in spread.entries:
        if any(f".controller.{part}." in path for part in unused):
            raise ValueError(f"spread.{path}: one law commands all axes, so an axis has none. Leave it out.")


def _joined(common: dict[str, Any], own: Any) -> dict[str, Any]:
    """Return the common table with the distributions of another one, recursively."""
    both = dict(common)
    for key, value in own.items() if isinstance(own, dict) else ():
        nested = not is_distribution(value) and isinstance(both.get(key), dict)
        both[key] = _joined(both[key], value) if nested else value
    return both


def machine_spread(
    top: Table, rotor: Rotor, q: np.ndarray, axes: Sequence[BearingAxis], names: list[str], cases: list[Case]
) -> Spread:
    """Return the spread of a machine. Each axis varies independently, except for the numbers of the processor.

    `q`: coordinates at t = 0. `names`: of the bearings. `cases`: those of the axes, with their own spreads. Raises
    ValueError for an invalid entry of the rotor or its start, or for an unknown bearing.
    """
    raw = top.table("spread").raw
    for name, own in Table(raw, "spread").table(OF_BEARING).raw.items():
        labels = [axis.name.removeprefix(f"{name}.") for axis in axes if axis.name.startswith(f"{name}.")]
        if name not in names:
            raise ValueError(f"spread.{OF_BEARING}.{name}: there is no such bearing. There are: {', '.join(names)}.")
        if wrong := [key for key in own if key in ("x", "y", "z") and key not in labels]:
            raise ValueError(f"spread.{OF_BEARING}.{name}.{wrong[0]}: its axes are {', '.join(labels)}.")
    known = rotor_places(rotor) | start_places(q)
    entries = entries_of({key: value for key, value in raw.items() if key in (*OF_ROTOR, OF_START)}, "", list(known))
    check_entries(Spread(tuple(entries)), known)
    for k, (axis, case) in enumerate(zip(axes, cases, strict=True)):
        for path, kind in case.spread.entries:
            if not path.startswith(COMMON):
                entries.append((f"{OF_BEARING}.{axis.name}.{path}", kind))
            elif k == 0:
                entries.append((path, kind))
    return Spread(tuple(entries), cases[0].spread.design)


def machine_places(rotor: Rotor, q: Any, names: Sequence[str], cases: Sequence[Case]) -> dict[str, Place]:
    """Return every number of a machine that may vary, by dotted path. `q`: start. `names`: of the axes."""
    table = rotor_places(rotor) | start_places(q)
    for name, case in zip(names, cases, strict=True):
        own = {path: x for path, x in places(case.cascade, case.scenario).items() if not path.startswith(NOT_OF_AXIS)}
        table |= {path if path.startswith(COMMON) else f"{OF_BEARING}.{name}.{path}": x for path, x in own.items()}
    return table


def shared(known: Mapping[str, Place], names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the paths of the numbers that the paths of a bearing, or of all axes, stand for. `names`: of the axes."""
    groups: dict[str, tuple[str, ...]] = {}
    for name in names:
        own = f"{OF_BEARING}.{name}."
        for path in known:
            if path.startswith(own):
                number = path.removeprefix(own)
                for common in (number, f"{OF_BEARING}.{name.rpartition('.')[0]}.{number}"):
                    groups[common] = (*groups.get(common, ()), path)
    return groups


def start_places(q: Any) -> dict[str, Place]:
    """Return the coordinates of the rigid rotor at t = 0 by dotted path."""
    return {
        f"{START}{k}": Place((), TILT if name.startswith("beta") else OFFSET, np.asarray(q)[k])
        for k, name in enumerate(COORDINATES)
    }


def varied_start(q: Any, values: Mapping[str, Any]) -> np.ndarray:
    """Return the starts of members: the values of `start_places` are arrays [N], and so is the start, [N, n].

    Without values it is the start itself.
    """
    start = np.array(q, float)
    for path, x in values.items():
        if path.startswith(START):
            start = np.array(np.broadcast_to(start, (len(x), start.shape[-1])))
            start[:, int(path.removeprefix(START))] = x
    return start


def axis_values(values: Mapping[str, object], name: str, known: Iterable[str]) -> dict[str, object]:
    """Return the values of one axis by the paths of its case, `known`. `name`: of the axis."""
    own = f"{OF_BEARING}.{name}."
    common = {path: x for path, x in values.items() if path in known}
    return common | {path.removeprefix(own): x for path, x in values.items() if path.startswith(own)}


def rotor_places(rotor: Rotor) -> dict[str, Place]:
    """Return the numbers of a rotor, its unbalances and its loads by dotted path.

    The frequencies and dampings of the bending modes are those of a rotor with diagonal stiffness and damping.
    """
    M, K, D, G = (np.asarray(x) for x in (rotor.M, rotor.K, rotor.D, rotor.G))
    table = {
        "rotor.m": Place((), MASS, M[0, 0]),
        "rotor.I_t": Place((), I_T, M[3, 3]),
        "rotor.I_p": Place((), I_P, G[3, 4]),
    }
    numbers = numbers_in(rotor, "rotor")
    # a table of speeds has no rate of its own
    table |= {path: numbers[path] for path in ("rotor.speed", "rotor.acceleration")[: 1 if rotor.changes else 2]}
    w = np.sqrt(np.diag(K)[RIGID::2] / np.diag(M)[RIGID::2])
    for j, (own, d) in enumerate(zip(w, np.diag(D)[RIGID::2], strict=True)):
        table[f"rotor.modes.{j}.frequency"] = Place((), FREQUENCY, own / (2 * np.pi))
        table[f"rotor.modes.{j}.damping"] = Place((), DAMPING, d / (2 * own * M[RIGID + 2 * j, RIGID + 2 * j]))
    for stem, name in (("rotor.unbalances.", "unbalance."), ("rotor.loads.", "load."), ("rotor.base.", "base.")):
        own = {path: place for path, place in numbers.items() if path.startswith(stem) and ".along" not in path}
        table |= {path.replace(stem, name).replace(".signal.", ".", 1): x for path, x in own.items()}
    return table


def varied_rotors(rotor: Rotor, values: Mapping[str, Any]) -> Rotor:
    """Return the rotors of members: the values of `rotor_places` are arrays [N], and so is each leaf, [N, ...].

    Without values it is the rotor itself.
    """
    own = {path: np.asarray(x, float) for path, x in values.items() if path.startswith(OF_ROTOR)}
    if not own:
        return rotor
    members = [varied_rotor(rotor, dict(zip(own, row, strict=True))) for row in zip(*own.values(), strict=True)]
    return jax.tree.map(lambda *x: np.stack(x), *members)


def varied_rotor(rotor: Rotor, values: Mapping[str, float]) -> Rotor:
    """Return the rotor with these numbers of `rotor_places`.

    The weight follows the mass. The polar inertia scales the gyroscopic terms of the bending modes too.
    """
    known = rotor_places(rotor)
    M, D, G, K, gravity = (np.array(x, float) for x in (rotor.M, rotor.D, rotor.G, rotor.K, rotor.gravity))
    for path, x in values.items():
        if known[path].route:
            rotor = with_number(rotor, known[path].route, x)
        elif path == "rotor.m":
            M[range(3), range(3)], gravity = x, gravity * (x / M[0, 0])
        elif path == "rotor.I_t":
            M[(3, 4), (3, 4)] = x
        elif path == "rotor.I_p":
            G *= x / G[3, 4] if G[3, 4] else 1.0
            G[3, 4], G[4, 3] = x, -x
        else:
            k = RIGID + 2 * int(path.split(".")[2])
            mass, at = M[k, k], (range(k, k + 2), range(k, k + 2))
            w = np.sqrt(K[k, k] / mass)
            ratio = D[k, k] / (2 * w * mass)
            if path.endswith("frequency"):
                w = 2 * np.pi * x
            else:
                ratio = x
            K[at], D[at] = mass * w**2, 2 * ratio * w * mass
    return dataclasses.replace(rotor, M=M, D=D, G=G, K=K, gravity=gravity)


def fastest_rotor(rotor: Rotor, spread: Spread) -> Rotor:
    """Return the rotor of the spread with the highest frequencies, for the choice of the integration step."""
    known, chosen = rotor_places(rotor), {}
    for path, kind in spread.entries:
        if path in known:
            ends = kind.support(float(np.asarray(known[path].value)))
            chosen[path] = ends[0] if path in ("rotor.m", "rotor.I_t") else max(ends, key=abs)
    return varied_rotor(rotor, chosen)
