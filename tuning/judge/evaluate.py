"""Evaluation of gains on an ensemble, and comparison of the search's steps with accurate ones."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.ensemble import wilson
from ambjax.ensemble.study import Study
from ambjax.linear import Stability, stability_of
from tuning.problem.config import seeds
from tuning.problem.members import FEW, Members
from tuning.problem.tuning_problem import REFERENCE_TOLERANCE, TuningProblem

# Largest relative difference of two values that agree: settled rms errors with the search's steps and with accurate
# ones (above it, the steps are refined), and judged and expected means of a limited quantity (above it, the training
# ensemble lacks members with large values).
RESOLVED = 0.1


def judge(problem: TuningProblem, x: np.ndarray, seed: int, count: int) -> dict[str, np.ndarray]:
    """Return the metrics and the terms of the loss ("loss.NAME"), each [count], of an ensemble at coordinates x [m].

    `TuningProblem.judging` defines the steps. In continuous time they are finer than those of the search; on a
    processor they are those of the case, unless the search has refined its steps.
    """
    metrics = problem.judging.metrics(x[None], problem.objective.chosen(seed, np.arange(count), count))
    both = metrics["metrics"] | {f"loss.{name}": values for name, values in metrics["loss"].items()}
    return {name: values[0] for name, values in both.items()}


class JudgedMembers(NamedTuple):
    """The first N members of the ensemble with this `seed`, judged at coordinates x [m].

    `columns` [N]: metrics and terms of the loss, from `judge`.
    """

    problem: TuningProblem
    x: np.ndarray
    seed: int
    columns: Mapping[str, np.ndarray]

    @property
    def held(self) -> np.ndarray:
        """The numbers of the members that are held."""
        return np.flatnonzero(held(self.columns))

    def chosen(self, numbers: np.ndarray) -> Members:
        """Return the members with these numbers."""
        return self.problem.objective.chosen(self.seed, numbers, len(self.columns["lost_at_s"]))

    def worst(self) -> dict[str, Any]:
        """Return the worst member: its run ends first (lost or stalled), or else its settled error is the largest.

        `replay` is the command that simulates it and returns these values, for the directory of the report; None if the
        judge's steps differ from those of `ambjax simulate`.
        """
        error, lost_at = self.columns["settled_max_abs_error_m"], self.columns["lost_at_s"]
        index = int(np.lexsort((-error, lost_at))[0])
        case = self.problem.case
        study = Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, self.seed, len(error))
        return {
            "member": index,
            "settled_max_abs_error_m": float(error[index]),
            "lost_at_s": float(lost_at[index]),
            "replay": study.command("tuned.toml", index) if self.problem.replays else None,
        }


def rms(values: np.ndarray) -> float:
    """Return the root mean square over an ensemble."""
    return float(np.sqrt(np.mean(values**2)))


class StepError(NamedTuple):
    """Comparison of coarse steps, those of the search or of the judge, with accurate ones.

    `search_m`, `reference_m` (m): settled rms errors with coarse and with accurate steps, over the `members` that are
    held with both. `relative`: relative difference of these errors; NaN without such members or for `reference_m` = 0.
    `tried`: number of members compared. `lost`, `stalled`: number of members that are held with coarse steps, but lost
    or stalled with accurate ones. `unheld`: these members. `negligible_m`: difference of the errors (m) within the
    accuracy of the reference, below which the steps count as resolved.
    """

    search_m: float
    reference_m: float
    relative: float
    members: int
    tried: int
    lost: int
    stalled: int
    unheld: Members
    negligible_m: float

    @property
    def unconfirmed(self) -> int:
        """Number of members that are held with coarse steps but lost or stalled with accurate ones."""
        return self.lost + self.stalled

    @property
    def resolved(self) -> bool:
        """Whether the error by coarse steps agrees with that by accurate ones."""
        return abs(self.relative) <= RESOLVED or abs(self.search_m - self.reference_m) <= self.negligible_m

    @property
    def refuted(self) -> str:
        """The reason why accurate steps do not confirm the result; '' if they confirm it."""
        if self.lost:
            return f"accurate steps lose {self.lost} of {self.tried} members tried, which coarser steps hold"
        if self.stalled:
            return f"accurate steps cannot decide {self.stalled} of {self.tried} members tried (they stall)"
        if not self.members:
            return "no member compared is held with both steps"
        return "" if self.resolved else f"coarser steps give a settled rms error {self.difference_text}"

    @property
    def difference_text(self) -> str:
        """Difference of the two errors as part of a sentence: in per cent, or both values if the reference is 0."""
        if math.isfinite(self.relative):
            return f"off by {100 * self.relative:.2g} %"
        found = (f"{x:.2g} m" if math.isfinite(x) else "no number" for x in (self.search_m, self.reference_m))
        return "of {} against {}".format(*found)

    def facts(self) -> dict[str, Any]:
        """Return the comparison as plain data for report.json."""
        summary = {name: getattr(self, name) for name in self._fields if name not in ("unheld", "negligible_m")}
        return summary | {"resolved": self.resolved, "refuted": self.refuted, "text": describe(self)}


def describe(error: StepError) -> str:
    """Return the result of the comparison as a phrase."""
    described = error.members and not error.unconfirmed
    return f"settled rms error {error.difference_text} on {error.members} members" if described else error.refuted


def comparison_members(problem: TuningProblem) -> Members:
    """Return the members used to compare steps: the first FEW of the training ensemble."""
    count = problem.tune.budget.members
    return problem.objective.chosen(seeds(problem.tune.budget)[0], np.arange(min(FEW, count)), count)


def worst_of(values: np.ndarray) -> np.ndarray:
    """Return the indices of the FEW largest values [n], largest first."""
    return np.argsort(-values, kind="stable")[:FEW]


def stability(problem: TuningProblem, x: np.ndarray, members: Members) -> Stability:
    """Return the stability of the loops of members at coordinates x [m]."""
    # in continuous time, the step of the case may be too coarse for these gains
    clock = problem.case.clock if problem.sampled else problem.case.clock.with_method(None)
    return stability_of(*problem.objective.fixed(x, members), clock)


def step_error(problem: TuningProblem, x: np.ndarray, members: Members | None = None) -> StepError:
    """Compare the search's steps with accurate ones at x [m], on `members` (default: `comparison_members`)."""
    members = comparison_members(problem) if members is None else members
    ours, theirs = (
        {name: values[0] for name, values in engine.metrics(x[None], members)["metrics"].items()}
        for engine in problem.steps
    )
    ended = [np.isfinite(metrics["lost_at_s"]) for metrics in (ours, theirs)]
    held, unconfirmed = ~(ended[0] | ended[1]), ended[1] & ~ended[0]
    stalled = unconfirmed & theirs["stalled"]
    search_m, reference_m = (
        rms(metrics["settled_rms_error_m"][held]) if held.any() else math.nan for metrics in (ours, theirs)
    )
    relative = search_m / reference_m - 1 if reference_m > 0 else math.nan
    unheld: Members = jax.tree.map(lambda a: a[unconfirmed], members)
    negligible = REFERENCE_TOLERANCE * float(np.asarray(problem.objective.loss.s_0))
    both, lost = int(held.sum()), int((unconfirmed & ~stalled).sum())
    return StepError(search_m, reference_m, relative, both, len(held), lost, int(stalled.sum()), unheld, negligible)


