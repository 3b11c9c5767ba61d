"""Integrators: methods that advance an initial value problem over one sample period with held measurement errors.

    advance(problem, Begin(t, state, memory, code=0), period) -> Advanced(state, code, t, memory, span)

The state is any pytree of scalars. An integrator stops at the first state whose status code is not 0, and returns the
state before it. `start(period)` returns the initial memory of the method.

Stage times are moved into the step by a few units in the last place. A jump at the boundary of two steps then belongs
to the second step. Otherwise the last stage of the first step would include the jump, and the method would be of first
order there.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array, lax

from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, record, static
from ambjax.numerics.smooth import away_from_zero
from ambjax.simulation.edges import NO_EDGES, Edges, inset
from ambjax.simulation.trajectory import ALIVE, NOTHING, TOUCHED, Instant, Span, blank

# Time of a stage as a function of its fraction of the step, 0 to 1.
Times = Callable[[float], Scalar]


class InitialValueProblem(NamedTuple):
    """An initial value problem, whose time derivative is rates(inputs(t), state).

    - `inputs`: external inputs as a function of time.
    - `rates`: right-hand side rates(inputs, state).
    - `scale`: a state with the characteristic size of each component; integration errors are relative to it.
    - `status`: status(state) -> code, 0 while the state is valid.
    - `layer`: for each component, the largest integration error that keeps it in the boundary layer of its smoothed
      sign; inf: no sign. None: no such signs in the problem.
    - `observed`: observed(inputs, state) -> (rates, Instant), the rates and the signals to record; None: no signals.
    - `instant_structure`: any Instant, which defines the structure of those signals.
    - `jumps`: whether the rates jump at the start of a sample.
    - `slide`: slide(inputs(t_0), inputs(t_1), h, state, span) -> (state, span), a step for this particular system;
      None: there is none.
    - `edges`: other instants at which the rates jump.
    - `motion`: motion(state) -> displacement and velocity of the rotor, or of each of its axes [c]; None: no rotor.
    - `limit`: |displacement| at which the status becomes TOUCHED; of each axis, if there are several.
    """

    inputs: Callable[[Scalar], Any]
    rates: Callable[[Any, Any], Any]
    scale: Any
    status: Callable[[Any], Array]
    layer: Any = None
    observed: Callable[[Any, Any], tuple[Any, Instant]] | None = None
    instant_structure: Instant = NOTHING
    jumps: Array | bool = False
    slide: Callable[[Any, Any, Scalar, Any, Span], tuple[Any, Span]] | None = None
    edges: Edges = NO_EDGES
    motion: Callable[[Any], tuple[Array, Array]] | None = None
    limit: Scalar = jnp.inf

    def moving(self, state: Any) -> tuple[Array, Array] | tuple[()]:
        """Return the displacement and the velocity of the rotor; empty without a rotor."""
        return () if self.motion is None else self.motion(state)

    def ended(
        self, before: Any, after: tuple[Array, Array] | tuple[()], begin: Array, end: Array, code: Array
    ) -> Array:
        """Return the time of the end, s; if the last step reaches the limit, that at which |displacement| equals it.

        `before`: state at the begin of the last step. `after`: motion at its end. Between them the motion is the cubic
        with these displacements and velocities. Its crossing is found by Newton's method, from the crossing of the
        chord. The time has no derivatives.
        """
        if self.motion is None or not after:
            return end
        touched, end = (code == TOUCHED) & (end > begin), lax.stop_gradient(end)
        given = lax.stop_gradient((begin, self.limit, *self.motion(before), *after))

        def crossing(now: tuple[Array, Array]) -> tuple[Array, Array]:
            # XLA moves what is constant in a loop out of it, and would compute it in every sample.
            begin, limit, z, z_dot, z_after, z_dot_after = (jnp.where(now[0], x, 0.0) for x in given)
            h = now[1] - begin
            sign = jnp.where(z_after < 0, -1.0, 1.0)
            a, slope_a, b, slope_b = sign * z, sign * h * z_dot, sign * z_after, sign * h * z_dot_after
            curve, twist = 3 * (b - a) - 2 * slope_a - slope_b, 2 * (a - b) + slope_a + slope_b
            share = jnp.clip((limit - a) / away_from_zero(b - a, 1e-30), 0.0, 1.0)
            for _ in range(5):
                beyond = a + share * (slope_a + share * (curve + share * twist)) - limit
                slope = away_from_zero(slope_a + share * (2 * curve + share * 3 * twist), 1e-30)
                share = jnp.clip(share - beyond / slope, 0.0, 1.0)
            if jnp.ndim(share):  # the first axis that reaches its limit
                share = jnp.min(jnp.where(b < limit, 1.0, share))
            return jnp.zeros_like(touched), jnp.where(jnp.isfinite(share), begin + share * h, end)

        # The loop makes one turn, and none in an ensemble of which no member reaches the limit in this step.
        return lax.while_loop(lambda now: now[0], crossing, (touched, end))[1]

    def rates_and_signals(self, inputs: Any, state: Any) -> tuple[Any, Instant]:
        return (self.rates(inputs, state), NOTHING) if self.observed is None else self.observed(inputs, state)


class Begin(NamedTuple):
    """Where an integration begins.

    - `t`, `state`: time, s, and the state there.
    - `memory`: data that the method carries from one sample to the next.
    - `code`: status code; if it is not 0, the state does not change.
    """

    t: Scalar
    state: Any
    memory: object
    code: Scalar = ALIVE


class Advanced(NamedTuple):
    """Result of `advance`.

    - `state`: last state with status code 0.
    - `code`: status code at the end.
    - `t`: time of the end, s; if there is an invalid state, of the first one, or of its crossing of the limit.
    - `memory`: data for the next sample.
    - `span`: extremes and integrals of the signals.
    """

    state: Any
    code: Array
    t: Array
    memory: object
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

    def start(self, period: Scalar) -> object: ...

    def advance(self, problem: InitialValueProblem, begin: Begin, period: Scalar) -> Advanced: ...


def in_turn(method: Integrator, parts: Sequence[tuple[InitialValueProblem, Scalar]], begin: Begin) -> list[Advanced]:
    """Integrate problems one after another, for a sample in which the rates jump at known instants.

    `parts`: pairs of a problem and its duration, s; the duration may be 0.

    Returns one result for each problem. The span of a result begins at the start of the first problem.
    """
    reached = list[Advanced]()
    for problem, time in parts:
        after = method.advance(problem, begin, time)
        if reached:
            end = jnp.where(reached[-1].code == ALIVE, after.t, reached[-1].t)
            after = after._replace(t=end, span=reached[-1].span.joined(after.span))
        reached.append(after)
        begin = Begin(begin.t + time, after.state, after.memory, after.code)
    return reached


class WholeState:
    """Base class of a system (`rollout.System`) whose whole state is integrated, as one problem per sample."""

    def problem(self, errors: Any) -> InitialValueProblem:
        raise NotImplementedError

    def jump(self, t: Scalar, state: Any, errors: object) -> Any:
        """Return the state: it does not jump at the start of a sample."""
        return state

    def advance(self, method: Integrator, errors: object, begin: Begin, period: Scalar) -> Advanced:
        return method.advance(self.problem(errors), begin, period)


def stage_times(t: Scalar, h: Scalar) -> Times:
    """Return the stage times t + share h, moved strictly inside the step."""
    moved = inset(t, h)
    return lambda share: t + moved + share * (h - 2 * moved)


@record
class FixedSteps:
    """Equal substeps, divided at edges. The loop has a fixed length, so JAX can differentiate it in both modes."""

    substeps: int = static(default=1, doc="steps per sample period")
    limit = None
    title: ClassVar[str]

    def __str__(self) -> str:
        return f"{self.title}, {self.substeps} substep{'s' * (self.substeps != 1)}"

    def step_size(self, period: float) -> float | None:
        return period / self.substeps

    def start(self, period: Scalar) -> tuple[()]:
        return ()

    def _step(self, problem: InitialValueProblem, at: Times, h: Scalar, state: Any, span: Span) -> tuple[Any, Span]:
        raise NotImplementedError

    def advance(self, problem: InitialValueProblem, begin: Begin, period: Scalar) -> Advanced:
        t, state, memory, code = begin
        h = jnp.asarray(period) / self.substeps
        place, steps = problem.edges.steps(t, h, self.substeps)

        def body(number: Array, carry: tuple[Any, Array, Any, Span, Any]) -> tuple[Any, Array, Any, Span, Any]:
            x, code, last, span, place = carry
            alive = code == ALIVE
            # Times do not depend on the status, so that members share the times and the inputs at these times.
            start, stop, step, place = steps(number, place)
            new, after = self._step(problem, stage_times(start, step), step, x, span)
            code = jnp.where(alive, problem.status(new), code)
            x = choose(code == ALIVE, new, x)
            last = choose(alive, (start, stop, problem.moving(new)), last)
            return x, code, last, choose(alive, after, span), place

        t = jnp.asarray(t, h.dtype)
        code, last = jnp.asarray(code, jnp.int32), (t, t, problem.moving(state))
        # what a step changes varies over members if the status does: so from the start, JAX maps the step only once
        alive = code == ALIVE
        last, span = (choose(alive, x, x) for x in (last, blank(problem.instant_structure)))
        first = (state, code, last, span, place)
        x, ended, (start, end, motion), span, _ = lax.fori_loop(0, self.substeps + problem.edges.most, body, first)
        t_end = problem.ended(x, motion, start, end, ended)
        return Advanced(x, ended, t_end, memory, span.shortened(end - t_end))
