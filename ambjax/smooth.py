"""Smooth stand-ins for functions whose derivative jumps or blows up."""

import jax.numpy as jnp
from jax import Array

from ambjax._pytree import Scalar

TWO_OVER_PI = 0.6366197723675814


def smooth_sign(x: Scalar, p: Scalar) -> Array:
    """sgn(x) as 2/pi arctan(p x); slope 2p/pi at zero. Remark 3 of the paper.

    `p` has the inverse unit of `x`.
    """
    return TWO_OVER_PI * jnp.arctan(p * jnp.asarray(x))


def smooth_root(x: Scalar, p: Scalar) -> Array:
    """sqrt(|x|) sgn(x) as x / (x^2 + 1/p^2)^(1/4); slope sqrt(p) at zero instead of infinity."""
    x = jnp.asarray(x)
    return x / jnp.sqrt(jnp.sqrt(x * x + 1.0 / (p * jnp.asarray(p))))


def safe_sqrt(x: Scalar) -> Array:
    """sqrt(max(x, 0)) with derivative 0, not infinity, where x <= 0."""
    x = jnp.asarray(x)
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def away_from_zero(x: Scalar, floor: Scalar) -> Array:
    """x, with its magnitude held at `floor` or more and its sign kept (0 counts as positive)."""
    x = jnp.asarray(x)
    near = jnp.abs(x) < floor
    return jnp.where(near, jnp.where(x < 0, -1.0, 1.0) * floor, x)