def held(metrics: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return which members [N] are held: neither lost nor stalled."""
    return ~np.isfinite(metrics["lost_at_s"])


def summarise(metrics: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the statistics of an ensemble [N] for the report: statuses, survival, and metrics over members.

    The status of a member whose integration stalled is unknown: the member counts neither as lost nor as held, and not
    as a survivor. Metrics include only held members, because the state of a lost rotor is frozen and its drive is
    off. If no member is held, the summary has no metrics.
    """
    alive = held(metrics)
    survival, ended = wilson(int(alive.sum()), len(alive)), metrics["lost_at_s"][~alive]
    summary: dict[str, Any] = {"members": len(alive), "held": int(alive.sum())}
    summary |= {name: int(metrics[name].sum()) for name in ("lost", "stalled")}
    bounds = {f"survival_{name}": float(getattr(survival, name)) for name in ("low", "high")}
    summary |= {"survival": float(survival.value)} | bounds
    if ended.size:
        summary |= {"lost_at_s.mean": float(ended.mean()), "lost_at_s.largest": float(ended.max())}
    if not alive.any():
        return summary
    errors = metrics["settled_rms_error_m"][alive]
    summary |= {
        "settled_rms_error_m": rms(errors),
        "settled_rms_error_worst_member_m": float(errors.max()),
        "settled_max_abs_error_m": float(metrics["settled_max_abs_error_m"][alive].max()),
    }
    for name, values in metrics.items():
        if values.dtype == bool or name == "lost_at_s":
            continue
        finite = values[alive & np.isfinite(values)]
        if finite.size:
            summary |= {f"{name}.mean": float(finite.mean()), f"{name}.largest": float(finite.max())}
    return summary
