"""Adaptive steps: the error estimate of a trial step decides whether it is accepted, and how long the next one is."""

from typing import Any, ClassVar, NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.numerics.reversible import while_loop
from ambjax.simulation.integrate import Advanced, Begin, InitialValueProblem, Times, stage_times
from ambjax.simulation.trajectory import ALIVE, STALLED, Instant, Span, blank


class Attempt(NamedTuple):
    """A trial step.

    - `state`, `error`: state at its end, and the estimate of its error.
    - `here`: signals at its start.
    - `densities`: integrals of the densities over the step, from the stages of the method; None: the trapezoidal rule
      is used.
    """

    state: object
    error: object
    here: Instant
    densities: object = None


class _Progress(NamedTuple):
    """State of the loop over trial steps.

    - `h`, `first`: next trial step (s), and the one that the first accepted step suggested.
    - `elapsed`, `before`: elapsed time, and the previous step (s).
    - `last`: begin of the last accepted step (s after t), and the motion of the rotor at its end.
    """

    state: object
    h: Array
    first: Array
    elapsed: Array
    code: Array
    trials: Array
    before: Array
    span: Span
    last: tuple[Array, Any]


@record
class AdaptiveSteps:
    """Base class of adaptive methods: the rms of error / allowed error over the state is at most 1 in each step.

    The allowed error of a component is `tolerance` (scale + |state|), but at most the boundary layer of its smoothed
    sign. A kink of the rates, such as the limit of the supply, increases the error estimate of a step that contains it.
    The steps therefore shrink before it. The trial step at the end of a sample is the first trial step of the next.

    - `ORDER`: the error estimate of a step h falls as h^ORDER.

    Forward mode, reverse mode and vmap work. Reverse mode repeats the steps of each sample (`numerics.reversible`).
    """

    tolerance: Scalar = leaf(default=1e-6, unit="1", above=0, at_most=1.0, doc="relative error allowed per step")
    most_steps: int = static(default=10_000, doc="trial steps per sample period after which the run stalls")

    limit = None
    title: ClassVar[str]
    ORDER: ClassVar[int]

    def __str__(self) -> str:
        return f"{self.title}, adaptive, tolerance {float(self.tolerance):g}"

    def step_size(self, period: float) -> float | None:
        return None

    def start(self, period: Scalar) -> Array:
        return jnp.asarray(period) * 1e-3

    def _attempt(self, problem: InitialValueProblem, at: Times, h: Array, state: Any) -> Attempt:
        raise NotImplementedError

    def advance(self, problem: InitialValueProblem, begin: Begin, period: Scalar) -> Advanced:
        (t, state, memory, code), period = begin, jnp.asarray(period)

        def unfinished(now: _Progress) -> Array:
            return (now.elapsed < period) & (now.code == ALIVE) & (now.trials < self.most_steps)

        def trial(now: _Progress) -> _Progress:
            left = period - now.elapsed
            goal = problem.edges.until(t + now.elapsed, left)
            last = now.h * 1.0001 >= goal
            step = jnp.where(last, goal, now.h)
            tried = self._attempt(problem, stage_times(t + now.elapsed, step), step, now.state)
            size = self._size(tried.error, now.state, tried.state, problem)
            accept = size <= 1
            suggestion = step * jnp.clip(0.9 * jnp.maximum(size, 1e-9) ** (-1 / self.ORDER), 0.2, 5.0)
            # A step that an edge or the end of the sample shortened must not reduce the next step.
            h = jnp.where(last & accept, jnp.maximum(now.h, suggestion), suggestion)
            verdict = jnp.where(accept, problem.status(tried.state), ALIVE)
            span, before = self._recorded(now, tried, step, problem.jumps & (now.elapsed == 0))
            end = jnp.where(last & (goal >= left), period, now.elapsed + step)
            return _Progress(
                choose(accept & (verdict == ALIVE), tried.state, now.state),
                h,
                jnp.where(now.elapsed > 0, now.first, suggestion),
                jnp.where(accept, end, now.elapsed),
                verdict,
                now.trials + 1,
                jnp.where(accept, before, now.before),
                choose(accept, span, now.span),
                choose(accept, (now.elapsed, problem.moving(tried.state)), now.last),
            )

        zero, code = jnp.zeros_like(period), jnp.asarray(code, jnp.int32)
        h = cast(Array, lax.stop_gradient(memory))
        first = _Progress(
            state, h, h, zero, code, jnp.int32(0), zero, blank(problem.instant_structure), (zero, problem.moving(state))
        )
        done = while_loop(unfinished, trial, first)
        x = done.state
        end = problem.rates_and_signals(problem.inputs(stage_times(t, done.elapsed)(1.0)), x)[1]
        span = choose(done.elapsed > 0, done.span.with_instant(end, done.before / 2), done.span)
        stalled = (done.code == ALIVE) & (done.elapsed < period)
        # Under noise, the step at the start of a sample is a better guess for the next sample than that at its end.
        memory = jnp.where(problem.jumps & (done.elapsed > 0), done.first, done.h)
        t_end = problem.ended(x, done.last[1], t + done.last[0], t + done.elapsed, done.code)
        span = span.shortened(t + done.elapsed - t_end)
        return Advanced(x, jnp.where(stalled, STALLED, done.code), t_end, memory, span)

    @staticmethod
    def _recorded(now: _Progress, tried: Attempt, step: Array, first: Array) -> tuple[Span, Array]:
        """Return the span with the trial step, and the length of the step for the trapezoidal rule, s.

        The weight of a state is half the sum of the steps before and after it. `first`: the step begins with a jump. It
        then uses only the value at its end, because fast states leave their initial values within nanoseconds.
        """
        if tried.densities is not None:
            span = now.span.with_instant(tried.here, 0.0, step)
            more = jax.tree.map(lambda a, b: a + b, span.densities, tried.densities)
            return span._replace(densities=more), jnp.zeros_like(step)
        weight = (now.before + jnp.where(first, 0.0, step)) / 2
        return now.span.with_instant(tried.here, weight, step), jnp.where(first, 2 * step, step)

    def _size(self, error: object, x: object, new: object, problem: InitialValueProblem) -> Array:
        """Return the root mean square of error over allowed error; 1e9 if a component is not finite."""
        layer = jax.tree.map(lambda _: jnp.inf, problem.scale) if problem.layer is None else problem.layer

        def ratio(e: Array, a: Array, b: Array, s: Array, most: Array) -> Array:
            return (e / jnp.minimum(self.tolerance * (s + jnp.maximum(jnp.abs(a), jnp.abs(b))), most)) ** 2

        ratios = jax.tree.leaves(jax.tree.map(ratio, error, x, new, problem.scale, layer))
        size = lax.stop_gradient(jnp.sqrt(sum(ratios) / len(ratios)))
        return jnp.where(jnp.isfinite(size), size, 1e9)
