"""One member by itself, with the rounding that it has in an ensemble.

XLA compiles a rollout of one member into scalar code and a block of members into vector code. The two contract products
and sums into fused operations at different places, so their results differ in the last bit. In a loop with a converter
or a sign without a layer that difference grows until the runs have nothing in common. So a member that is simulated by
itself runs in a block of the size that an ensemble has, and fills every lane of it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import map_members
from ambjax.ensemble.study import Study
from ambjax.ensemble.worker import CALL, chunk
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Fold, standard_for
from ambjax.simulation.rollout import Outcome, RolloutState, System, begin, finish, prepare, stretch
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.scenario import Scenario

# Samples in one call of the compiled program: their rows of all lanes take 20 MB.
STRETCH = 2048


class Replay(NamedTuple):
    """A member of a study: its trajectory and its metrics.

    `metrics` have the bits of the member's row in the study. `deviation` is the largest relative difference between
    these and the metrics of the recorded trajectory: at most `rounding` where the trajectory is that of the study.
    """

    trajectory: Trajectory
    metrics: dict[str, Any]
    deviation: float
    rounding: float


def as_member(scenario: Scenario) -> Scenario:
    """The scenario with its member's number as an array [1]: that varies in every ensemble."""
    return dataclasses.replace(scenario, member=np.atleast_1d(np.asarray(scenario.member)))


def record(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    *,
    fold: Fold | None = None,
    tell: Callable[[int], Any] = lambda _: None,
) -> Outcome:
    """Simulate one member and record every sample, with the rounding of an ensemble's block.

    Leaves are numbers; those that vary in the ensemble are arrays [1], as from `Study.batch`. Rows are [samples], all
    else has the shape that `rollout` gives it. `tell` is called with the number of samples that were added. On a CPU
    every bit of a row is that of the ensemble (tests/test_replay.py); a sum in a fold may differ in the last one.

    Raises ValueError as `rollout` does.
    """
    system, clock = prepare(cascade, as_member(scenario), clock)
    return record_system(system, clock, fold=fold, tell=tell)


def record_system(
    system: Any, clock: Clock, *, fold: Fold | None = None, tell: Callable[[int], Any] = lambda _: None
) -> Outcome:
    """`record` of a `rollout.System`, of which a leaf is an array [1] (`as_member`); nothing is checked."""
    tree = canonical((system, clock, fold))
    count = min(STRETCH, clock.samples)
    progress, rows, outcomes = map_members(_begun, tree, threads=1, call=1), [], list[Outcome]()
    for first in range(0, clock.samples, count):
        progress, outcome = map_members(_stretched(count), (*tree, progress, first), threads=1, call=1)
        outcomes = [jax.tree.map(lambda x: x[0], outcome)]
        left = min(count, clock.samples - first)
        # a copy: the array holds the rows of all lanes
        rows.append(jax.tree.map(lambda x, n=left: x[:n].copy(), outcomes[0].trajectory.rows))
        tell(left)
    whole = jax.tree.map(lambda *xs: np.concatenate(xs), *rows)
    return outcomes[0]._replace(trajectory=dataclasses.replace(outcomes[0].trajectory, rows=whole))


def replay(study: Study, index: int, tell: Callable[[int], Any] = lambda _: None) -> Replay:
    """One member of a study. Its metrics come from the study's own compiled program, its trajectory from `record`.

    Raises ValueError as `rollout` does.
    """
    columns = chunk(study, index, index + 1, CALL, threads=1)
    cascade, scenario = study.batch(np.array([index]))
    outcome = record(cascade, scenario, study.clock, fold=standard_for(study.settle, scenario), tell=tell)
    metrics = {name: columns[name][0] for name in outcome.measured}
    deviation = max(_relative(metrics[name], x) for name, x in outcome.measured.items())
    eps = float(np.finfo(np.asarray(metrics["rms_error_m"]).dtype).eps)
    return Replay(outcome.trajectory, metrics, deviation, study.clock.samples * eps)


def _relative(a: Any, b: Any) -> float:
    """|a - b| as a share of the larger; 1 where only one of them is finite."""
    a, b = float(a), float(b)
    if a == b:
        return 0.0
    return abs(a - b) / max(abs(a), abs(b)) if np.isfinite(a - b) else 1.0


def _begun(tree: tuple[System, Clock, Fold | None]) -> RolloutState:
    return begin(*tree)


@functools.cache
def _stretched(count: int) -> Callable[[Any], Any]:
    """The same function each time, so that it compiles once."""

    def one(tree: tuple[System, Clock, Fold | None, RolloutState, Any]) -> tuple[RolloutState, Outcome]:
        system, clock, fold, progress, first = tree
        progress, rows = stretch(system, clock, fold, progress, first, count)
        return progress, finish(progress, rows, fold)

    return one
