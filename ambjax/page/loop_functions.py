"""The sampled loop that JAX traces for the page, as JavaScript. Every number of the case is a parameter."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.cases.reader import Case
from ambjax.compiler.short_compilation import precision
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import Scalar, canonical, replaced
from ambjax.page.functions import function_source, loop_source, operands_of, piece_of
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import RolloutState, begin, one_sample
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import sampled_of
from ambjax.simulation.trajectory import Row
from ambjax.world.scenario import Scenario


class Numbers(NamedTuple):
    """All numbers of a case that the loop uses. Each leaf is a parameter of the JavaScript.

    `settle`: start of the settled metrics, s. `period`: sample period, s.
    """

    cascade: Cascade
    scenario: Scenario
    settle: Scalar
    period: Scalar


@dataclasses.dataclass(frozen=True)
class LoopFunctions:
    """The functions of the loop, which JAX traces.

    `clock`: number of samples and integrator. The argument `normals` of the methods is a tuple of three scalars, the
    normal numbers of the sample.
    """

    clock: Clock

    def _system(self, numbers: Numbers, normals: Any) -> tuple[Sampled, Clock, Metrics]:
        clock = replaced(self.clock, sample_period=numbers.period)
        built = sampled_of(numbers.cascade, numbers.scenario, clock)
        word = jnp.zeros((), jnp.uint32)
        cascade = built.loop.cascade.turning(numbers.scenario.rotor)
        loop = ClosedLoop(cascade, numbers.scenario.turning(), (word, word), normals)
        return dataclasses.replace(built, loop=loop), clock, self._fold(numbers)

    def _fold(self, numbers: Numbers) -> Metrics:
        """Return the metrics without those once per revolution, which compute with arrays."""
        return Metrics.of(numbers.settle, dataclasses.replace(numbers.scenario, rotor=None))

    def start(self, numbers: Numbers, normals: Any) -> RolloutState:
        """Return the state of the run before the first sample."""
        return begin(*self._system(numbers, normals))

    def step(
        self, numbers: Numbers, progress: RolloutState, normals: Any, k: Array
    ) -> tuple[RolloutState, Row, tuple[Array, Array]]:
        """Return the state after sample k, the row of this sample, and the currents of both coils at its start, A."""
        system, clock, fold = self._system(numbers, normals)
        after, row = one_sample(system, clock, fold, progress, k)
        return after, row, numbers.scenario.plant.currents(progress.state.plant)

    def result(self, numbers: Numbers, progress: RolloutState) -> dict[str, Array]:
        """Return the metrics of a run that ended in this state."""
        fold = self._fold(numbers)
        return fold.result(progress.fold, progress.ending)


def loop_parameters(case: Case, any_delay: bool = False) -> Numbers:
    """Return the numbers of a case on a processor."""
    cascade = case.cascade.on_processor()
    if any_delay:
        cascade = cascade.on_processor(0.0, longest_delay(case), between=True)
    return Numbers(cascade, case.scenario, case.settle, case.clock.sample_period)


def longest_delay(case: Case) -> float:
    """Return the longest delay that the page admits, samples: the number of commands that its programs keep."""
    return float(len(case.cascade.on_processor().timing.constant_past(jnp.zeros(()))))


# Signals in a row, which the page draws; the currents of both coils follow. A row of a member has the first three only.
SIGNALS = ("z", "alive", "r", "u", "u_mean", "i_ref", "q_z", "z_measured", "sigma", "v_tilde", "i")
COILS = ("i_1", "i_2")


class LoopScript(NamedTuple):
    """The loop as JavaScript.

    - `source`: the functions `startLoop(P, W, out)`, `makeLoop(P)`, `makeMember(P)` and `loopMetrics(P, S, out)`.
      W: normal random numbers. `out`: array of the result. See `functions.loop_source` for the functions that
      `makeLoop` and `makeMember` return. That of a member does not update the metrics in S.
    - `parameters`: the case's values of the parameters P.
    - `metrics`: names of the metrics, in the order of `out` of `loopMetrics`.
    - `states`: number of states S.
    - `lost`: index of the state that contains the status code of the rotor.
    """

    source: str
    parameters: list[float]
    metrics: list[str]
    states: int
    lost: int


def loop_script(case: Case, any_delay: bool = False) -> LoopScript:
    """Return the loop of a case on a processor as JavaScript. `any_delay`: for every delay that the page
    admits, not only that of the case.

    Raises ValueError for a part of the case that scalar code cannot express.
    """
    with precision("double"):
        numbers = canonical(loop_parameters(case, any_delay))
        functions = LoopFunctions(case.clock)
        zero = jnp.zeros(())
        normals = (zero, zero, zero)
        start = piece_of(functions.start, "pw", (numbers, normals))
        shapes = jax.eval_shape(functions.start, numbers, normals)
        progress = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        step = piece_of(functions.step, "pswn", (numbers, progress, normals, zero))
        result = piece_of(functions.result, "ps", (numbers, progress))
    _, row, coils = step.results
    shown = [getattr(row, name) for name in SIGNALS] + list(coils)
    every = operands_of(step.results[0])
    source = "\n".join(
        [
            function_source(start, "startLoop", "PW", start.results),
            loop_source(step, "makeLoop", shown, every),
            loop_source(step, "makeMember", shown[:3], []),
            function_source(result, "loopMetrics", "PS", result.results),
        ]
    )
    values = [float(x) for x in jax.tree.leaves(numbers)]
    lost = jax.tree.leaves(jax.tree.map(lambda x: x is shapes.ending.lost_code, shapes)).index(True)
    return LoopScript(source, values, list(result.results), len(every), lost)
