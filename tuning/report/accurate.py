"""The errors of the report's numbers due to its fixed integration steps, and nominal runs for its pictures.

To find these errors, a few members are simulated again with accurate steps. The report does so in continuous time
only, where these are the steps of adaptive RODAS3.
"""

import dataclasses
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.replay import record_member
from ambjax.simulation.rollout import rollout
from ambjax.simulation.trajectory import Trajectory
from tuning.judge.evaluate import compare_metrics, metrics_of, summarise
from tuning.problem.tuning_problem import TuningProblem

# Number of held-out members that are simulated by accurate steps.
COMPARED = 8
# Relative error of the report's steps above which a number is marked.
MARKED = 0.05


def compare_steps(
    problem: TuningProblem, x: np.ndarray, seed: int, count: int, names: tuple[str, ...]
) -> dict[str, Any]:
    """Compare the report's steps with accurate steps on the first members of an ensemble, at coordinates x [m].

    Returns plain data. `members`: number of members simulated. `held`: number of members that survive with both steps.
    `metrics`: for each of `names`, the summary over these members (`summarise`) with the report's steps and with
    accurate steps, and the relative error. `lost`, `stalled`: numbers of members with each of the steps. `refuted`: why
    accurate steps contradict the report; '' if they do not, or if no member survives in the report.
    """
    numbers = np.arange(min(COMPARED, count))
    members = problem.objective.chosen(seed, numbers, count)
    both = metrics_of(problem.judging, x, members), metrics_of(problem.reference, x, members)
    error = compare_metrics(problem, *both, members)
    held = np.logical_and.reduce([~np.isfinite(metrics["lost_at_s"]) for metrics in both])
    ways = ("report", "accurate")
    facts: dict[str, Any] = {"members": len(numbers), "held": int(held.sum()), "marked_beyond": MARKED}
    facts["refuted"] = error.refuted if error.members + error.unconfirmed else ""
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
    """Return the relative error of `ours`; +inf if `theirs` is 0 and `ours` is not."""
    if ours == theirs:
        return 0.0
    return ours / theirs - 1 if theirs else float("inf")


def nominal(problem: TuningProblem, cascade: Cascade) -> Trajectory:
    """Simulate the nominal case under this cascade and record every sample.

    The steps are accurate ones, or those of `ambjax simulate` if the judge uses these.
    """
    case = problem.case
    if problem.replays:
        return record_member(cascade, case.scenario, case.clock).trajectory
    clock = dataclasses.replace(case.clock, method=problem.reference.objective.clock.method)
    return rollout(cascade, case.scenario, clock).trajectory
