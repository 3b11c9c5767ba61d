"""RODAS3, an L-stable Rosenbrock method, with equal and with adaptive steps."""

from typing import cast

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.compiler.barrier import materialised
from ambjax.numerics import linear
from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.integrate import (
    Advanced,
    FixedSteps,
    InitialValueProblem,
    Inputs,
    State,
    Times,
    axpy,
    choose,
    stage_times,
)
from ambjax.simulation.span import Instant, Span, blank
from ambjax.simulation.trajectory import ALIVE, STALLED


def rodas3_step(
    problem: InitialValueProblem[Inputs, State], at: Times, h: Scalar, state: State
) -> tuple[State, State, Instant]:
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

    def stage(f: State, *couplings: tuple[Scalar, State]) -> State:
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
    """RODAS3 with equal substeps, for stiff loops that need reverse-mode differentiation."""

    limit = None

    def _step(
        self, problem: InitialValueProblem[Inputs, State], at: Times, h: Scalar, state: State, span: Span
    ) -> tuple[State, Span]:
        new, _, here = rodas3_step(problem, at, h, state)
        there = problem.rates_and_signals(problem.inputs(at(1.0)), new)[1]
        return new, span.with_instant(here, h / 2, h).with_instant(there, h / 2)

    def __str__(self) -> str:
        return f"RODAS3 (L-stable Rosenbrock), {self.substeps} substeps"


# Carry of the adaptive method: state, trial step, elapsed time, status code, number of trials, previous step, and span.
_Trial = tuple[State, Array, Array, Array, Array, Array, Span]


@record
class AdaptiveRodas3:
    """RODAS3 with adaptive steps: the rms of error / allowed error over the state is at most 1 in each step.

    The error is the estimate of `rodas3_step`. The allowed error of a component is `tolerance` (scale + |state|), but
    at most the boundary layer of its smoothed sign. With a larger error, one step would move the state to the other
    side of the sign, and the next step would move it back. The steps would then shrink until the run stalls. When a
    stiff smoothed sign leaves saturation, the steps shrink for a few microseconds and then grow again. The trial step
    at the end of a sample is the first trial step of the next.

    Forward mode and vmap work. Reverse mode does not, because JAX cannot reverse a while loop.

    The tolerance bounds the error of each step. The error of z over a run is proportional to the response of the loop
    to an impulse: the largest later change of z after a change of the velocity. At a tolerance of 1e-7, the error of z
    is at most 1e-8 m if a velocity change of 1 m/s moves z by at most 0.1 m. The response of a rotor that is nearly
    lost is larger.
    """

    tolerance: Scalar = leaf(default=1e-6, unit="1", above=0, at_most=1.0, doc="relative error allowed per step")
    most_steps: int = static(default=10_000, doc="trial steps per sample period after which the run stalls")

    limit = None

    def step_size(self, period: float) -> float | None:
        return None

    def start(self, period: Scalar) -> Array:
        return jnp.asarray(period) * 1e-3

    def advance(
        self,
        problem: InitialValueProblem[Inputs, State],
        t: Scalar,
        period: Scalar,
        state: State,
        memory: object,
        code: Scalar = ALIVE,
    ) -> Advanced[State]:
        period = jnp.asarray(period)

        def unfinished(carry: _Trial[State]) -> Array:
            elapsed, code, trials = carry[2:5]
            return (elapsed < period) & (code == ALIVE) & (trials < self.most_steps)

        def trial(carry: _Trial[State]) -> _Trial[State]:
            x, h, elapsed, _, trials, before, span = carry
            left = period - elapsed
            goal = problem.edges.until(t + elapsed, left)
            last = h * 1.0001 >= goal
            step = jnp.where(last, goal, h)
            new, error, here = rodas3_step(problem, stage_times(t + elapsed, step), step, x)
            size = self._size(error, x, new, problem)
            accept = size <= 1
            suggestion = step * jnp.clip(0.9 * jnp.maximum(size, 1e-9) ** (-1 / 3), 0.2, 5.0)
            # A step that an edge or the end of the sample shortened must not reduce the next step.
            h = jnp.where(last & accept, jnp.maximum(h, suggestion), suggestion)
            verdict = jnp.where(accept, problem.status(new), ALIVE)
            # Trapezoidal rule: the weight of a state is half the sum of the steps before and after it. The first step
            # after a jump uses only the value at its end, because fast states leave their initial values within
            # nanoseconds.
            first = problem.jumps & (elapsed == 0)
            span = choose(accept, span.with_instant(here, (before + jnp.where(first, 0.0, step)) / 2, step), span)
            before = jnp.where(accept, jnp.where(first, 2 * step, step), before)
            elapsed = jnp.where(accept, jnp.where(last & (goal >= left), period, elapsed + step), elapsed)
            return choose(accept & (verdict == ALIVE), new, x), h, elapsed, verdict, trials + 1, before, span

        zero, code = jnp.zeros_like(period), jnp.asarray(code, jnp.int32)
        begin = (
            state,
            cast(Array, lax.stop_gradient(memory)),
            zero,
            code,
            jnp.int32(0),
            zero,
            blank(problem.instant_structure),
        )
        x, h, elapsed, code, _, before, span = lax.while_loop(unfinished, trial, begin)
        end = problem.rates_and_signals(problem.inputs(stage_times(t, elapsed)(1.0)), x)[1]
        span = choose(elapsed > 0, span.with_instant(end, before / 2), span)
        stalled = (code == ALIVE) & (elapsed < period)
        return Advanced(x, jnp.where(stalled, STALLED, code), t + elapsed, h, span)

    def _size(self, error: State, x: State, new: State, problem: InitialValueProblem[Inputs, State]) -> Array:
        """Return the root mean square of error over allowed error; 1e9 if a component is not finite."""
        layer = jax.tree.map(lambda _: jnp.inf, problem.scale) if problem.layer is None else problem.layer

        def ratio(e: Array, a: Array, b: Array, s: Array, most: Array) -> Array:
            return (e / jnp.minimum(self.tolerance * (s + jnp.maximum(jnp.abs(a), jnp.abs(b))), most)) ** 2

        ratios = jax.tree.leaves(jax.tree.map(ratio, error, x, new, problem.scale, layer))
        size = lax.stop_gradient(jnp.sqrt(sum(ratios) / len(ratios)))
        return jnp.where(jnp.isfinite(size), size, 1e9)

    def __str__(self) -> str:
        return f"RODAS3 (L-stable Rosenbrock), adaptive, tolerance {float(self.tolerance):g}"
