"""The cause of a symptom of a run: a part of the case without which the same run does not show the symptom.

A part is named as the cause only after a run without it. Parts are tried one at a time. If the symptom remains without
each of them, no cause is named: it may be the gains of the laws, or several parts together.
"""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.simulation.clock import Clock
from ambjax.world.amplifier import Amplifier
from ambjax.world.scenario import SLOTS, Scenario
from ambjax.world.waveforms import reference_at

# Resolution that stands for an ideal converter, bits. With a number instead of None, the compiled program is the same.
FINE_BITS = 32
# Number by which the sample period is divided in a run that shows whether it is the cause.
FINER = 4
# Words for a case in which no single part is the cause.
NO_PART = "No single part of the case is the cause"


class Part(NamedTuple):
    """A part of a case: its name, what to change if it is the cause, and the case without the part."""

    name: str
    remedy: str
    cascade: Cascade
    scenario: Scenario
    clock: Clock


class Cause(NamedTuple):
    """Result of `find_cause`.

    `part`: name of the part without which the symptom is gone; None if it remains without each part tried. `remedy`:
    what to change.
    """

    part: str | None
    remedy: str
    tried: tuple[str, ...]


# Whether a case shows the symptom. If the run cannot decide it, the answer is True.
Shows = Callable[[Cascade, Scenario, Clock], bool]


def find_cause(
    shows: Shows, cascade: Cascade, scenario: Scenario, clock: Clock, tell: Callable[[str], object] = lambda _: None
) -> Cause:
    """Return the first part of `parts` without which the case does not show the symptom."""
    tried: list[str] = []
    for part in parts(cascade, scenario, clock):
        tell(f"looking for the cause: simulating without {part.name}")
        if not shows(part.cascade, part.scenario, part.clock):
            return Cause(part.name, part.remedy, tuple(tried))
        tried.append(part.name)
    return Cause(None, "", tuple(tried))


def cause_words(cause: Cause, with_part: str, without: str) -> str:
    """Return the sentences on a cause. `with_part`, `without`: clauses on the run with the cause and without it."""
    if cause.part is not None:
        return f"The cause is {cause.part}: in a run without this, {without}. {cause.remedy}".strip()
    remains = f": {with_part} also without {', '.join(cause.tried)} (each taken away alone)" if cause.tried else ""
    return f"{NO_PART}{remains}. Possible causes, not tested: the gains and p of the laws, or several parts together."


def parts(cascade: Cascade, scenario: Scenario, clock: Clock) -> Iterator[Part]:
    """Yield the parts of a case that can be taken away: errors first, then limits, then what any machine has."""
    errors = (*_sensors(scenario), *_processor(cascade), *_model(cascade, scenario))
    limits = (*_supply(scenario), *_delay(cascade), *_iron(scenario))
    for name, remedy, changed in (*errors, *limits, *_motion(scenario, clock)):
        controller, world = (changed, scenario) if isinstance(changed, Cascade) else (cascade, changed)
        yield Part(name, remedy, controller, world, clock)
    if cascade.sampled:
        period = float(clock.sample_period)
        finer = dataclasses.replace(clock, samples=FINER * clock.samples, sample_period=period / FINER)
        name = f"the sample period of {period:g} s (with {period / FINER:g} s instead)"
        yield Part(name, "Shorten clock.sample_period, or lower the gains or p of the laws.", cascade, scenario, finer)


def _sensors(scenario: Scenario) -> Iterator[tuple[str, str, Scenario]]:
    sensor = scenario.sensors
    if (quiet := scenario.louder(0.0)).sensor != scenario.sensor:
        yield "the noise of the sensors", "Lower it, or choose an observer that attenuates it more.", quiet
    for name in ("bits", "bits_i"):
        if (bits := getattr(sensor, name)) is not None:
            words = f"the converter (sensor.{name} = {float(np.max(bits)):g})"
            yield words, "Give more bits, or a smaller range_z or range_i.", scenario.with_sensor(**{name: FINE_BITS})
    if sensor.faulty:
        yield "the faults of the position sensor", "", scenario.with_sensor(outliers=None, dropouts=None)
    if sensor.bandwidth is not None:
        yield "the low-pass of the position sensor", "Raise sensor.bandwidth.", scenario.with_sensor(bandwidth=None)
    if np.any(np.asarray(sensor.gain) != 1) or np.any(np.asarray(sensor.offset) != 0):
        exact = scenario.with_sensor(gain=1.0, offset=0.0)
        yield "the calibration of the position sensor (sensor.gain, sensor.offset)", "Correct it.", exact


