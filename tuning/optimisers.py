"""Optimisers by name, as optax transformations: optax's Adam, and a BFGS for a few gains.

`update(gradient, state, x, value=...)` receives the value and the gradient at x, the point of the last trial. The state
contains the best point so far and its value. After a rejected trial, the next step starts at the best point.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

BFGS = "bfgs"
NAMES = (BFGS, "adam")

# Trust radius of the BFGS: its largest value (1: a factor e of one gain), and its value for the first step, which has
# no estimate of the curvature.
LARGEST_RADIUS, FIRST_RADIUS = 1.0, 0.3
# After a rejected trial, the trust radius is the length of its step times CONTRACTION, or times BACKTRACK if the trial
# lies beyond a jump of the function. Adam repeats a rejected step with its length multiplied by BACKTRACK.
CONTRACTION = 0.5
BACKTRACK = CONTRACTION**2
# A trial lies beyond a jump if its value, a logarithm, exceeds the best value by this or more, or if its value or
# gradient is not finite.
JUMP = 1.0


class BFGSState(NamedTuple):
    """State of the BFGS: best point [m], its value and gradient [m], inverse Hessian [m, m], trust radius, trials."""

    best: Array
    value: Array
    gradient: Array
    inverse: Array
    radius: Array
    trials: Array


class FirstOrderState(NamedTuple):
    """State of a first-order optimiser with backtracking: best point [m], its value, and optax's state, `inner`."""

    best: Array
    value: Array
    inner: Any


def optimiser(name: str, learning_rate: float) -> optax.GradientTransformationExtraArgs:
    """Return the optimiser of this name, one of NAMES. The BFGS does not use `learning_rate`."""
    return bfgs() if name == BFGS else backtracking(optax.adam(learning_rate))


def bfgs() -> optax.GradientTransformationExtraArgs:
    """Return a dense BFGS (Nocedal and Wright, Numerical Optimization, 2006, 6.1) with a trust region.

    A trial is rejected if its value is not below the best value, or if its value or gradient is not finite. A rejected
    trial still updates the inverse Hessian, unless it lies beyond a jump of the function (JUMP). Values are logarithms.
    """

    def init(x: Array) -> BFGSState:
        never, radius = (jnp.asarray(number, x.dtype) for number in (jnp.inf, FIRST_RADIUS))
        return BFGSState(x, never, jnp.zeros_like(x), jnp.eye(len(x), dtype=x.dtype), radius, jnp.zeros((), int))

    def update(gradient: Array, state: BFGSState, x: Array, *, value: Array, **_: object) -> tuple[Array, BFGSState]:
        finite, gradient = _finite(gradient, value)
        accept = finite & (value < state.value)
        smooth = finite & (value < state.value + JUMP)
        s, y = x - state.best, gradient - state.gradient
        inverse = _updated_inverse(state, s, y, smooth)
        tried = jnp.sqrt(s @ s)
        wider = jnp.minimum(jnp.maximum(state.radius, 2 * tried), LARGEST_RADIUS)
        narrower = jnp.where(smooth, CONTRACTION, BACKTRACK) * tried
        radius = jnp.where(state.trials == 0, state.radius, jnp.where(accept, wider, narrower))
        best, slope = jnp.where(accept, x, state.best), jnp.where(accept, gradient, state.gradient)
        step = -inverse @ slope
        step = jnp.where(slope @ step < 0, step, -slope)
        length = jnp.sqrt(step @ step)
        step = step * jnp.minimum(1.0, radius / jnp.where(length > 0, length, 1.0))
        value = jnp.where(accept, value, state.value)
        return best + step - x, BFGSState(best, value, slope, inverse, radius, state.trials + 1)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _updated_inverse(state: BFGSState, s: Array, y: Array, smooth: Array) -> Array:
    """Return the inverse Hessian [m, m] after an update with the step s [m] and the gradient's change y [m]."""
    curvature = s @ y
    usable = (state.trials > 0) & smooth & (curvature > 1e-10 * jnp.sqrt((s @ s) * (y @ y)))
    rho = 1 / jnp.where(usable, curvature, 1.0)
    # The first pair (s, y) of a search sets the scale of the inverse Hessian.
    scale = jnp.where(state.trials == 1, curvature / jnp.where(usable, y @ y, 1.0), 1.0)
    left = jnp.eye(len(s), dtype=s.dtype) - rho * jnp.outer(s, y)
    return jnp.where(usable, scale * left @ state.inverse @ left.T + rho * jnp.outer(s, s), state.inverse)


def backtracking(inner: optax.GradientTransformation) -> optax.GradientTransformationExtraArgs:
    """Return an optimiser that rejects trials with a value or gradient that is not finite.

    A rejected trial does not change the state of `inner`. The next trial lies between the best point and the rejected
    one, at the fraction BACKTRACK of their distance.
    """

    def init(x: Array) -> FirstOrderState:
        return FirstOrderState(x, jnp.asarray(jnp.inf, x.dtype), inner.init(x))

    def update(
        gradient: Array, state: FirstOrderState, x: Array, *, value: Array, **_: object
    ) -> tuple[Array, FirstOrderState]:
        accept, gradient = _finite(gradient, value)
        better = accept & (value < state.value)
        step: Any
        step, after = inner.update(gradient, state.inner, x)
        step = jnp.where(accept, step, state.best + BACKTRACK * (x - state.best) - x)
        after = jax.tree.map(lambda p, q: jnp.where(accept, p, q), after, state.inner)
        return step, FirstOrderState(jnp.where(better, x, state.best), jnp.where(better, value, state.value), after)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _finite(gradient: Array, value: Array) -> tuple[Array, Array]:
    """Return whether value and gradient [m] are finite, and the gradient, or zeros if they are not."""
    finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
    return finite, jnp.where(finite, gradient, 0.0)
