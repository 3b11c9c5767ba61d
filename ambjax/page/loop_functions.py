"""Functions of the sampled loop that JAX traces for the page. Every number of the case is an argument."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.cases.reader import Case
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import Scalar, replaced
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
