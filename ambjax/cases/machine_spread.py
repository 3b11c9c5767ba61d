"""The table [spread] of a machine: distributions of numbers of the rotor, and of each axis."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ambjax.cases.axis_case import FROM_ROTOR
from ambjax.cases.machine_controller import merged
from ambjax.cases.reader import Case
from ambjax.cases.rotor_numbers import OF_BEARING, SHAPES, rotor_places
from ambjax.cases.rotor_tables import COORDINATES, BearingAxis
from ambjax.cases.table import Table
from ambjax.cases.variation import entries_of, is_distribution
from ambjax.ensemble.distributions import Distribution, Uniform
from ambjax.ensemble.paths import Place, places
from ambjax.ensemble.spread import Spread, SpreadError, check_entries, check_spread
from ambjax.numerics.records import leaf
from ambjax.world.rotor import Rotor

# First words of the paths of the rotor, and of its start.
OF_ROTOR, OF_START = ("rotor", "unbalance", "load", "base"), "initial"
START = "initial.q."
# A table that a machine does not have.
ABSENT = "disturbance"
# Coordinates of the rigid rotor at t = 0.
OFFSET = leaf(unit="m", at_least=-10.0, at_most=10.0, doc="displacement of the centre of mass at t = 0")
TILT = leaf(unit="rad", at_least=-10.0, at_most=10.0, doc="tilt at t = 0")
# Numbers that all axes share, and those of the case of an axis that its machine replaces.
COMMON, NOT_OF_AXIS = "processor.", ("rotor.", "initial.", "disturbance.")


def axis_table(raw: dict[str, Any], axis: BearingAxis, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the table [spread] of the case of one axis: the common paths, then those of its bearing and of the axis.

    The second table is that of the notch, which the case of an axis does not have. `name`: of the bearing. Raises
    ValueError, one line, for a number that an axis does not have of its own.
    """
    table = Table(raw).table("spread")
    own = table.table(OF_BEARING).table(name)
    of_axis = own.table(axis.name.removeprefix(f"{name}."))
    parts = [table.raw, {key: value for key, value in own.raw.items() if key not in SHAPES}, of_axis.raw]
    for key in (*OF_ROTOR, OF_START):
        if any(key in part for part in parts[1:]):
            raise ValueError(f"spread.{OF_BEARING}.{name}.{key}: it belongs to the whole rotor. Spread {key} instead.")
    joined: dict[str, Any] = {}
    for part in parts:
        joined = merged(joined, part, lambda x: not is_distribution(x))
    dropped = (*OF_ROTOR, OF_START, OF_BEARING, "x", "y", "z")
    joined = {key: value for key, value in joined.items() if key not in dropped}
    if ABSENT in joined:
        raise ValueError(f"spread.{ABSENT}: the members of a machine do not vary it. Leave it out.")
    for key in FROM_ROTOR:
        if isinstance(joined.get("plant"), dict) and key in joined["plant"]:
            raise ValueError(f"spread.plant.{key}: the rotor gives it. Spread rotor.m instead.")
    notch, laws = {}, joined.get("controller")
    if isinstance(laws, dict) and "notch" in laws:
        notch, laws = {"notch": laws["notch"]}, {key: value for key, value in laws.items() if key != "notch"}
        joined = {key: laws if key == "controller" else x for key, x in joined.items() if key != "controller" or laws}
    return {"spread": joined} if joined else {}, notch


def with_notches(
    spread: Spread, tables: Sequence[dict[str, Any]], axes: Sequence[BearingAxis], cases: Sequence[Case]
) -> Spread:
    """Return the spread with the numbers of the notches. `tables`: of each axis, as `axis_table` returns them."""
    entries = list(spread.entries)
    for table, axis, case in zip(tables, axes, cases, strict=True):
        known = places(case.cascade, case.scenario)
        own = entries_of(table, "controller.", list(known))
        check_entries(Spread(tuple(own)), known)
        entries += [(f"{OF_BEARING}.{axis.name}.{path}", kind) for path, kind in own]
    return dataclasses.replace(spread, entries=tuple(entries))


