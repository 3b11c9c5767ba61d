"""Replay of one member of an ensemble, with the same rounding as in the ensemble.

XLA compiles a rollout of one member into scalar code, and a block of members into vector code. These codes contract
products and sums into fused operations at different places, so their results differ in the last bit. In a loop with a
converter, or with a set-valued sign, that difference grows until the two runs are unrelated. Here a single member is
therefore simulated in a block of the same size as in an ensemble, and copies of it fill the other lanes of the block.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, SupportsFloat

import jax
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import map_members
from ambjax.ensemble.study import Study
from ambjax.ensemble.worker import CALL, chunk
from ambjax.numerics.records import Scalar, canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Fold
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import Result, RolloutState, System, begin, finish, prepare, recorded_segment
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.scenario import Scenario

# Samples in one call of the compiled program: the rows of all lanes take 20 MB.
SEGMENT = 2048


class Replay(NamedTuple):
    """One member of a study: its trajectory and its metrics.

    - `trajectory`: the member's trajectory, with every sample recorded.
    - `metrics`: the member's metrics by name. On a CPU they equal its row in the study, bit for bit.
    - `deviation`: largest relative difference between `metrics` and the metrics of `trajectory`.
    - `rounding`: bound on `deviation` if the trajectory is that of the study.
    """

    trajectory: Trajectory
    metrics: dict[str, Any]
    deviation: float
    rounding: float


def as_member(scenario: Scenario) -> Scenario:
    """Return the scenario with its member number as an array [1], as in an ensemble of one member."""
    return dataclasses.replace(scenario, member=np.atleast_1d(np.asarray(scenario.member)))


def record_member(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    *,
    fold: Fold | None = None,
    tell: Callable[[int], object] = lambda _: None,
) -> Result:
    """Simulate one member with the rounding of an ensemble's block, and record every sample.

    Leaves are numbers, except that leaves which vary in the ensemble are arrays [1], as `Study.batch` returns them.
    `tell` is called with the number of new samples after each part of the run.

    Returns the Result of `rollout`, with rows [samples]. On a CPU the rows are bit for bit those of the ensemble
    (tests/test_replay.py); a sum in a fold may differ in the last bit.

    Raises ValueError as `rollout` does.
    """
    system, clock = prepare(cascade, as_member(scenario), clock)
    return record_system(system, clock, fold=fold, tell=tell)


def record_system(
    system: System, clock: Clock, *, fold: Fold | None = None, tell: Callable[[int], object] = lambda _: None
) -> Result:
    """Do the work of `record_member` for a `rollout.System`, without checks. At least one leaf must be an array [1]."""
    tree = canonical((system, clock, fold))
    count = min(SEGMENT, clock.samples)
    progress, rows, outcomes = map_members(_begun, tree, threads=1, call=CALL), [], list[Result]()
    for first in range(0, clock.samples, count):
        progress, outcome = map_members(_RecordedSegment(count), (*tree, progress, first), threads=1, call=CALL)
        outcomes = [jax.tree.map(lambda x: x[0], outcome)]
        left = min(count, clock.samples - first)
        # Copy, because the slice would keep the rows of all lanes in memory.
        rows.append(jax.tree.map(lambda x, n=left: x[:n].copy(), outcomes[0].trajectory.rows))
        tell(left)
    whole = jax.tree.map(lambda *xs: np.concatenate(xs), *rows)
    return outcomes[0]._replace(trajectory=dataclasses.replace(outcomes[0].trajectory, rows=whole))


def replay(study: Study, index: int, tell: Callable[[int], object] = lambda _: None) -> Replay:
    """Simulate one member of a study again.

    The metrics come from the compiled program of the study, the trajectory from `record_member`. `tell`: as in
    `record_member`. Raises ValueError as `rollout` does.
    """
    columns = chunk(study, index, index + 1, CALL, threads=1)
    cascade, scenario = study.batch(np.array([index]))
    outcome = record_member(cascade, scenario, study.clock, fold=Metrics.of(study.settle, scenario), tell=tell)
    metrics = {name: columns[name][0] for name in outcome.metrics}
    deviation = max(_relative(metrics[name], x) for name, x in outcome.metrics.items())
    eps = float(np.finfo(np.asarray(metrics["rms_error_m"]).dtype).eps)
    return Replay(outcome.trajectory, metrics, deviation, study.clock.samples * eps)


def _relative(a: SupportsFloat, b: SupportsFloat) -> float:
    """Return |a - b|/max(|a|, |b|); 0 if both are equal or NaN, 1 if they differ and are not both finite."""
    a, b = float(a), float(b)
    if a == b or np.isnan([a, b]).all():
        return 0.0
    return abs(a - b) / max(abs(a), abs(b)) if np.isfinite(a - b) else 1.0


def _begun(tree: tuple[System, Clock, Fold | None]) -> RolloutState:
    return begin(*tree)


@dataclasses.dataclass(frozen=True)
class _RecordedSegment:
    """The function that simulates the next `count` samples of one member."""

    count: int

    def __call__(self, tree: tuple[System, Clock, Fold | None, RolloutState, Scalar]) -> tuple[RolloutState, Result]:
        system, clock, fold, progress, first = tree
        progress, rows = recorded_segment(system, clock, fold, progress, first, self.count)
        return progress, finish(progress, rows, fold)
