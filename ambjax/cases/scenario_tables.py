"""The tables of a case file that make its scenario: reference, disturbances, sensors, actuator and start."""

import dataclasses
import math
from typing import Any

from ambjax.cases.table import Table, show
from ambjax.numerics.records import leaf
from ambjax.simulation.clock import Clock
from ambjax.world import signals
from ambjax.world.amplifier import Amplifier
from ambjax.world.band_noise import BandNoise
from ambjax.world.bearing import Bearing
from ambjax.world.faults import VALUES, Dropouts, Outliers
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.sensor import Sensor

# The signals by kind.
SIGNALS: dict[str, type] = {
    "constant": signals.Constant,
    "step": signals.Step,
    "pulse": signals.Pulse,
    "sine": signals.Sine,
    "smoothstep": signals.SmoothStep,
    "chirp": signals.Chirp,
    "band-noise": BandNoise,
    "sum": signals.Sum,
}
UNITS = {"q_z": ("m/s^2", "A^2/m^2"), "q_i": ("A/s",)}
# Largest number of terms of a sum; each term is compiled.
MOST_TERMS = 100
SETTLE = leaf(default=0.5, unit="s", at_least=0, at_most=1e6, doc='time from which "settled" metrics count')
FIELDS = {field.name: field for kind in (Scenario, Clock) for field in dataclasses.fields(kind)}


def _signal(table: Table, extra: tuple[str, ...] = ()) -> Any:
    kind = table.choice("kind", list(SIGNALS))
    if kind == "sum":
        table.only(["kind", "terms", *extra])
        terms = table.raw.get("terms")
        if not isinstance(terms, list) or not terms:
            raise ValueError(f"{table.at('terms')} = {show(terms)}: it must be a list of at least one signal table.")
        if len(terms) > MOST_TERMS:
            raise ValueError(f"{table.at('terms')}: {len(terms)} terms are too many; give at most {MOST_TERMS}.")
        return signals.Sum(tuple(_signal(Table(t, f"{table.at('terms')}[{n}]")) for n, t in enumerate(terms)))
    return table.record(SIGNALS[kind], extra=("kind", *extra))


def _disturbances(table: Table) -> dict[str, Any]:
    table.only(list(UNITS))
    made = {}
    for name in table.raw:
        one, units = table.table(name), list(UNITS[name])
        unit = one.choice("unit", units, units[0])
        made["q_v" if unit == "A^2/m^2" else name] = _signal(one, extra=("unit",))
    return made


def scenario_from(top: Table, plant: Bearing) -> tuple[Scenario, float | None]:
    """Return the scenario, and run.settle (s) or None. Raises ValueError for invalid tables."""
    actuator, run = top.table("actuator"), top.table("run")
    names = [field.name for field in dataclasses.fields(Amplifier)]
    actuator.only(["u_max", *names])
    run.only(["seed", "settle", "clearance"])
    settle = run.leaf("settle", SETTLE)
    scenario = Scenario(
        plant=plant,
        reference=_signal(top.table("reference")) if "reference" in top.raw else signals.Constant(),
        sensor=_sensor(top.table("sensor")) if "sensor" in top.raw else None,
        initial=top.table("initial").record(Initial),
        u_max=actuator.leaf("u_max", FIELDS["u_max"], math.inf),
        amplifier=actuator.record(Amplifier, extra=("u_max",)) if any(n in actuator.raw for n in names) else None,
        clearance=run.leaf("clearance", FIELDS["clearance"]),
        seed=_seed(run),
        **_disturbances(top.table("disturbance")),
    )
    return scenario, settle


def _sensor(table: Table) -> Sensor:
    sensor, velocity = table.record(Sensor, extra=("velocity", "outliers", "dropouts")), table.switch("velocity")
    faults = {
        "outliers": table.table("outliers").record(Outliers) if "outliers" in table.raw else None,
        "dropouts": _dropouts(table.table("dropouts")) if "dropouts" in table.raw else None,
    }
    return dataclasses.replace(sensor, velocity=velocity is not False, **faults)


def _dropouts(table: Table) -> Dropouts:
    value = table.choice("value", list(VALUES), VALUES[0])
    return dataclasses.replace(table.record(Dropouts, extra=("value",)), value=value)


def _seed(run: Table) -> int:
    seed = run.raw.get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise ValueError(f"{run.at('seed')} = {show(seed)}: it must be a whole number from 0 to 4294967295.")
    return seed


def check_start(scenario: Scenario) -> None:
    """Raise ValueError unless the rotor starts within its clearance, and the clearance within the gap."""
    gap, stop, z = scenario.plant.s_0, scenario.touchdown, scenario.initial.z
    if not stop < gap:
        raise ValueError(f"run.clearance = {stop:g} m: it must be less than the gap plant.s_0 = {gap:g} m.")
    if not abs(z) < stop:
        raise ValueError(
            f"initial.z = {z:g} m: the rotor would touch its stop at the start; |z| must be less than {stop:g} m "
            "(run.clearance, by default 0.9 of plant.s_0)."
        )
