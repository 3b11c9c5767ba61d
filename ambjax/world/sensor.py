"""Sensors: measurements and their errors."""

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.numerics.gaussian import LARGEST_NORMAL, normals
from ambjax.numerics.records import Scalar, bounded, part, record, static
from ambjax.numerics.smooth import polynomial
from ambjax.world.faults import Dropouts, FaultOnsets, Outliers, Sensed
from ambjax.world.rotation import Runout

# Coefficients of a series for m_3 (`_moments`), used for b < 1: m_3 is b times the sum of 3! (-b)^j / (j + 4)!. The
# first omitted coefficient is below 3e-18.
SERIES = tuple(math.factorial(3) * (-1) ** j / math.factorial(j + 4) for j in range(16))


class Errors(NamedTuple):
    """Errors of the sensors, constant over one sample: noise of z (m), z_dot (m/s) and i (A).

    `runout` (m) and `onsets`, the faults that begin at the sample, are () if the sensor has none. The runout is also ()
    if a low-pass receives it.
    """

    z: Array
    z_dot: Array
    i: Array
    runout: Array | tuple[()] = ()
    onsets: FaultOnsets | tuple[()] = ()


class Measurement(NamedTuple):
    """Measured or estimated motion and current: z (m), z_dot (m/s), i (A)."""

    z: Array
    z_dot: Array
    i: Array


