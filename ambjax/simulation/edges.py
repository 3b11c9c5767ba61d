"""Edges: instants at which the rates of a problem, or a derivative of them, jump. Steps end at edges.

In continuous time, steps of a fixed number may contain a jump, unless an amplifier controls the current.

A method has its nominal order only on steps in which the rates are smooth. A jump inside a step causes an error of
first order in the step length for every method, and a kink one of second order.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, is_traced
from ambjax.world.recorded import Knots


class Edges(NamedTuple):
    """Instants at which the rates jump or have a kink.

    - `at`: single instants, s.
    - `most`: largest number of instants strictly inside one advance of an integrator with a fixed number of steps; 0:
      such steps do not end at edges.
    - `knots`: instants of recorded signals.
    """

    at: tuple[Scalar, ...] = ()
    most: int = 0
    knots: tuple[Knots, ...] = ()

    def until(self, now: Scalar, h: Scalar) -> Array:
        """Return the time from `now` to the first edge within the next `h`, s; h if there is no edge."""
        tolerance, step = inset(now, h), jnp.asarray(h)
        for edge in (*self.at, *(knots.after(now + 2 * tolerance) for knots in self.knots)):
            ahead = (edge > now + tolerance) & (edge < now + step - tolerance)
            step = jnp.where(ahead, edge - now, step)
        return step

    def pieces(self, t: Scalar, time: Scalar) -> list[Array]:
        """Return the lengths, s, of the parts into which the single instants divide t to t + time; some may be 0."""
        lengths, left, single = [], jnp.asarray(time), Edges(self.at)
        for _ in range(min(self.most, len(self.at))):
            lengths.append(single.until(t, left))
            t, left = t + lengths[-1], left - lengths[-1]
        return [*lengths, left]

    def steps(self, t: Scalar, h: Scalar, count: int) -> tuple[Any, Callable[[Array, Any], tuple]]:
        """Divide `count` equal steps of length h, from t on, at the edges inside them.

        Returns the position before the first step, and a function from the number of a step, 0 to `count` + `most` - 1,
        and the position to its begin, end and length, s, and the next position.
        """
        if not self.most:
            return (), lambda number, place: (t + number * h, t + (number + 1) * h, jnp.asarray(h), place)
        h = jnp.asarray(h)

        def step(number: Array, place: tuple[Array, Array]) -> tuple[Array, Array, Array, tuple[Array, Array]]:
            begin, done = place  # time since t, and number of the equal steps that are complete
            goal = h * jnp.minimum(done + 1, count)
            more = count + self.most - number > count - done  # more steps than equal steps are left
            length = jnp.where(more, self.until(t + begin, goal - begin), goal - begin)
            whole = length >= goal - begin
            end = jnp.where(whole, goal, begin + length)
            return t + begin, t + end, end - begin, (end, jnp.minimum(done + whole, count))

        return (jnp.zeros_like(h), jnp.zeros((), jnp.int32)), step


NO_EDGES = Edges()


def inset(t: Scalar, h: Scalar) -> Scalar:
    """Return the distance by which stages at the ends of a step are moved into it, s: a few units in the last place."""
    return _rounding() * (abs(t) + h)


def _rounding() -> float:
    """Return a few units in the last place of 1 in the working precision."""
    return 4 * float(jnp.finfo(jnp.result_type(float)).eps)


def most_inside(edges: tuple[Scalar, ...], period: Scalar, knots: tuple[Knots, ...] = ()) -> int | None:
    """Return the largest number of `edges` and `knots` strictly inside one sample; None if one or the period is traced.

    `period`: one sample period or several, s. The number is an upper bound for an ensemble. An edge that differs
    between members counts as inside a sample. Two edges count as inside the same sample if their distance can be
    shorter than the longest period. The distance can have every value between its extremes over the members.
    """
    if any(map(is_traced, (*edges, *(one.start for one in knots), period))):
        return None
    periods = np.asarray(period, float)
    inside = [x for x in (np.asarray(x, float) for x in edges) if np.any(x > 0) and _between_samples(x, periods)]
    longest = np.max(periods)

    def share(a: np.ndarray, b: np.ndarray) -> bool:
        return bool(np.min(a - b) < longest and np.max(a - b) > -longest)

    single = max((sum(share(a, b) for b in inside) for a in inside), default=0)
    return single + sum(_knots_inside(one, periods) for one in knots)


def _knots_inside(knots: Knots, periods: np.ndarray) -> int:
    """Return the largest number of knots strictly inside one sample.

    If the start of the record or the period differs between members, it is an upper bound: the largest number in any
    interval of the longest period.
    """
    longest = float(np.max(periods))
    if np.ptp(np.asarray(knots.start, float)) > 0 or np.ptp(periods) > 0:
        ends = np.searchsorted(knots.times, knots.times + longest)
        return int(np.max(ends - np.arange(len(ends)), initial=0))
    at = knots.times + np.ravel(np.asarray(knots.start, float))[0]
    nearest = np.round(at / longest) * longest
    inside = (at > 0) & (np.abs(at - nearest) > _rounding() * (np.abs(nearest) + longest))
    samples = np.floor(at[inside] / longest)
    return int(np.max(np.unique(samples, return_counts=True)[1], initial=0))


def _between_samples(edge: np.ndarray, periods: np.ndarray) -> bool:
    """Return whether an edge (s) lies between samples, or differs between members."""
    if np.ptp(edge) > 0:
        return True
    at = np.ravel(edge)[0]
    nearest = np.round(at / periods) * periods
    return bool(np.any(np.abs(at - nearest) > _rounding() * (np.abs(nearest) + periods)))
