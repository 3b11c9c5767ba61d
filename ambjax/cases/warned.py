"""Warnings about values of a case that are valid but probably unintended, such as millimetres given as metres."""

import math
import pathlib
import tomllib
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ambjax.cases import reader
from ambjax.cases.plausibility import implausible
from ambjax.cases.reach import reach, widest
from ambjax.cases.reader import Case
from ambjax.compiler.barrier import as_outside_jit
from ambjax.numerics.declared import leaves_of
from ambjax.simulation.system import reads_velocity
from ambjax.text.words import one_line
from ambjax.world.scenario import Scenario

# The plant parameter whose default is correct for every machine.
GRAVITY = "g"
# Largest plausible standard deviation of the position noise, and largest offset, as shares of the gap.
MOST_NOISE = 0.1


def read_case(path: str | pathlib.Path | Mapping[str, Any]) -> Case:
    """Read and check the case file at `path`, and return the case. A dict of tables, as from TOML, works too.

    A value that is valid but probably unintended, such as millimetres given as metres, causes a UserWarning. Raises
    ValueError, one line, if `path` is neither, if the file cannot be read, or if any part of it is invalid.

        case = ambjax.read_case("my.toml")
    """
    with as_outside_jit():
        case = reader.read_case(path)
        texts = warnings_of(case) if isinstance(path, Mapping) else warnings_of_file(case, path)
    for text in texts:
        warnings.warn(text, stacklevel=2)
    return case


def warnings_of_file(case: Case, path: str | pathlib.Path) -> list[str]:
    """Return the warnings of a case that was read from `path`, one line each."""
    empty = ["the file is empty, so every number has its default. 'ambjax template' prints a case."]
    return [one_line(f"{path}: {text}") for text in [*([] if case.text.strip() else empty), *warnings_of(case)]]


def warnings_of(case: Case) -> list[str]:
    """Return one line for each implausible value of a case: its path, the value, the reason and a possible fix."""
    own = [*_assumed(case), *_noise(case), *_velocity(case), *_currents(case), *_motion(case)]
    return [*own, *implausible(case)]


def _assumed(case: Case) -> Iterator[str]:
    plant, given = case.scenario.plant, tomllib.loads(case.text).get("plant", {})
    units = {field.name: field.metadata["unit"] for field in leaves_of(type(plant))}
    left = [name for name in units if name not in given and name != GRAVITY]
    left = [f"{name} = {getattr(plant, name):g}{f' {units[name]}' * (units[name] != '1')}" for name in left]
    if left and units.keys() & given.keys():
        yield f"[plant] omits numbers, which keep the paper's values: {', '.join(left)}. Give those that differ."


def _noise(case: Case) -> Iterator[str]:
    sensor, gap = case.scenario.sensors, case.scenario.plant.s_0
    for name, size in (("std", sensor.std), ("offset", abs(sensor.offset))):
        if size > MOST_NOISE * gap:
            share = f"{100 * size / gap:.3g} % of the gap, {gap:g} m"
            yield f"sensor.{name} = {getattr(sensor, name):g} m is {share}. Is it in another unit?"


def _velocity(case: Case) -> Iterator[str]:
    sensor, sampled = case.scenario.sensors, case.scenario.sensor or case.cascade.sampled
    if sensor.velocity and sensor.std_z_dot == 0 and sampled and reads_velocity(case.cascade, case.clock.sample_period):
        advice = "Set sensor.std_z_dot, or set sensor.velocity = false and use an observer that estimates the velocity."
        yield f"sensor.std_z_dot = 0 m/s: THE VELOCITY IS MEASURED WITHOUT ERROR, unlike by any real sensor. {advice}"


def idealised(case: Case) -> str:
    """Return a line that lists the idealisations of a case and the keys that remove them; '' if there are none."""
    parts = []
    if case.scenario.plant.one_current:
        parts.append("one current for both coils (plant.kind = 'two-coil' gives each its own)")
    if case.scenario.sensors.velocity and reads_velocity(case.cascade, case.clock.sample_period):
        parts.append("a measured velocity (sensor.velocity = false, and an observer that estimates it)")
    return f"Idealisations of this case, unlike a real bearing: {' and '.join(parts)}." if parts else ""


def reversal(case: Case, most_i: float) -> Iterator[str]:
    """Yield a warning if the largest |i| of a run, `most_i` in A, reverses the current of one coil.

    It applies to plants with one current for both coils. With two coils, i is half the difference of their currents and
    does not determine either of them.
    """
    if case.scenario.plant.one_current and most_i > case.scenario.plant.i_0:
        yield f"|i| reaches {most_i:.4g} A, {_beyond(case)} plant.kind = 'two-coil' simulates each coil's current."


def _beyond(case: Case) -> str:
    i_0 = case.scenario.plant.i_0
    return (
        f"above the bias plant.i_0 = {i_0:g} A: the current of one coil, i_0 - |i|, is reversed, which not every drive "
        "can do."
    )


def _currents(case: Case) -> Iterator[str]:
    scenario, plant, beyond = case.scenario, case.scenario.plant, _beyond(case)
    if abs(scenario.initial.i) > plant.i_0:
        yield f"initial.i = {scenario.initial.i:g} A is {beyond}"
    weight = plant.m * plant.g / plant.k_i  # v = 4 i_0 i / s_0^2 at z = 0
    if abs(weight) > plant.i_0:
        numbers = ", ".join(f"{name} = {getattr(plant, name):g}" for name in ("m", "n", "A", "s_0", "i_0"))
        yield f"plant: holding the rotor at z = 0 takes {abs(weight):.4g} A, {beyond} Check {numbers}."
    if plant.R * abs(weight) > scenario.u_max:
        least = plant.R * abs(weight)
        yield f"actuator.u_max = {scenario.u_max:g} V is less than the {least:.4g} V that hold the rotor at z = 0."
    yield from _coil_voltage(scenario, float(plant.R * abs(weight)))


def _coil_voltage(scenario: Scenario, least: float) -> Iterator[str]:
    coil = scenario.actuator.coil
    if coil is None or coil.u_max is None:
        return
    bias = float(scenario.plant.R * scenario.plant.i_0)
    if least > (reserve := float(coil.reserve(bias))):
        yield (
            f"actuator.coil.u_max = {coil.u_max:g} V leaves {reserve:.4g} V above the bias, less than the {least:.4g} "
            "V that hold the rotor at z = 0."
        )
    if scenario.u_max > coil.u_max + bias:
        given = "is left out: the command has no limit"
        if not math.isinf(scenario.u_max):
            given = f"= {scenario.u_max:g} V: the controller commands up to this voltage"
        yield (
            f"actuator.u_max {given}, but beyond {coil.u_max + bias:.4g} V "
            f"both coils are at actuator.coil.u_max. Set u_max to {reserve:.4g} V, at which the first coil is at its "
            "limit."
        )


def _motion(case: Case) -> Iterator[str]:
    scenario, clock, plant = case.scenario, case.clock, case.scenario.plant
    period, fall = float(clock.sample_period), 1 / math.sqrt(plant.k_s / plant.m)
    if scenario.sensor and period > fall:
        yield (
            f"clock.sample_period = {period:g} s, for which each measurement error is held, is longer than the time "
            f"constant of the unstable rotor, {fall:.3g} s. Is it in milliseconds or microseconds?"
        )
    wide = widest(case.spread, case.cascade, scenario)
    far, stop = reach(wide, clock), float(np.min(wide.touchdown))
    if not far < stop:
        yield f"reference: it may reach {far:.4g} m, but the rotor touches down at {stop:.4g} m (run.clearance)."
