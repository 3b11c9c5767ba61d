"""Rollout: the simulation of a cascade in a scenario. It returns a trajectory, the result of a fold, or both."""

import dataclasses
import functools
import math
from typing import Any, NamedTuple, Protocol, Self, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.compiler.fast_path import one_kernel
from ambjax.control.cascade import Cascade
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, canonical
from ambjax.numerics.shapes import require_one_member
from ambjax.simulation.clock import Clock, takes_case
from ambjax.simulation.folds import Ending, Fold, updated
from ambjax.simulation.integrate import Advanced, Begin, Integrator
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.method import with_method
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import check_inputs, check_recording, started, system_of
from ambjax.simulation.trajectory import ALIVE, Row, Span, Trajectory, first_time
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors

# Types of the state of a system, of the errors of its sensors, and of its row.
S = TypeVar("S")
E = TypeVar("E")
R = TypeVar("R")


class Result(NamedTuple):
    """Result of a rollout: the trajectory, and the result of the fold.

    - `trajectory`: rows and status of the rotor; the rows are None if none were recorded.
    - `metrics`: result of the fold; None without a fold.
    """

    trajectory: Trajectory
    metrics: Any


class System(Protocol[S, E, R]):
    """Interface of a system for a rollout: the closed loop, or the closed loop with an extended state.

    - `realised()`: the system of one member, with its random signals drawn.
    - `sensor_errors(sample)`: the errors of the sensors at sample number `sample`.
    - `start()`: the state at t = 0.
    - `status(state)`: the status code of the rotor, an index of `trajectory.STATUSES`.
    - `rest(state, code)`: the frozen state of a rotor that is lost with this status code.
    - `row(t, state, errors, alive)`: the row at time t (s).
    - `completed(row, span)`: the row with the signals that are known only at the end of the sample.
    - `singularity(row)`: a number that is positive on the admissible side of the singular curve C. Eq. (9)

    - `jump(t, state, errors)`: the state after the jump at the start of the sample at t (s), such as a step of a
      controller on a processor. The row and the integrator use it. The state of a lost rotor does not jump.
    - `advance(method, errors, begin, period)`: the result of the method at the end of the sample.

    `integrate.WholeState` has the last two for a system that integrates its whole state as one problem per sample.
    """

    def realised(self) -> Self: ...
    def sensor_errors(self, sample: Scalar) -> E: ...
    def start(self) -> S: ...
    def status(self, state: S) -> Array: ...
    def rest(self, state: S, code: Array) -> S: ...
    def row(self, t: Scalar, state: S, errors: E, alive: Array) -> R: ...
    def completed(self, row: R, span: Span) -> R: ...
    def singularity(self, row: R) -> Array: ...
    def jump(self, t: Scalar, state: S, errors: E) -> S: ...
    def advance(self, method: Integrator, errors: E, begin: Begin, period: Scalar) -> Advanced: ...


class Extended:
    """Base class of a system with more states than its `loop`, whose state is the field `loop` of its own state."""

    loop: Any

    def realised(self) -> Self:
        return dataclasses.replace(self, loop=self.loop.realised())  # pyright: ignore[reportArgumentType]

    def sensor_errors(self, sample: Scalar) -> Errors:
        return self.loop.sensor_errors(sample)

    def status(self, state: Any) -> Array:
        return self.loop.status(state.loop)

    def rest(self, state: Any, code: Array) -> Any:
        return state._replace(loop=self.loop.rest(state.loop, code))

    def completed(self, row: Any, span: Span) -> Any:
        return row

    def singularity(self, row: Any) -> Array:
        return self.loop.singularity(row)


class ExtendedOnProcessor(Extended):
    """Base class of a system on a processor whose further states change only at the samples."""

    def advance(self, method: Integrator, errors: Errors, begin: Begin, period: Scalar) -> Advanced:
        after = self.loop.advance(method, errors, begin._replace(state=begin.state.loop), period)
        return after._replace(state=begin.state._replace(loop=after.state))


class RolloutState(NamedTuple):
    """State of a rollout between two samples.

    - `state`: state of the system.
    - `ending`: the result so far: status of the rotor, and the times of its loss and of the first crossing of C.
    - `memory`, `fold`: states of the integrator and of the fold.
    """

    state: Any
    ending: Ending
    memory: Any
    fold: Any


