"""Signals that consist of straight lines: ramp and trapezoid."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record
from ambjax.world.waveforms import hull, later


def _share(t: Scalar, start: Scalar, duration: Scalar) -> Array:
    """Return (t - start)/duration, limited to 0..1; all in s."""
    return jnp.clip((jnp.asarray(t) - start) / duration, 0.0, 1.0)


@record
class Ramp:
    """0 until `start`, then a straight line to `amplitude` over `duration`, then `amplitude`.

    Use it for a load that grows slowly: `Scenario(q_f=signals.Ramp(50.0, start=0.1, duration=0.5))`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="final value")
    start: Scalar = leaf(default=0.0, unit="s", at_least=-1e9, at_most=1e9, doc="start of the rise")
    duration: Scalar = leaf(default=0.1, unit="s", at_least=1e-9, at_most=1e9, doc="duration of the rise")

    def __call__(self, t: Scalar) -> Array:
        return self.amplitude * _share(t, self.start, self.duration)

    def span(self, end: float) -> tuple[float, float]:
        ends = (np.clip((t - np.asarray(self.start)) / self.duration, 0.0, 1.0) for t in (0.0, end))
        return hull(*(self.amplitude * share for share in ends))

    def edges(self) -> tuple[Scalar, ...]:
        """Return the times of the two kinks, s."""
        return (self.start, self.start + self.duration)

    shifted = later


@record
class Trapezoid:
    """0 until `start`, a straight line to `amplitude` over `rise`, `amplitude` for `hold`, a line to 0 over `fall`.

    Use it for a shock with a finite rise, as in tests of shock:
    `Scenario(base=signals.Trapezoid(30.0, 0.1, 0.002, 0.005, 0.002))`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="largest value")
    start: Scalar = leaf(default=0.0, unit="s", at_least=-1e9, at_most=1e9, doc="start of the rise")
    rise: Scalar = leaf(default=0.1, unit="s", at_least=1e-9, at_most=1e9, doc="duration of the rise")
    hold: Scalar = leaf(default=0.1, unit="s", at_least=0, at_most=1e9, doc="time at the largest value")
    fall: Scalar = leaf(default=0.1, unit="s", at_least=1e-9, at_most=1e9, doc="duration of the fall")

    def __call__(self, t: Scalar) -> Array:
        down = self.start + self.rise + self.hold
        return self.amplitude * (_share(t, self.start, self.rise) - _share(t, down, self.fall))

    def span(self, end: float) -> tuple[float, float]:
        return hull(0.0, self.amplitude)

    def edges(self) -> tuple[Scalar, ...]:
        """Return the times of the four kinks, s."""
        top, down = self.start + self.rise, self.start + self.rise + self.hold
        return (self.start, top, down, down + self.fall)

    shifted = later
