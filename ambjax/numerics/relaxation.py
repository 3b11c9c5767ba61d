"""A variable that relaxes under a smoothed sign: w' = drift - gain sgn(w), over a step of any length."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign

# Newton steps on the slaved sign: monotone from below; they leave less than 1e-3 of the right-hand side.
NEWTON = 6
# |w| p below which w is slaved at once. Within the layer it relaxes in 1/(gamma p), not at its initial rate: a slide
# there would end anywhere in the step for a change of w by a millionth, and derivatives would be such cliffs'.
EDGE = 1.0


def relaxation(w: Array, drift: Array, gain: Scalar, p: Scalar, h: Scalar) -> tuple[Array, Array, Array]:
    """w' = drift - gain sgn(w) over h, as two constant rates of `gain sgn(w)`: (first, second, time of the first).

    First it slides at its initial rate to the sign's layer (or to the end); then it is slaved, one backward Euler step.
    """
    first = gain * smooth_sign(w, p)
    closing = first - drift
    outside = jnp.sign(w) * jnp.maximum(jnp.abs(w) - EDGE / p, 0.0)
    safe = jnp.where(closing == 0, 1.0, closing)
    tau = jnp.where(outside * closing > 0, jnp.minimum(outside * (1 / safe), h), 0.0)
    left = h - tau
    return first, gain * smooth_sign(_implicit(w - tau * closing + left * drift, left * gain, p), p), tau


@jax.custom_jvp
def _implicit(b: Array, reach: Array, p: Scalar) -> Array:
    """The w with w + reach sgn(w) = b, by Newton's method from below: the left side is concave in |w|.

    Its derivative is that of the equation, not of the iteration: a fifth of the work.
    """
    size = jnp.abs(b)
    w = jnp.maximum(size / (1 + reach * p * TWO_OVER_PI), size - reach)
    for _ in range(NEWTON):
        slope = 1 + reach * p * TWO_OVER_PI / (1 + (p * w) ** 2)
        w = w + (size - w - reach * smooth_sign(w, p)) / slope
    return jnp.where(b < 0, -w, w)


@_implicit.defjvp
def _implicit_jvp(primals: tuple[Array, Array, Scalar], tangents: tuple[Any, Any, Any]) -> tuple[Array, Array]:
    (b, reach, p), (db, d_reach, dp) = primals, tangents
    w = _implicit(b, reach, p)
    flat = TWO_OVER_PI / (1 + (p * w) ** 2)
    change = db - smooth_sign(w, p) * d_reach - reach * flat * w * dp
    return w, change / (1 + reach * p * flat)
