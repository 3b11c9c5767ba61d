"""Smooth replacements of functions with discontinuous or unbounded derivatives, and fast vectorised functions."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone
from ambjax.numerics.records import Scalar

TWO_OVER_PI = 0.6366197723675814
TWO_PI = 6.283185307179586
HALF_PI = 1.5707963267948966
# fmt: off
# arctan x = x P(x^2) / Q(x^2) on |x| <= 1, relative error 2e-15, for float64.
ARCTAN_P = (1.0, 2.27400010594489066, 1.81451283323316237, 0.603864314681801684, 7.68191381424752628e-2,
            2.49654800699140172e-3)
ARCTAN_Q = (1.0, 2.60733343927809713, 2.48362397966403936, 1.05312942946270827, 0.192502581283719859,
            1.20469788049161978e-2, 1.11282795138436982e-4)
# arctan x = x R(x^2) on |x| <= 1, relative error 1.5e-8, for float32: a weighted least-squares fit.
ARCTAN_R = (0.9999999847653734, -0.33333073339931396, 0.19992619283325946, -0.14203643594913185, 0.10640930585893088,
            -0.07504287175107752, 0.04269143198666149, -0.016068575113646982, 0.0028498761308979135)
# sin(2 pi y) = y S(y^2) on |y| <= 1/4: interpolation at Chebyshev nodes. The relative error is 3e-19 for float64 and
# 7e-9 for float32.
SINE_S = {
    "float64": (6.283185307179586, -41.341702240399755, 81.60524927607362, -76.70585975282492, 42.058693925428685,
                -15.0946416761179, 3.8199280942271643, -0.7177337921413454, 0.10089695501646812),
    "float32": (6.283185280154407, -41.34168061334652, 81.60247636892518, -76.58117264427872, 39.7598270853191),
}
# fmt: on


@jax.jit
def refined_reciprocal(x: Array) -> Array:
    """Return 1/x for |x| between 1e-37 and 1e37.

    Many CPUs divide vectors of float32 faster than vectors of float64. In float64 on a CPU, the function therefore
    refines a float32 quotient by one step of third order. The error is at most about one unit in the last place. In a
    JAX trace it is a call of this name (REFINED), which the exporter writes as a quotient.
    """
    if x.dtype != jnp.float64 or jax.default_backend() != "cpu":
        return 1 / x
    rough = (1 / x.astype(jnp.float32)).astype(jnp.float64)
    error = 1 - x * rough
    return rough + rough * (error + error * error)


REFINED = "refined_reciprocal"


@jax.custom_jvp
@compiled_alone
def reciprocal(x: Array) -> Array:
    """Return 1/x, with a derivative that does not divide: divisions would dominate the cost of a gradient."""
    return refined_reciprocal(x)


reciprocal.defjvps(lambda dx, value, _: -(value * value) * dx)


def _extreme(of: Callable[..., Array], first: Callable[..., Array]) -> Callable[[Scalar, Scalar], Array]:
    """Return the function `of` (a, b) with the derivative of a where first(a, b), otherwise that of b.

    JAX's rule compares the result with a and b. If XLA computes an argument twice with different rounding, the result
    equals neither, and reverse mode returns 0.
    """
    extreme = jax.custom_jvp(lambda a, b: of(a, b))

    @extreme.defjvp
    def _(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
        return extreme(*primals), jnp.where(first(*primals), *tangents)

    return extreme


larger, smaller = _extreme(jnp.maximum, jnp.greater_equal), _extreme(jnp.minimum, jnp.less_equal)


def polynomial(u: Array, coefficients: Sequence[Scalar]) -> Scalar:
    """Evaluate a polynomial in u, coefficients in ascending order, by Estrin's scheme.

    With 9 coefficients, the chain of dependent multiply-adds is half as long as in Horner's scheme.
    """
    terms = list(coefficients)
    while len(terms) > 1:
        odd = [*terms[1::2], *[None] * (len(terms) % 2)]
        terms = [a if b is None else a + b * u for a, b in zip(terms[::2], odd, strict=True)]
        u = u * u
    return terms[0]


@jax.custom_jvp
@compiled_alone
def arctan_per(x: Array, per: Array) -> Array:
    """Return arctan(x) / per with one division.

    The function vectorises, whereas XLA's arctan is a scalar library call on CPUs. For |x| > 1 it uses arctan|x| =
    pi/2 - arctan(1/|x|). In float64 it then multiplies the numerator and the denominator of arctan(1/|x|) by a power of
    |x|. This reverses the order of their coefficients and saves a division. In a step of the loop, divisions are the
    most expensive operations.
    """
    size = jnp.abs(x)
    large = size > 1
    if x.dtype == jnp.float64:
        size = jnp.minimum(size, 1e20)  # its 12th power must not overflow
        u = size * size
        top = [jnp.where(large, far, near) for near, far in zip(ARCTAN_P, reversed(ARCTAN_P), strict=True)]
        below = [jnp.where(large, far, near) for near, far in zip(ARCTAN_Q, reversed(ARCTAN_Q), strict=True)]
        angle, over = size * polynomial(u, top), polynomial(u, below)
        angle = jnp.where(large, HALF_PI * over - angle, angle)
        return jnp.where(x < 0, -angle, angle) / (over * per)
    y = jnp.minimum(size, 1.0) / jnp.maximum(size, 1.0)
    angle = y * polynomial(y * y, ARCTAN_R)
    angle = jnp.where(large, HALF_PI - angle, angle)
    return jnp.where(x < 0, -angle, angle) / per


@arctan_per.defjvp
def _arctan_per_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    (x, per), (dx, d_per) = primals, tangents
    value = arctan_per(x, per)
    return value, (dx / (1 + x * x) - value * d_per) / per


def _reduced_angle(x: Array) -> Array:
    """Return the angle x, in turns, reduced to -1/2..1/2 without rounding error."""
    return x - jnp.floor(x + 0.5)


def _quarter(y: Array) -> Array:
    """Return sin(2 pi y) for |y| <= 1/4."""
    return y * polynomial(y * y, SINE_S[y.dtype.name])


@jax.custom_jvp
@compiled_alone
def sine(x: Array) -> Array:
    """Return sin(2 pi x), x in turns. The function vectorises, whereas XLA's sine is a library call on CPUs."""
    y = _reduced_angle(x)
    return _quarter(jnp.maximum(jnp.minimum(y, 0.5 - y), -0.5 - y))


