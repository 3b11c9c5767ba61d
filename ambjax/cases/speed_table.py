"""The speed of [rotor]: a number with a rate, or a table of speeds over time."""

import dataclasses

import numpy as np

from ambjax.cases.table import Table, show
from ambjax.world.rotation import Rotation, SpeedChange

SPEED, ACCELERATION = (field for field in dataclasses.fields(Rotation) if field.name in ("speed", "acceleration"))
(AT,) = (field for field in dataclasses.fields(SpeedChange) if field.name == "at")


def table_of_speeds(table: Table) -> Rotation | None:
    """Return the speed of `speed = { times, rpm }`, linear between the times and constant outside; None: no table."""
    if not isinstance(table.raw.get("speed"), dict):
        return None
    for key in ("acceleration", "speed_end"):
        if key in table.raw:
            raise ValueError(f"{table.at(key)}: rotor.speed is a table, which gives it. Leave {key} out.")
    own = table.table("speed")
    own.only(["times", "rpm"])
    times, rpm = ([one.leaf(key, field) for key in one.raw] for one, field in _columns(own))
    if len(times) < 2 or len(times) != len(rpm) or np.any(np.diff(times) <= 0):
        raise ValueError(
            f"{own.path} = {show(own.raw)}: it must have two or more times (s), ascending, and one rpm for each."
        )
    rates = [0.0, *(np.diff(rpm) / np.diff(times)).tolist(), 0.0]
    changes = [SpeedChange(t, by) for t, by in zip(times, np.diff(rates).tolist(), strict=True)]
    if times[0] > 0:
        return Rotation(rpm[0], changes=tuple(changes))
    return Rotation(rpm[0], rates[1], changes=tuple(changes[1:]))


def speed_of(table: Table) -> Rotation:
    """Return the speed of the table [rotor] of a machine."""
    return table_of_speeds(table) or Rotation(
        table.leaf("speed", SPEED, 0.0), table.leaf("acceleration", ACCELERATION, 0.0)
    )


def _columns(own: Table) -> list[tuple[Table, dataclasses.Field]]:
    """Return the lists of times and speeds, each as a table with a key for each number, and their bounds."""
    columns = []
    for key, field in (("times", AT), ("rpm", SPEED)):
        values = own.raw.get(key)
        if not isinstance(values, list):
            raise ValueError(f"{own.at(key)} = {show(values)}: it must be a list of numbers.")
        columns.append((Table({f"{key}.{n}": x for n, x in enumerate(values)}, own.path), field))
    return columns
