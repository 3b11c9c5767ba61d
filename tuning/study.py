"""A study: a case and its [tune], made into an objective, a goal and an engine; and what its answer is worth."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from ambjax.casefile import Case
from ambjax.integrate import Adaptive, Integrator, Slide
from ambjax.method import choose_method
from ambjax.scenario import Clock
from ambjax.sliding import slides
from tuning.conditions import bounds
from tuning.config import Tune, seeds
from tuning.goal import Goal
from tuning.loss import loss_for
from tuning.objective import Engine, Objective
from tuning.ranges import Range, bounded

# Members simulated at a time when an ensemble is judged.
CHUNK = 1024
# Members and tolerance of the accurate reference against which the steps of the search are held.
REFERENCE_MEMBERS, REFERENCE_TOLERANCE, MOST_TRIALS = 4, 1e-6, 10_000
# Beyond this relative error of the settled rms error the steps are refined and the search goes on.
RESOLVED = 0.1


@dataclasses.dataclass(frozen=True)
class Study:
    """Case, settings and what is compiled from them."""

    case: Case
    tune: Tune
    objective: Objective
    engine: Engine
    goal: Goal
    ranges: list[Range]


def method_for(case: Case, substeps: int) -> Integrator:
    """The step of the search: of fixed number, so that all members take as long, and blind to gamma p."""
    if slides(case.cascade):
        return Slide(substeps)
    return choose_method(case.cascade, case.scenario, float(case.clock.sample_period), reverse=True)


def study_of(case: Case, tune: Tune, *, finer: int = 1, threads: int | None = None) -> Study:
    """The study of a case, in steps `finer` times as fine as [tune] asks for."""
    clock = Clock(case.clock.samples, case.clock.sample_period, method_for(case, finer * tune.budget.substeps))
    loss = loss_for(case.scenario, case.settle, tune.early)
    objective = Objective(tune.space, case.cascade, case.scenario, clock, loss, case.spread)
    conditions = bounds(case.cascade, case.scenario, clock)
    space, box = bounded(objective, conditions, tune.space.values(case.cascade))
    objective = dataclasses.replace(objective, space=space)
    goal = Goal(tune.weights, tune.risk, conditions, tune.conditions, tune.margin)
    mode = "forward" if len(tune.space) <= MOST_FORWARD else "reverse"
    return Study(case, tune, objective, Engine(objective, settle=case.settle, mode=mode, threads=threads), goal, box)


# Beyond this many gains reverse mode is the cheaper one.
MOST_FORWARD = 8


def judge(study: Study, x: np.ndarray, seed: int, count: int) -> dict[str, np.ndarray]:
    """Every metric [count] of the members of an ensemble under the gains at x [m], and the loss's terms."""
    parts = []
    for first in range(0, count, CHUNK):
        who = study.objective.chosen(seed, np.arange(first, min(first + CHUNK, count)), count)
        found = study.engine.metrics(x[None], who)
        parts.append({**found["metrics"], **{f"loss.{name}": v for name, v in found["loss"].items()}})
    return {name: np.concatenate([part[name][0] for part in parts]) for name in parts[0]}


def rms(values: np.ndarray) -> float:
    """Root mean square over an ensemble."""
    return float(np.sqrt(np.mean(values**2)))


class StepError(NamedTuple):
    """The search's own step against adaptive RODAS3 on a few training members: settled rms error of both, m.

    Of those members whom both hold; `relative` is NaN if there is none. `lost`: numbers of those whom the search's
    step holds, but not the accurate one.
    """

    search_m: float
    reference_m: float
    relative: float
    members: int
    lost: list[int]

    @property
    def resolved(self) -> bool:
        """Whether the search's steps tell the truth there."""
        return abs(self.relative) <= RESOLVED


def told(relative: float) -> str:
    """The error of the search's own steps, relative to accurate ones, in words; NaN where none was held by both."""
    if math.isnan(relative):
        return "no member compared is held by both"
    return f"settled rms error off by {100 * relative:.2g} %"


def step_error(study: Study, x: np.ndarray) -> StepError:
    """What the search's own steps are worth at x [m]."""
    seed, count = seeds(study.tune.budget)[0], study.tune.budget.members
    numbers = np.arange(min(REFERENCE_MEMBERS, count))
    who = study.objective.chosen(seed, numbers, count)
    clock = dataclasses.replace(study.objective.clock, method=Adaptive(REFERENCE_TOLERANCE, most_steps=MOST_TRIALS))
    objective = dataclasses.replace(study.objective, clock=clock)
    reference = Engine(objective, settle=study.case.settle, lanes=len(who.member))
    ours, theirs = (e.metrics(x[None], who)["metrics"] for e in (study.engine, reference))
    ended = [np.isfinite(found["lost_at_s"])[0] for found in (ours, theirs)]
    held = ~(ended[0] | ended[1])
    if not held.any():
        return StepError(math.nan, math.nan, math.nan, 0, [])
    search_m, reference_m = (rms(found["settled_rms_error_m"][0][held]) for found in (ours, theirs))
    unseen = numbers[ended[1] & ~ended[0]].tolist()
    return StepError(search_m, reference_m, search_m / reference_m - 1, int(held.sum()), unseen)


def summarise(study: Study, found: dict[str, np.ndarray]) -> dict[str, Any]:
    """Numbers of an ensemble [N] for the report: pooled rms and largest error, survival, mean and largest metrics."""
    from ambjax.ensemble.statistics import wilson

    lost, errors = np.isfinite(found["lost_at_s"]), found["settled_rms_error_m"]
    n = len(lost)
    kept = wilson(n - int(lost.sum()), n)
    told: dict[str, Any] = {
        "members": n,
        "lost": int(lost.sum()),
        "survival": float(kept.value),
        "survival_low": float(kept.low),
        "survival_high": float(kept.high),
        "settled_rms_error_m": rms(errors),
        "settled_rms_error_worst_member_m": float(errors.max()),
        "settled_max_abs_error_m": float(found["settled_max_abs_error_m"].max()),
    }
    for name, values in found.items():
        if values.dtype == bool:
            continue
        finite = values[np.isfinite(values)]
        if finite.size:
            told[f"{name}.mean"] = float(finite.mean())
            told[f"{name}.largest"] = float(finite.max())
    return told