def refuse_unused(spread: Spread, output: str) -> None:
    """Raise ValueError for a number of laws that an axis lacks because one law commands all. `output`: of that law."""
    unused = ("observer", "position", "model", *(["current"] if output == "voltage" else []))
    for path, _ in spread.entries:
        if any(f".controller.{part}." in path for part in unused):
            raise ValueError(f"spread.{path}: one law commands all axes, so an axis has none. Leave it out.")


def machine_spread(
    top: Table, rotor: Rotor, q: np.ndarray, axes: Sequence[BearingAxis], names: list[str], cases: list[Case]
) -> Spread:
    """Return the spread of a machine. Each axis varies independently, except for the numbers of the processor.

    `q`: coordinates at t = 0. `names`: of the bearings. `cases`: those of the axes, with their own spreads. Raises
    ValueError for an invalid entry of the rotor or its start, for a start beyond a stop, or for an unknown bearing.
    """
    raw = top.table("spread").raw
    bearings, shapes = Table(raw, "spread").table(OF_BEARING), {}
    for name in bearings.raw:
        own = bearings.table(name).raw
        shapes[name] = {key: own[key] for key in SHAPES if key in own}
        labels = [axis.name.removeprefix(f"{name}.") for axis in axes if axis.name.startswith(f"{name}.")]
        if name not in names:
            raise ValueError(f"spread.{OF_BEARING}.{name}: there is no such bearing. There are: {', '.join(names)}.")
        if wrong := [key for key in own if key in ("x", "y", "z") and key not in labels]:
            raise ValueError(f"spread.{OF_BEARING}.{name}.{wrong[0]}: its axes are {', '.join(labels)}.")
    known = rotor_places(rotor, [axis.name for axis in axes]) | start_places(q)
    given = {key: value for key, value in raw.items() if key in (*OF_ROTOR, OF_START)}
    entries = entries_of(given, "", list(known))
    entries += entries_of({name: own for name, own in shapes.items() if own}, f"{OF_BEARING}.", list(known))
    check_entries(Spread(tuple(entries)), known)
    _check_start(entries, q, axes, cases)
    for k, (axis, case) in enumerate(zip(axes, cases, strict=True)):
        for path, kind in case.spread.entries:
            if not path.startswith(COMMON):
                entries.append((f"{OF_BEARING}.{axis.name}.{path}", kind))
            elif k == 0:
                entries.append((path, kind))
    return Spread(tuple(entries), cases[0].spread.design)


def _check_start(
    entries: Iterable[tuple[str, Distribution]], q: np.ndarray, axes: Sequence[BearingAxis], cases: Sequence[Case]
) -> None:
    """Raise ValueError if a member may start beyond the stop of an axis. `q`: coordinates of the nominal start."""
    ends = np.stack([q, q])
    for path, kind in entries:
        if path.startswith(START):
            k = int(path.removeprefix(START))
            ends[:, k] = kind.support(float(q[k]))
    for axis, case in zip(axes, cases, strict=True):
        reach = (axis.stop if case.scenario.stop is None else axis.magnet) * ends
        low, high = float(reach.min(0).sum()), float(reach.max(0).sum())
        if low < high:
            own = Spread((*case.spread.entries, ("initial.z", Uniform(low, high))))
            try:
                check_spread(own, case.cascade, case.scenario)
            except SpreadError as error:
                reason = error.reason.replace("initial.z", "z")
                raise ValueError(f"spread.initial.q: at axis {axis.name}, {reason}") from None


def machine_places(rotor: Rotor, q: Any, names: Sequence[str], cases: Sequence[Case]) -> dict[str, Place]:
    """Return every number of a machine that may vary, by dotted path. `q`: start. `names`: of the axes."""
    table = rotor_places(rotor, names) | start_places(q)
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
