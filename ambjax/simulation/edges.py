"""Edges: instants at which the rates of a problem jump. Integrators end a step at each edge of the problem.

In continuous time, only adaptive steps end at edges. Steps of a fixed number may contain a jump there.

A method has its nominal order only on steps in which the rates are smooth. A jump inside a step causes an error of
first order in the step length for every method.
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
    """Instants at which the rates jump.

    - `at`: the instants, s.
    - `most`: largest number of them strictly inside one advance of an integrator with a fixed number of steps; 0: such
      steps do not end at edges.
    """

    at: tuple[Scalar, ...] = ()
    most: int = 0

    def until(self, now: Scalar, h: Scalar) -> Array:
        """Return the time from `now` to the first edge within the next `h`, s; h if there is no edge.

        An edge within rounding of either end is not inside: `inset` moves the stages to the correct side of it.
        """
        tolerance, step = inset(now, h), jnp.asarray(h)
        for edge in self.at:
            ahead = (edge > now + tolerance) & (edge < now + step - tolerance)
            step = jnp.where(ahead, edge - now, step)
        return step

    def pieces(self, t: Scalar, time: Scalar) -> list[Array]:
        """Return the lengths, s, of the `most` + 1 parts into which edges divide t to t + time; some may be 0."""
        lengths, left = [], jnp.asarray(time)
        for _ in range(self.most):
            lengths.append(self.until(t, left))
            t, left = t + lengths[-1], left - lengths[-1]
        return [*lengths, left]

    def steps(self, t: Scalar, h: Scalar, count: int) -> Callable[[Array], tuple[Array, Array, Array]]:
        """Divide `count` equal steps of length h, from t on, at the edges inside them.

        Returns a function from the number of a step, 0 to `count` + `most` - 1, to its begin, end and length, s. If
        there are fewer edges than `most`, some steps have length 0.
        """
        if not self.most:
            return lambda number: (t + number * h, t + (number + 1) * h, jnp.asarray(h))
        after = list(itertools.accumulate(self.pieces(t, count * h)[:-1]))

        def step(number: Array) -> tuple[Array, Array, Array]:
            # Insert one edge after another into the sorted ends of equal steps; the clip keeps them sorted.
            ends = [h * jnp.clip(number + k, 0, count) for k in range(-self.most, 2)]
            for edge in after:
                ends = [jnp.clip(edge, low, high) for low, high in itertools.pairwise(ends)]
            begin, end = ends
            return t + begin, t + end, end - begin

        return step


NO_EDGES = Edges()


def inset(t: Scalar, h: Scalar) -> Scalar:
    """Return the distance by which stages at the ends of a step are moved into it, s: a few units in the last place.

    The step begins at t (s) and has length h (s).
    """
    return _rounding() * (abs(t) + h)


def _rounding() -> float:
    """Return a few units in the last place of 1 in the working precision."""
    return 4 * float(jnp.finfo(jnp.result_type(float)).eps)


def most_inside(scenario: Scenario, period: Scalar, reference: bool = False) -> int | None:
    """Return the largest number of edges of the disturbances strictly inside one sample; None if an
    edge or the period is traced.

    `reference`: include the edges of the reference, which a processor reads at the samples only. `period`: one sample period or several, s.

    The number is an upper bound for an ensemble. An edge that differs
    between members counts as inside a sample. Two edges count as inside the same sample if their distance can be
    shorter than the longest period. The distance can have every value between its extremes over the members.
    """
    edges = scenario.edges(reference)
    if any(map(is_traced, (*edges, period))):
        return None
    periods = np.asarray(period, float)
    inside = [x for x in (np.asarray(x, float) for x in edges) if np.any(x > 0) and _between_samples(x, periods)]
    longest = np.max(periods)

    def share(a: np.ndarray, b: np.ndarray) -> bool:
        return bool(np.min(a - b) < longest and np.max(a - b) > -longest)

    return max((sum(share(a, b) for b in inside) for a in inside), default=0)


def _between_samples(edge: np.ndarray, periods: np.ndarray) -> bool:
    """Return whether an edge (s) lies between samples, or differs between members."""
    if np.ptp(edge) > 0:
        return True
    at = np.ravel(edge)[0]
    nearest = np.round(at / periods) * periods
    return bool(np.any(np.abs(at - nearest) > _rounding() * (np.abs(nearest) + periods)))
