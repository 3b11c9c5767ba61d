"""Explicit Runge-Kutta methods with equal substeps, for smooth gains: Euler, RK4, Dormand-Prince."""

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax._apart import apart
from ambjax._pytree import Scalar, record
from ambjax.integrate import Problem, Times, _Fixed


@functools.cache
def _combination(weights: tuple[float, ...]) -> Callable[..., Array]:
    """x + h sum of weight * rate, in a loop of its own: what it is given and gives is stored, never computed again."""

    def plain(x: Array, h: Array, rates: tuple[Array, ...]) -> Array:
        first, *others = ((w, k) for w, k in zip(weights, rates, strict=True) if w)
        total = first[0] * first[1]
        for w, k in others:
            total = total + w * k
        return x + h * total

    combined = jax.custom_jvp(apart(plain))

    @combined.defjvp
    def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
        (x, h, rates), (dx, dh, d_rates) = primals, tangents
        slope = sum(w * k for w, k in zip(weights, rates, strict=True) if w)
        return combined(x, h, rates), combined(dx, h, d_rates) + dh * slope  # tangents are kept from fusion likewise

    return combined


class _Explicit(_Fixed):
    """An explicit Runge-Kutta method: the times of its stages, and weights in the state after each, the new one last.

    Stages are written out, and the state that each begins from is kept from XLA's fusion: fused, shared terms of the
    right-hand side are computed again for every component of every stage.
    """

    TIMES: ClassVar[tuple[float, ...]]
    ROWS: ClassVar[tuple[tuple[float, ...], ...]]

    def _step(self, problem: Problem, at: Times, h: Scalar, state: Any) -> Any:
        inputs = {share: problem.inputs(at(share)) for share in self.TIMES}
        x, stages, h = state, [], jnp.asarray(h)
        for share, row in zip(self.TIMES, self.ROWS, strict=True):
            stages.append(problem.rates(inputs[share], x))
            combined = _combination(row)
            x = jax.tree.map(lambda x, *ks, combined=combined: combined(x, h, ks), state, *stages)
        return x


@record
class Euler(_Explicit):
    """Explicit Euler, order 1."""

    limit = 2.0
    TIMES = (0.0,)
    ROWS = ((1.0,),)

    def __str__(self) -> str:
        return f"explicit Euler, {self.substeps} substeps"


@record
class RK4(_Explicit):
    """The classical explicit Runge-Kutta method, order 4."""

    limit = 2.785
    TIMES = (0.0, 1 / 2, 1 / 2, 1.0)
    ROWS = ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6))

    def __str__(self) -> str:
        return f"RK4, {self.substeps} substeps"


@record
class DormandPrince(_Explicit):
    """Dormand and Prince's method, order 5: for held noise, where accuracy sets the step.

    J. Comput. Appl. Math. 6 (1980) 19-26. Its seventh stage serves an error estimate only, which equal steps do not
    need.
    """

    limit = 3.3
    TIMES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0)
    ROWS = (
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    )

    def __str__(self) -> str:
        return f"Dormand-Prince 5, {self.substeps} substeps"