@takes_case
def rollout(
    cascade: Cascade, scenario: Scenario, clock: Clock, *, fold: Fold | None = None, record_every: int = 1
) -> Result:
    """Simulate `scenario.plant` under `cascade` for `clock.samples` sample periods. `rollout(case)` works too.

    Use it for derivatives and batches: the function is pure and jitted, and works under jit, vmap, jvp and grad, with
    every method. `simulate` returns the metrics, tables and pictures of one run.

    - `fold`: accumulated at every sample, so that metrics need no stored trajectory; None: no metrics.
    - `record_every`: a row is recorded at the start of the first of so many samples; 0: no rows.

    Returns a `Result`. The state is frozen if |z| reaches `Scenario.limit`, a state leaves the range of the model
    (`loop.DIVERGENCE`), or the integrator stalls. `Trajectory.lost_code` then gives the reason, and values and
    derivatives stay finite.

    Raises ValueError for an invalid gain, parameter or clock, for arrays of members outside `vmap`, and for a step of
    the integrator above its stability limit.

        rows = ambjax.rollout(case).trajectory.rows
        rows.z  # m, [rows]
    """
    loop, clock = prepare(cascade, scenario, clock)
    check_recording(fold, record_every)
    require_one_member({"controller": cascade, "scenario": scenario, "clock": clock})
    loop, clock, fold = canonical((loop, clock, fold))
    return roll(loop, clock, fold, record_every=record_every)


def prepare(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[ClosedLoop | Sampled, Clock]:
    """Check a case. Return the system and the clock for `run`; a method is chosen if the clock has none.

    Raises ValueError as `rollout` does.
    """
    check_inputs(cascade, scenario, clock)
    clock = with_method(clock, cascade, scenario)
    return system_of(cascade, started(cascade, scenario), clock), clock


def run(system: System, clock: Clock, fold: Fold | None, record_every: int) -> Result:
    """Simulate a whole rollout without checks. The function is not jitted; `roll` is its compiled form."""
    progress, rows = segment(system, clock, fold, begin(system, clock, fold), 0, clock.samples, record_every)
    return finish(progress, rows, fold)


roll = one_kernel(run, static_argnames=("record_every",))


def begin(system: System, clock: Clock, fold: Fold | None) -> RolloutState:
    """Return the state of the rollout before the first sample."""
    system = system.realised()
    dtype = jnp.result_type(float)
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype), system.start())
    never = jnp.asarray(jnp.inf, dtype)
    ending = Ending(system.status(state), never, never, jnp.asarray(clock.duration, dtype))
    ending = ending._replace(lost_at=jnp.where(ending.lost_code == ALIVE, never, 0.0))
    memory = clock.integrator.start(jnp.asarray(clock.sample_period, dtype))
    return RolloutState(state, ending, memory, () if fold is None else fold.init())


