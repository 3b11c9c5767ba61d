"""Explicit Runge-Kutta methods for smooth gains: Euler, RK4, DOP853 with equal steps, Cash-Karp with adaptive steps."""

import functools
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import compiled_alone, materialised
from ambjax.numerics.records import Scalar, record
from ambjax.simulation.adaptive import AdaptiveSteps, Attempt
from ambjax.simulation.integrate import FixedSteps, InitialValueProblem, Times
from ambjax.simulation.trajectory import Instant, Span


@functools.cache
def _combination(weights: tuple[float, ...]) -> Callable[..., Array]:
    """Return the function (x, h, rates) -> x + h sum(weight * rate), on CPUs compiled as a separate loop."""

    def plain(x: Array, h: Array, rates: tuple[Array, ...]) -> Array:
        first, *others = ((w, k) for w, k in zip(weights, rates, strict=True) if w)
        total = first[0] * first[1]
        for w, k in others:
            total = total + w * k
        return x + h * total

    combination = jax.custom_jvp(compiled_alone(plain))

    @combination.defjvp
    def _(
        primals: tuple[Array, Array, tuple[Array, ...]], tangents: tuple[Array, Array, tuple[Array, ...]]
    ) -> tuple[Array, Array]:
        (x, h, rates), (dx, dh, d_rates) = primals, tangents
        slope = sum(w * k for w, k in zip(weights, rates, strict=True) if w)
        return combination(x, h, rates), combination(dx, h, d_rates) + dh * slope  # tangents are not fused either

    return combination


class _Tableau:
    """Base class of explicit Runge-Kutta methods.

    - `TIMES`: times of the stages, as fractions of the step.
    - `ROWS`: Butcher tableau: row k has the weights of the first k rates in the state at stage k + 1; the last row
      gives the new state.

    On CPUs, the rates and the state of each stage are excluded from XLA's fusion.
    """

    TIMES: ClassVar[tuple[float, ...]]
    ROWS: ClassVar[tuple[tuple[float, ...], ...]]

    def _stages(self, problem: InitialValueProblem, at: Times, h: Array, state: Any) -> tuple[Any, list, list[Instant]]:
        inputs = {share: problem.inputs(at(share)) for share in self.TIMES}
        x, rates, instants = state, [], []
        for share, row in zip(self.TIMES, self.ROWS, strict=True):
            rate, instant = problem.rates_and_signals(inputs[share], x)
            rates.append(materialised(rate, x))
            instants.append(instant)
            combination = _combination(row)
            x = jax.tree.map(lambda x, *ks, combination=combination: combination(x, h, ks), state, *rates)
        return x, rates, instants


class _Explicit(_Tableau, FixedSteps):
    """Base class of explicit Runge-Kutta methods with equal substeps."""

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        h = jnp.asarray(h)
        x, _, (first, *others) = self._stages(problem, at, h, state)
        # Integrals use the weights of the method. Only the first stage counts for extremes; the others are trial
        # states.
        span = span.with_instant(first, self.ROWS[-1][0] * h, h)
        for instant, weight in zip(others, self.ROWS[-1][1:], strict=True):
            span = span.with_densities(instant, weight * h)
        return x, span


@record
class Euler(_Explicit):
    """Explicit Euler, order 1.

    Use it only for comparisons, with many substeps: `Clock(1000, 1e-4, solvers.Euler(100))`.
    """

    title = "explicit Euler"
    limit = 2.0
    TIMES = (0.0,)
    ROWS = ((1.0,),)


@record
class RK4(_Explicit):
    """The classical explicit Runge-Kutta method, order 4.

    Use it where a fixed number of steps is wanted and the loop is not stiff: `Clock(1000, 1e-4, solvers.RK4(4))`.
    """

    title = "RK4"
    limit = 2.785
    TIMES = (0.0, 1 / 2, 1 / 2, 1.0)
    ROWS = ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6))


@record
class DOP853(_Explicit):
    """Dormand and Prince's method of order 8, with 12 stages.

    Suitable if the noise is held over each sample: one or two steps per sample are then sufficient.

    Coefficients: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I (2nd ed., 1993), II.10. The
    error estimates are omitted, because the steps are fixed.

    `Clock(1000, 1e-4, solvers.DOP853(1))` takes one step per sample.
    """

    title = "DOP853"
    limit = 6.39
    # fmt: off
    TIMES = (0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726, 1 / 3, 1 / 4,
             4 / 13, 127 / 195, 3 / 5, 6 / 7, 1.0)
    ROWS = (
        (0.05260015195876773,),
        (0.0197250569845379, 0.0591751709536137),
        (0.02958758547680685, 0.0, 0.08876275643042054),
        (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
        (1 / 27, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
        (19 / 512, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -9 / 512),
        (0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328, -0.015319437748624402,
         0.008273789163814023),
        (0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726, 27.59209969944671, 20.154067550477894,
         -43.48988418106996),
        (0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843, 21.230051448181193, 15.279233632882423,
         -33.28821096898486, -0.020331201708508627),
        (-0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295, -8.149787010746927, -18.52006565999696,
         22.739487099350505, 2.4936055526796523, -3.0467644718982196),
        (2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188, 27.94888452941996,
         -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636),
        (0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003, -5.801203960010585,
         0.3111643669578199, -0.1521609496625161, 0.20136540080403034, 0.04471061572777259),
    )
    # fmt: on


@record
class AdaptiveCashKarp(_Tableau, AdaptiveSteps):
    """The method of Cash and Karp, order 5(4), with adaptive steps. `AdaptiveSteps` defines the allowed error.

    Suitable if the loop is not stiff. A trial step takes six evaluations and no Jacobian. A kink of the rates, such as
    the limit of the supply, takes few of them.

    Coefficients: Cash and Karp, ACM Trans. Math. Softw. 16 (1990) 201-222. `ERROR`: the weights of the solution of
    order 5 minus those of order 4.

    `Clock(1000, 1e-4, solvers.AdaptiveCashKarp(1e-8))` sets the allowed error.
    """

    title = "Cash-Karp 5(4)"
    ORDER = 5
    TIMES = (0.0, 1 / 5, 3 / 10, 3 / 5, 1.0, 7 / 8)
    ROWS = (
        (1 / 5,),
        (3 / 40, 9 / 40),
        (3 / 10, -9 / 10, 6 / 5),
        (-11 / 54, 5 / 2, -70 / 27, 35 / 27),
        (1631 / 55296, 175 / 512, 575 / 13824, 44275 / 110592, 253 / 4096),
        (37 / 378, 0.0, 250 / 621, 125 / 594, 0.0, 512 / 1771),
    )
    ERROR = (-277 / 64512, 0.0, 6925 / 370944, -6925 / 202752, -277 / 14336, 277 / 7084)

    def _attempt(self, problem: InitialValueProblem, at: Times, h: Array, state: Any) -> Attempt:
        def total(weights: tuple[float, ...], trees: list[Any]) -> Any:
            return jax.tree.map(lambda *ks: h * sum(w * k for w, k in zip(weights, ks, strict=True) if w), *trees)

        new, rates, instants = self._stages(problem, at, h, state)
        integrals = total(self.ROWS[-1], [x.densities for x in instants])
        return Attempt(new, total(self.ERROR, rates), instants[0], integrals)
