"""What gains are worth: an ensemble that judges them, and accurate steps against the search's own."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.ensemble import wilson
from ambjax.ensemble.study import Study
from tuning.config import seeds
from tuning.objective.lanes import Engine
from tuning.objective.members import Members
from tuning.problem import REFERENCE_MEMBERS, TuningProblem

# Members simulated at a time when an ensemble is judged.
AT_ONCE = 1024
# Beyond this relative error of the settled rms error the steps are refined and the search goes on.
RESOLVED = 0.1
# unless the two differ by less than this share of the gap: as much as the reference itself is worth.
NEGLIGIBLE = 1e-6


def judge(problem: TuningProblem, x: np.ndarray, seed: int, count: int) -> dict[str, np.ndarray]:
    """Every metric [count] of the members of an ensemble under the gains at x [m], and the loss's terms."""
    parts = []
    for first in range(0, count, AT_ONCE):
        who = problem.objective.chosen(seed, np.arange(first, min(first + AT_ONCE, count)), count)
        metrics = problem.judging.metrics(x[None], who)
        parts.append({**metrics["metrics"], **{f"loss.{name}": v for name, v in metrics["loss"].items()}})
    return {name: np.concatenate([part[name][0] for part in parts]) for name in parts[0]}


def worst(problem: TuningProblem, judged: dict[str, np.ndarray], seed: int) -> dict[str, Any]:
    """The member of the ensemble `judged` [N] that fares worst: the first lost, else that of the largest settled error.

    `replay` is the command that simulates it by itself, beside the report, and gives these numbers; None where the
    judge's steps are not those of `ambjax simulate`.
    """
    error, lost_at = judged["settled_max_abs_error_m"], judged["lost_at_s"]
    index = int(np.lexsort((-error, lost_at))[0])
    case = problem.case
    study = Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, seed, len(error))
    return {
        "member": index,
        "settled_max_abs_error_m": float(error[index]),
        "lost_at_s": float(lost_at[index]),
        "replay": study.command("tuned.toml", index) if problem.replays else None,
    }


def rms(values: np.ndarray) -> float:
    """Root mean square over an ensemble."""
    return float(np.sqrt(np.mean(values**2)))


class StepError(NamedTuple):
    """Steps of the search, or finer ones of the judge, against accurate ones: settled rms error of both, m.

    Of those `members` whom both hold; `relative` is NaN if there is none. `lost`, `stalled`: how many of the `tried`
    the coarser steps hold, but the accurate ones lose, or cannot decide; `who` they are.
    """

    search_m: float
    reference_m: float
    relative: float
    members: int
    tried: int
    lost: int
    stalled: int
    who: Members
    negligible_m: float
    """a difference that is none"""

    @property
    def unseen(self) -> int:
        """Members that accurate steps do not hold, though the coarser ones do."""
        return self.lost + self.stalled

    @property
    def resolved(self) -> bool:
        """Whether the coarser steps tell the truth of the error there."""
        return abs(self.relative) <= RESOLVED or abs(self.search_m - self.reference_m) <= self.negligible_m

    @property
    def refuted(self) -> str:
        """Why accurate steps do not confirm that the rotor is held there, and how well; '' where they do."""
        if self.lost:
            return f"accurate steps lose {self.lost} of {self.tried} members tried, which coarser ones hold"
        if self.stalled:
            return f"accurate steps cannot decide {self.stalled} of {self.tried} members tried (they stall)"
        if not self.members:
            return "no member compared is held by both"
        return "" if self.resolved else f"coarser steps give a settled rms error {self.off}"

    @property
    def off(self) -> str:
        """How far off the coarser steps are, in words: a share, or both where there is none."""
        if math.isfinite(self.relative):
            return f"off by {100 * self.relative:.2g} %"
        found = (f"{x:.2g} m" if math.isfinite(x) else "no number" for x in (self.search_m, self.reference_m))
        return "of {} against {}".format(*found)

    def facts(self) -> dict[str, Any]:
        """All of it as plain data."""
        summary = {name: getattr(self, name) for name in self._fields if name not in ("who", "negligible_m")}
        return summary | {"resolved": self.resolved, "refuted": self.refuted, "told": words(self)}


def words(error: StepError) -> str:
    """What accurate steps say, in words."""
    told = error.members and not error.unseen
    return f"settled rms error {error.off} on {error.members} members" if told else error.refuted


def compared(problem: TuningProblem) -> Members:
    """The members on whom steps are compared first: of the training ensemble."""
    count = problem.tune.budget.members
    return problem.objective.chosen(seeds(problem.tune.budget)[0], np.arange(min(REFERENCE_MEMBERS, count)), count)


def worst_of(values: np.ndarray) -> np.ndarray:
    """Numbers of the members with the largest values [n], REFERENCE_MEMBERS of them, worst first."""
    return np.argsort(-values, kind="stable")[:REFERENCE_MEMBERS]


def step_error(problem: TuningProblem, x: np.ndarray, who: Members | None = None) -> StepError:
    """What the search's own steps are worth at x [m], on these members; left out: on the first that it is tuned on."""
    who = compared(problem) if who is None else who
    ours, theirs = (metrics_of(engine, x, who) for engine in problem.steps)
    return difference(problem, ours, theirs, who)


def metrics_of(engine: Engine, x: np.ndarray, who: Members) -> dict[str, np.ndarray]:
    """Every metric [n] of these members under the gains at x [m]."""
    return {name: values[0] for name, values in engine.metrics(x[None], who)["metrics"].items()}


def difference(
    problem: TuningProblem, ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray], who: Members
) -> StepError:
    """What steps are worth by which these members' metrics [n] are `ours`, and `theirs` by accurate ones."""
    ended = [np.isfinite(metrics["lost_at_s"]) for metrics in (ours, theirs)]
    held, unseen = ~(ended[0] | ended[1]), ended[1] & ~ended[0]
    stalled = unseen & theirs["stalled"]
    search_m, reference_m = (
        rms(metrics["settled_rms_error_m"][held]) if held.any() else math.nan for metrics in (ours, theirs)
    )
    relative = search_m / reference_m - 1 if reference_m > 0 else math.nan
    those: Members = jax.tree.map(lambda a: a[unseen], who)
    negligible = NEGLIGIBLE * float(np.asarray(problem.objective.loss.s_0))
    both, lost = int(held.sum()), int((unseen & ~stalled).sum())
    return StepError(search_m, reference_m, relative, both, len(held), lost, int(stalled.sum()), those, negligible)


def held(metrics: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which members [N] run to the end: neither lost nor stalled."""
    return ~np.isfinite(metrics["lost_at_s"])


def summarise(metrics: dict[str, np.ndarray]) -> dict[str, Any]:
    """Numbers of an ensemble [N] for the report: statuses, survival, and pooled, mean and largest metrics.

    A member whose integration stalled is not `lost`, for its status is not known; but it is not `held` either, and does
    not survive. Metrics are of the members that are held: a rotor that is lost is frozen, and from then on its voltage
    and current are 0. Without such members there are none.
    """
    alive, n = held(metrics), len(metrics["lost_at_s"])
    survival = wilson(int(alive.sum()), n)
    ended = metrics["lost_at_s"][~alive]
    summary: dict[str, Any] = {
        "members": n,
        "held": int(alive.sum()),
        "lost": int(metrics["lost"].sum()),
        "stalled": int(metrics["stalled"].sum()),
        "survival": float(survival.value),
        "survival_low": float(survival.low),
        "survival_high": float(survival.high),
    }
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
