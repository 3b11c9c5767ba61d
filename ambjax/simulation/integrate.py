"""Integrators: one signature, `advance`, over one sample period in which the inputs are held.

    advance(problem, t, period, state, memory, code=0) -> Advanced(state, code, t, memory, span)

A `Problem` is a right-hand side on any pytree of scalars, what drives it as a function of time, the
size of each component that still matters, and the status of a state: 0 while all is well. An integrator
stops at the first state whose code is not 0 and returns the last good one; begun with such a code, it
moves nothing. `memory` is what the method carries from one sample to the next (`start(period)` makes the
first), `span` what was seen on the way (`ambjax.simulation.span`).

Stage times are moved inside the step by a few units in the last place, so that a jump that falls on
a step's edge is seen by the steps after it and not by those before: otherwise the last stage sees
it early and the method falls to first order there.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.compiler.barrier import materialised
from ambjax.numerics import linear
from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.edges import NO_EDGES, Edges, inset
from ambjax.simulation.span import NOTHING, Instant, Span, blank
from ambjax.simulation.trajectory import ALIVE, STALLED

State = TypeVar("State")
InputFunction = Callable[[Array], Any]
Rates = Callable[[Any, Any], Any]
StatusFunction = Callable[[Any], Array]
# Stage times of one step, by the share of it that has passed.
Times = Callable[[float], Array]


class InitialValueProblem(NamedTuple):
    """What is integrated: rates(inputs(t), state), scale (a state) and status(state) -> code.

    `layer` (a state): the largest error with which a component stays where a smoothed sign turns; None: none does.
    `observed(inputs(t), state) -> (rates, Instant)`: the rates and what is to be seen; None: nothing is. `shown`: any
    such instant, for its structure. `jumps`: whether the rates jump at the start of a sample; `edges`: where else.
    `slide(inputs(t_0), inputs(t_1), h, state, span) -> (state, span)`, where there is one, is a step made for this
    very system.
    """

    inputs: InputFunction
    rates: Rates
    scale: Any
    status: StatusFunction
    layer: Any = None
    observed: Callable[[Any, Any], tuple[Any, Instant]] | None = None
    shown: Instant = NOTHING
    jumps: bool = False
    slide: Callable[[Any, Any, Scalar, Any, Span], tuple[Any, Span]] | None = None
    edges: Edges = NO_EDGES

    def watched(self, inputs: Any, state: Any) -> tuple[Any, Instant]:
        """Rates, and what is to be seen."""
        return (self.rates(inputs, state), NOTHING) if self.observed is None else self.observed(inputs, state)


class Advanced(NamedTuple):
    """The end of one sample period: last good state, status's code, the time it refers to, memory, what was seen."""

    state: Any
    code: Array
    t: Array
    memory: Any
    span: Span


class Integrator(Protocol):
    """What `rollout` needs of a method."""

    @property
    def limit(self) -> float | None:
        """Largest stable step times slope on the negative real axis; None if there is none."""
        ...

    def step_size(self, period: float) -> float | None:
        """The step in s, or None if the method chooses it as it goes."""
        ...

    def start(self, period: Scalar) -> Any: ...

    def advance(
        self, problem: InitialValueProblem, t: Scalar, period: Scalar, state: Any, memory: Any, code: Scalar = ALIVE
    ) -> Advanced: ...


def in_turn(
    method: Integrator,
    stretches: Sequence[tuple[InitialValueProblem, Scalar]],
    t: Scalar,
    state: Any,
    memory: Any,
    code: Scalar = ALIVE,
) -> list[Advanced]:
    """Problems one after another, each for its time (s; 0 too): a sample within which rates jump at known instants.

    What has been reached after each of them, since the first began.
    """
    (problem, time), *others = stretches
    reached = [method.advance(problem, t, time, state, memory, code)]
    for problem, following in others:
        t, time, so_far = t + time, following, reached[-1]
        after = method.advance(problem, t, time, so_far.state, so_far.memory, so_far.code)
        end = jnp.where(so_far.code == ALIVE, after.t, so_far.t)
        reached.append(after._replace(t=end, span=so_far.span.joined(after.span)))
    return reached


def axpy(state: State, *terms: tuple[Scalar, State]) -> State:
    """state + sum of factor * direction over the terms, leaf by leaf."""
    for factor, direction in terms:
        state = jax.tree.map(lambda x, d, factor=factor: x + factor * d, state, direction)
    return state


