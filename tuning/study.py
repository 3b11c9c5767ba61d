"""A study: a case and its [tune], made into an objective, a goal and an engine; and what its answer is worth."""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.cases.reader import Case
from ambjax.simulation.clock import Clock
from ambjax.simulation.integrate import Adaptive, Integrator, Slide
from ambjax.simulation.method import choose_method
from ambjax.simulation.sliding import slides
from tuning.config import Tune, seeds
from tuning.objective.conditions import bounds
from tuning.objective.goal import Goal
from tuning.objective.loss import loss_for
from tuning.objective.problem import Engine, Members, Objective
from tuning.objective.ranges import Range, bounded

# Members simulated at a time when an ensemble is judged, and how many times as fine as the search's the steps are then:
# these miss the voltage's mean square by 2 to 4 % and its chatter by 5 to 11 %, those by 0.3 and 0.4 %
# (tests/test_metrics_dense.py).
CHUNK, FINE = 1024, 4
# Members and tolerance of the accurate reference against which the steps of the search are held.
REFERENCE_MEMBERS, REFERENCE_TOLERANCE, MOST_TRIALS = 4, 1e-6, 10_000
# Beyond this relative error of the settled rms error the steps are refined and the search goes on.
RESOLVED = 0.1
# unless the two differ by less than this share of the gap: as much as the reference itself is worth.
NEGLIGIBLE = 1e-6


@dataclasses.dataclass(frozen=True)
class Study:
    """Case, settings and what is compiled from them."""

    case: Case
    tune: Tune
    objective: Objective
    engine: Engine
    goal: Goal
    ranges: list[Range]
    finer: int = 1
    """how many times as fine its steps are as [tune] asks for"""

    @functools.cached_property
    def reference(self) -> Engine:
        """The same objective in accurate steps."""
        return self._stepping(Adaptive(REFERENCE_TOLERANCE, most_steps=MOST_TRIALS), lanes=REFERENCE_MEMBERS)

    @functools.cached_property
    def judging(self) -> Engine:
        """The same objective in steps FINE times as fine: what a report prints."""
        method: Any = self.objective.clock.method
        return self._stepping(dataclasses.replace(method, substeps=FINE * method.substeps), threads=self.engine.threads)

    def _stepping(self, method: Integrator, **more: Any) -> Engine:
        objective = dataclasses.replace(self.objective, clock=dataclasses.replace(self.objective.clock, method=method))
        return Engine(objective, settle=self.case.settle, **more)


def method_for(case: Case, substeps: int, finer: int) -> Integrator:
    """The step of the search, `finer` times as fine: of fixed number, so that all members take as long.

    Where the loop slides, `substeps` a sample, blind to the stiffness of the inversion law.
    """
    if slides(case.cascade, case.scenario.plant):
        return Slide(finer * substeps)
    method: Any = choose_method(case.cascade, case.scenario, float(case.clock.sample_period), reverse=True)
    return dataclasses.replace(method, substeps=finer * method.substeps)


def study_of(case: Case, tune: Tune, *, finer: int = 1, threads: int | None = None) -> Study:
    """The study of a case, in steps `finer` times as fine as [tune] asks for."""
    clock = Clock(case.clock.samples, case.clock.sample_period, method_for(case, tune.budget.substeps, finer))
    loss = loss_for(case.scenario, case.settle, tune.early)
    objective = Objective(tune.space, case.cascade, case.scenario, clock, loss, case.spread)
    conditions = bounds(case.cascade, case.scenario, clock)
    space, box = bounded(objective, conditions, tune.space.values(case.cascade))
    objective = dataclasses.replace(objective, space=space)
    goal = Goal(tune.weights, tune.risk, conditions, tune.conditions, tune.margin)
    mode = "forward" if len(tune.space) <= MOST_FORWARD else "reverse"
    return Study(
        case, tune, objective, Engine(objective, settle=case.settle, mode=mode, threads=threads), goal, box, finer
    )


# Beyond this many gains reverse mode is the cheaper one.
MOST_FORWARD = 8


