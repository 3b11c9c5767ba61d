"""Implicit discretisation of signs, for laws on a processor: the sign is evaluated at the end of the step.

relax(w, h, p) returns the w+ with w+ + h sgn_p(w+) = w, where sgn_p(x) = 2/pi arctan(p x). p = None is the set-valued
sign, for which w+ = sign(w) max(|w| - h, 0). With an explicit step, w changes its sign at every sample if h p is large.
The implicit step never overshoots (V. Acary and B. Brogliato, Syst. Control Lett. 59 (2010) 284-293).

`relaxation` advances a variable under a smoothed sign in continuous time over a step of any length.
"""

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone, materialised
from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import (
    TWO_OVER_PI,
    arctan_per,
    limited,
    refined_reciprocal,
    safe_sqrt,
    smooth_root,
    smooth_sign,
)

# Steps of Halley's method. They start from the solution for a rational sign with the same tail and 2.5 times the slope
# at 0. This solution is 0.4 to 1 times the exact one. The relative residual is 3e-8 after 2 steps, and at the level of
# rounding after 3 (with Newton's method: 2e-12 after 4).
HALLEY = 3
# Steps of Halley's method for a sign and a root, in `twist`.
TWIST = 7
# Steps of Newton's method for the backward Euler step of `relaxation`. They converge monotonically from below. The
# relative residual is below 6e-3, and below 2e-5 if p reach <= 1e3.
BACKWARD_EULER = 6
# |w| p below which there is no slide. Within this boundary layer w does not keep its initial rate, but relaxes with the
# time constant pi/(2 gain p). The end of a slide there would be extremely sensitive to w, and derivatives would be
# useless.
EDGE = 1.0


def relax(w: Scalar, h: Scalar, p: Scalar | None) -> Array:
    """Return the w+ with w+ + h sgn_p(w+) = w. h >= 0 has the unit of w, and p its inverse."""
    w, h = jnp.asarray(w), jnp.asarray(h)
    if p is None:
        w = materialised(w)
        return w - limited(w, h)
    return _relaxed(p * w, TWO_OVER_PI * p * h) / p


def share(w: Scalar, h: Scalar, p: Scalar | None) -> Array:
    """Return sgn_p(w+) for w+ = relax(w, h, p), in -1..1. It equals (w - w+)/h."""
    if p is None:
        w, h = jnp.asarray(w), jnp.asarray(h)
        hard = h > 0
        return jnp.where(hard, limited(w * (1 / jnp.where(hard, h, 1.0)), 1.0), jnp.sign(w))
    return smooth_sign(relax(w, h, p), p)


@jax.custom_jvp
@compiled_alone
def _relaxed(x: Array, h: Array) -> Array:
    """Return the y with y + h arctan(y) = x."""
    size = jnp.abs(x)
    # y + reach y/(y + eps) = |x|
    reach, eps = h / TWO_OVER_PI, TWO_OVER_PI
    b = eps + reach - size
    root = jnp.sqrt(b * b + 4 * eps * size)
    y = jnp.where(b > 0, 2 * eps * size * refined_reciprocal(jnp.abs(b) + root), (root - b) / 2)
    for _ in range(HALLEY):
        flat = 1 + y * y
        steep = refined_reciprocal(flat + h)  # reciprocal first: y^4 would overflow in float32
        newton = (y + h * arctan_per(y, jnp.ones_like(y)) - size) * steep
        y = y - newton * flat * refined_reciprocal(1 + (y * steep) * (h * newton))
    return jnp.where(x < 0, -y, y)


@_relaxed.defjvp
def _relaxed_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    # derivative of the implicit equation, not of the iteration
    (x, h), (dx, dh) = primals, tangents
    y = _relaxed(x, h)
    flat = 1 + y * y
    return y, (dx - arctan_per(y, jnp.ones_like(y)) * dh) * (flat / (flat + h))


def twist(x: Scalar, a: Scalar, b: Scalar, p: Scalar | None) -> tuple[Array, Array]:
    """Return root_p(y) and sgn_p(y) for the y with y + a root_p(y) + b sgn_p(y) = x; a > 0, b >= 0.

    root_p is `smooth_root`. p = None has a closed form: if |x| <= b, then y = 0 and the sign is x/b, or sgn x if b = 0.
    """
    x, a, b = jnp.asarray(x), jnp.asarray(a), jnp.asarray(b)
    if p is None:
        y = _hard_twist(x, a, b)
        return smooth_root(y, None), jnp.where(b > 0, jnp.clip(x / jnp.where(b > 0, b, 1.0), -1.0, 1.0), jnp.sign(x))
    y = _twisted(x, a, b, jnp.asarray(p))
    return smooth_root(y, p), smooth_sign(y, p)


def _hard_twist(x: Array, a: Array, b: Array) -> Array:
    excess = jnp.maximum(jnp.abs(x) - b, 0.0)
    below = a + safe_sqrt(a * a + 4 * excess)
    root = 2 * excess / jnp.where(below > 0, below, 1.0)
    return jnp.sign(x) * root * root


