"""How a rotor comes to its reference, as folds: when it has settled, and how far it overshoots.

Both are numbers that move with the gains: their derivatives are those of the crossing, and of the farthest sample.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record
from ambjax.simulation.metrics import Ending

# A crossing slower than this share of the band per sample has no slope of its own.
SLOWEST = 1e-3


class Crossing(NamedTuple):
    """When |z - r| last came within the band, s; time of the last sample, s, and |z - r| there, m."""

    at: Array
    t: Array
    size: Array


@record
class Settling:
    """Time of the run, s, at which |z - r| last comes within `band` (m), interpolated between samples.

    0 if it never leaves it; where it is outside at the end, the duration times |z - r| / band there, so that it is
    longer than the run.
    """

    band: Scalar = leaf(unit="m", above=0, at_most=1.0)

    def init(self) -> Crossing:
        zero = jnp.zeros((), jnp.result_type(float))
        return Crossing(zero, zero, zero)

    def update(self, carry: Crossing, row: Any, span: Any) -> Crossing:
        size = jnp.abs(row.z - row.r)
        fall = jnp.maximum(carry.size - size, SLOWEST * self.band)
        share = jnp.minimum((carry.size - self.band) / fall, 1.0)
        entered = (carry.size > self.band) & (size <= self.band)
        at = jnp.where(entered, carry.t + (row.t - carry.t) * share, carry.at)
        return Crossing(at, row.t, size)

    def result(self, carry: Crossing, ending: Ending) -> Array:
        return jnp.where(carry.size > self.band, ending.duration * carry.size / self.band, carry.at)


class Reach(NamedTuple):
    """Lowest and highest of where z began and of r so far, and how far z went beyond, m."""

    low: Array
    high: Array
    beyond: Array


@record
class Overshoot:
    """How far z leaves the range from where it began to the reference's extremes so far, m: for a step of r the
    overshoot as it is usually meant; for a rotor lifted to r = 0, how far it goes beyond 0."""

    def init(self) -> Reach:
        zero = jnp.zeros((), jnp.result_type(float))
        return Reach(zero + jnp.inf, zero - jnp.inf, zero)

    def update(self, carry: Reach, row: Any, span: Any) -> Reach:
        began = jnp.where(row.t <= 0, row.z, row.r)
        low = jnp.minimum(carry.low, jnp.minimum(began, row.r))
        high = jnp.maximum(carry.high, jnp.maximum(began, row.r))
        return Reach(low, high, jnp.maximum(carry.beyond, jnp.maximum(row.z - high, low - row.z)))

    def result(self, carry: Reach, ending: Ending) -> Array:
        return carry.beyond
