"""Smooth stand-ins for functions whose derivative jumps or blows up."""

import jax
import jax.numpy as jnp
from jax import Array

from ambjax._pytree import Scalar

TWO_OVER_PI = 0.6366197723675814
HALF_PI = 1.5707963267948966
# arctan x = x P(x^2) / Q(x^2) on |x| <= 1, to 2e-15 relative in float64.
ARCTAN_P = (
    1.0,
    2.27400010594489066,
    1.81451283323316237,
    0.603864314681801684,
    7.68191381424752628e-2,
    2.49654800699140172e-3,
)
ARCTAN_Q = (
    1.0,
    2.60733343927809713,
    2.48362397966403936,
    1.05312942946270827,
    0.192502581283719859,
    1.20469788049161978e-2,
    1.11282795138436982e-4,
)


@jax.custom_jvp
def arctan(x: Array) -> Array:
    """arctan by one rational function, which vectorises; XLA's own is a scalar library call on CPUs."""
    size = jnp.abs(x)
    large = size > 1
    y = jnp.where(large, 1 / jnp.where(large, size, 1.0), size)
    u = y * y
    p, q = ARCTAN_P[-1], ARCTAN_Q[-1]
    for coefficient in ARCTAN_P[-2::-1]:
        p = p * u + coefficient
    for coefficient in ARCTAN_Q[-2::-1]:
        q = q * u + coefficient
    angle = y * (p / q)
    return jnp.where(x < 0, -1.0, 1.0) * jnp.where(large, HALF_PI - angle, angle)


@arctan.defjvp
def _arctan_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (dx,) = primals, tangents
    return arctan(x), dx / (1 + x * x)


def smooth_sign(x: Scalar, p: Scalar) -> Array:
    """sgn(x) as 2/pi arctan(p x); slope 2p/pi at zero. Remark 3 of the paper.

    `p` has the inverse unit of `x`.
    """
    return TWO_OVER_PI * arctan(p * jnp.asarray(x))


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