def _supply(scenario: Scenario) -> Iterator[tuple[str, str, Scenario]]:
    amplifier = scenario.actuator
    if np.any(np.isfinite(np.asarray(scenario.u_max))):
        name = f"the limit of the voltage (actuator.u_max = {float(np.min(scenario.u_max)):g} V)"
        unlimited = dataclasses.replace(scenario, u_max=jnp.inf)
        if amplifier.coil is not None:
            coil = dataclasses.replace(amplifier.coil, u_max=None)
            unlimited = dataclasses.replace(unlimited, amplifier=dataclasses.replace(amplifier, coil=coil))
        yield name, "Raise it, or reduce the gains, the noise or the loads.", unlimited
    if isinstance(scenario.amplifier, Amplifier):
        ideal = dataclasses.replace(scenario, amplifier=None)
        yield "the amplifier (its lag, dead band and current limits)", "Change [actuator].", ideal


def _processor(cascade: Cascade) -> Iterator[tuple[str, str, Cascade]]:
    if not cascade.timing.implicit:
        yield "the explicit steps", 'Set discretisation = "implicit".', cascade.with_processor(implicit=True)
    if cascade.timing.guard is not None:
        yield "the guard of the readings", "Change [processor.guard].", cascade.with_processor(guard=None)
    if cascade.notch is not None:
        remedy = "Lower its rate, raise its min_speed, or correct its phase."
        yield "the notch (controller.notch)", remedy, dataclasses.replace(cascade, notch=None)


def _delay(cascade: Cascade) -> Iterator[tuple[str, str, Cascade]]:
    timing = cascade.timing
    if (delay := float(np.max(timing.delay))) > 0:
        remedy = "Reduce the delay or the gains." if timing.predicts else "Set predict = true, or reduce the delay."
        name = f"the delay of {delay:g} sample{'s' * (delay != 1)}"
        yield name, remedy, cascade.with_processor(delay=0.0, assumed=None)


def _model(cascade: Cascade, scenario: Scenario) -> Iterator[tuple[str, str, Cascade]]:
    """Yield the cascade whose model has the numbers of the true plant, if they differ."""
    names = [field.name for field in dataclasses.fields(cascade.model) if field.metadata.get("leaf")]
    true = {name: getattr(scenario.plant, name) for name in names if hasattr(scenario.plant, name)}
    if any(np.any(np.asarray(getattr(cascade.model, name)) != np.asarray(x)) for name, x in true.items()):
        exact = dataclasses.replace(cascade, model=dataclasses.replace(cascade.model, **true))
        yield "the difference of controller.model from the plant", "Correct [controller.model].", exact


def _iron(scenario: Scenario) -> Iterator[tuple[str, str, Scenario]]:
    if scenario.plant.iron is not None:
        ideal = dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, iron=None))
        yield "the iron of the magnets (plant.iron)", "Reduce the bias or the loads.", ideal


def _motion(scenario: Scenario, clock: Clock) -> Iterator[tuple[str, str, Scenario]]:
    end = float(clock.duration)
    loads = [getattr(scenario.turning(), slot) for slot in SLOTS if slot != "reference"]
    acts = any(load is not None and any(load.span(end)) for load in loads)
    if acts or scenario.sensors.runout is not None:
        yield "the disturbances and the runout", "", scenario.undisturbed()
    r, r_dot, *_ = (np.asarray(x) for x in reference_at(scenario.reference, jnp.zeros(())))
    initial = scenario.initial
    if np.any(np.asarray(initial.z) != r) or np.any(np.asarray(initial.z_dot) != r_dot):
        near = dataclasses.replace(initial, z=r + 0.0 * np.asarray(initial.z), z_dot=r_dot + 0.0 * initial.z_dot)
        remedy = "Start nearer to the reference, or give the laws a larger range."
        yield "the start away from the reference", remedy, dataclasses.replace(scenario, initial=near)