@record
class Sensor:
    """The sensors, with Gaussian noise on each measurement, drawn once per sample period and held constant in it.

    The runout of the rotor is added to the position. The low-pass (`bandwidth`), the gain, the offset, the noise, the
    converter and the faults then act on the sum, in this order; the result is the reading. Low-pass, converter and
    faults require a processor. Without a processor, the laws receive the measurement at every instant, not only at the
    samples.

    Use it in every case that a real bearing must follow: `Scenario(sensor=sensors.Sensor(std=1e-7, velocity=False))`.
    """

    std: Scalar = bounded(0.0, "m", 0, 1.0, "standard deviation of the noise of z")
    std_z_dot: Scalar = bounded(0.0, "m/s", 0, 1e6, "standard deviation of the noise of z_dot")
    std_i: Scalar = bounded(0.0, "A", 0, 1e6, "standard deviation of the noise of i")
    offset: Scalar = bounded(0.0, "m", -1.0, 1.0, "offset of the position sensor")
    gain: Scalar = bounded(1.0, "1", 0.01, 100, "gain of the position sensor, ideally 1")
    bandwidth: Scalar | None = bounded(None, "Hz", 1, 1e9, "bandwidth of the position sensor, order 1; none: no lag")
    bits: Scalar | None = bounded(None, "", 2, 32, "bits of the converter of z and i; none: not rounded", whole=True)
    bits_i: Scalar | None = bounded(
        None, "", 2, 32, "resolution of the converter of i, if it is another one; none: that of z", whole=True
    )
    range_z: Scalar | None = bounded(None, "m", 1e-9, 1.0, "the converter reads z within +-range_z; none: s_0")
    range_i: Scalar | None = bounded(None, "A", 1e-9, 1e6, "the converter reads i within +-range_i; none: 2 i_0")
    velocity: bool = static(default=True, doc="whether z_dot is measured; if not, an observer must estimate it")
    outliers: Outliers | None = part(default=None, doc="single wrong readings of the position; None: no such fault")
    dropouts: Dropouts | None = part(
        default=None, doc="intervals without a reading of the position; None: no such fault"
    )
    runout: Runout | None = part(
        default=None, doc="runout of the surface that the position sensor reads; None: no runout"
    )

    sampled: ClassVar[tuple[str, ...]] = ("bits", "bits_i", "bandwidth", "outliers", "dropouts")
    """Fields that require a processor."""

    @property
    def noises(self) -> tuple[Scalar, ...]:
        """The standard deviations of the noise of z (m), z_dot (m/s) and i (A)."""
        return self.std, self.std_z_dot, self.std_i

    @property
    def faulty(self) -> bool:
        return self.outliers is not None or self.dropouts is not None

    def noise(self, key: tuple[Scalar, Scalar], sample: Scalar) -> Measurement:
        """Return the noise at sample number `sample`. `key`: random key of the member (`Scenario.words`)."""
        return self.scaled(normals(key, sample))

    def scaled(self, normals: Sequence[Array]) -> Measurement:
        """Return the noise for three normal random numbers."""
        return Measurement(*(std * x for std, x in zip(self.noises, normals, strict=True)))

    def on_processor(self, errors: Errors, key: tuple[Scalar, Scalar], sample: Scalar, period: Scalar) -> Errors:
        """Return the errors of a sample with the runout and the faults that begin at this sample."""
        if self.runout is not None and self.bandwidth is None:
            t = jnp.asarray(sample, jnp.result_type(float)) * period
            errors = errors._replace(runout=self.runout(t))
        return errors._replace(onsets=self.fault_onsets(key, sample, period)) if self.faulty else errors

    def fault_onsets(self, key: tuple[Scalar, Scalar], sample: Scalar, period: Scalar) -> FaultOnsets:
        """Return the faults that begin at sample number `sample`. `key`: as in `noise`. `period`: sample period, s."""
        none = jnp.zeros(())
        outlier = none if self.outliers is None else self.outliers.onset(key, sample, period)
        return FaultOnsets(outlier, none > 0 if self.dropouts is None else self.dropouts.onset(key, sample, period))

    def sensed(self, z: Array, before: Sensed, onsets: FaultOnsets, period: Scalar, s_0: Scalar) -> Sensed:
        """Return the next state of the faulty sensor, whose z is the reading with faults. `z`: converted reading, m."""
        z = z + onsets.outlier
        if self.dropouts is None:
            return Sensed(z, before.left)
        left = jnp.where(onsets.drops, self.dropouts.samples(period), jnp.maximum(before.left - 1, 0.0))
        return Sensed(jnp.where(left > 0, self.dropouts.read(before.z, self.ends(s_0)), z), left)

    def ends(self, s_0: Scalar) -> Scalar:
        """Return the end of the converter's range of z (m) for a plant with the gap s_0 (m)."""
        return s_0 if self.range_z is None else self.range_z

    def step(self, s_0: Scalar) -> Scalar:
        """Return the step of the converter of z (m) for a plant with the gap s_0 (m); 0 without a converter."""
        return 0.0 if self.bits is None else 2 * self.ends(s_0) / 2.0**self.bits

    def largest_error(self, s_0: Scalar) -> Scalar:
        """Return the largest error of a reading of z (m) besides gain and offset. `s_0`: gap of the plant, m."""
        runout = 0.0 if self.runout is None else sum(abs(one.amplitude) for one in self.runout.harmonics)
        return LARGEST_NORMAL * self.std + self.step(s_0) / 2 + self.gain * runout

    def largest_reading(self, z: Scalar, s_0: Scalar) -> Scalar:
        """Return the largest |reading| (m) for displacements up to z (m). `s_0`: gap of the plant, m."""
        return self.gain * z + abs(self.offset) + self.largest_error(s_0)

    @property
    def velocity_error(self) -> Scalar:
        """Largest relative difference of the measured velocity from the rate of the readings of z; 1 if unknown."""
        return abs(self.gain - 1) if self.velocity and self.bandwidth is None else 1.0

    def linear(self) -> "Sensor":
        """Return the sensor without the effects that a linear system cannot contain."""
        return dataclasses.replace(self.louder(0.0), bits=None, bits_i=None, outliers=None, dropouts=None)

    @property
    def current_bits(self) -> Scalar | None:
        """The resolution of the converter of i, bits; None: no converter."""
        return self.bits if self.bits_i is None else self.bits_i

    def current_end(self, i_0: Scalar) -> Scalar:
        """Return the end of the converter's range of i (A) for a plant with the bias current i_0 (A)."""
        return 2 * i_0 if self.range_i is None else self.range_i

    def louder(self, factor: Scalar) -> "Sensor":
        stds = {"std": self.std, "std_z_dot": self.std_z_dot, "std_i": self.std_i}
        return dataclasses.replace(self, **{name: std * factor for name, std in stds.items()})

    def over_surface(self, motion: Measurement, t: Scalar) -> Measurement:
        """Return the motion of the surface that the position sensor reads at t (s): the rotor's, plus the runout."""
        if self.runout is None:
            return motion
        t = jnp.asarray(t, jnp.result_type(float))
        runout, rate = jax.jvp(self.runout, (t,), (jnp.ones_like(t),))
        return motion._replace(z=motion.z + runout, z_dot=motion.z_dot + rate)

    def reading(self, motion: Measurement, errors: Errors) -> Measurement:
        """Return the readings of a motion with these errors. `motion.z`: after the low-pass."""
        if not isinstance(errors.runout, tuple):
            motion = motion._replace(z=motion.z + errors.runout)
        z_dot = motion.z_dot + errors.z_dot if self.velocity else jnp.zeros_like(motion.z_dot)
        return Measurement(self.gain * motion.z + self.offset + errors.z, z_dot, motion.i + errors.i)

    def converted(self, reading: Measurement, s_0: Scalar, i_0: Scalar) -> Measurement:
        """Return the converted readings; s_0 (m) and i_0 (A) of the plant give the ranges that are left out."""
        if self.bits is not None:
            reading = reading._replace(z=converted(reading.z, self.bits, self.ends(s_0)))
        if (bits := self.current_bits) is not None:
            reading = reading._replace(i=converted(reading.i, bits, self.current_end(i_0)))
        return reading

    def lagged(self, y: Array, before: Measurement, after: Measurement, h: Scalar) -> Array:
        """Return the output of the low-pass after h (s), from y (m): y' = w (z - y), w = 2 pi bandwidth.

        The result is exact for any w h, if z(t) is the cubic with the positions and velocities at both ends.
        """
        assert self.bandwidth is not None
        # z = z_0 + s c_1 + s^2 c_2 + s^3 c_3, 0 <= s <= 1
        c_1, rise, end = h * before.z_dot, after.z - before.z, h * after.z_dot
        c_2, c_3 = 3 * rise - 2 * c_1 - end, c_1 + end - 2 * rise
        m_0, m_1, m_2, m_3 = _moments(2 * jnp.pi * self.bandwidth * jnp.asarray(h))
        return y + (m_0 * (before.z - y) + m_1 * c_1 + m_2 * c_2 + m_3 * c_3)


