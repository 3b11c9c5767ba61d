"""The robust exact differentiator of order m = 1 or 2, and the base class of the observers that use it.

If |f^(m+1)| <= L, its estimate of f' is exact after a finite time (A. Levant, Int. J. Control 76 (2003) 924-941):
x_k' = x_{k+1} + lam_k L^((k+1)/(m+1)) |e|^((m-k)/(m+1)) sgn e, e = f - x_0, k = 0 .. m, x_{m+1} = 0. On a processor it
is discretised by backward Euler, so that the outputs have neither chatter nor bias (R. Seeber, Proper implicit
discretization of arbitrary-order robust exact differentiators, arXiv 2404.02770).
"""

from typing import ClassVar, Self

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, rate
from ambjax.control.stages import Observer
from ambjax.numerics.records import Scalar
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement

# Levant's coefficients lam_0 .. lam_m, by order m.
LAM = {1: (1.5, 1.1), 2: (2.0, 2.12, 1.1)}
# Newton steps for the cubic, from above: after 5 the relative residual is below 2e-16 for every right-hand side.
NEWTON = 5


def smooth_rates(x: tuple[Array, ...], f: Array, L: Scalar, width: Scalar) -> tuple[Array, ...]:
    """Return x' in continuous time, with the powers of |e| smoothed over `width`.

    For |e| far below `width` (in the unit of f), x' is that of a linear observer of rate (L/width)^(1/(m+1)).
    """
    m, e = len(x) - 1, f - x[0]
    fast, near = (L / width) ** (1 / (m + 1)), e * e + width * width
    # e (e^2 + width^2)^(-(k+1)/(2(m+1))), in units of `width`
    pushes = [
        lam * fast ** (k + 1) * e * (near / (width * width)) ** (-(k + 1) / (2 * (m + 1)))
        for k, lam in enumerate(LAM[m])
    ]
    return tuple(a + b for a, b in zip(pushes, (*x[1:], jnp.zeros_like(e)), strict=True))


def implicit_step(x: tuple[Array, ...], f: Array, L: Scalar, T: Scalar) -> tuple[Array, ...]:
    """Return x at this sample from x at the previous one, by backward Euler with period T (s)."""
    m = len(x) - 1
    lam, b = LAM[m], f - sum(T**k * one for k, one in enumerate(x))
    ratio = b / (L * T ** (m + 1))
    # r^(m+1) + lam_0 r^m + .. + lam_{m-1} r = c = |ratio| - lam_m; r = 0 if the set-valued sign balances b
    c = jnp.maximum(jnp.abs(ratio) - lam[m], 0.0)
    r = 2 * c / (lam[0] + jnp.sqrt(lam[0] ** 2 + 4 * c)) if m == 1 else _cubic_root(c)
    after = [x[m] + L * T * jnp.clip(ratio, -lam[m], lam[m])]
    for k in reversed(range(m)):
        push = lam[k] * L * T ** (m - k + 1) * r ** (m - k) * jnp.sign(b)
        after.insert(0, x[k] + T * after[0] + push)
    return tuple(after)


@jax.custom_jvp
@compiled_alone
def _cubic_root(c: Array) -> Array:
    """Return the root r of `implicit_step` for m = 2."""
    square, linear, _ = LAM[2]
    # The root of each term alone is an upper bound. The left side is convex, so Newton's steps decrease to the root.
    r = jnp.minimum(jnp.minimum(c / linear, jnp.sqrt(c / square)), jnp.cbrt(c))
    for _ in range(NEWTON):
        r = r - (((r + square) * r + linear) * r - c) / ((3 * r + 2 * square) * r + linear)
    return r


@_cubic_root.defjvp
def _cubic_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # derivative of the implicit equation, not of the iteration
    r, (square, linear, _) = _cubic_root(*primals), LAM[2]
    return r, tangents[0] / ((3 * r + 2 * square) * r + linear)


# States of a differentiator.
DERIVATIVES = (
    ("z", "m", "position after the last sample"),
    ("z_dot", "m/s", "its rate"),
    ("z_ddot", "m/s^2", "its second derivative"),
)
# Width of the smoothed sign of a differentiator in continuous time, as a share of the gap.
WIDTH = 1e-6


class ExactDifferentiator(Observer[tuple[Array, ...]]):
    """Base class of robust exact differentiators. `L` bounds the derivative of order `order` + 1 of the position."""

    L: Scalar
    order: ClassVar[int]
    estimates_velocity: ClassVar[bool] = True

    def designed(self, model: Plant, sampling: Sampling | None) -> Self:
        return type(self)(model.pole ** (self.order + 1) * model.s_0 / 25)  # pyright: ignore[reportCallIssue]

    def init(self, model: Plant, measured: Measurement) -> tuple[Array, ...]:
        return (jnp.asarray(measured.z), *[jnp.zeros(())] * self.order)

    def scale(self, model: Plant) -> tuple[Scalar, ...]:
        z, z_dot, _ = model.sizes()
        return (z, z_dot, jnp.abs(model.g) / 50 + 1e-3)[: self.order + 1]

    def slope(self, model: Plant) -> Scalar:
        """Return the largest slope of x_0' of `smooth_rates` with respect to e, 1/s."""
        return LAM[self.order][0] * (self.L / (WIDTH * model.s_0)) ** (1 / (self.order + 1))

    def layer(self, model: Plant) -> tuple[Scalar, ...]:
        return (0.3 * (WIDTH * model.s_0), *[jnp.inf] * self.order)

    def __call__(
        self, model: Plant, inputs: Measurement, state: tuple[Array, ...]
    ) -> tuple[Measurement, tuple[Array, ...]]:
        return inputs._replace(z_dot=state[1]), smooth_rates(state, inputs.z, self.L, WIDTH * model.s_0)

    def step(
        self, model: Plant, inputs: Measurement, state: tuple[Array, ...], period: Scalar
    ) -> tuple[Measurement, tuple[Array, ...]]:
        after = implicit_step(state, inputs.z, self.L, period)
        # exact for polynomials of degree `order`: for order 2, the state x_1 lags by half a sample
        z_dot = after[1] + period / 2 * after[2] if self.order == 2 else after[1]
        return inputs._replace(z_dot=z_dot), after

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        power = self.order + 1
        words = f"(x w)^{power} s_0, x from 1/10 to 1"
        return {"L": rate(context, 0.1, 1, words, 1 / float(context.model.s_0), power)}
