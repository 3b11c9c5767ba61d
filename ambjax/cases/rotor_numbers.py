"""The numbers of a rotor, its unbalances and its loads that vary between machines, by dotted path."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from ambjax.cases.rotor_tables import DAMPING, FREQUENCY, I_P, I_T, MASS, RIGID
from ambjax.ensemble.paths import Place, numbers_in, with_number
from ambjax.ensemble.spread import Spread
from ambjax.numerics.records import leaf
from ambjax.world.rotation import Rotation
from ambjax.world.rotor import Rotor

SPEED = ("rotor.speed", "rotor.acceleration")
# First word of the paths of one bearing or one axis.
OF_BEARING = "bearing"
# Shapes of a bending mode: keys of a bearing, for its magnet and its sensor, with their rows of a rotor; and a factor.
SHAPES = {"modes": "at_magnets", "sensor_modes": "at_sensors"}
SHAPE = leaf(unit="1/kg^0.5", at_least=-1e6, at_most=1e6, doc="shape of a bending mode, mass-normalised")
FACTOR = leaf(unit="1", at_least=0.0, at_most=1e3, doc="factor of the shape of a bending mode at all places")


def rotor_places(rotor: Rotor, names: Sequence[str]) -> dict[str, Place]:
    """Return the numbers of a rotor, its unbalances and its loads by dotted path. `names`: of the axes.

    The frequencies and dampings of the bending modes are those of a rotor with diagonal stiffness and damping.
    """
    M, K, D, G = (np.asarray(x) for x in (rotor.M, rotor.K, rotor.D, rotor.G))
    table = {
        "rotor.m": Place((), MASS, M[0, 0]),
        "rotor.I_t": Place((), I_T, M[3, 3]),
        "rotor.I_p": Place((), I_P, G[3, 4]),
    }
    numbers = dict(numbers_in(rotor, "rotor", ()))
    # a table of speeds has no rate of its own
    table |= {path: numbers[path] for path in SPEED[: 1 if rotor.changes else 2]}
    w = np.sqrt(np.diag(K)[RIGID::2] / np.diag(M)[RIGID::2])
    for j, (own, d) in enumerate(zip(w, np.diag(D)[RIGID::2], strict=True)):
        table[f"rotor.modes.{j}.frequency"] = Place((), FREQUENCY, own / (2 * np.pi))
        table[f"rotor.modes.{j}.damping"] = Place((), DAMPING, d / (2 * own * M[RIGID + 2 * j, RIGID + 2 * j]))
        table[f"rotor.modes.{j}.scale"] = Place((), FACTOR, 1.0)
    for path, rows, k, at in _shape_rows(rotor, names):
        one = np.asarray(getattr(rotor, rows))[k]
        table[path] = Place((), SHAPE, one[at] @ one[:2])
    for stem, name in (("rotor.unbalances.", "unbalance."), ("rotor.loads.", "load."), ("rotor.base.", "base.")):
        own = {path: place for path, place in numbers.items() if path.startswith(stem) and ".along" not in path}
        table |= {path.replace(stem, name).replace(".signal.", ".", 1): x for path, x in own.items()}
    return table


def _shape_rows(rotor: Rotor, names: Sequence[str]) -> Iterator[tuple[str, str, int, slice]]:
    """Yield the path of each shape at a bearing, and where it is: matrix of rows, axis, and columns x and y."""
    rows = np.asarray(rotor.at_magnets)
    for k, name in enumerate(names):
        for j in range((rows.shape[1] - RIGID) // 2 if np.any(rows[k, :2]) else 0):
            for key, matrix in SHAPES.items():
                at = slice(RIGID + 2 * j, RIGID + 2 * j + 2)
                yield f"{OF_BEARING}.{name.rpartition('.')[0]}.{key}.{j}", matrix, k, at


def varied_rotors(rotor: Rotor, values: Mapping[str, Any], names: Sequence[str]) -> Rotor:
    """Return the rotors of members: the values of `rotor_places` are arrays [N], and so is each leaf, [N, ...].

    Without values it is the rotor itself.
    """
    known = rotor_places(rotor, names)
    own = {path: np.asarray(x, float) for path, x in values.items() if path in known}
    if not own:
        return rotor
    members = [varied_rotor(rotor, dict(zip(own, row, strict=True)), names) for row in zip(*own.values(), strict=True)]
    return jax.tree.map(lambda *x: np.stack(x), *members)


def varied_rotor(rotor: Rotor, values: Mapping[str, float], names: Sequence[str] = ()) -> Rotor:
    """Return the rotor with these numbers of `rotor_places`. `names`: of the axes.

    The weight and the unbalance of a grade follow the mass. The polar inertia scales the gyroscopic terms of the
    bending modes too.
    """
    known = rotor_places(rotor, names)
    M, D, G, K, gravity = (np.array(x, float) for x in (rotor.M, rotor.D, rotor.G, rotor.K, rotor.gravity))
    for path, x in values.items():
        if known[path].route:
            rotor = with_number(rotor, known[path].route, x)
        elif path == "rotor.m":
            ratio = x / M[0, 0]
            M[range(3), range(3)], gravity = x, gravity * ratio
            for k, one in enumerate(rotor.unbalances):
                if one.graded and f"unbalance.{k}.amount" not in values:
                    rotor = with_number(rotor, ("unbalances", k, "amount"), one.amount * ratio)
        elif path == "rotor.I_t":
            M[(3, 4), (3, 4)] = x
        elif path == "rotor.I_p":
            G *= x / G[3, 4] if G[3, 4] else 1.0
            G[3, 4], G[4, 3] = x, -x
        elif path.endswith((".frequency", ".damping")):
            k = RIGID + 2 * int(path.split(".")[2])
            mass, at = M[k, k], (range(k, k + 2), range(k, k + 2))
            w = np.sqrt(K[k, k] / mass)
            ratio = D[k, k] / (2 * w * mass)
            if path.endswith("frequency"):
                w = 2 * np.pi * x
            else:
                ratio = x
            K[at], D[at] = mass * w**2, 2 * ratio * w * mass
    rotor = _with_shapes(rotor, values, names)
    return dataclasses.replace(rotor, M=M, D=D, G=G, K=K, gravity=gravity)


def _with_shapes(rotor: Rotor, values: Mapping[str, float], names: Sequence[str]) -> Rotor:
    """Return the rotor with the shapes at its bearings, then with the factors of its modes at all places."""
    matrices = {matrix: np.array(getattr(rotor, matrix), float) for matrix in SHAPES.values()}
    for path, matrix, k, at in _shape_rows(rotor, names):
        if path in values:
            matrices[matrix][k, at] = values[path] * matrices[matrix][k, :2]
    factors = np.ones(len(rotor.gravity))
    for j in range((len(factors) - RIGID) // 2):
        factors[RIGID + 2 * j : RIGID + 2 * j + 2] = values.get(f"rotor.modes.{j}.scale", 1.0)
    return dataclasses.replace(
        rotor,
        **{matrix: rows * factors for matrix, rows in matrices.items()},
        unbalances=tuple(
            dataclasses.replace(one, along_x=one.along_x * factors, along_y=one.along_y * factors)
            for one in rotor.unbalances
        ),
        loads=tuple(dataclasses.replace(one, along=one.along * factors) for one in rotor.loads),
    )


def widest_rotation(rotor: Rotor, spread: Spread) -> Rotation:
    """Return the speed of the rotor; its numbers that vary are arrays with both ends, in all combinations."""
    own = [(path.removeprefix("rotor."), kind) for path, kind in spread.entries if path in SPEED]
    ends = [kind.support(float(np.asarray(getattr(rotor, name)))) for name, kind in own]
    grid = np.meshgrid(*ends, indexing="ij")
    return dataclasses.replace(rotor.rotation, **{name: x for (name, _), x in zip(own, grid, strict=True)})


def fastest_rotor(rotor: Rotor, spread: Spread) -> Rotor:
    """Return the rotor of the spread with the highest frequencies, for the choice of the integration step."""
    known, chosen = rotor_places(rotor, ()), {}
    for path, kind in spread.entries:
        if path in known:
            ends = kind.support(float(np.asarray(known[path].value)))
            chosen[path] = ends[0] if path in ("rotor.m", "rotor.I_t") else max(ends, key=abs)
    return varied_rotor(rotor, chosen)
