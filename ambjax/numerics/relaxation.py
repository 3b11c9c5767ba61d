"""Relaxation of a variable under a smoothed sign, w' = drift - gain sgn(w), over a step of any length."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign

# Newton steps for the implicit sign. They converge monotonically from below; the relative residual is below 1e-3.
NEWTON = 6
# |w| p below which there is no slide. Within this boundary layer w relaxes with time constant 1/(gamma p), not at its
# initial rate. The end of a slide there would be extremely sensitive to w, and derivatives would be useless.
EDGE = 1.0


def relaxation(w: Array, drift: Array, gain: Scalar, p: Scalar, h: Scalar) -> tuple[Array, Array, Array]:
    """Solve w' = drift - gain sgn(w) over h (s) approximately, with two constant values of gain sgn(w).

    First w slides at its initial rate until it reaches the boundary layer of the sign, or until the end. The rest is
    one backward Euler step.

    Returns the first value, the second value, and the duration of the first, s.
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
    """Return the w with w + reach sgn(w) = b, by Newton's method from below; the left side is concave in |w|.

    The derivative is that of the implicit equation, not of the iteration, which takes a fifth of the work.
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
