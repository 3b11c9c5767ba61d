"""Settling time and overshoot, as folds.

Both are differentiable in the gains. The derivative of the settling time is that of the instant at which |z - r|
crosses the band. The derivative of the overshoot is that of the sample with the largest excursion.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record
from ambjax.numerics.smooth import larger, smaller
from ambjax.simulation.folds import Ending
from ambjax.simulation.trajectory import Row, Span

# Smallest slope of a crossing, in bands per sample, which bounds the derivative of the settling time.
SLOWEST = 1e-3


class Crossing(NamedTuple):
    """State of `Settling`.

    - `at`: time at which |z - r| last came within the band, s.
    - `t`, `size`: time of the previous sample, s, and |z - r| there, m.
    """

    at: Array
    t: Array
    size: Array


@record
class Settling:
    """Settling time, s: the time at which |z - r| last comes within `band` (m), interpolated between samples.

    It is 0 if |z - r| never leaves the band. If |z - r| is outside the band at the end of the run, the settling time is
    the duration of the run times the final |z - r|/band, so it is longer than the run.
    """

    band: Scalar = leaf(unit="m", above=0, at_most=1.0, doc="the band")

    def init(self) -> Crossing:
        zero = jnp.zeros((), jnp.result_type(float))
        return Crossing(zero, zero, zero)

    def update(self, carry: Crossing, row: Row, span: Span) -> Crossing:
        size = jnp.abs(row.z - row.r)
        fall = jnp.maximum(carry.size - size, SLOWEST * self.band)
        share = jnp.minimum((carry.size - self.band) / fall, 1.0)
        entered = (carry.size > self.band) & (size <= self.band)
        at = jnp.where(entered, carry.t + (row.t - carry.t) * share, carry.at)
        return Crossing(at, row.t, size)

    def result(self, carry: Crossing, ending: Ending) -> Array:
        return jnp.where(carry.size > self.band, ending.duration * carry.size / self.band, carry.at)


class Reach(NamedTuple):
    """State of `Overshoot`: extremes of the initial z and of r so far, and the largest excursion of z beyond, m."""

    low: Array
    high: Array
    beyond: Array


@record
class Overshoot:
    """Overshoot, m: the largest excursion of z beyond the range of its initial value and of all earlier references.

    For a step of r it is the usual overshoot; for a rotor that is lifted to r = 0, the excursion beyond 0.
    """

    def init(self) -> Reach:
        zero = jnp.zeros((), jnp.result_type(float))
        return Reach(zero + jnp.inf, zero - jnp.inf, zero)

    def update(self, carry: Reach, row: Row, span: Span) -> Reach:
        began = jnp.where(row.t <= 0, row.z, row.r)
        low = smaller(carry.low, smaller(began, row.r))
        high = larger(carry.high, larger(began, row.r))
        return Reach(low, high, larger(carry.beyond, larger(row.z - high, low - row.z)))

    def result(self, carry: Reach, ending: Ending) -> Array:
        return carry.beyond
