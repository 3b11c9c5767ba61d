"""Edges: instants at which the rates of a problem jump. Integrators end a step at each of them.

A method keeps its order only on steps over which the rates are smooth. A jump inside a step is an error of first
order in the step's length, whatever the method.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, is_traced
from ambjax.world.scenario import Scenario


class Edges(NamedTuple):
    """Instants `at` which rates jump, s. At most `most` of them lie strictly inside one advance of an integrator."""

    at: tuple[Scalar, ...] = ()
    most: int = 0

    def until(self, now: Scalar, h: Scalar) -> Array:
        """Time from `now` to the first edge within the next `h`, s; h if there is none.

        An edge within rounding of either end is not inside: `inset` places it on the right side of that end.
        """
        tolerance, step = inset(now, h), jnp.asarray(h)
        for edge in self.at:
            ahead = (edge > now + tolerance) & (edge < now + step - tolerance)
            step = jnp.where(ahead, edge - now, step)
        return step

    def pieces(self, t: Scalar, time: Scalar) -> list[Array]:
        """Lengths of the `most` + 1 intervals (s; 0 too) into which the edges divide t to t + time."""
        lengths, left = [], jnp.asarray(time)
        for _ in range(self.most):
            lengths.append(self.until(t, left))
            t, left = t + lengths[-1], left - lengths[-1]
        return [*lengths, left]

    def steps(self, t: Scalar, h: Scalar, count: int) -> Callable[[Array], tuple[Array, Array, Array]]:
        """Begin, end and length (s) of each of `count` + `most` steps, as a function of its number.

        They are `count` equal ones of length h from t on, divided at the edges inside; those that are left over have
        no length.
        """
        if not self.most:
            return lambda number: (t + number * h, t + (number + 1) * h, jnp.asarray(h))
        after = list(itertools.accumulate(self.pieces(t, count * h)[:-1]))

        def step(number: Array) -> tuple[Array, Array, Array]:
            # The ends of equal steps, into which one edge after another is inserted: merged, they remain in order.
            ends = [h * jnp.clip(number + k, 0, count) for k in range(-self.most, 2)]
            for edge in after:
                ends = [jnp.clip(edge, low, high) for low, high in itertools.pairwise(ends)]
            begin, end = ends
            return t + begin, t + end, end - begin

        return step


NO_EDGES = Edges()


def inset(t: Scalar, h: Scalar) -> Scalar:
    """By how much the stages of a step of length h from t on are moved into it, s: a few units in the last place."""
    return 4 * jnp.finfo(jnp.result_type(float)).eps * (abs(t) + h)


def most_inside(scenario: Scenario, period: Scalar) -> int | None:
    """The largest number of edges of the disturbances that lie strictly inside one sample; None if one is traced.

    `period`: of the samples, s, or several. An edge that differs between members is taken to lie inside a sample, and
    two edges to share one where their distance may be shorter than the period for some member between those given.
    """
    edges = scenario.edges()
    if any(map(is_traced, (*edges, period))):
        return None
    periods = np.asarray(period, float)
    inside = [x for x in (np.asarray(x, float) for x in edges) if np.any(x > 0) and _between_samples(x, periods)]
    longest = np.max(periods)

    def share(a: np.ndarray, b: np.ndarray) -> bool:
        return bool(np.min(a - b) < longest and np.max(a - b) > -longest)

    return max((sum(share(a, b) for b in inside) for a in inside), default=0)


def _between_samples(edge: np.ndarray, periods: np.ndarray) -> bool:
    """Whether an edge (s) lies between the samples, or differs between members."""
    if np.ptp(edge) > 0:
        return True
    at = np.ravel(edge)[0]
    nearest = np.round(at / periods) * periods
    return bool(np.any(np.abs(at - nearest) > inset(nearest, periods)))
