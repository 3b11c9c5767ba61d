"""RODAS3, an L-stable Rosenbrock method, with equal and with adaptive steps."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.numerics import linear
from ambjax.numerics.linear import axpy
from ambjax.numerics.records import Scalar, record
from ambjax.simulation.adaptive import AdaptiveSteps, Attempt
from ambjax.simulation.integrate import FixedSteps, InitialValueProblem, Times
from ambjax.simulation.trajectory import Instant, Span


def rodas3_step(problem: InitialValueProblem, at: Times, h: Scalar, state: Any) -> tuple[Any, Any, Instant]:
    """Compute one step of RODAS3, its error estimate, and the signals at its start.

    RODAS3 is a Rosenbrock method of order 3(2), L-stable and stiffly accurate (Sandu et al., Atmospheric Environment 31
    (1997) 3459-3472). A step takes one Jacobian, one factorisation of I - h J / 2 and three evaluations. Stages are
    scaled by h, so that a step with h = 0 does not change the state.
    """
    t_0 = at(0.0)
    rates = jax.jit(problem.rates)  # traced once here, not once per column of the Jacobian
    inputs, inputs_t = jax.jvp(problem.inputs, (t_0,), (jnp.ones_like(t_0),))
    factors = linear.factor(linear.jacobian(lambda x: rates(inputs, x), state), h / 2)
    f_0, f_t, here = jax.jvp(lambda s: problem.rates_and_signals(s, state), (inputs,), (inputs_t,), has_aux=True)
    inputs = problem.inputs(at(1.0))

    def stage(f: Any, *couplings: tuple[Scalar, Any]) -> Any:
        increment = jax.tree.map(lambda q: h / 2 * q, f)
        return materialised(linear.solve(factors, axpy(increment, *((c / 2, u) for c, u in couplings))))

    u_1 = stage(axpy(f_0, (h / 2, f_t)))
    u_2 = stage(axpy(f_0, (1.5 * h, f_t)), (4.0, u_1))
    y_3 = axpy(state, (2.0, u_1))
    u_3 = stage(rates(inputs, y_3), (1.0, u_1), (-1.0, u_2))
    y_4 = axpy(y_3, (1.0, u_3))
    u_4 = stage(rates(inputs, y_4), (1.0, u_1), (-1.0, u_2), (-8.0 / 3.0, u_3))
    return axpy(y_4, (1.0, u_4)), u_4, here


@record
class Rodas3(FixedSteps):
    """RODAS3 with equal substeps, for stiff loops that need reverse-mode differentiation.

    `Clock(1000, 1e-4, solvers.Rodas3(10))` takes ten substeps per sample.
    """

    title = "RODAS3 (L-stable Rosenbrock)"

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        new, _, here = rodas3_step(problem, at, h, state)
        there = problem.rates_and_signals(problem.inputs(at(1.0)), new)[1]
        return new, span.with_instant(here, h / 2, h).with_instant(there, h / 2)


@record
class AdaptiveRodas3(AdaptiveSteps):
    """RODAS3 with adaptive steps; `AdaptiveSteps` defines the allowed error of a step.

    When a stiff smoothed sign leaves saturation, the steps shrink for a few microseconds and then grow again.

    The tolerance bounds the error of each step. The error of z over a run is proportional to the response of the loop
    to an impulse: the largest later change of z after a change of the velocity. At a tolerance of 1e-7, the error of z
    is at most 1e-8 m if a velocity change of 1 m/s moves z by at most 0.1 m. The response of a rotor that is nearly
    lost is larger.

    Use it for stiff gains, and wherever the stiffness is not known: `Clock(1000, 1e-4, solvers.AdaptiveRodas3())`.
    """

    title = "RODAS3 (L-stable Rosenbrock)"
    ORDER = 3

    def _attempt(self, problem: InitialValueProblem, at: Times, h: Array, state: Any) -> Attempt:
        return Attempt(*rodas3_step(problem, at, h, state))
