"""The tables of a case file that make its scenario: reference, disturbances, sensors, actuator and start."""

import dataclasses
import math
from typing import Any

from ambjax.cases.named_files import CaseFiles
from ambjax.cases.speed_table import OWN_SPEED, check_turning, rotation_from, turning_from
from ambjax.cases.table import Table
from ambjax.numerics.records import leaf
from ambjax.simulation.clock import Clock
from ambjax.world import waveforms
from ambjax.world.amplifier import Amplifier, CoilLimits, CurrentAmplifier
from ambjax.world.bearing import Bearing
from ambjax.world.faults import VALUES, Dropouts, Outliers
from ambjax.world.ramps import Ramp, Trapezoid
from ambjax.world.recorded import BandNoise, Recorded
from ambjax.world.rotation import Harmonic, Runout, Unbalance, UnbalanceGrade
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.sensor import Sensor
from ambjax.world.touchdown import Stop

# The signals by kind.
SIGNALS: dict[str, type] = {
    "constant": waveforms.Constant,
    "step": waveforms.Step,
    "pulse": waveforms.Pulse,
    "sine": waveforms.Sine,
    "smoothstep": waveforms.SmoothStep,
    "chirp": waveforms.Chirp,
    "band-noise": BandNoise,
    "ramp": Ramp,
    "trapezoid": Trapezoid,
    "table": Recorded,
    "unbalance": Unbalance,
    "unbalance-grade": UnbalanceGrade,
    "sum": waveforms.Sum,
}
# Units of the signals that fix their unit.
FIXED_UNITS = {kind: signal.unit for kind, signal in SIGNALS.items() if hasattr(signal, "unit")}
# The units of each disturbance, and the field of the scenario for each unit. The default is the unit that the signal
# fixes (FIXED_UNITS), or else the first.
UNITS = {"q_z": {"m/s^2": "q_z", "N": "q_f", "A^2/m^2": "q_v"}, "q_i": {"A/s": "q_i"}, "base": {"m/s^2": "base"}}
# Largest number of terms of a sum, of signals that disturb the same quantity, and of harmonics of a runout. Each of
# them is compiled.
MOST_TERMS = 100
# The amplifiers by actuator.mode, the default first.
AMPLIFIERS: dict[str, type] = {kind.mode: kind for kind in (Amplifier, CurrentAmplifier)}
SETTLE = leaf(default=0.5, unit="s", at_least=0, at_most=1e6, doc='time from which "settled" metrics count')
STOP = {field.name: field for field in dataclasses.fields(Stop)}
FIELDS = {field.name: field for kind in (Scenario, Clock) for field in dataclasses.fields(kind)}


def signal_from(table: Table, unit: str, files: CaseFiles, extra: tuple[str, ...] = ()) -> Any:
    """Return the signal of a table, whose values are in `unit`. `extra`: further keys that the table may have."""
    kind = table.choice("kind", list(SIGNALS))
    if kind == "sum":
        table.only(["kind", "terms", *extra])
        return waveforms.Sum(tuple(signal_from(part, unit, files) for part in _several(table, "terms")))
    if kind == "table":
        return files.signal(table, extra)
    turns = "rotation" in {field.name for field in dataclasses.fields(SIGNALS[kind])}
    made = (turning_from if turns else Table.record)(table, SIGNALS[kind], ("kind", *extra))
    if (own := FIXED_UNITS.get(kind, unit)) != unit:
        fix = " Omit `unit`." if "unit" in table.raw else ""
        raise ValueError(f'{table.at("kind")} = "{kind}": it gives {own}, but a signal in {unit} belongs here.{fix}')
    return made


def _disturbances(table: Table, files: CaseFiles) -> dict[str, Any]:
    """Return the disturbances by field of the scenario. Several signals of the same field become a sum."""
    table.only(list(UNITS))
    found: dict[str, list[Any]] = {}
    for name, slots in UNITS.items():
        for one in _each(table, name) if name in table.raw else ():
            unit = one.choice("unit", list(slots), usual_unit(name, one.raw))
            found.setdefault(slots[unit], []).append(signal_from(one, unit, files, extra=("unit",)))
    return {slot: made[0] if len(made) == 1 else waveforms.Sum(tuple(made)) for slot, made in found.items()}


