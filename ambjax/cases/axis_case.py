"""The case of one axis of a machine: its tables, and messages that name the keys of the machine's file."""

import copy
import dataclasses
import math
import re
from typing import Any

import numpy as np

from ambjax.cases.machine_controller import axis_controller, merged
from ambjax.cases.reader import PLANTS, Case
from ambjax.cases.rotor_tables import OWN, BearingAxis
from ambjax.cases.scenario_tables import FIELDS
from ambjax.cases.table import Table, show
from ambjax.world.plant import Plant
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import POLE

# Tables of a machine that its axes do not have.
MACHINE_TABLES = ("rotor", "bearing", "unbalance", "load", "base")
# Numbers of a plant that follow from those of the rotor.
FROM_ROTOR = ("m", "k_z", "g")
# Tables in the lists of messages that are not those of an axis of a machine.
NOT_OF_MACHINE = re.compile(r"\b(rotor|initial|disturbance)(\.\w+)*\.\*, ")


def axis_tables(
    raw: dict[str, Any], bearing: Table, axis: BearingAxis, m: float, force: float, start: tuple[np.ndarray, float]
) -> dict[str, Any]:
    """Return the case of one axis: the common tables, what the bearing changes, and the rotor's share.

    `m` (kg), `force` (N): mass and weight that the axis carries. `start`: coordinates and current (A) at t = 0.
    """
    apart = (*MACHINE_TABLES, "initial", "tune", "spread")
    own = copy.deepcopy({key: value for key, value in raw.items() if key not in apart})
    if turning := {key: raw["rotor"][key] for key in ("speed", "acceleration") if key in raw["rotor"]}:
        own["rotor"] = {"speed": 0.0, **turning}
    for table in OWN:
        if table in bearing.raw:
            own[table] = merged(own.get(table, {}), bearing.table(table).raw)
    plant = own.get("plant", {})
    for table in (Table(raw).table("plant"), bearing.table("plant")):
        _check_plant(table, PLANTS.get(str(plant.get("kind")), Plant))
    own["plant"] = plant | {"m": m, "k_z": 0.0, "g": force / m}
    run = Table(own).table("run").raw
    if "clearance" in bearing.raw:
        own["run"] = run | {"clearance": bearing.leaf("clearance", FIELDS["clearance"])}
    axis_controller(own)
    if isinstance(own.get("sensitivity"), dict):
        own["sensitivity"].pop("speeds", None)
    limited, (q, i) = axis.magnet if "stop_stiffness" in run else axis.stop, start
    return own | {"initial": {"z": float(limited @ q), "i": i}}


def with_runout_at(axis: BearingAxis, case: Case) -> Case:
    """Return the case of a radial axis with the runout that its sensor reads: its angle later than one along x."""
    sensor, (x, y) = case.scenario.sensor, axis.sensor[:2]
    if sensor is None or sensor.runout is None or not (x or y):
        return case
    angle = math.atan2(y, x)
    later = [dataclasses.replace(one, phase=one.phase - one.number * angle) for one in sensor.runout.harmonics]
    runout = dataclasses.replace(sensor.runout, harmonics=tuple(later))
    return dataclasses.replace(case, scenario=case.scenario.with_sensor(runout=runout))


def _check_plant(table: Table, kind: type) -> None:
    """Raise ValueError for a number that the rotor gives, or for an unknown key. `kind`: of the plant."""
    for name in FROM_ROTOR:
        if name in table.raw:
            given = show(table.raw[name])
            raise ValueError(f"{table.at(name)} = {given}: the rotor gives it. Leave it out beside [rotor].")
    names = [field.name for field in dataclasses.fields(kind) if field.name not in FROM_ROTOR]
    table.only(["kind", "iron", *(name for name in names if name != "iron")], ("rotor.m", "rotor.gravity"))


def as_written(message: str, raw: dict[str, Any], bearing: Table, axis: BearingAxis) -> str:
    """Return a message about the case of an axis with the path that the machine's file `raw` has."""
    name, label = axis.name.rpartition(".")[::2]
    message = NOT_OF_MACHINE.sub("", message.replace("initial.z =", "initial.q: at this axis z =", 1))
    for key, whole in (("m", "rotor.m and the places of the bearings"), ("g", "rotor.gravity and these places")):
        message = re.sub(rf"^plant\.{key} =", f"{whole}: of the share of this axis, {key} =", message)
    found = re.match(r"\w+(\.\w+)*", message)
    first, *others = found[0].split(".") if found else [""]
    if (first, *others) == ("run", "clearance") and "clearance" in bearing.raw:
        return message.replace("run.clearance", bearing.at("clearance"), 1)
    if first in OWN and _has(bearing.raw, [first, *others]):
        return f"{bearing.path}.{message}"
    for own in (["bearing", name, label], ["bearing", name]):
        if first == "spread" and _has(raw, ["spread", *own, *others]):
            return message.replace("spread", ".".join(["spread", *own]), 1)
    return message


def _has(raw: object, keys: list[str]) -> bool:
    return not keys or (isinstance(raw, dict) and keys[0] in raw and _has(raw[keys[0]], keys[1:]))


def check_axis(case: Case, axis: BearingAxis, force: float, q: np.ndarray) -> None:
    """Raise ValueError if the magnet of an axis cannot carry `force` (N), or touches the rotor at the start q."""
    most, gap = float(case.scenario.largest_force), POLE * float(case.scenario.plant.s_0)
    if abs(force) > most:
        raise ValueError(
            f"axis {axis.name}: it must carry {abs(force):.4g} N, and its magnet gives at most {most:.4g} N at the "
            "centre. Increase plant.n, plant.A, plant.i_0 or the limits of [actuator], or reduce plant.s_0."
        )
    if abs(z := float(axis.magnet @ q)) >= gap:
        why = f"the rotor would touch it; |z| must be below {gap:g} m."
        raise ValueError(f"axis {axis.name}: initial.q: at the magnet z = {z:g} m: {why}")


def stop_slope(rotor: Rotor, cases: list[Case]) -> float:
    """Return the largest slope (1/s) of the rotor on an elastic stop at a place of its own; 0 without.

    `cases`: those of the axes, first.
    """
    if rotor.at_stops is None:
        return 0.0
    rows, stops = np.asarray(rotor.at_stops), [case.scenario.stop for case in cases]
    masses = 1 / np.sum(rows * np.linalg.solve(np.asarray(rotor.M), rows.T).T, 1)
    return max((float(stop.slope(m)) for stop, m in zip(stops, masses, strict=False) if stop is not None), default=0.0)
