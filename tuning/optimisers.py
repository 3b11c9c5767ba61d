"""Optimisers by name: all of optax's that need a learning rate alone, and a BFGS for a handful of gains."""

import inspect
from typing import Any, NamedTuple

import jax.numpy as jnp
import optax
from jax import Array

BFGS = "bfgs"
# Longest step of the BFGS: about a factor e in one gain. The first step, before any curvature is known.
LONGEST, FIRST = 1.0, 0.3
# A refused trial halves the longest step; one far behind a cliff says nothing about curvature, and quarters it.
HALF, QUARTER = 0.5, 0.25


class Memory(NamedTuple):
    """Inverse Hessian [m, m], the best point and its gradient [m], longest step now, and trials seen."""

    inverse: Array
    x: Array
    gradient: Array
    radius: Array
    seen: Array


def begin(x: Array, inverse: Array | None = None) -> Memory:
    """Before the first gradient, at x [m]; with an inverse Hessian if one is known."""
    radius = jnp.asarray(FIRST if inverse is None else LONGEST, x.dtype)
    inverse = jnp.eye(x.shape[0], dtype=x.dtype) if inverse is None else inverse
    return Memory(inverse, x, jnp.zeros_like(x), radius, jnp.zeros((), int))


def bfgs(memory: Memory, x: Array, gradient: Array, accept: Array, smooth: Array) -> tuple[Array, Memory]:
    """The next trial [m] of a dense BFGS (Nocedal and Wright, Numerical Optimization, 2006, 6.1) in a trust region.

    `gradient` is that at the trial x; it has become the best point if `accept`. A refused trial tells of the curvature
    too, if it is on the same slope (`smooth`): the next one starts from the best point again, better informed.
    """
    s, y = x - memory.x, gradient - memory.gradient
    tried, curvature = jnp.sqrt(s @ s), s @ y
    usable = (memory.seen > 0) & smooth & (curvature > 1e-10 * jnp.sqrt((s @ s) * (y @ y)))
    rho = 1 / jnp.where(usable, curvature, 1.0)
    # the first pair sets the scale
    scale = jnp.where(memory.seen == 1, curvature / jnp.where(usable, y @ y, 1.0), 1.0)
    left = jnp.eye(x.shape[0], dtype=x.dtype) - rho * jnp.outer(s, y)
    inverse = jnp.where(usable, scale * left @ memory.inverse @ left.T + rho * jnp.outer(s, s), memory.inverse)
    wider = jnp.minimum(jnp.maximum(memory.radius, 2 * tried), LONGEST)
    narrower = jnp.where(smooth, HALF, QUARTER) * tried
    radius = jnp.where(memory.seen == 0, memory.radius, jnp.where(accept, wider, narrower))
    at, slope = jnp.where(accept, x, memory.x), jnp.where(accept, gradient, memory.gradient)
    step = -inverse @ slope
    step = jnp.where(slope @ step < 0, step, -slope)
    length = jnp.sqrt(step @ step)
    step = step * jnp.minimum(1.0, radius / jnp.where(length > 0, length, 1.0))
    return at + step, Memory(inverse, at, slope, radius, memory.seen + 1)


def names() -> list[str]:
    """Optimisers that may be asked for."""
    return [BFGS, *sorted(_optax())]


def optimiser(name: str, learning_rate: float) -> optax.GradientTransformation:
    """optax's optimiser of this name."""
    return _optax()[name](learning_rate)


def _optax() -> dict[str, Any]:
    """optax's optimisers that take a learning rate and need nothing else, and only gradients."""
    found = {}
    for name in ("adabelief", "adagrad", "adam", "adamax", "adan", "lamb", "lion", "nadam", "radam", "rmsprop", "sgd"):
        made = getattr(optax, name, None)
        if made is not None and "learning_rate" in inspect.signature(made).parameters:
            found[name] = made
    return found
