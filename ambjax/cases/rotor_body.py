"""A rotor as mass, inertia and bending modes, from whatever a case file gives; readers of its numbers and its loads."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.named_files import CaseFiles
from ambjax.cases.scenario_tables import signal_from
from ambjax.cases.table import Table
from ambjax.numerics.records import leaf
from ambjax.world.rotation import GRAM_MM, UnbalanceGrade
from ambjax.world.rotor import BaseMotion, RotorLoad, RotorUnbalance
from ambjax.world.waveforms import Signal

PLACE = leaf(default=0.0, unit="m", at_least=-100.0, at_most=100.0, doc="place on the shaft")
MASS = leaf(unit="kg", at_least=1e-6, at_most=1e6, doc="mass")
I_T = leaf(unit="kg m^2", at_least=0.0, at_most=1e9, doc="moment of inertia about an axis across the shaft")
I_P = leaf(unit="kg m^2", at_least=0.0, at_most=1e9, doc="moment of inertia about the shaft")
FREQUENCY = leaf(unit="Hz", at_least=1e-3, at_most=1e6, doc="frequency of a bending mode, free and at rest")
DAMPING = leaf(default=0.005, unit="1", at_least=0.0, at_most=1.0, doc="damping ratio of the bending modes")
MODES = leaf(default=4, at_least=0, at_most=20, whole=True, doc="number of bending modes")

AMOUNT, PHASE = (field for field in dataclasses.fields(RotorUnbalance) if field.name in ("amount", "phase"))
GRADE = {field.name: field for field in dataclasses.fields(UnbalanceGrade)}


class RotorBody(NamedTuple):
    """Mass, inertia and bending modes of a rotor. Places of the case file minus `centre` are those from the centre.

    `gyroscopic` [2 + k, 2 + k]: as in `ShaftModel`. `shapes`: shapes [k] of the modes at a place of the case file;
    None: the tables give them.
    """

    m: float
    I_t: float
    I_p: float
    centre: float
    frequencies: np.ndarray
    dampings: np.ndarray
    gyroscopic: np.ndarray
    shapes: Callable[[float], np.ndarray] | None

    def place(self, table: Table, key: str = "at", modes: str = "modes", other: Any = None) -> tuple[float, np.ndarray]:
        """Return the distance (m) of a place from the centre of mass, and the shapes of the modes there.

        `other`: place (m) and shapes that are used if the table gives none; None: 0 and no motion.
        """
        count = len(self.frequencies)
        at, default = other or (self.centre, np.zeros(count))
        found = table.leaf(key, PLACE, at)
        if self.shapes is not None:
            return found - self.centre, self.shapes(found)
        needed = count and other is not None and found != at
        return found - self.centre, vector(table, modes, count, None if needed else default)


def needed(table: Table, key: str, field: Any) -> float:
    """Return a number that the table must give."""
    if key not in table.raw:
        raise ValueError(f"{table.at(key)} is missing: give the {field.metadata['doc']}, {field.metadata['unit']}.")
    return table.leaf(key, field)


def vector(table: Table, key: str, length: int, default: Any = None) -> np.ndarray:
    """Return a list of `length` numbers; `default` if it is left out."""
    if key not in table.raw and default is not None:
        return np.asarray(default, float)
    value = table.array(key, None, f"a list of {length} numbers")
    if value is None or np.shape(value) != (length,) or not np.all(np.isfinite(np.asarray(value, float))):
        raise table.refuse(key, f"it must be a list of {length} numbers.")
    return np.asarray(value, float)


def dampings_of(table: Table, default: np.ndarray) -> np.ndarray:
    """Return the damping ratio of each mode: the key `damping`, one number or a list; `default` if it is left out."""
    given = table.raw.get("damping")
    if given is None:
        return default
    if not isinstance(given, list):
        return np.full(len(default), table.leaf("damping", DAMPING))
    for x in vector(table, "damping", len(default)):
        Table({"damping": float(x)}, table.path).leaf("damping", DAMPING)
    return vector(table, "damping", len(default))


def row(at: float, direction: Any, shapes: np.ndarray) -> np.ndarray:
    """Return the displacement [n] along `direction` of the shaft at `at` (m) per unit of each coordinate."""
    x, y, z = direction
    return np.concatenate([[x, y, z, -at * y, at * x], np.outer(shapes, [x, y]).ravel()])


def unbalance_from(table: Table, body: RotorBody, graded: int) -> RotorUnbalance:
    """Return an unbalance. `graded`: number of planes that share the unbalance of a grade equally."""
    if "amount" in table.raw and "grade" in table.raw:
        raise ValueError(f"{table.at('grade')}: give amount, or grade and service_speed, not both.")
    own = ["grade", "service_speed"] if "grade" in table.raw else ["amount"]
    table.only(["at", *own, "phase", *(["modes"] if body.shapes is None else [])])
    at, shapes = body.place(table)
    x, y = (jnp.asarray(row(at, d, shapes)) for d in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    if "grade" in table.raw:
        G, service_speed = (needed(table, key, GRADE[key]) for key in own)
        grade = UnbalanceGrade(G, service_speed)
        amount = float(body.m * grade.eccentricity / GRAM_MM / graded)
    else:
        amount = needed(table, "amount", AMOUNT)
    return RotorUnbalance(amount, x, y, table.leaf("phase", PHASE, 0.0), graded="grade" in table.raw)


def load_from(table: Table, body: RotorBody, files: CaseFiles) -> RotorLoad:
    """Return a load on the rotor."""
    own = ("at", *(["modes"] if body.shapes is None else []))
    at, shapes = body.place(table)
    signal, direction = _directed(table, "N", files, own)
    return RotorLoad(signal, jnp.asarray(row(at, direction, shapes)))


def base_from(table: Table, n: int, files: CaseFiles) -> BaseMotion:
    """Return a motion of the stator. `n`: number of coordinates of the rotor."""
    signal, direction = _directed(table, "m/s^2", files)
    return BaseMotion(signal, jnp.concatenate([direction, jnp.zeros(n - 3)]))


def _directed(table: Table, unit: str, files: CaseFiles, own: tuple[str, ...] = ()) -> tuple[Signal, np.ndarray]:
    """Return the signal of a table and the unit vector of its `direction`. `own`: keys that are not the signal's."""
    direction = vector(table, "direction", 3)
    size = float(np.linalg.norm(direction))
    if size == 0:
        raise table.refuse("direction", "it must not be zero.")
    rest = Table({key: value for key, value in table.raw.items() if key not in ("direction", *own)}, table.path)
    signal = signal_from(rest, unit, files)
    if _turns(signal):
        raise ValueError(f"{table.path}: an unbalance turns with the rotor. Give it as [[unbalance]].")
    return signal, direction / size


def _turns(signal: Any) -> bool:
    """Return whether a part of a signal has the speed of the rotor."""
    return any(map(_turns, getattr(signal, "terms", ()))) or getattr(signal, "rotation", signal) is None
