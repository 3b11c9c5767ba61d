"""Integrators: methods that advance an initial value problem over one sample period with held measurement errors.

    advance(problem, t, period, state, memory, code=0) -> Advanced(state, code, t, memory, span)

The state is any pytree of scalars. An integrator stops at the first state whose status code is not 0, and returns the
state before it. If the initial code is not 0, the state does not change. `memory` is the data that the method carries
from one sample to the next; `start(period)` returns the initial memory. `span` holds the extremes and integrals of
signals over the sample (`ambjax.simulation.span`).

Stage times are moved into the step by a few units in the last place. A jump at the boundary of two steps then belongs
to the second step. Otherwise the last stage of the first step would include the jump, and the method would be of first
order there.
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
# Time of a stage as a function of its fraction of the step, 0 to 1.
Times = Callable[[float], Array]


class InitialValueProblem(NamedTuple):
    """An initial value problem, whose time derivative is rates(inputs(t), state).

    - `inputs`: external inputs as a function of time.
    - `rates`: right-hand side rates(inputs, state).
    - `scale`: a state with the smallest relevant magnitude of each component.
    - `status`: status(state) -> code, 0 while the state is valid.
    - `layer`: a state with the width of the boundary layer of each component's smoothed sign; None: no such signs.
    - `observed`: observed(inputs, state) -> (rates, Instant), the rates and the signals to record; None: no signals.
    - `shown`: any Instant, which defines the structure of those signals.
    - `jumps`: whether the rates jump at the start of a sample.
    - `slide`: slide(inputs(t_0), inputs(t_1), h, state, span) -> (state, span), a step for this particular system;
      None: there is none.
    - `edges`: other instants at which the rates jump.
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
        """Return the rates, and the signals to record."""
        return (self.rates(inputs, state), NOTHING) if self.observed is None else self.observed(inputs, state)


class Advanced(NamedTuple):
    """Result of `advance`.

    - `state`: last state with status code 0.
    - `code`: status code at the end.
    - `t`: time of the end, s; of the first invalid state, if there is one.
    - `memory`: data for the next sample.
    - `span`: extremes and integrals of the signals.
    """

    state: Any
    code: Array
    t: Array
    memory: Any
    span: Span


class Integrator(Protocol):
    """Interface of an integration method, as `rollout` uses it."""

    @property
    def limit(self) -> float | None:
        """Largest stable product of step and slope on the negative real axis; None if there is no limit."""
        ...

    def step_size(self, period: float) -> float | None:
        """Return the step, s; None if the step is adaptive."""
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
    """Integrate problems one after another, for a sample in which the rates jump at known instants.

    `stretches`: pairs of a problem and its duration, s; the duration may be 0.

    Returns the results after each problem, accumulated from the start of the first.
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
    """Return state + sum of factor * direction over the terms, leaf by leaf."""
    for factor, direction in terms:
        state = jax.tree.map(lambda x, d, factor=factor: x + factor * d, state, direction)
    return state


def choose(condition: Array, yes: State, no: State) -> State:
    """Apply jnp.where to every leaf of two states."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _inside(t: Scalar, h: Scalar) -> Times:
    """Return the stage times t + share h, moved strictly inside the step."""
    moved = inset(t, h)
    return lambda share: t + moved + share * (h - 2 * moved)


@record
class _Fixed:
    """Equal substeps, divided at edges, in a loop of fixed length: supports forward and reverse mode."""

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
            # Times do not depend on the status, so that members share the times and the inputs at these times.
            start, stop, step = steps(number)
            new, after = self._step(problem, _inside(start, step), step, x, span)
            code = jnp.where(alive, problem.status(new), code)
            x = choose(code == ALIVE, new, x)
            return x, code, jnp.where(alive, stop, end), choose(alive, after, span)

        begin = (state, jnp.asarray(code, jnp.int32), jnp.asarray(t, h.dtype), blank(problem.shown))
        x, code, end, span = lax.fori_loop(0, self.substeps + problem.edges.most, body, begin)
        return Advanced(x, code, end, memory, span)


def rodas3_step(problem: InitialValueProblem, at: Times, h: Scalar, state: Any) -> tuple[Any, Any, Instant]:
    """Compute one step of RODAS3, its error estimate, and the signals at its start.

    RODAS3 is a Rosenbrock method of order 3(2), L-stable and stiffly accurate (Sandu et al., Atmospheric Environment 31
    (1997) 3459-3472). A step takes one Jacobian, one factorisation of I - h J / 2 and three evaluations. Stages are
    scaled by h, so that h = 0 is the identity.
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
    """RODAS3 with equal substeps, for stiff loops that need reverse-mode differentiation."""

    limit = None

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        new, _, here = rodas3_step(problem, at, h, state)
        there = problem.watched(problem.inputs(at(1.0)), new)[1]
        return new, span.seen(here, h / 2, h).seen(there, h / 2)

    def __str__(self) -> str:
        return f"RODAS3 (L-stable Rosenbrock), {self.substeps} substeps"


@record
class Slide(_Fixed):
    """The sliding step (`ambjax.simulation.sliding`) with equal substeps, for stiff gains under held noise.

    The step is of second order in the slow motion of the loop, for any stiffness of the inversion law. It requires an
    inversion law with a method `slide`, such as `inversion.Adaptive`, and a lumped plant; otherwise a simulation raises
    ValueError.
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
    """RODAS3 with adaptive steps: the estimated error of each step stays below `tolerance` (scale + |state|).

    The error also stays within the boundary layer of each smoothed sign. A larger error would move the state to the
    other side of the sign and the next step back, so that the steps shrink until the run stalls. Where a stiff smoothed
    sign leaves saturation, for a few microseconds, the steps shrink and then grow again. The last step of a sample is
    the first trial step of the next.

    Forward mode and vmap work. Reverse mode does not, because JAX cannot reverse a while loop.

    The tolerance bounds the error of a step, not the error of z at the end, which is proportional to the response of
    the loop to a disturbance. At a tolerance of 1e-7, z is within 1e-8 m if a velocity impulse of 1 m/s moves z by at
    most 0.1 m. The response of a rotor that is nearly lost is larger.
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
            # A step that an edge or the end of the sample shortened must not reduce the next step.
            h = jnp.where(last & accept, jnp.maximum(h, suggestion), suggestion)
            verdict = jnp.where(accept, problem.status(new), ALIVE)
            # Trapezoidal rule: the weight of a state is half of the steps before and after it. The first step after a
            # jump has only the value at its end, because fast states leave their initial values within nanoseconds.
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
        """Return the root mean square of error over allowed error; 1e9 if a component is not finite."""
        layer = jax.tree.map(lambda _: jnp.inf, problem.scale) if problem.layer is None else problem.layer

        def ratio(e: Array, a: Array, b: Array, s: Array, most: Array) -> Array:
            return (e / jnp.minimum(self.tolerance * (s + jnp.maximum(jnp.abs(a), jnp.abs(b))), most)) ** 2

        ratios = jax.tree.leaves(jax.tree.map(ratio, error, x, new, problem.scale, layer))
        size = lax.stop_gradient(jnp.sqrt(sum(ratios) / len(ratios)))
        return jnp.where(jnp.isfinite(size), size, 1e9)

    def __str__(self) -> str:
        return f"RODAS3 (L-stable Rosenbrock), adaptive, tolerance {float(self.tolerance):g}"