def segment(
    system: System,
    clock: Clock,
    fold: Fold | None,
    progress: RolloutState,
    first: Scalar,
    count: int,
    record_every: int,
) -> tuple[RolloutState, Row | None]:
    """Simulate `count` samples from number `first` on, and record a row at every `record_every`-th sample.

    Returns the new state and the rows; the rows are None if record_every = 0.
    """
    step = functools.partial(one_sample, system.realised(), clock, fold)

    def unrecorded(progress: RolloutState, first: Scalar, count: int) -> RolloutState:
        return lax.fori_loop(0, count, lambda n, progress: step(progress, first + n)[0], progress)

    def block(progress: RolloutState, k: Array, length: int) -> tuple[RolloutState, Row]:
        progress, row = step(progress, k)
        if length > 1:
            progress = unrecorded(progress, k + 1, length - 1)
        return progress, row

    if record_every == 0:
        return unrecorded(progress, first, count), None
    starts = first + record_every * jnp.arange(count // record_every)
    progress, rows = lax.scan(functools.partial(block, length=record_every), progress, starts)
    if rest := count % record_every:
        progress, last = block(progress, jnp.asarray(first + count - rest), rest)
        rows = jax.tree.map(lambda many, one: jnp.concatenate([many, one[None]]), rows, last)
    return progress, rows


def recorded_segment(
    system: System, clock: Clock, fold: Fold | None, progress: RolloutState, first: Scalar, count: int
) -> tuple[RolloutState, Row]:
    """Simulate `count` samples from number `first` on, and record every row. Returns the new state and the rows.

    Samples after the last sample of the clock do not change the state. One compiled program with a fixed `count` can
    therefore simulate every part of a run. The caller must discard the rows of these samples.
    """
    step = functools.partial(one_sample, system.realised(), clock, fold)

    def sample(progress: RolloutState, k: Array) -> tuple[RolloutState, Row]:
        after, row = step(progress, k)
        return choose(k < clock.samples, after, progress), row

    return lax.scan(sample, progress, first + jnp.arange(count))


def finish(progress: RolloutState, rows: Row | None, fold: Fold | None) -> Result:
    """Return the outcome of a rollout from the state after the last sample and the rows."""
    lost_code, lost_at, singular_at, _ = progress.ending
    metrics = None if fold is None else fold.result(progress.fold, progress.ending)
    return Result(Trajectory(cast(Row, rows), lost_at, lost_code, singular_at), metrics)


def one_sample(
    system: Any, clock: Clock, fold: Fold | None, progress: RolloutState, k: Array
) -> tuple[RolloutState, Row]:
    """Record the row at the start of sample k, then integrate to its end with the measurement errors held.

    Reverse mode recomputes each sample (`jax.checkpoint`). Its memory then grows with the number of samples, not with
    the number of substeps.
    """

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def run(system: Any, clock: Clock, fold: Fold | None, progress: RolloutState) -> tuple[RolloutState, Row]:
        state, ending, memory, folded = progress
        dtype = jnp.result_type(float)
        t = k.astype(dtype) * clock.sample_period
        errors = system.sensor_errors(k)
        alive = ending.lost_code == ALIVE
        # Signals are evaluated just after t. A signal that jumps at this instant then has its value after the jump,
        # even if t was rounded down.
        just_after = t * (1 + 4 * jnp.finfo(dtype).eps)
        jumped = system.jump(just_after, state, errors)
        state = state if jumped is state else choose(alive, jumped, state)
        row = system.row(just_after, state, errors, alive)._replace(t=t)
        method, period = clock.integrator, clock.sample_period
        after = system.advance(method, errors, Begin(t, state, memory, ending.lost_code), period)
        row = system.completed(row, after.span)
        folded = folded if fold is None else updated(fold, folded, row, after.span)
        lost_now = alive & (after.code != ALIVE)
        resting = system.rest(after.state, after.code)
        state = choose(lost_now, resting, after.state)
        crossed = alive & (system.singularity(row) <= 0)
        ending = Ending(
            after.code,
            jnp.where(lost_now, after.t, ending.lost_at),
            first_time(crossed, t, ending.singular_at),
            ending.duration,
        )
        return RolloutState(state, ending, after.memory, folded), row

    return run(system, clock, fold, progress)


def rolled_in_parts(system: System, clock: Clock, fold: Fold) -> Result:
    """Simulate a rollout without rows, in parts that reverse mode recomputes (`jax.checkpoint`).

    Reverse mode stores the state at the start of each part and, for one part at a time, the state at each sample: if N
    samples have a divisor near sqrt(N), its memory grows with sqrt(N). The result is that of `run`, up to rounding.
    `clock` must have fixed steps. The function is not jitted.
    """
    system, clock, fold = canonical((system.realised(), clock, fold))
    # the number of samples of a part: the largest divisor of `samples` that is at most its square root
    length = next(one for one in range(math.isqrt(clock.samples), 0, -1) if clock.samples % one == 0)

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def part(progress: RolloutState, first: Array, system: Any, clock: Clock, fold: Fold) -> RolloutState:
        return segment(system, clock, fold, progress, first, length, 0)[0]

    advanced = lambda number, progress: part(progress, number * length, system, clock, fold)  # noqa: E731
    progress = lax.fori_loop(0, clock.samples // length, advanced, begin(system, clock, fold))
    return finish(progress, None, fold)