def judge(study: Study, x: np.ndarray, seed: int, count: int) -> dict[str, np.ndarray]:
    """Every metric [count] of the members of an ensemble under the gains at x [m], and the loss's terms."""
    parts = []
    for first in range(0, count, CHUNK):
        who = study.objective.chosen(seed, np.arange(first, min(first + CHUNK, count)), count)
        found = study.judging.metrics(x[None], who)
        parts.append({**found["metrics"], **{f"loss.{name}": v for name, v in found["loss"].items()}})
    return {name: np.concatenate([part[name][0] for part in parts]) for name in parts[0]}


def rms(values: np.ndarray) -> float:
    """Root mean square over an ensemble."""
    return float(np.sqrt(np.mean(values**2)))


class StepError(NamedTuple):
    """The search's own step against adaptive RODAS3 on a few members: settled rms error of both, m.

    Of those `members` whom both hold; `relative` is NaN if there is none. `lost`, `stalled`: how many of the `tried`
    the search's step holds, but the accurate one loses, or cannot decide; `who` they are.
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
        """Members that accurate steps do not hold, though the search's own do."""
        return self.lost + self.stalled

    @property
    def resolved(self) -> bool:
        """Whether the search's steps tell the truth of the error there."""
        return abs(self.relative) <= RESOLVED or abs(self.search_m - self.reference_m) <= self.negligible_m

    @property
    def refuted(self) -> str:
        """Why accurate steps do not confirm that the rotor is held there, and how well; '' where they do."""
        if self.lost:
            return f"accurate steps lose {self.lost} of {self.tried} members tried, which the search's own hold"
        if self.stalled:
            return f"accurate steps cannot decide {self.stalled} of {self.tried} members tried (they stall)"
        if not self.members:
            return "no member compared is held by both"
        return "" if self.resolved else f"its own steps give a settled rms error off by {100 * self.relative:.2g} %"

    def facts(self) -> dict[str, Any]:
        """All of it as plain data."""
        told = {name: getattr(self, name) for name in self._fields if name not in ("who", "negligible_m")}
        return told | {"resolved": self.resolved, "refuted": self.refuted, "told": words(self)}


def words(error: StepError) -> str:
    """What accurate steps say, in words."""
    compared = f"settled rms error off by {100 * error.relative:.2g} % on {error.members} members"
    return compared if error.members and not error.unseen else error.refuted


def compared(study: Study) -> Members:
    """The members on whom steps are compared first: of the training ensemble."""
    count = study.tune.budget.members
    return study.objective.chosen(seeds(study.tune.budget)[0], np.arange(min(REFERENCE_MEMBERS, count)), count)


def worst_of(values: np.ndarray) -> np.ndarray:
    """Numbers of the members with the largest values [n], REFERENCE_MEMBERS of them, worst first."""
    return np.argsort(-values, kind="stable")[:REFERENCE_MEMBERS]


def step_error(study: Study, x: np.ndarray, who: Members | None = None) -> StepError:
    """What the search's own steps are worth at x [m], on these members; left out: on the first that it is tuned on."""
    who = compared(study) if who is None else who
    ours, theirs = (e.metrics(x[None], who)["metrics"] for e in (study.engine, study.reference))
    ended = [np.isfinite(found["lost_at_s"])[0] for found in (ours, theirs)]
    held, unseen = ~(ended[0] | ended[1]), ended[1] & ~ended[0]
    stalled = unseen & theirs["stalled"][0]
    search_m, reference_m = (
        rms(found["settled_rms_error_m"][0][held]) if held.any() else math.nan for found in (ours, theirs)
    )
    relative = search_m / reference_m - 1 if reference_m > 0 else math.nan
    those: Members = jax.tree.map(lambda a: a[unseen], who)
    negligible = NEGLIGIBLE * float(np.asarray(study.objective.loss.s_0))
    both, lost = int(held.sum()), int((unseen & ~stalled).sum())
    return StepError(search_m, reference_m, relative, both, len(held), lost, int(stalled.sum()), those, negligible)


def summarise(study: Study, found: dict[str, np.ndarray]) -> dict[str, Any]:
    """Numbers of an ensemble [N] for the report: pooled rms and largest error, survival, mean and largest metrics."""
    from ambjax.ensemble import wilson

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
