"""The table [rotor] of one axis, and the loads and the runout that turn with it."""

import dataclasses
from typing import Any

from ambjax.cases.speed_table import SPEED, table_of_speeds
from ambjax.cases.table import Table
from ambjax.numerics.records import leaf
from ambjax.world.rotation import Rotation
from ambjax.world.scenario import SLOTS, Scenario

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
    parts = {
        f"disturbance.{slot if slot == 'base' else 'q_z'}": getattr(scenario, slot)
        for slot in SLOTS
        if slot != "reference"
    }
    parts["sensor.runout"] = scenario.sensor and scenario.sensor.runout
    for path, part in parts.items():
        for one in getattr(part, "terms", (part,)):
            if not hasattr(one, "rotation"):
                continue
            if one.rotation is None and scenario.rotor is None:
                raise ValueError(f"[rotor] is missing: {path} turns. Write [rotor] with speed = 3000.0, in rpm.")
            if one.rotation is not None and scenario.rotor is not None:
                raise ValueError(f"{path}.speed: it turns with [rotor]. Leave {', '.join(OWN_SPEED)} out.")