class IdealSensor(Sensor):
    """Sensors without error. They add no operation to a program."""

    @property
    def noises(self) -> tuple[Scalar, ...]:
        return ()

    def noise(self, key: tuple[Scalar, Scalar], sample: Scalar) -> Measurement:
        return self.scaled(())

    def scaled(self, normals: Sequence[Array]) -> Measurement:
        return Measurement(*[jnp.zeros(())] * 3)

    def reading(self, motion: Measurement, errors: Errors) -> Measurement:
        return motion


def _moments(b: Array) -> tuple[Array, Array, Array, Array]:
    """Return y(1) of y' = b (s^k - y), y(0) = 0, for k = 0 to 3 and b >= 0.

    The result is (m_0, m_1, m_2, m_3), with m_0 = 1 - exp(-b) and k m_{k-1} = b (1 - m_k). For b < 1, the recursion
    from m_0 upwards loses digits, so the recursion from m_3 downwards is used.
    """
    short = b < 1
    few, many = jnp.where(short, b, 0.0), jnp.where(short, 1.0, b)  # keeps each branch finite where it is not used
    m_3 = few * polynomial(few, SERIES)
    m_2 = few * (1 - m_3) / 3
    m_1 = few * (1 - m_2) / 2
    down = (few * (1 - m_1), m_1, m_2, m_3)
    m_0, per = 1 - jnp.exp(-many), 1 / many
    m_1 = 1 - per * m_0
    m_2 = 1 - 2 * per * m_1
    up = (m_0, m_1, m_2, 1 - 3 * per * m_2)
    m_0, m_1, m_2, m_3 = (jnp.where(short, x, y) for x, y in zip(down, up, strict=True))
    return m_0, m_1, m_2, m_3


def converted(x: Array, bits: Scalar, limit: Scalar) -> Array:
    """Return the output of a converter of `bits` bits over -limit..limit for the input x: x rounded and saturated.

    The derivative is that of the saturation alone.
    """
    half = jnp.round(jnp.exp2(jnp.asarray(bits) - 1))  # XLA's exp2 has a rounding error
    step = limit / half
    held = jnp.where(x > limit - step, limit - step, jnp.where(x < -limit, -limit, x))
    return held + lax.stop_gradient(step * jnp.round(held / step) - held)