def usual_unit(name: str, raw: dict[str, Any]) -> str:
    """Return the unit of a disturbance `name` whose table `raw` gives none."""
    own = [unit for unit in UNITS[name] if unit == FIXED_UNITS.get(str(raw.get("kind")))]
    return [*own, *UNITS[name]][0]


def _each(table: Table, name: str) -> list[Table]:
    """Return the tables of a key: its one table, or its list of tables, written as [[disturbance.q_z]]."""
    return _several(table, name) if isinstance(table.raw[name], list) else [table.table(name)]


def _several(table: Table, key: str, words: str = "signal tables") -> list[Table]:
    """Return the tables of a list of 1 to MOST_TERMS."""
    raw = table.raw.get(key)
    if not isinstance(raw, list) or not 0 < len(raw) <= MOST_TERMS:
        raise table.refuse(key, f"it must be a list of 1 to {MOST_TERMS} {words}.")
    return table.tables(key)


def scenario_from(top: Table, plant: Bearing, files: CaseFiles) -> tuple[Scenario, float | None]:
    """Return the scenario, and run.settle (s) or None. Raises ValueError for invalid tables."""
    actuator, run = top.table("actuator"), top.table("run")
    run.only(["seed", "settle", "clearance", *(f"stop_{name}" for name in STOP)])
    settle = run.leaf("settle", SETTLE)
    scenario = Scenario(
        plant=plant,
        reference=signal_from(top.table("reference"), "m", files) if "reference" in top.raw else waveforms.Constant(),
        rotor=rotation_from(top.table("rotor")) if "rotor" in top.raw else None,
        sensor=_sensor(top.table("sensor")) if "sensor" in top.raw else None,
        initial=top.table("initial").record(Initial),
        u_max=actuator.leaf("u_max", FIELDS["u_max"], math.inf),
        amplifier=_amplifier(actuator),
        clearance=run.leaf("clearance", FIELDS["clearance"]),
        stop=_stop(run),
        seed=run.leaf("seed", FIELDS["seed"], 0),
        **_disturbances(top.table("disturbance"), files),
    )
    check_turning(scenario)
    return scenario, settle


def drive(actuator: Table) -> str:
    """Return actuator.mode: "voltage" or "current". Raises ValueError for another one."""
    return actuator.choice("mode", list(AMPLIFIERS), next(iter(AMPLIFIERS)))


def _amplifier(actuator: Table) -> Amplifier | CurrentAmplifier | None:
    """Return the amplifier of a table; None for an ideal source of voltage. Raises ValueError for a wrong key."""
    mode = drive(actuator)
    kind, other = AMPLIFIERS[mode], [one for name, one in AMPLIFIERS.items() if name != mode]
    names = [field.name for field in dataclasses.fields(kind)]
    foreign = {field.name for one in other for field in dataclasses.fields(one)} - set(names)
    if mine := [name for name in actuator.raw if name in foreign]:
        raise ValueError(
            f'{actuator.at(mine[0])}: an amplifier with mode = "{mode}" has no such number; it has '
            f"{', '.join(names)}. Leave it out."
        )
    actuator.only(["mode", "u_max", *names])
    if mode == "current" and "bandwidth" not in actuator.raw:
        raise ValueError(
            f'{actuator.at("mode")} = "current": {actuator.at("bandwidth")} is missing. Give the bandwidth of the '
            "amplifier's current loop, Hz: bandwidth = 1e3, for example."
        )
    if not any(name in actuator.raw for name in names):
        return None
    amplifier, coil = actuator.record(kind, extra=("mode", "u_max", "coil")), actuator.table("coil")
    if "coil" not in actuator.raw:
        return amplifier
    limits = coil.record(CoilLimits, extra=("unidirectional",))
    limits = dataclasses.replace(limits, unidirectional=coil.switch("unidirectional") is True)
    return dataclasses.replace(amplifier, coil=limits)


