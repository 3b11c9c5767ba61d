"""The generalised notch at the speed of the rotor: a part of any cascade, before its observer.

Herzog, Buehler, Gaehler and Larsonneur, Unbalance compensation using generalized notch filters in the multivariable
feedback of magnetic bearings, IEEE Trans. Control Systems Technology 4 (1996).
"""

import dataclasses
import itertools
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, part, record, static
from ambjax.numerics.smooth import TWO_PI
from ambjax.world.plant import Plant
from ambjax.world.rotation import PER_MINUTE, Rotation, known
from ambjax.world.sensor import Measurement

# What a notch removes, and the reading in which it removes it.
NULLED = {"force-free": "i", "displacement-free": "z"}


@record
class NotchGain:
    """Gain of a notch at one speed: the inverse of the response, at this speed, of the nulled reading to z_read."""

    speed: Scalar = leaf(unit="rpm", at_least=0, at_most=1e7, doc="speed")
    real: Scalar = leaf(unit="", at_least=-1e30, at_most=1e30, doc="real part, m/A or 1")
    imaginary: Scalar = leaf(unit="", at_least=-1e30, at_most=1e30, doc="imaginary part, m/A or 1")


class NotchState(NamedTuple):
    """State of a notch: the complex signal whose real part it adds to z (m), the mean of y, and the time.

    `elapsed`: the time since the first reading, in s; on a processor in samples, whose sum is exact in float32 too. It
    is () if the speed is constant.
    """

    real: Array
    imaginary: Array
    mean: Array
    elapsed: Array | tuple[()]


