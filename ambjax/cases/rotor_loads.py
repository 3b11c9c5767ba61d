"""Readers of [[unbalance]], [[load]] and [[base]] of a machine: what acts on the rotor besides its bearings."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from ambjax.cases.recordings import Recordings
from ambjax.cases.rotor_body import RotorBody, needed, row, vector
from ambjax.cases.scenario_tables import signal_from
from ambjax.cases.table import Table, show
from ambjax.world.rotation import GRAM_MM, UnbalanceGrade
from ambjax.world.rotor import BaseMotion, RotorLoad, RotorUnbalance
from ambjax.world.waveforms import Signal

AMOUNT, PHASE = (field for field in dataclasses.fields(RotorUnbalance) if field.name in ("amount", "phase"))
GRADE = {field.name: field for field in dataclasses.fields(UnbalanceGrade)}


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


def load_from(table: Table, body: RotorBody, recordings: Recordings) -> RotorLoad:
    """Return a load on the rotor."""
    own = ("at", *(["modes"] if body.shapes is None else []))
    at, shapes = body.place(table)
    signal, direction = _directed(table, "N", recordings, own)
    return RotorLoad(signal, jnp.asarray(row(at, direction, shapes)))


def base_from(table: Table, n: int, recordings: Recordings) -> BaseMotion:
    """Return a motion of the stator. `n`: number of coordinates of the rotor."""
    signal, direction = _directed(table, "m/s^2", recordings)
    return BaseMotion(signal, jnp.concatenate([direction, jnp.zeros(n - 3)]))


def _directed(table: Table, unit: str, recordings: Recordings, own: tuple[str, ...] = ()) -> tuple[Signal, np.ndarray]:
    """Return the signal of a table and the unit vector of its `direction`. `own`: keys that are not the signal's."""
    direction = vector(table, "direction", 3)
    size = float(np.linalg.norm(direction))
    if size == 0:
        raise ValueError(f"{table.at('direction')} = {show(table.raw['direction'])}: it must not be zero.")
    rest = Table({key: value for key, value in table.raw.items() if key not in ("direction", *own)}, table.path)
    signal = signal_from(rest, unit, recordings)
    if _turns(signal):
        raise ValueError(f"{table.path}: an unbalance turns with the rotor. Give it as [[unbalance]].")
    return signal, direction / size


def _turns(signal: Any) -> bool:
    """Return whether a part of a signal has the speed of the rotor."""
    return any(map(_turns, getattr(signal, "terms", ()))) or getattr(signal, "rotation", signal) is None
