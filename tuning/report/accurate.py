"""What the report's own steps are worth on each of its numbers, and nominal runs for its pictures.

The steps of the report are of fixed number, for speed; here a few members are simulated again by adaptive RODAS3.
"""

import dataclasses
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.replay import record
from ambjax.simulation.rollout import rollout
from ambjax.simulation.trajectory import Trajectory
from tuning.judge import difference, metrics_of, summarise
from tuning.problem import TuningProblem

# Held-out members that are simulated again.
AGAIN = 8
# A number that the report's own steps miss by more than this share is marked.
MARKED = 0.05


def compared(problem: TuningProblem, x: np.ndarray, seed: int, count: int, names: tuple[str, ...]) -> dict[str, Any]:
    """The first members of the ensemble of `count` with this seed at x [m], by the report's steps and by accurate ones.

    `members` simulated, `held` by both; over these the summaries (`summarise`) of `names`: of the report, accurate,
    and the relative error of the former. `lost`, `stalled`: how many are, by either. `refuted`: why accurate steps do
    not confirm what the report says of them; '' where they do, or the report itself holds nobody.
    """
    numbers = np.arange(min(AGAIN, count))
    members = problem.objective.chosen(seed, numbers, count)
    both = metrics_of(problem.judging, x, members), metrics_of(problem.reference, x, members)
    error = difference(problem, *both, members)
    held = np.logical_and.reduce([~np.isfinite(metrics["lost_at_s"]) for metrics in both])
    ways = ("report", "accurate")
    facts: dict[str, Any] = {"members": len(numbers), "held": int(held.sum()), "marked_beyond": MARKED}
    facts["refuted"] = error.refuted if error.members + error.unseen else ""
    for status in ("lost", "stalled"):
        facts[status] = {way: int(metrics[status].sum()) for way, metrics in zip(ways, both, strict=True)}
    facts["metrics"] = {}
    if held.any():
        ours, theirs = (summarise({name: values[held] for name, values in metrics.items()}) for metrics in both)
        shown = [name for name in names if name in ours and name in theirs]
        facts["metrics"] = {
            name: {"report": ours[name], "accurate": theirs[name], "relative": _relative(ours[name], theirs[name])}
            for name in shown
        }
    return facts


def _relative(ours: float, theirs: float) -> float:
    """How far off ours is: +inf where theirs is 0 and ours is not."""
    if ours == theirs:
        return 0.0
    return ours / theirs - 1 if theirs else float("inf")


def nominal(problem: TuningProblem, cascade: Cascade) -> Trajectory:
    """The case's own run, nothing spread, under this cascade: a row for each sample.

    In accurate steps; where the judge takes those of `ambjax simulate`, that command's run.
    """
    case = problem.case
    if problem.replays:
        return record(cascade, case.scenario, case.clock).trajectory
    clock = dataclasses.replace(case.clock, method=problem.reference.objective.clock.method)
    return rollout(cascade, case.scenario, clock).trajectory