@record
class SynchronousNotch:
    """Adds a signal at the speed of the rotor to the reading of z, so that i or z contains none at this speed.

    The complex signal c turns with the rotor, c' = j W c - 2 rate g (y - m), and Re c is added to the reading. y is
    the reading in which the notch removes the speed: that of i ("force-free"), or that of z ("displacement-free"). Its
    mean, m' = rate (y - m), is subtracted, so that the notch does not respond to a constant y. g is the inverse of the
    response G of y to a signal added to the reading of z, in the closed loop at the speed W. What y contains at the
    speed then decays as exp(-rate t), if rate is small against the bandwidth of the loop. An error of the phase of g
    must be below 90 degrees. Below `min_speed` and above `max_speed` the notch is off: c' = (j W - rate) c, so that the
    signal appears and vanishes gradually.

    On a processor, c_{n+1} = exp(j W T) (c_n - 2 rate T g (y_n - m_n)), with the mean of W at both samples. For a
    constant speed, the notch is linear and time-invariant. `linear.with_notch_gains` computes the gains.
    """

    removes: str = static(default="force-free", choices=tuple(NULLED), doc='"force-free" or "displacement-free"')
    rate: Scalar = bounded(10.0, "1/s", 1e-6, 1e6, "rate at which the notch converges")
    min_speed: Scalar = bounded(0.0, "rpm", 0, 1e7, "speed from which the notch is on")
    max_speed: Scalar = bounded(1e7, "rpm", 0, 1e7, "speed above which the notch is off again")
    ordered: ClassVar = ("min_speed", "max_speed")
    gains: tuple[NotchGain, ...] = part(default=(), doc="gain at each speed, in between linear")
    rotor: Rotation | None = part(default=None, doc="speed of the rotor; that of a scenario replaces it")
    varying: bool = static(default=False, doc="whether the speed changes during a run")
    phase: float | None = static(
        default=None, doc="phase of the response that the notch inverts, degrees; None: that of the linear loop"
    )

    def init(self, measured: Measurement) -> NotchState:
        """Return the state at the first reading: the notch adds nothing."""
        y = jnp.asarray(self._nulled(measured))
        return NotchState(0.0 * y, 0.0 * y, y, 0.0 * y if self.varying else ())

    def _nulled(self, measured: Measurement) -> Array:
        return getattr(measured, NULLED[self.removes])

    def scale(self, model: Plant) -> NotchState:
        """Return the characteristic size of each state."""
        z, y = jnp.asarray(model.s_0 / 50), jnp.asarray(self._nulled(model.sizes()))
        return NotchState(z, z, y, jnp.ones(()) if self.varying else ())

    def memory(self) -> list[tuple[str, str, str]]:
        """Return name, unit and meaning of each state."""
        parts = [("real", "m", "what the notch adds to z"), ("imaginary", "m", "the same, a quarter of a turn earlier")]
        parts.append(("mean", "A" if NULLED[self.removes] == "i" else "m", "mean of the nulled reading"))
        return [*parts, *[("elapsed", "samples", "samples since the first reading, for the speed")] * self.varying]

    def at(self, speed: Scalar | None = None) -> "SynchronousNotch":
        """Return the notch at a constant speed (rpm), with the gain for it alone; None: that at t = 0."""
        speed = jnp.abs(jnp.asarray(known(self.rotor).speed if speed is None else speed))
        notch = dataclasses.replace(self, rotor=Rotation(speed), varying=False)
        _, real, imaginary, _ = notch._now(0.0)
        return dataclasses.replace(notch, gains=(NotchGain(speed, real, imaginary),))

    def _now(self, t: Scalar) -> tuple[Array, Array, Array, Array]:
        """Return the speed (rpm), real and imaginary part of the gain, and whether the notch is on, 1 or 0."""
        rpm = known(self.rotor).rpm(t)
        size = jnp.abs(rpm)
        real, imaginary = (jnp.asarray(getattr(self.gains[0], name)) for name in ("real", "imaginary"))
        for low, high in itertools.pairwise(self.gains):
            share = jnp.minimum(jnp.maximum((size - low.speed) / (high.speed - low.speed), 0.0), 1.0)
            real = real + share * (high.real - low.real)
            imaginary = imaginary + share * (high.imaginary - low.imaginary)
        # a rotor that turns backwards: the response at -W is the conjugate of that at W
        # a number, because XLA aborts when it compiles a loop with a choice between constants
        on = jnp.where(size >= self.min_speed, 1.0, 0.0) * jnp.where(size <= self.max_speed, 1.0, 0.0)
        return rpm, real, jnp.where(rpm < 0, -imaginary, imaginary), on

    def __call__(self, measured: Measurement, state: NotchState) -> tuple[Array, NotchState]:
        """Return z with the signal of the notch, m, and the rate of the state."""
        rpm, real, imaginary, on = self._now(0.0 if isinstance(state.elapsed, tuple) else state.elapsed)
        W = TWO_PI * PER_MINUTE * rpm
        moving = self._nulled(measured) - state.mean
        drive, decay = -2 * self.rate * on * moving, (1 - on) * self.rate
        a = -W * state.imaginary + real * drive - decay * state.real
        b = W * state.real + imaginary * drive - decay * state.imaginary
        elapsed = () if isinstance(state.elapsed, tuple) else jnp.ones_like(state.elapsed)
        return measured.z + state.real, NotchState(a, b, self.rate * moving, elapsed)

    def step(self, measured: Measurement, state: NotchState, period: Scalar) -> tuple[Array, NotchState]:
        """Return z with the signal of the notch, m, and the state at the next sample. `period`: sample period, s."""
        elapsed = state.elapsed
        rpm, real, imaginary, on = self._now(0.0 if isinstance(elapsed, tuple) else elapsed * period)
        moving = self._nulled(measured) - state.mean
        drive, kept = -2 * self.rate * period * on * moving, jnp.maximum(1 - (1 - on) * self.rate * period, 0.0)
        a, b = kept * state.real + real * drive, kept * state.imaginary + imaginary * drive
        mean_rpm = rpm
        if not isinstance(elapsed, tuple):
            elapsed = elapsed + 1.0
            mean_rpm = (rpm + known(self.rotor).rpm(elapsed * period)) / 2
        turn = TWO_PI * PER_MINUTE * period * mean_rpm
        c, s = jnp.cos(turn), jnp.sin(turn)
        a, b = a * c - b * s, a * s + b * c
        return measured.z + state.real, NotchState(a, b, state.mean + self.rate * period * moving, elapsed)
