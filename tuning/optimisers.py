"""Optimisers by name, all of them optax's transformations: its own of first order, and a BFGS for a handful of gains.

Each is told the value at the point where the gradient was taken, `update(gradient, state, x, value=...)`, and holds in
its state the best point and value so far; a trial that it refuses is left again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

BFGS = "bfgs"
# optax's optimisers that need a learning rate alone, and only gradients.
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

# Longest step of the BFGS: about a factor e in one gain. The first step, before any curvature is known.
LONGEST, FIRST = 1.0, 0.3
# A refused trial halves the longest step; one far behind a cliff says nothing about curvature, and quarters it.
HALF, QUARTER = 0.5, 0.25
# A trial whose value, a logarithm, is worse than the best by more than this is behind a cliff.
CLIFF = 1.0
# A refused step of an optimiser of optax's own is tried again at this share of its length.
SHORTER = 0.25


class Curvature(NamedTuple):
    """State of the BFGS: best point [m], value and gradient [m] there, inverse Hessian [m, m], longest step, trials."""

    best: Array
    value: Array
    gradient: Array
    inverse: Array
    radius: Array
    seen: Array

    def anew(self, fresh: "Curvature") -> "Curvature":
        """The fresh state elsewhere, for another goal of the same curvature."""
        return fresh._replace(inverse=self.inverse, radius=jnp.full_like(self.radius, LONGEST))


class Retreat(NamedTuple):
    """State of a first-order optimiser that steps back: its own (`inner`), the best point [m] and its value."""

    best: Array
    value: Array
    inner: Any

    def anew(self, fresh: "Retreat") -> "Retreat":
        """The fresh state elsewhere, for another goal."""
        return fresh


def optimiser(name: str, learning_rate: float) -> optax.GradientTransformationExtraArgs:
    """The optimiser of this name, one of NAMES; the BFGS finds the length of its steps itself."""
    return bfgs() if name == BFGS else stepping_back(FIRST_ORDER[name](learning_rate))


def bfgs() -> optax.GradientTransformationExtraArgs:
    """A dense BFGS (Nocedal and Wright, Numerical Optimization, 2006, 6.1) in a trust region.

    A refused trial, no better than the best, tells of the curvature too, if it is on the same slope (CLIFF): the next
    one starts from the best point again, better informed. Values are logarithms.
    """

    def init(x: Array) -> Curvature:
        never, radius = (jnp.asarray(number, x.dtype) for number in (jnp.inf, FIRST))
        return Curvature(x, never, jnp.zeros_like(x), jnp.eye(len(x), dtype=x.dtype), radius, jnp.zeros((), int))

    def update(gradient: Array, state: Curvature, x: Array, *, value: Array, **_: Any) -> tuple[Array, Curvature]:
        finite, gradient = _finite(gradient, value)
        accept = finite & (value < state.value)
        smooth = finite & (value < state.value + CLIFF)
        s, y = x - state.best, gradient - state.gradient
        inverse = _informed(state, s, y, smooth)
        tried = jnp.sqrt(s @ s)
        wider = jnp.minimum(jnp.maximum(state.radius, 2 * tried), LONGEST)
        narrower = jnp.where(smooth, HALF, QUARTER) * tried
        radius = jnp.where(state.seen == 0, state.radius, jnp.where(accept, wider, narrower))
        best, slope = jnp.where(accept, x, state.best), jnp.where(accept, gradient, state.gradient)
        step = -inverse @ slope
        step = jnp.where(slope @ step < 0, step, -slope)
        length = jnp.sqrt(step @ step)
        step = step * jnp.minimum(1.0, radius / jnp.where(length > 0, length, 1.0))
        value = jnp.where(accept, value, state.value)
        return best + step - x, Curvature(best, value, slope, inverse, radius, state.seen + 1)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _informed(state: Curvature, s: Array, y: Array, smooth: Array) -> Array:
    """The inverse Hessian [m, m] that knows of the step s [m] and the gradient's change y [m] along it."""
    curvature = s @ y
    usable = (state.seen > 0) & smooth & (curvature > 1e-10 * jnp.sqrt((s @ s) * (y @ y)))
    rho = 1 / jnp.where(usable, curvature, 1.0)
    # the first pair sets the scale
    scale = jnp.where(state.seen == 1, curvature / jnp.where(usable, y @ y, 1.0), 1.0)
    left = jnp.eye(len(s), dtype=s.dtype) - rho * jnp.outer(s, y)
    return jnp.where(usable, scale * left @ state.inverse @ left.T + rho * jnp.outer(s, s), state.inverse)


def stepping_back(inner: optax.GradientTransformation) -> optax.GradientTransformationExtraArgs:
    """An optimiser whose trials where the value or gradient is no number are refused: it does not see them.

    The next one is at SHORTER of the way from the best point to the refused one.
    """

    def init(x: Array) -> Retreat:
        return Retreat(x, jnp.asarray(jnp.inf, x.dtype), inner.init(x))

    def update(gradient: Array, state: Retreat, x: Array, *, value: Array, **_: Any) -> tuple[Array, Retreat]:
        accept, gradient = _finite(gradient, value)
        better = accept & (value < state.value)
        step: Any
        step, after = inner.update(gradient, state.inner, x)
        step = jnp.where(accept, step, state.best + SHORTER * (x - state.best) - x)
        after = jax.tree.map(lambda p, q: jnp.where(accept, p, q), after, state.inner)
        return step, Retreat(jnp.where(better, x, state.best), jnp.where(better, value, state.value), after)

    return optax.GradientTransformationExtraArgs(init, update)  # pyright: ignore[reportArgumentType]


def _finite(gradient: Array, value: Array) -> tuple[Array, Array]:
    """Whether value and gradient [m] are numbers, and the gradient, or zeros."""
    finite = jnp.isfinite(value) & jnp.isfinite(gradient).all()
    return finite, jnp.where(finite, gradient, 0.0)
