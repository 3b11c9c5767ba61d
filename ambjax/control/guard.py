"""The guard of a controller on a processor: it refuses implausible readings and replaces them by predictions.

docs/processor.md defines the rules.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.gaussian import LARGEST_NORMAL
from ambjax.numerics.records import Scalar, bounded, record
from ambjax.world.plant import Plant, State
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement

# Default limits of velocity (gaps per sample) and current: bias currents, or with a converter a share of its range.
GAPS, CURRENTS, BEYOND = 2.0, 100.0, 1.1


def _limit(unit: str, doc: str, least: float = 1e-30) -> Any:
    return bounded(None, unit, least, 1e30, doc)


class Watch(NamedTuple):
    """State of a guard.

    `expected`: predicted readings of the next sample (m, m/s, A). `left`: number of successive samples for which a
    reading may still be replaced; 0 at the start, and after `Guard.samples` refused samples.
    """

    expected: Measurement
    left: Array


class GuardResult(NamedTuple):
    """Result of the guard at a sample.

    `reading`: the readings that the laws receive. `refused`: whether a reading was refused. `steps`: whether the laws
    step; otherwise u = 0 (the safe command). `left`: `Watch.left` of the next sample.
    """

    reading: Measurement
    refused: Array
    steps: Array
    left: Array


@record
class Guard:
    """Refuse a reading that is NaN or beyond its limit, or a z farther from its prediction than the rotor can move.

    The nominal model's prediction replaces a refused reading for up to `samples` successive samples. After that u = 0
    until all readings are within their limits. `with_limits` derives each number that is left out (None).
    """

    z: Scalar | None = _limit(
        "m", "largest |z|; none: clearance times sensor gain, plus |offset|, plus the largest error of the sensor"
    )
    z_dot: Scalar | None = _limit("m/s", "largest |z_dot|; none: two gaps per sample, 2 s_0/T")
    i: Scalar | None = _limit("A", "largest |i|; none: 100 i_0, or 1.1 times the range of the converter")
    noise: Scalar | None = _limit(
        "m",
        "largest difference of two readings of one position; none: 13.6 sensor.std, plus a step of the converter, plus "
        "twice the runout",
        0,
    )
    speed: Scalar | None = _limit(
        "m/s",
        "largest error of the predicted velocity; none: 6.8 sensor.std_z_dot, plus pole times clearance if z_dot is "
        "not measured or the sensor has a low-pass, else plus pole times clearance times |sensor.gain - 1|",
        0,
    )
    samples: Scalar | None = bounded(
        None,
        "samples",
        1,
        1_000_000,
        "largest number of successive predictions; none: 1/(pole T); in this time, an error grows by the factor e",
        whole=True,
    )

    @property
    def derived(self) -> bool:
        return all(getattr(self, field.name) is None for field in dataclasses.fields(type(self)))

    def with_limits(self, model: Plant, scenario: Scenario, period: Scalar, velocity: bool) -> "Guard":
        """Return the guard with every number set; those that are None are derived (docs/processor.md).

        `period`: sample period, s. `velocity`: whether the controller reads a measured velocity.
        """
        sensor = scenario.sensors
        limit, clearance = scenario.limit, scenario.limit / scenario.plant.s_0 * model.s_0
        fall, velocity_error = model.pole * clearance, sensor.velocity_error if velocity else 1.0
        values = {
            "z": sensor.largest_reading(limit, scenario.plant.s_0),
            "z_dot": GAPS * model.s_0 / period,
            "i": CURRENTS * model.i_0
            if sensor.current_bits is None
            else BEYOND * sensor.current_end(scenario.plant.i_0),
            "noise": 2 * sensor.largest_error(scenario.plant.s_0),
            "speed": LARGEST_NORMAL * sensor.std_z_dot + velocity_error * fall,
            "samples": jnp.maximum(1 / (model.pole * period) // 1, 1.0),
        }
        own = {name: getattr(self, name) for name in values}
        return Guard(**{name: value if own[name] is None else own[name] for name, value in values.items()})

    def start(self) -> Watch:
        zero = jnp.zeros(())
        return Watch(Measurement(zero, zero, zero), zero)

    def check(self, model: Plant, measured: Measurement, watch: Watch, period: Scalar, velocity: bool) -> GuardResult:
        """Accept or replace the readings of a sample. `velocity`: whether z_dot is checked too."""
        guard: Any = self  # its numbers are set (`with_limits`)
        (z, _, i), time = watch.expected, (guard.samples - watch.left + 1) * period
        # bound of the model's error in acceleration, m/s^2: the full pull of one magnet at the expected z and i
        share = (model.i_0 + jnp.abs(i)) / (model.s_0 - jnp.abs(z))
        reach = guard.noise + time * (guard.speed + time / 2 * (model.a * share * share))
        near = (jnp.abs(measured.z - z) <= reach) | (watch.left <= 0)
        fine = Measurement(
            near & (jnp.abs(measured.z) <= guard.z),
            jnp.abs(measured.z_dot) <= guard.z_dot if velocity else jnp.asarray(True),
            jnp.abs(measured.i) <= guard.i,
        )
        good = fine.z & fine.z_dot & fine.i
        left = jnp.where(good, jnp.asarray(guard.samples), jnp.maximum(watch.left - 1, 0.0))
        reading = Measurement(*(jnp.where(ok, x, y) for ok, x, y in zip(fine, measured, watch.expected, strict=True)))
        return GuardResult(reading, ~good, good | (watch.left > 0), left)

    def refused(self, before: Watch, after: Watch) -> tuple[Array, Array]:
        """Return whether a reading was refused at the sample between two states, and whether this sample gave u = 0."""
        refused = after.left < jnp.asarray(self.samples)
        return refused, refused & (before.left <= 0)


def expected(driven: Callable[[Array, State], State], at: State, u: Array, period: Scalar) -> Measurement:
    """Return the predicted readings of the next sample. `at`: nominal state. `u`: mean command over it, V or A."""
    rates = driven(u, at)
    z, z_dot, i = (x + period * rate for x, rate in zip(at[:3], rates[:3], strict=True))
    return Measurement(z + period * period / 2 * rates.z_dot, z_dot, i)
