"""Optimisers by name: all of optax's that need a learning rate alone, and a BFGS for a handful of gains."""

import inspect
from typing import Any, NamedTuple

import jax.numpy as jnp
import optax
from jax import Array

# Longest step of the BFGS: about a factor e in one gain.
LONGEST = 1.0
FIRST = 0.3


class Memory(NamedTuple):
    """Inverse Hessian [m, m], the last point and gradient [m], and how many of them there were."""

    inverse: Array
    x: Array
    gradient: Array
    seen: Array


def bfgs() -> optax.GradientTransformation:
    """Dense BFGS (Nocedal and Wright, Numerical Optimization, 2006, 6.1) with steps of at most LONGEST.

    The inverse Hessian of a few gains is cheap to keep whole; in logarithms of gains its scale is of order 1.
    """

    def init(params: Any) -> Memory:
        x = jnp.asarray(params)
        return Memory(jnp.eye(x.shape[0], dtype=x.dtype), x, jnp.zeros_like(x), jnp.zeros((), int))

    def update(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        gradient, x = updates, jnp.asarray(params)
        s, y = x - state.x, gradient - state.gradient
        curvature = s @ y
        usable = (state.seen > 0) & (curvature > 1e-10 * jnp.sqrt((s @ s) * (y @ y)))
        rho = 1 / jnp.where(usable, curvature, 1.0)
        # the first pair sets the scale
        scaled = jnp.where(state.seen == 1, curvature / jnp.where(usable, y @ y, 1.0), 1.0) * state.inverse
        left = jnp.eye(x.shape[0], dtype=x.dtype) - rho * jnp.outer(s, y)
        inverse = jnp.where(usable, left @ scaled @ left.T + rho * jnp.outer(s, s), state.inverse)
        step = -inverse @ gradient
        step = jnp.where(gradient @ step < 0, step, -gradient)
        length = jnp.sqrt(step @ step)
        most = jnp.where(state.seen == 0, FIRST, LONGEST)
        step = step * jnp.minimum(1.0, most / jnp.where(length > 0, length, 1.0))
        return step, Memory(inverse, x, gradient, state.seen + 1)

    return optax.GradientTransformation(init, update)


def names() -> list[str]:
    """Optimisers that may be asked for."""
    return ["bfgs", *sorted(_optax())]


def optimiser(name: str, learning_rate: float) -> optax.GradientTransformation:
    """The optimiser of this name."""
    return bfgs() if name == "bfgs" else _optax()[name](learning_rate)


def _optax() -> dict[str, Any]:
    """optax's optimisers that take a learning rate and need nothing else, and only gradients."""
    found = {}
    for name in ("adabelief", "adagrad", "adam", "adamax", "adan", "lamb", "lion", "nadam", "radam", "rmsprop", "sgd"):
        made = getattr(optax, name, None)
        if made is not None and "learning_rate" in inspect.signature(made).parameters:
            found[name] = made
    return found
