"""Optimisers by name, as optax transformations: optax's first-order methods, and a BFGS for a few gains.

`update(gradient, state, x, value=...)` receives the value at the trial x. The state holds the best point so far and its
value. After a rejected trial the next one starts from the best point.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

BFGS = "bfgs"
# optax's optimisers that need only gradients and a learning rate.
FIRST_ORDER: dict[str, Callable[[float], optax.GradientTransformation]] = {
    "adabelief": optax.adabelief,
    "adagrad": optax.adagrad,
    "adam": optax.adam,
    "adamax": optax.adamax,
    "adan": optax.adan,
    "lamb": optax.lamb,
    "lion": optax.lion,
    "nadam": optax.nadam,
    "radam": optax.radam,
    "rmsprop": optax.rmsprop,
    "sgd": optax.sgd,
}
NAMES = (BFGS, *FIRST_ORDER)

# Longest step of the BFGS (1: a factor e of one gain), and the first step, taken before an estimate of the curvature.
LONGEST, FIRST = 1.0, 0.3
# A rejected trial reduces the trust radius to this share of its step: HALF, or QUARTER beyond a cliff.
HALF, QUARTER = 0.5, 0.25
# A trial is beyond a cliff if its value, a logarithm, exceeds the best by more than this.
CLIFF = 1.0
# A rejected step of a first-order optimiser is repeated at this share of its length.
SHORTER = 0.25


class Curvature(NamedTuple):
    """State of the BFGS: best point [m], its value and gradient [m], inverse Hessian [m, m], trust radius, trials."""

    best: Array
    value: Array
    gradient: Array
    inverse: Array
    radius: Array
    trials: Array

    def restarted(self, fresh: "Curvature") -> "Curvature":
        """Return the state `fresh` with the inverse Hessian of this one, for a goal of the same curvature."""
        return fresh._replace(inverse=self.inverse, radius=jnp.full_like(self.radius, LONGEST))


class Retreat(NamedTuple):
    """State of a first-order optimiser that steps back: best point [m], its value, and the state of optax (`inner`)."""

    best: Array
    value: Array
    inner: Any

    def restarted(self, fresh: "Retreat") -> "Retreat":
        """Return the state `fresh`."""
        return fresh


def optimiser(name: str, learning_rate: float) -> optax.GradientTransformationExtraArgs:
    """Return the optimiser of this name, one of NAMES. The BFGS does not use `learning_rate`."""
    return bfgs() if name == BFGS else stepping_back(FIRST_ORDER[name](learning_rate))


def bfgs() -> optax.GradientTransformationExtraArgs:
    """Return a dense BFGS (Nocedal and Wright, Numerical Optimization, 2006, 6.1) with a trust region.

    A trial is rejected if it does not improve on the best point. It still updates the inverse Hessian, unless it lies
    beyond a cliff (CLIFF). Values are logarithms.
    """

    def init(x: Array) -> Curvature:
        never, radius = (jnp.asarray(number, x.dtype) for number in (jnp.inf, FIRST))
        return Curvature(x, never, jnp.zeros_like(x), jnp.eye(len(x), dtype=x.dtype), radius, jnp.zeros((), int))

    def update(gradient: Array, state: Curvature, x: Array, *, value: Array, **_: object) -> tuple[Array, Curvature]:
        finite, gradient = _finite(gradient, value)
        accept = finite & (value < state.value)
        smooth = finite & (value < state.value + CLIFF)
        s, y = x - state.best, gradient - state.gradient
        inverse = _updated_inverse(state, s, y, smooth)
        tried = jnp.sqrt(s @ s)
        wider = jnp.minimum(jnp.maximum(state.radius, 2 * tried), LONGEST)
        narrower = jnp.where(smooth, HALF, QUARTER) * tried
        radius = jnp.where(state.trials == 0, state.radius, jnp.where(accept, wider, narrower))
        best, slope = jnp.where(accept, x, state.best), jnp.where(accept, gradient, state.gradient)
        step = -inverse @ slope
        step = jnp.where(slope @ step < 0, step, -slope)
        length = jnp.sqrt(step @ step)
        step = step * jnp.minimum(1.0, radius / jnp.where(length > 0, length, 1.0))
        value = jnp.where(accept, value, state.value)
        return best + step - x, Curvature(best, value, slope, inverse, radius, state.trials + 1)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _updated_inverse(state: Curvature, s: Array, y: Array, smooth: Array) -> Array:
    """Return the inverse Hessian [m, m] after an update with the step s [m] and the gradient's change y [m]."""
    curvature = s @ y
    usable = (state.trials > 0) & smooth & (curvature > 1e-10 * jnp.sqrt((s @ s) * (y @ y)))
    rho = 1 / jnp.where(usable, curvature, 1.0)
    # the first pair sets the scale
    scale = jnp.where(state.trials == 1, curvature / jnp.where(usable, y @ y, 1.0), 1.0)
    left = jnp.eye(len(s), dtype=s.dtype) - rho * jnp.outer(s, y)
    return jnp.where(usable, scale * left @ state.inverse @ left.T + rho * jnp.outer(s, s), state.inverse)


def stepping_back(inner: optax.GradientTransformation) -> optax.GradientTransformationExtraArgs:
    """Return an optimiser that rejects trials with a value or gradient that is not finite.

    A rejected trial does not change the state of `inner`. The next trial is at the share SHORTER of the way from the
    best point to the rejected one.
    """

    def init(x: Array) -> Retreat:
        return Retreat(x, jnp.asarray(jnp.inf, x.dtype), inner.init(x))

    def update(gradient: Array, state: Retreat, x: Array, *, value: Array, **_: object) -> tuple[Array, Retreat]:
        accept, gradient = _finite(gradient, value)
        better = accept & (value < state.value)
        step: Any
        step, after = inner.update(gradient, state.inner, x)
        step = jnp.where(accept, step, state.best + SHORTER * (x - state.best) - x)
        after = jax.tree.map(lambda p, q: jnp.where(accept, p, q), after, state.inner)
        return step, Retreat(jnp.where(better, x, state.best), jnp.where(better, value, state.value), after)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _finite(gradient: Array, value: Array) -> tuple[Array, Array]:
    """Return whether value and gradient [m] are finite, and the gradient, or zeros if they are not."""
    finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
    return finite, jnp.where(finite, gradient, 0.0)
