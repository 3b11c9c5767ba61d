"""Warnings about unlikely values: quantities in a wrong unit, and loads or rates that the machine cannot follow."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from ambjax.cases.forces import forces
from ambjax.cases.reader import Case
from ambjax.simulation.response import ORDERS, ROUNDED
from ambjax.world.recorded import Recorded
from ambjax.world.scenario import SLOTS
from ambjax.world.waveforms import frequencies_of

# Flux density above which common silicon steel begins to saturate, T (Schweitzer and Maslen, Magnetic Bearings, 2009).
MOST_FLUX = 1.2
# Smallest number of samples per time constant of the unstable pole, and smallest ratio of a bandwidth to this pole. A
# loop needs a bandwidth of twice its unstable pole (Skogestad and Postlethwaite, Multivariable Feedback Control, 5.9).
LEAST_SAMPLES, LEAST_BANDWIDTH = 3.0, 2.0
# Largest ratio of a converter step to the standard deviation of the noise at which the noise dithers the converter.
MOST_STEP = 4.0
# Plausible ranges of numbers of the plant, their units, usual values, and the unit that a wrong one is probably in. The
# paper's values of s_0, A and mu_0 are 5e-3, 0.121 and 1.25e-6.
RANGES = {
    "s_0": ((2e-5, 2e-2), "m", "gaps are 0.1 mm to some mm, 1e-4 to 5e-3", "millimetres"),
    "A": ((1e-6, 1.0), "m^2", "poles have some cm^2, 1e-4 and more", "another unit"),
    "mu_0": ((6e-7, 2.5e-6), "N/A^2", "that of air is 1.257e-6", "another unit"),
    "m": ((1e-3, 1e5), "kg", "usual values are 0.001 to 100000 kg", "grams"),
    "i_0": ((1e-3, 100.0), "A", "usual values are 0.001 to 100 A", "milliamperes"),
    "R": ((1e-4, 1e4), "ohm", "usual values are 0.0001 to 10000 ohm", "milliohms"),
}
# Standard gravity, m/s^2, and the largest plausible ratio of a rotor's weight to the largest force of its bearing. The
# bearings of a vertical axis may be weaker than the weight.
GRAVITY, MOST_WEIGHT = 9.81, 10.0
# Smallest plausible range of a converter, in clearances or bias currents.
LEAST_RANGE = 0.1
# Largest plausible limit of a current, in bias currents.
MOST_CURRENT = 100.0
# Largest plausible length of a recorded signal, in lengths of the run.
LONGEST_FILE = 100.0
# Largest plausible runout, as a share of the clearance.
MOST_RUNOUT = 0.5
# Smallest plausible delay that is not 0, in samples; balance quality grades of ISO 21940-11, mm/s.
LEAST_DELAY, GRADES = 0.01, (0.4, 4000.0)


def implausible(case: Case) -> list[str]:
    """Return a warning, in one line, for each implausible number of a case and each implausible relation of two."""
    machine = [*_ranges(case), *_forces(case), *_flux(case), *_limits(case), *_rates(case), *_converter(case)]
    return [*machine, *_delay(case), *_runout(case), *_aliases(case), *_orders(case), *_loads(case), *_faults(case)]


def unresolved(axes: Iterable[Case]) -> list[str]:
    """Return a warning, in one line, for each frequency and order of a machine that the samples do not resolve."""
    return list(dict.fromkeys(text for case in axes for text in [*_aliases(case), *_orders(case)]))


def _ranges(case: Case) -> Iterator[str]:
    for name, ((low, high), unit, usual, slip) in RANGES.items():
        value = float(getattr(case.scenario.plant, name))
        if value and not low <= value <= high:
            yield f"plant.{name} = {value:g} {unit}: {usual}. Is it in {slip}?"
    if (k_z := float(case.scenario.plant.k_z)) > 0:
        yield f"plant.k_z = {k_z:g} N/m pushes the rotor away from z = 0; a restoring bearing has k_z < 0."


def _forces(case: Case) -> Iterator[str]:
    largest, weight, load = forces(case)
    mass = float(case.scenario.plant.m)
    if (heavy := GRAVITY * mass) > MOST_WEIGHT * largest:
        yield (
            f"plant.m = {mass:g} kg: the rotor weighs {heavy:.4g} N, {heavy / largest:.3g} times the largest force of "
            f"the magnets, {largest:.4g} N. Is it in grams? Or is actuator.i_max or u_max too small?"
        )
    if weight <= largest < weight + load:
        yield (
            f"[disturbance]: weight and loads reach {weight + load:.4g} N, but the magnets pull with at most "
            f"{largest:.4g} N at z = 0, with |i| at the bias current or its limit. They cannot "
            "carry a constant load of this size."
        )


def _flux(case: Case) -> Iterator[str]:
    plant, iron = case.scenario.plant, case.scenario.plant.iron
    flux = float(plant.mu_0) * float(plant.n) * float(plant.i_0) / (2 * float(plant.s_0))  # of the bias current
    if flux > MOST_FLUX and (iron is None or iron.saturation is None):
        why = f"iron saturates above about {MOST_FLUX:g} T. Check n, i_0 and s_0, or give plant.iron.saturation."
        yield f"plant: the bias flux density mu_0 n i_0/(2 s_0) is {flux:.3g} T; {why}"
    if iron is not None and iron.saturation is not None and flux > float(iron.saturation):
        yield (
            f"plant.iron.saturation = {float(iron.saturation):g} T is less than the bias flux density "
            f"mu_0 n i_0/(2 s_0) = {flux:.3g} T: the iron saturates at rest. Check saturation, n, i_0 and s_0."
        )


def _limits(case: Case) -> Iterator[str]:
    amplifier, bias = case.scenario.actuator, float(case.scenario.plant.i_0)
    for path, part in (("actuator", amplifier), ("actuator.coil", getattr(amplifier, "coil", None))):
        limit = getattr(part, "i_max", None)
        if limit is not None and float(limit) > MOST_CURRENT * bias:
            times = f"{float(limit) / bias:.4g} times plant.i_0"
            yield f"{path}.i_max = {float(limit):g} A is {times}. Is it in milliamperes?"
    dead, u_max = getattr(amplifier, "dead_band", None), float(case.scenario.u_max)
    if dead is not None and float(dead) >= u_max:
        yield f"actuator.dead_band = {float(dead):g} V is not below actuator.u_max = {u_max:g} V: no voltage acts."


def _rates(case: Case) -> Iterator[str]:
    scenario, pole = case.scenario, float(case.scenario.plant.pole)
    samples = 1 / (float(case.clock.sample_period) * pole)
    if case.cascade.sampled and 1 <= samples < LEAST_SAMPLES:
        yield (
            f"clock.sample_period = {float(case.clock.sample_period):g} s: the time constant of the unstable rotor has "
            f"only {samples:.2g} samples. Give at least {LEAST_SAMPLES:g}; usable margins need 10 or more."
        )
    for name, part in (("sensor", scenario.sensors), ("actuator", scenario.actuator)):
        bandwidth = part.bandwidth
        if bandwidth is not None and 2 * math.pi * float(bandwidth) < LEAST_BANDWIDTH * pole:
            yield (
                f"{name}.bandwidth = {float(bandwidth):g} Hz is less than twice the unstable pole, {pole:.4g} 1/s = "
                f"{pole / (2 * math.pi):.4g} Hz: a loop with usable margins needs more. Is it in kHz?"
            )
    if (notch := case.cascade.notch) is not None and float(notch.rate) > pole:
        yield (
            f"controller.notch.rate = {float(notch.rate):g} 1/s exceeds the unstable pole, {pole:.4g} 1/s. A notch "
            "must converge slowly against the loop. Lower the rate."
        )


def _converter(case: Case) -> Iterator[str]:
    sensor, plant = case.scenario.sensors, case.scenario.plant
    ranges = (("range_z", float(case.scenario.touchdown), "clearance"), ("range_i", float(plant.i_0), "bias current"))
    for name, size, what in ranges if sensor.bits is not None else ():
        given = getattr(sensor, name)
        if given is not None and float(given) < LEAST_RANGE * size:
            reads = f"the converter reads {100 * float(given) / size:.3g} % of the {what}"
            yield f"sensor.{name} = {float(given):g}: {reads}. Is it in another unit?"
    if sensor.bits is None or not sensor.std:
        return
    step = float(sensor.step(case.scenario.plant.s_0))
    if step > MOST_STEP * float(sensor.std):
        yield (
            f"sensor.bits = {float(sensor.bits):g}: a step of {step:.3g} m is {step / float(sensor.std):.3g} times the "
            "noise sensor.std, so the noise does not dither the converter. Give more bits, or a smaller range_z."
        )


def _delay(case: Case) -> Iterator[str]:
    delay = float(case.cascade.timing.delay)
    if 0 < delay < LEAST_DELAY:
        yield f"processor.delay = {delay:g} samples is close to 0. Is it in seconds?"


def _runout(case: Case) -> Iterator[str]:
    runout, stop = case.scenario.turning().sensors.runout, float(case.scenario.touchdown)
    if runout is None:
        return
    most = max(abs(float(one)) for one in runout.span(float(case.clock.duration)))
    if most > MOST_RUNOUT * stop:
        advice = "Are the amplitudes in another unit?"
        yield f"sensor.runout: the harmonics reach {most:.3g} m, {100 * most / stop:.3g} % of run.clearance. {advice}"


def _signals(case: Case) -> dict[str, object]:
    return {f"{'' if slot == 'reference' else 'disturbance.'}{slot}": getattr(case.scenario, slot) for slot in SLOTS}


def _loads(case: Case) -> Iterator[str]:
    """Yield a warning for each signal that begins after the run or lasts far longer, and for each unknown grade."""
    duration = float(case.clock.duration)
    for path, signal in _signals(case).items():
        for part in getattr(signal, "terms", (signal,)):
            start = float(np.min(getattr(part, "start", 0.0)))
            length = float(np.ptp(part.samples.times)) if isinstance(part, Recorded) else 0.0
            if length > LONGEST_FILE * duration:
                yield f"{path}: the file lasts {length:g} s, the run {duration:g} s. Are its times in milliseconds?"
            if start >= duration:
                yield f"{path}: start = {start:g} s, but the run ends at clock.duration = {duration:g} s."
            grade = float(np.max(getattr(part, "grade", GRADES[0])))
            if grade and not GRADES[0] <= grade <= GRADES[1]:
                low, high = GRADES
                yield f"{path}: grade = {grade:g} mm/s: ISO 21940-11 has G {low:g} to G {high:g}. Is it in m/s?"


def _faults(case: Case) -> Iterator[str]:
    """Yield a warning for each kind of fault of the position sensor that never occurs."""
    duration = float(case.clock.duration)
    for name in ("outliers", "dropouts"):
        fault, path = getattr(case.scenario.sensors, name), f"sensor.{name}"
        if fault is None or fault.rate or any(one.startswith(f"{path}.") for one in case.spread.paths):
            continue
        if fault.at is None:
            yield f"{path}: no fault occurs, because its rate is 0. Give rate, 1/s, or at, s."
        elif float(fault.at) > duration - float(case.clock.sample_period) / 2:
            yield f"{path}: at = {float(fault.at):g} s, but the run ends at clock.duration = {duration:g} s."


def _half(case: Case) -> float:
    """Return half the sampling rate, less rounding errors, Hz."""
    return (0.5 - ROUNDED) / float(case.clock.sample_period)


def _aliases(case: Case) -> Iterator[str]:
    half = _half(case)
    parts = _signals(case) | {"rotor": case.scenario.rotor, "sensor.runout": case.scenario.sensors.runout}
    for path, signal in parts.items():
        for name, high in frequencies_of(signal):
            if high >= half:
                why = "samples cannot resolve it. Reduce clock.sample_period."
                yield f"{path}: {name} gives {high:.4g} Hz, not below half the sampling rate, {half:.4g} Hz: {why}"


def _orders(case: Case) -> Iterator[str]:
    """Yield a warning for orders of the rotor's speed that the samples, or the length of the run, do not resolve."""
    if (rotor := case.scenario.rotor) is None:
        return
    half, duration = _half(case), float(case.clock.duration)
    once = rotor.fastest(duration) / (2 * np.pi)
    runout = case.scenario.sensors.runout
    harmonics = [] if runout is None else [int(one.number) for one in runout.harmonics]
    if high := [order for order in sorted({*ORDERS, *harmonics}) if order * once >= half > once]:
        least = min(high)
        zero = " Its metrics are 0." if least in ORDERS else ""
        yield (
            f"rotor.speed: {least} times the speed is {least * once:.4g} Hz, not below half the sampling rate, "
            f"{half:.4g} Hz: samples cannot resolve this order.{zero} Reduce clock.sample_period."
        )
    if once and (turns := abs(float(rotor.turns(duration) - rotor.turns(case.settle)))) < 1:
        yield (
            f"rotor.speed: the rotor makes {turns:.3g} revolutions after run.settle, and the metrics at 1x and 2x need "
            "one: they are 0. Extend clock.duration."
        )
