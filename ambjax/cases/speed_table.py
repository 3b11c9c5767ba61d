"""The speed of [rotor], a number with a rate or a table over time, and the loads of one axis that turn with it."""

import dataclasses
import math
from typing import Any

import numpy as np

from ambjax.cases.table import Table
from ambjax.numerics.records import leaf
from ambjax.world.rotation import Rotation, SpeedChange
from ambjax.world.scenario import SLOTS, Scenario

SPEED, ACCELERATION = (field for field in dataclasses.fields(Rotation) if field.name in ("speed", "acceleration"))
(AT,) = (field for field in dataclasses.fields(SpeedChange) if field.name == "at")
# Largest number of speeds in a list.
MOST_SPEEDS = 100


def table_of_speeds(table: Table) -> Rotation | None:
    """Return the speed of `speed = { times, rpm }`, linear between the times and constant outside; None: no table."""
    if not isinstance(table.raw.get("speed"), dict):
        return None
    for key in ("acceleration", "speed_end"):
        if key in table.raw:
            raise ValueError(f"{table.at(key)}: rotor.speed is a table, which gives it. Leave {key} out.")
    own = table.table("speed")
    own.only(["times", "rpm"])
    times, rpm = own.column("times", field=AT), own.column("rpm", field=SPEED)
    if len(times) < 2 or len(times) != len(rpm) or np.any(np.diff(times) <= 0):
        raise table.refuse("speed", "it must have two or more times (s), ascending, and one rpm for each.")
    rates = [0.0, *(np.diff(rpm) / np.diff(times)).tolist(), 0.0]
    changes = [SpeedChange(t, by) for t, by in zip(times, np.diff(rates).tolist(), strict=True)]
    if times[0] > 0:
        return Rotation(rpm[0], changes=tuple(changes))
    return Rotation(rpm[0], rates[1], changes=tuple(changes[1:]))


def listed_speeds(table: Table, most: int) -> list[float]:
    """Return the key `speeds`, rpm: a list, or a range of equal steps, as in `ambjax map`. `most`: of them."""
    value = table.raw["speeds"]
    values = _range(value) if isinstance(value, str) else value
    if not isinstance(values, list) or not 0 < len(values) <= most:
        ranges = f'a range "LOW:HIGH:COUNT" of 2 to {most}, as "0:6000:7"'
        raise table.refuse("speeds", f"it must be a list of 1 to {most} speeds (rpm), or {ranges}.")
    speeds = [Table({f"speeds[{k}]": x}, table.path).leaf(f"speeds[{k}]", SPEED) for k, x in enumerate(values)]
    if (twice := next((x for x in speeds if speeds.count(x) > 1), None)) is not None:
        raise table.refuse("speeds", f"{twice:g} rpm is given more than once. Give it once.")
    return speeds


def _range(text: str) -> list[float] | None:
    try:
        first, last, number = text.split(":")
        low, high, count = float(first), float(last), int(number)
    except ValueError:
        return None
    good = -math.inf < low < high < math.inf and 2 <= count <= MOST_SPEEDS
    return np.linspace(low, high, count).tolist() if good else None


def speed_of(table: Table) -> Rotation:
    """Return the speed of the table [rotor] of a machine."""
    if turning := table_of_speeds(table):
        return turning
    return Rotation(table.leaf("speed", SPEED, 0.0), table.leaf("acceleration", ACCELERATION, 0.0))


RUN_UP = leaf(default=1.0, unit="s", at_least=1e-9, at_most=1e9, doc="duration of the run-up")
# Keys of a load or a runout with a speed of its own, in a case without [rotor].
OWN_SPEED = ("speed", "speed_end", "duration")


def rotation_from(table: Table) -> Rotation:
    """Return the speed of [rotor]. Raises ValueError for an invalid one."""
    if turning := table_of_speeds(table):
        table.only(["speed"])
        return turning
    rotation = table.record(Rotation)
    rotation.check(table.path)
    return rotation


def turning_from(table: Table, kind: type, extra: tuple[str, ...]) -> Any:
    """Return the load or the runout of a table. Without keys of a speed, its speed is that of [rotor]."""
    rest = Table({key: value for key, value in table.raw.items() if key not in OWN_SPEED}, table.path)
    made = rest.record(kind, extra)
    if len(rest.raw) == len(table.raw):
        return made
    if "speed" not in table.raw:
        raise ValueError(f"{table.at('speed')} is missing: give it (rpm), or all keys of the speed in [rotor].")
    speed, end = (table.leaf(key, SPEED) for key in OWN_SPEED[:2])
    rate = 0.0 if end is None else (end - speed) / table.leaf("duration", RUN_UP, RUN_UP.default)
    return dataclasses.replace(made, rotation=Rotation(speed, rate, end if rate else None))


def check_turning(scenario: Scenario) -> None:
    """Raise ValueError if a load or the runout has no speed, or has its own beside [rotor]."""
    parts = [(f"disturbance.{'base' if slot == 'base' else 'q_z'}", getattr(scenario, slot)) for slot in SLOTS[1:]]
    for path, part in [*parts, ("sensor.runout", scenario.sensor and scenario.sensor.runout)]:
        for one in getattr(part, "terms", (part,)):
            if not hasattr(one, "rotation"):
                continue
            if one.rotation is None and scenario.rotor is None:
                raise ValueError(f"[rotor] is missing: {path} turns. Write [rotor] with speed = 3000.0, in rpm.")
            if one.rotation is not None and scenario.rotor is not None:
                raise ValueError(f"{path}.speed: it turns with [rotor]. Leave {', '.join(OWN_SPEED)} out.")