@jax.custom_jvp
def _twisted(x: Array, a: Array, b: Array, p: Array) -> Array:
    """Return the y of `twist`, by Halley's method. A step out of the bracket is replaced by its geometric mean."""
    size = jnp.abs(x)
    # The solution without the root term is an upper bound. The solution for the root term of this bound is a lower one.
    above = relax(size, b, p)
    below = jnp.maximum(relax(size - a * smooth_root(above, p), b, p), _hard_twist(size, a, b))
    y = low = jnp.maximum(below, size / _steep(jnp.zeros_like(size), a, b, p))
    high = above
    for _ in range(TWIST):
        f, steep = y + a * smooth_root(y, p) + b * smooth_sign(y, p) - size, _steep(y, a, b, p)
        newton = f / steep
        low, high = jnp.where(f < 0, y, low), jnp.where(f < 0, high, y)
        y = y - newton / (1 + newton * _second_derivative(y, a, b, p) / steep)
        y = jnp.where((y >= low) & (y <= high), y, safe_sqrt(low) * safe_sqrt(high))
    return jnp.where(x < 0, -y, y)


@_twisted.defjvp
def _twisted_jvp(primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    x, a, b, p = primals
    y = _twisted(x, a, b, p)
    whole = lambda a, b, p: a * smooth_root(y, p) + b * smooth_sign(y, p)  # noqa: E731
    moved = jax.jvp(whole, (a, b, p), tangents[1:])[1]
    return y, (tangents[0] - moved) / _steep(y, a, b, p)


def _steep(y: Array, a: Array, b: Array, p: Array) -> Array:
    """Return the derivative of y + a root_p(y) + b sgn_p(y)."""
    far = y * y + 1 / (p * p)
    fourth = jnp.sqrt(jnp.sqrt(far))
    return 1 + a * (1 - y * y / (2 * far)) / fourth + b * TWO_OVER_PI * p / (1 + (p * y) ** 2)


def _second_derivative(y: Array, a: Array, b: Array, p: Array) -> Array:
    """Return minus half the second derivative of y + a root_p(y) + b sgn_p(y), for y >= 0."""
    far, flat = y * y + 1 / (p * p), 1 + (p * y) ** 2
    root = (y * y / 4 + 1.5 / (p * p)) / (far * far * jnp.sqrt(jnp.sqrt(far)))
    return y * (a * root / 2 + b * TWO_OVER_PI * p * (p / flat) ** 2)


def relaxation(
    w: Array, drift: Array, gain: Scalar, p: Scalar, h: Scalar
) -> tuple[Array, Array, Array, tuple[Array, Array, Array]]:
    """Solve w' = drift - gain sgn(w) over h (s) approximately, with two constant values of gain sgn(w).

    If w is outside the boundary layer of the sign and moves towards it, w first slides at its initial rate until it
    reaches the layer, or until the end. The rest is one backward Euler step.

    Returns the first value, the second value, the duration of the first, s, and w at the start, at the end of the first
    value and at the end of the step.
    """
    w, drift = materialised((w, drift))
    first = gain * smooth_sign(w, p)
    closing = first - drift
    outside = jnp.sign(w) * jnp.maximum(jnp.abs(w) - EDGE / p, 0.0)
    safe = jnp.where(closing == 0, 1.0, closing)
    tau = jnp.where(outside * closing > 0, jnp.minimum(outside * (1 / safe), h), 0.0)
    left = h - tau
    second = gain * smooth_sign(_backward_euler(w - tau * closing + left * drift, left * gain, p), p)
    between = w + tau * (drift - first)
    return first, second, tau, (w, between, between + left * (drift - second))


@jax.custom_jvp
def _backward_euler(b: Array, reach: Array, p: Scalar) -> Array:
    """Return the w with w + reach sgn(w) = b, by Newton's method from below; the left side is concave in |w|.

    The derivative is that of the implicit equation. It takes a fifth of the work of a derivative of the iteration.
    """
    size = jnp.abs(b)
    w = jnp.maximum(size / (1 + reach * p * TWO_OVER_PI), size - reach)
    for _ in range(BACKWARD_EULER):
        slope = 1 + reach * p * TWO_OVER_PI / (1 + (p * w) ** 2)
        w = w + (size - w - reach * smooth_sign(w, p)) / slope
    return jnp.where(b < 0, -w, w)


@_backward_euler.defjvp
def _backward_euler_jvp(
    primals: tuple[Array, Array, Scalar], tangents: tuple[Array, Array, Array]
) -> tuple[Array, Array]:
    (b, reach, p), (db, d_reach, dp) = primals, tangents
    w = _backward_euler(b, reach, p)
    flat = TWO_OVER_PI / (1 + (p * w) ** 2)
    change = db - smooth_sign(w, p) * d_reach - reach * flat * w * dp
    return w, change / (1 + reach * p * flat)
