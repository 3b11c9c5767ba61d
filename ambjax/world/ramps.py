"""Signals that consist of straight lines: ramp and trapezoid."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, record
from ambjax.world.waveforms import Rise, hull, later


def _share(t: Scalar, start: Scalar, duration: Scalar) -> Array:
    """Return (t - start)/duration, limited to 0..1; all in s."""
    return jnp.clip((jnp.asarray(t) - start) / duration, 0.0, 1.0)


@record
class Ramp(Rise):
    """0 until `start`, then a straight line to `amplitude` over `duration`, then `amplitude`.

    Use it for a load that grows slowly: `Scenario(q_f=signals.Ramp(50.0, start=0.1, duration=0.5))`.
    """

    @staticmethod
    def curve(s: Any) -> Any:
        return s

    def __call__(self, t: Scalar) -> Array:
        return self.amplitude * _share(t, self.start, self.duration)


@record
class Trapezoid:
    """0 until `start`, a straight line to `amplitude` over `rise`, `amplitude` for `hold`, a line to 0 over `fall`.

    Use it for a shock with a finite rise, as in tests of shock:
    `Scenario(base=signals.Trapezoid(30.0, 0.1, 0.002, 0.005, 0.002))`.
    """

    amplitude: Scalar = leaf(at_least=-1e20, at_most=1e20, doc="largest value")
    start: Scalar = bounded(0.0, "s", -1e9, 1e9, "start of the rise")
    rise: Scalar = bounded(0.1, "s", 1e-9, 1e9, "duration of the rise")
    hold: Scalar = bounded(0.1, "s", 0, 1e9, "time at the largest value")
    fall: Scalar = bounded(0.1, "s", 1e-9, 1e9, "duration of the fall")

    def __call__(self, t: Scalar) -> Array:
        down = self.start + self.rise + self.hold
        return self.amplitude * (_share(t, self.start, self.rise) - _share(t, down, self.fall))

    def span(self, end: float) -> tuple[float, float]:
        return hull(0.0, self.amplitude)

    def edges(self) -> tuple[Scalar, ...]:
        top, down = self.start + self.rise, self.start + self.rise + self.hold
        return (self.start, top, down, down + self.fall)

    shifted = later