def _sensor(table: Table) -> Sensor:
    sensor = table.record(Sensor, extra=("velocity", "outliers", "dropouts", "runout"))
    velocity = table.switch("velocity")
    parts = {
        "outliers": table.table("outliers").record(Outliers) if "outliers" in table.raw else None,
        "dropouts": _dropouts(table.table("dropouts")) if "dropouts" in table.raw else None,
        "runout": _runout(table.table("runout")) if "runout" in table.raw else None,
    }
    return dataclasses.replace(sensor, velocity=velocity is not False, **parts)


def _runout(table: Table) -> Runout:
    table.only(["harmonics", *OWN_SPEED])
    words = "tables, [{ number = 1, amplitude = 1e-6, phase = 0.0 }] for example"
    waves = tuple(one.record(Harmonic) for one in _several(table, "harmonics", words))
    return dataclasses.replace(turning_from(table, Runout, ("harmonics",)), harmonics=waves)


def _dropouts(table: Table) -> Dropouts:
    value = table.choice("value", list(VALUES), VALUES[0])
    return dataclasses.replace(table.record(Dropouts, extra=("value",)), value=value)


def _stop(run: Table) -> Stop | None:
    """Return the stop of run.stop_stiffness and run.stop_damping; None if both are left out."""
    given = [name for name in STOP if f"stop_{name}" in run.raw]
    if not given:
        return None
    if "stiffness" not in given:
        raise run.refuse("stop_damping", "there is no stop to damp. Give run.stop_stiffness (N/m) too.")
    return Stop(*(run.leaf(f"stop_{name}", field, field.default) for name, field in STOP.items()))


def check_start(scenario: Scenario) -> None:
    """Raise ValueError unless the rotor starts within its clearance, and the clearance is less than the gap.

    With an elastic stop, the rotor may also start in contact with it; the initial |z| and the clearance must then be
    below `Scenario.limit`. The limits of a coil must contain its bias and its initial current.
    """
    _check_coils(scenario)
    gap, stop, z = scenario.plant.s_0, scenario.touchdown, scenario.initial.z
    if not stop < gap:
        raise ValueError(f"run.clearance = {stop:g} m: it must be less than the gap plant.s_0 = {gap:g} m.")
    if scenario.stop is not None:
        if not stop < scenario.limit:
            raise ValueError(f"run.clearance = {stop:g} m: with a stop it must be below {scenario.limit:g} m.")
        if not abs(z) < scenario.limit:
            why = f"|z| must be below {scenario.limit:g} m. Its stop begins at {math.copysign(stop, z):g} m."
            raise ValueError(f"initial.z = {z:g} m: the rotor would touch a magnet; {why}")
        return
    if not abs(z) < stop:
        why = f"|z| must be less than {stop:g} m (run.clearance, by default 0.9 of plant.s_0)."
        raise ValueError(f"initial.z = {z:g} m: the rotor would touch its stop at the start; {why}")


def _check_coils(scenario: Scenario) -> None:
    """Raise ValueError unless the limits of a coil contain its bias and its current at the start."""
    coil = scenario.actuator.coil
    if coil is None:
        return
    i_0, bias, i = scenario.plant.i_0, scenario.plant.R * scenario.plant.i_0, scenario.initial.i
    if coil.i_max is not None and not coil.i_max > i_0:
        why = f"it must be more than the bias current of each coil, plant.i_0 = {i_0:g} A."
        raise ValueError(f"actuator.coil.i_max = {coil.i_max:g} A: {why}")
    if coil.u_max is not None and not coil.u_max > bias:
        why = f"it must be more than the {bias:g} V of the bias current, R i_0."
        raise ValueError(f"actuator.coil.u_max = {coil.u_max:g} V: {why}")
    most = min(math.inf if coil.i_max is None else coil.i_max - i_0, i_0 if coil.unidirectional else math.inf)
    if abs(i) > most:
        raise ValueError(
            f"initial.i = {i:g} A: the current of a coil, i_0 + i or i_0 - i, would be outside actuator.coil; |i| "
            f"must be at most {most:g} A."
        )