@jax.custom_jvp
@compiled_alone
def cosine(x: Array) -> Array:
    """Return cos(2 pi x), x in turns."""
    return _quarter(0.25 - jnp.abs(_reduced_angle(x)))


sine.defjvps(lambda dx, _, x: TWO_PI * cosine(x) * dx)
cosine.defjvps(lambda dx, _, x: -TWO_PI * sine(x) * dx)


def smooth_sign(x: Scalar, p: Scalar | None, per: Scalar = 1.0) -> Array:
    """Return the smoothed sign 2/pi arctan(p x), divided by `per`. Remark 3 of the paper.

    `p` has the inverse unit of `x`; the slope at 0 is 2p/pi. p = None gives the sign without smoothing, 0 at 0.
    """
    if p is None:
        return jnp.sign(jnp.asarray(x)) / per
    return TWO_OVER_PI * arctan_per(p * jnp.asarray(x), jnp.asarray(per))


def smooth_root(x: Scalar, p: Scalar | None) -> Array:
    """Return x / (x^2 + 1/p^2)^(1/4), a smooth approximation of sqrt(|x|) sgn(x).

    The slope at 0 is sqrt(p). p = None gives sqrt(|x|) sgn(x) itself, whose slope at 0 is infinite.
    """
    x = jnp.asarray(x)
    if p is None:
        return jnp.sign(x) * safe_sqrt(jnp.abs(x))
    return x / jnp.sqrt(jnp.sqrt(x * x + 1.0 / (p * jnp.asarray(p))))


def safe_sqrt(x: Scalar) -> Array:
    """Return sqrt(max(x, 0)), with derivative 0 instead of infinity for x <= 0."""
    x = jnp.asarray(x)
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def away_from_zero(x: Scalar, floor: Scalar) -> Array:
    """Return x with its magnitude limited to at least `floor` and its sign unchanged; 0 counts as positive."""
    x = jnp.asarray(x)
    near = jnp.abs(x) < floor
    return jnp.where(near, jnp.where(x < 0, -1.0, 1.0) * floor, x)


def limited(x: Scalar, most: Scalar) -> Array:
    """Return x limited to -most..most. NaN stays NaN. jnp.clip, which tests for NaN, takes three times as long."""
    x, most = jnp.asarray(x), jnp.asarray(most)
    return jnp.where(x > most, most, jnp.where(x < -most, -most, x))