def choose(condition: Array, yes: State, no: State) -> State:
    """jnp.where over whole states."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _inside(t: Scalar, h: Scalar) -> Times:
    """Stage times t + share h, kept strictly inside the step."""
    moved = inset(t, h)
    return lambda share: t + moved + share * (h - 2 * moved)


@record
class _Fixed:
    """Equal substeps of `_step`, divided at edges, by a loop of fixed length: forward and reverse mode both work."""

    substeps: int = static(default=1, doc="steps per sample period")

    def step_size(self, period: float) -> float | None:
        return period / self.substeps

    def start(self, period: Scalar) -> Any:
        return ()

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        raise NotImplementedError

    def advance(
        self, problem: InitialValueProblem, t: Scalar, period: Scalar, state: Any, memory: Any, code: Scalar = ALIVE
    ) -> Advanced:
        h = jnp.asarray(period) / self.substeps
        steps = problem.edges.steps(t, h, self.substeps)

        def body(number: Array, carry: tuple[Any, Array, Array, Span]) -> tuple[Any, Array, Array, Span]:
            x, code, end, span = carry
            alive = code == ALIVE
            # Times do not depend on who is alive: members share them, and what is driven by them.
            start, stop, step = steps(number)
            new, after = self._step(problem, _inside(start, step), step, x, span)
            code = jnp.where(alive, problem.status(new), code)
            x = choose(code == ALIVE, new, x)
            return x, code, jnp.where(alive, stop, end), choose(alive, after, span)

        begin = (state, jnp.asarray(code, jnp.int32), jnp.asarray(t, h.dtype), blank(problem.shown))
        x, code, end, span = lax.fori_loop(0, self.substeps + problem.edges.most, body, begin)
        return Advanced(x, code, end, memory, span)


def rodas3_step(problem: InitialValueProblem, at: Times, h: Scalar, state: Any) -> tuple[Any, Any, Instant]:
    """One step of RODAS3, its error estimate and what is seen at its start: order 3(2), L-stable, stiffly accurate.

    Sandu et al., Atmospheric Environment 31 (1997) 3459-3472. One Jacobian, one factorisation of
    I - h J / 2 and three evaluations a step. Stages are scaled by h, so h = 0 is the identity.
    """
    t_0 = at(0.0)
    rates = jax.jit(problem.rates)  # traced once here, not once per column of the Jacobian
    inputs, inputs_t = jax.jvp(problem.inputs, (t_0,), (jnp.ones_like(t_0),))
    factors = linear.factor(linear.jacobian(lambda x: rates(inputs, x), state), h / 2)
    f_0, f_t, here = jax.jvp(lambda s: problem.watched(s, state), (inputs,), (inputs_t,), has_aux=True)
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
class Rodas3(_Fixed):
    """RODAS3 with equal substeps: for stiff loops when a loop of fixed length is wanted (reverse mode)."""

    limit = None

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        new, _, here = rodas3_step(problem, at, h, state)
        there = problem.watched(problem.inputs(at(1.0)), new)[1]
        return new, span.seen(here, h / 2, h).seen(there, h / 2)

    def __str__(self) -> str:
        return f"RODAS3 (L-stable Rosenbrock), {self.substeps} substeps"


@record
class Slide(_Fixed):
    """Equal substeps of the loop's own step (`ambjax.simulation.sliding`): for stiff gains under held noise.

    Second order in the loop's slow motion, however stiff the inversion law is; that must have a `slide`, as
    `inversion.Adaptive` does, and the plant be lumped.
    """

    limit = None

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        if problem.slide is None:
            raise ValueError(
                "clock.method = Slide(...): it steps lumped plants under an 'adaptive' inversion law. Use Rodas3."
            )
        return problem.slide(problem.inputs(at(0.0)), problem.inputs(at(1.0)), h, state, span)

    def __str__(self) -> str:
        return f"sliding step, {self.substeps} substeps"


@record
class AdaptiveRodas3:
    """RODAS3 whose steps keep the estimated error of each step below `tolerance` (scale + |state|).

    And within the layer of a smoothed sign, where there is one: an error beyond it lands on the sign's other side,
    the next step back on this one, and the run chatters across in ever smaller steps until it stalls.
    The corner where a stiff smoothed sign leaves saturation lasts microseconds and comes rarely: steps shrink
    there and grow again. The step carries over from one sample to the next. A while loop: forward
    mode and vmap work, reverse mode does not (JAX cannot reverse a loop of unknown length).

    The tolerance limits the error of a step, not that of z at the end. The latter is in proportion to how far the loop
    carries a kick: at 1e-7, z is within 1e-8 m where a kick of 1 m/s moves it by at most 0.1 m. A rotor that is barely
    caught carries kicks further.
    """

    tolerance: Scalar = leaf(default=1e-6, unit="1", above=0, at_most=1.0, doc="relative error allowed per step")
    most_steps: int = static(default=10_000, doc="trial steps per sample period after which the run stalls")

    limit = None

    def step_size(self, period: float) -> float | None:
        return None

    def start(self, period: Scalar) -> Any:
        return jnp.asarray(period) * 1e-3

    def advance(
        self, problem: InitialValueProblem, t: Scalar, period: Scalar, state: Any, memory: Any, code: Scalar = ALIVE
    ) -> Advanced:
        period = jnp.asarray(period)

        def unfinished(carry: Any) -> Array:
            elapsed, code, trials = carry[2:5]
            return (elapsed < period) & (code == ALIVE) & (trials < self.most_steps)

        def trial(carry: Any) -> Any:
            x, h, elapsed, _, trials, before, span = carry
            left = period - elapsed
            goal = problem.edges.until(t + elapsed, left)
            last = h * 1.0001 >= goal
            step = jnp.where(last, goal, h)
            new, error, here = rodas3_step(problem, _inside(t + elapsed, step), step, x)
            size = self._size(error, x, new, problem)
            accept = size <= 1
            suggestion = step * jnp.clip(0.9 * jnp.maximum(size, 1e-9) ** (-1 / 3), 0.2, 5.0)
            # A step cut short by an edge or the sample's end says little about the next one.
            h = jnp.where(last & accept, jnp.maximum(h, suggestion), suggestion)
            verdict = jnp.where(accept, problem.status(new), ALIVE)
            # By the trapezoidal rule, in which this state ends one step and begins the next. Not so the first step
            # after a jump, by the rule of its end alone: slaved states leave what the jump found within nanoseconds.
            first = problem.jumps & (elapsed == 0)
            span = choose(accept, span.seen(here, (before + jnp.where(first, 0.0, step)) / 2, step), span)
            before = jnp.where(accept, jnp.where(first, 2 * step, step), before)
            elapsed = jnp.where(accept, jnp.where(last & (goal >= left), period, elapsed + step), elapsed)
            return choose(accept & (verdict == ALIVE), new, x), h, elapsed, verdict, trials + 1, before, span

        zero, code = jnp.zeros_like(period), jnp.asarray(code, jnp.int32)
        begin = (state, lax.stop_gradient(memory), zero, code, jnp.int32(0), zero, blank(problem.shown))
        x, h, elapsed, code, _, before, span = lax.while_loop(unfinished, trial, begin)
        end = problem.watched(problem.inputs(_inside(t, elapsed)(1.0)), x)[1]
        span = choose(elapsed > 0, span.seen(end, before / 2), span)
        stalled = (code == ALIVE) & (elapsed < period)
        return Advanced(x, jnp.where(stalled, STALLED, code), t + elapsed, h, span)

    def _size(self, error: Any, x: Any, new: Any, problem: InitialValueProblem) -> Array:
        """Root mean square of the error against what is allowed; huge if anything is not finite."""
        layer = jax.tree.map(lambda _: jnp.inf, problem.scale) if problem.layer is None else problem.layer

        def ratio(e: Array, a: Array, b: Array, s: Array, most: Array) -> Array:
            return (e / jnp.minimum(self.tolerance * (s + jnp.maximum(jnp.abs(a), jnp.abs(b))), most)) ** 2

        ratios = jax.tree.leaves(jax.tree.map(ratio, error, x, new, problem.scale, layer))
        size = lax.stop_gradient(jnp.sqrt(sum(ratios) / len(ratios)))
        return jnp.where(jnp.isfinite(size), size, 1e9)

    def __str__(self) -> str:
        return f"RODAS3 (L-stable Rosenbrock), adaptive, tolerance {float(self.tolerance):g}"
