"""Spans: extremes and integrals of signals between two samples, accumulated by the integrator.

Under held noise, i_ref moves to a new value within microseconds after every sample, and the voltage is then at its
limit. Values at the samples show only the start of this transient. The integrator therefore evaluates the signals at
every substep, and returns their extremes and integrals.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import larger, smaller


class Instant(NamedTuple):
    """Signals of a system at one instant, each a pytree of numbers, or empty.

    - `sizes`: signals for which a Span records the extremes of the absolute value.
    - `densities`: signals for which a Span records the integral over time.
    """

    sizes: Any
    densities: Any


class Sizes(NamedTuple):
    """Signals whose extremes between samples are recorded. Names and units are those of a `Row`."""

    z: Array
    e_z: Array
    sigma: Array
    u: Array
    i: Array
    e: Array
    v_tilde: Array
    z_stop: Array | tuple[()] = ()


class Densities(NamedTuple):
    """Signals that are integrated between samples: u (V), u^2 (V^2), and the copper loss in both coils (W)."""

    u: Array
    u_squared: Array
    heat: Array


NOTHING = Instant((), ())
# An Instant with the pytree structure of the recorded signals.
INSTANT_TREE = Instant(Sizes(*[0.0] * 7), Densities(*[0.0] * 3))  # pyright: ignore[reportArgumentType]


class Span(NamedTuple):
    """Signals over an interval of time.

    - `time`: length of the interval, s.
    - `most`, `least`: largest and smallest |sizes|; 0 and +inf if the interval is empty.
    - `densities`: integrals of the densities.
    """

    time: Array
    most: Any
    least: Any
    densities: Any

    def with_instant(self, instant: Instant, weight: Scalar, time: Scalar = 0.0) -> "Span":
        """Add an instant to the extremes, and to the integrals with `weight` (s). Add `time` (s) to the length."""
        sizes = jax.tree.map(jnp.abs, instant.sizes)
        most = jax.tree.map(larger, self.most, sizes)
        least = jax.tree.map(smaller, self.least, sizes)
        return Span(self.time + time, most, least, self.densities).with_densities(instant, weight)

    def with_densities(self, instant: Instant, weight: Scalar) -> "Span":
        """Add an instant to the integrals only, for a trial state that is not on the trajectory."""
        more = jax.tree.map(lambda total, x: total + weight * x, self.densities, instant.densities)
        return self._replace(densities=more)

    def shortened(self, by: Scalar) -> "Span":
        """Return the interval without its last `by` seconds, which have no derivatives. Means of densities are kept."""
        share = 1 - lax.stop_gradient(by) / jnp.where(self.time > 0, self.time, 1.0)
        return self._replace(
            time=share * self.time, densities=jax.tree.map(lambda total: share * total, self.densities)
        )

    def joined(self, after: "Span") -> "Span":
        """Return the union of this interval and the next one."""
        most = jax.tree.map(larger, self.most, after.most)
        least = jax.tree.map(smaller, self.least, after.least)
        more = jax.tree.map(lambda x, y: x + y, self.densities, after.densities)
        return Span(self.time + after.time, most, least, more)


def blank(like: Instant) -> Span:
    """Return an empty interval. `like`: any Instant with the structure and the shapes of the signals."""
    zero = jnp.zeros((), jnp.result_type(float))
    nothing = jax.tree.map(lambda x: jnp.zeros(jnp.shape(x), zero.dtype), like)
    return Span(zero, nothing.sizes, jax.tree.map(lambda x: x + jnp.inf, nothing.sizes), nothing.densities)
