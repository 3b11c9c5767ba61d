"""Descent: a dense BFGS with a trust region, for several starts at once.

It follows Nocedal and Wright, Numerical Optimization, 2006, 6.1, without a line search. The goal is a logarithm.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.extend import record
from tuning.problem.goal import Goal

# Trust radius of the first step, which has no estimate of the curvature.
FIRST_RADIUS = 0.3
# A trial lies beyond a jump if its value, a logarithm, exceeds the best value by this or more, or if its value or
# gradient is not finite.
JUMP = 1.0


class Starts(NamedTuple):
    """State of starts, points that the search refines: the next trials, and the best points so far.

    `trial`, `best` [S, m]. `value` [S], `gradient` [S, m]: of the goal at the best points; +inf and 0 before the first
    trial. `inverse` [S, m, m]: inverse Hessian. `radius` [S]: trust radius. `trials` [S]: number of trials so far.
    """

    trial: Array
    best: Array
    value: Array
    gradient: Array
    inverse: Array
    radius: Array
    trials: Array


def begin(x: Array) -> Starts:
    """Return the initial state of starts at coordinates x [S, m]."""
    count, m = x.shape
    full = functools.partial(jnp.full, count, dtype=x.dtype)
    inverse = jnp.broadcast_to(jnp.eye(m, dtype=x.dtype), (count, m, m))
    return Starts(x, x, full(jnp.inf), jnp.zeros_like(x), inverse, full(FIRST_RADIUS), jnp.zeros(count, int))


def continued(earlier: Starts, x: Array) -> Starts:
    """Return the initial state of one start at x [1, m], with the inverse Hessian of the first of the `earlier` starts.

    With two trials, the next pair (s, y) does not change its scale.
    """
    return begin(x)._replace(inverse=earlier.inverse[:1], trials=jnp.full(1, 2))


def step(start: Starts, value: Array, gradient: Array) -> Starts:
    """Return one start after its trial. `value`, `gradient` [m]: of the goal at the trial.

    A trial is rejected if its value is not below the best value, or if its value or gradient is not finite. A rejected
    trial still updates the inverse Hessian, unless it lies beyond a jump of the function (JUMP). The trust radius is at
    most 1, a factor e of one gain. After a rejected trial it is half of its step, beyond a jump a quarter.
    """
    finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
    gradient = jnp.where(finite, gradient, 0.0)
    accept, smooth = finite & (value < start.value), finite & (value < start.value + JUMP)
    s = start.trial - start.best
    inverse = _updated_inverse(start, s, gradient - start.gradient, smooth)
    tried = jnp.sqrt(s @ s)
    wider = jnp.minimum(jnp.maximum(start.radius, 2 * tried), 1.0)
    narrower = jnp.where(smooth, 0.5, 0.25) * tried
    radius = jnp.where(start.trials == 0, start.radius, jnp.where(accept, wider, narrower))
    best, slope = jnp.where(accept, start.trial, start.best), jnp.where(accept, gradient, start.gradient)
    move = -inverse @ slope
    move = jnp.where(slope @ move < 0, move, -slope)
    length = jnp.sqrt(move @ move)
    move = move * jnp.minimum(1.0, radius / jnp.where(length > 0, length, 1.0))
    value = jnp.where(accept, value, start.value)
    return Starts(best + move, best, value, slope, inverse, radius, start.trials + 1)


def _updated_inverse(start: Starts, s: Array, y: Array, smooth: Array) -> Array:
    """Return the inverse Hessian [m, m] after an update with the step s [m] and the gradient's change y [m]."""
    curvature = s @ y
    usable = (start.trials > 0) & smooth & (curvature > 1e-10 * jnp.sqrt((s @ s) * (y @ y)))
    rho = 1 / jnp.where(usable, curvature, 1.0)
    # The first pair (s, y) of a search sets the scale of the inverse Hessian.
    scale = jnp.where(start.trials == 1, curvature / jnp.where(usable, y @ y, 1.0), 1.0)
    left = jnp.eye(len(s), dtype=s.dtype) - rho * jnp.outer(s, y)
    return jnp.where(usable, scale * left @ start.inverse @ left.T + rho * jnp.outer(s, s), start.inverse)


@record
class Descent:
    """Steps of several starts towards the least goal.

    The numbers of the limits are leaves, so it is compiled once for all goals of the same structure.
    """

    goal: Goal

    @functools.partial(jax.jit, static_argnums=1)
    def __call__(self, ordinary: int, starts: Starts, outcomes: Array, slopes: Array) -> Starts:
        """Return the starts after one step.

        `outcomes` [S, N, 1 + L]: the weighted loss and the limited quantities of each member at the trials. `slopes`
        [S, N, 1 + L, m]: their derivatives. The first `ordinary` members are not stressed.
        """

        def one(start: Starts, outcomes: Array, slopes: Array) -> Starts:
            value, weights = jax.value_and_grad(self.goal)(outcomes, ordinary)
            return step(start, value, jnp.tensordot(weights, slopes, 2))

        return jax.vmap(one)(starts, outcomes, slopes)
