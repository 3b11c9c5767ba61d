"""What happens between two samples: signals folded over time by the integrator.

Under held noise the reference of the current jumps every sample and slides to its place within microseconds, with the
drive at its stop. What is read at the samples is that jump and nothing else; so an integrator looks at the signals
at every substep, and hands on their integrals and extremes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar


class Instant(NamedTuple):
    """What a system shows at one instant: `sizes`, signals of which the extremes of |.| matter, and `densities`, of
    which the integral over time does. Each a pytree of scalars, or empty if nobody is to look."""

    sizes: Any
    densities: Any


NOTHING = Instant((), ())


class Span(NamedTuple):
    """A stretch of time, s: largest and smallest |sizes| on it (0 and +inf if it is empty), integrals of densities."""

    time: Array
    most: Any
    least: Any
    densities: Any

    def seen(self, instant: Instant, weight: Scalar, time: Scalar = 0.0) -> "Span":
        """With one more instant, which counts for `weight` (s) in the integrals; `time` longer."""
        sizes = jax.tree.map(jnp.abs, instant.sizes)
        most = jax.tree.map(jnp.maximum, self.most, sizes)
        least = jax.tree.map(jnp.minimum, self.least, sizes)
        return Span(self.time + time, most, least, self.densities).weighed(instant, weight)

    def weighed(self, instant: Instant, weight: Scalar) -> "Span":
        """With an instant that counts in the integrals alone: a trial state, which the system never takes."""
        more = jax.tree.map(lambda total, x: total + weight * x, self.densities, instant.densities)
        return self._replace(densities=more)

    def joined(self, after: "Span") -> "Span":
        """This stretch and the one after it."""
        most = jax.tree.map(jnp.maximum, self.most, after.most)
        least = jax.tree.map(jnp.minimum, self.least, after.least)
        more = jax.tree.map(lambda x, y: x + y, self.densities, after.densities)
        return Span(self.time + after.time, most, least, more)


def blank(like: Instant) -> Span:
    """No time at all. `like`: any instant, for its structure."""
    zero = jnp.zeros((), jnp.result_type(float))
    nothing = jax.tree.map(lambda _: zero, like)
    return Span(zero, nothing.sizes, jax.tree.map(lambda _: zero + jnp.inf, like.sizes), nothing.densities)
