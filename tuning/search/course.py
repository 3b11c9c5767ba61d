"""A course of searches: each goes on from what those before it found; looks, each around the best answer so far, for
one may end at a cliff behind which it goes on."""

import dataclasses
import itertools
import math
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ambjax.commands.outputs import say
from tuning.judge import StepError
from tuning.objective.loss import TERMS
from tuning.objective.members import Members
from tuning.problem import TuningProblem
from tuning.search.keeper import Keeper, SearchState, checkpoint
from tuning.search.optimise import best_of, search
from tuning.search.screen import around, everywhere

# Looks at most.
MOST_LOOKS = 5
# A look must gain this share of the loss; two in a row that do not are the last. One alone is chance: what it draws of
# the neighbourhood may miss the better optimum.
GAIN = 0.01
# Points of the paths of all searches that are tried with accurate steps where no answer was confirmed.
RETREATS = 12


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """What the rounds found: gains at x [m], the problem and members that they were last judged by, and how it went."""

    problem: TuningProblem
    who: Members
    x: np.ndarray
    error: StepError | None
    history: dict[str, np.ndarray]
    lost: int
    """members of the validation ensemble, and those that accurate steps do not hold"""
    seconds: float
    """in all, those before a resume included"""

    @property
    def confirmed(self) -> bool:
        """Whether accurate steps confirm it."""
        return self.error is not None and not self.error.refuted

    @property
    def good(self) -> bool:
        """And no more validation members are lost than may be."""
        tune = self.problem.tune
        return self.confirmed and self.lost <= tune.limits.may_lose(tune.budget.validation)


@dataclasses.dataclass
class Course:
    """Searches in a row: `past`; the problem and members that they have come to; what is random has this `seed`.

    Checkpoints lie in `out` (None: there are none) and hold `facts`; `resume` goes on with them.
    """

    problem: TuningProblem
    who: Members
    seed: int
    out: pathlib.Path | None = None
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)
    resume: bool = False
    tell: Callable[[SearchState, float], None] | None = None
    """called after each iteration; left out: a line is said"""
    past: list[SearchState] = dataclasses.field(default_factory=list)
    asides: int = 0
    """searches that limits asked for: no rounds"""
    began: float = dataclasses.field(default_factory=time.perf_counter)

    def search(self, points: np.ndarray, *, settled: bool = False) -> tuple[np.ndarray, float]:
        """The best point [m] that a search from these [K, m] finds, and its goal; `settled`: one has ended at the
        first."""
        tune, number = self.problem.tune, len(self.past) + 1
        path = self.out / checkpoint(number) if self.out else None
        progress = search(
            self.problem.engine, self.problem.goal, self.who, points, keep=tune.budget.starts,
            iterations=tune.budget.iterations, name=tune.optimiser, rate=tune.learning_rate,
            seed=self.seed + len(self.past), settled=settled,
            keeper=Keeper(path, self.facts, number), resume=self.resume, tell=self.tell or _teller(self.problem),
        )  # fmt: skip
        if progress.ended:
            say(f"round {number}: its search had ended; what it found is taken from {path}")
        if progress.interrupted and not progress.history:  # before anything new was found
            if not self.past:
                raise KeyboardInterrupt
            progress = dataclasses.replace(self.past.pop(), interrupted=True)
        self.past.append(progress)
        return _best(progress)

    def around(self, x: np.ndarray) -> np.ndarray:
        """Points around x for the next search."""
        return around(x, self.problem.tune.budget.screen, self.seed + len(self.past))

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the last search."""
        return self.past[-1].interrupted

    @property
    def hopeless(self) -> bool:
        """Whether the last search lost every member."""
        past = self.past[-1].history
        return int(past["lost"][-1][int(np.argmin(past["value"][-1]))]) == past["members"][-1]

    def answer(self, x: np.ndarray, error: StepError | None, lost: int) -> SearchResult:
        """What x is, as far as it is known now."""
        seconds = time.perf_counter() - self.began + sum(progress.earlier for progress in self.past)
        return SearchResult(self.problem, self.who, x, error, _joined(self.past), lost, seconds)


def looks(course: Course, start: np.ndarray) -> np.ndarray:
    """The best point [m] of a search from the gains `start` [m], and of others around it until that is worth no more.

    No others where all members are lost, or nothing is screened.
    """
    problem, budget = course.problem, course.problem.tune.budget
    x, value = course.search(everywhere(problem.objective, problem.goal.conditions, start, budget.screen, course.seed))
    if course.hopeless or not budget.screen:
        return x
    seen = [(value, x)]  # on the same members, in the same steps
    while look_again([value for value, _ in seen]) and not course.interrupted:
        x, value = course.search(course.around(x), settled=True)
        seen.append((value, x))
        x = min(seen, key=lambda look: look[0])[1]
    return x


def look_again(goals: Sequence[float]) -> bool:
    """Whether another look is worth its rollouts after looks that ended at these goals, logarithms."""
    best = [math.inf, *itertools.accumulate(goals, min)]
    gained = [before - after > GAIN for before, after in itertools.pairwise(best)]
    return len(goals) < MOST_LOOKS and any(gained[-2:])


def training(problem: TuningProblem) -> Members:
    """The ensemble that is tuned on: ordinary members, then stressed ones."""
    tune = problem.tune
    return problem.objective.training(
        tune.budget.seed, tune.budget.members, tune.budget.stressed, tune.stress, tune.gain_margin
    )


def points_of(past: list[SearchState]) -> np.ndarray:
    """Points [K, m] that the searches were at, best first: the best ones, and fewer and fewer of the others."""
    x = np.concatenate([np.asarray(one.history["x"]).reshape(-1, one.starts.best.shape[-1]) for one in past])
    value = np.concatenate([np.asarray(one.history["value"]).ravel() for one in past])
    _, first = np.unique(np.where(np.isfinite(value), value, np.inf), return_index=True)
    chosen = np.unique((np.linspace(0, np.sqrt(len(first) - 1), RETREATS).round(6) ** 2).astype(int))
    return x[first[chosen]]


def _best(progress: SearchState) -> tuple[np.ndarray, float]:
    x, value = best_of(progress)
    if not np.isfinite(value):
        raise ValueError(
            "tune: the loss or its derivative is not a finite number at any start that was tried. Look at the case "
            "with 'ambjax simulate' (does u chatter?), or change tune.screen and tune.bounds."
        )
    return x, value


def _joined(past: list[SearchState]) -> dict[str, np.ndarray]:
    """The histories of all rounds in a row; a round with fewer starts repeats its own."""
    width = max(len(one.active) for one in past)

    def wide(rows: Any) -> np.ndarray:
        rows = np.asarray(rows)
        return rows if rows.ndim < 2 or rows.shape[1] == width else np.repeat(rows[:, :1], width, axis=1)

    names = past[0].history
    return {name: np.concatenate([wide(one.history[name]) for one in past if one.history]) for name in names}


def _teller(problem: TuningProblem) -> Callable[[SearchState, float], None]:
    """What is said after each iteration."""
    scale = float(np.asarray(problem.objective.loss.s_0))
    budget, spent = problem.tune.budget, []

    def tell(progress: SearchState, seconds: float) -> None:
        spent.append(seconds)
        x, value = best_of(progress)
        gains = np.asarray(problem.objective.space.gains_at(jnp.asarray(x)))
        last = {name: rows[-1] for name, rows in progress.history.items()}
        best, count = int(np.argmin(last["value"])), int(last["members"])
        done, going = progress.iteration - progress.since, progress.active.sum()
        # the first iteration compiles, and says nothing about the others
        each = float(np.median(spent[1:])) if len(spent) > 1 else math.nan
        left = (budget.iterations - done) * each * going / len(progress.active)
        wait = f", at most {left:.0f} s left in this phase" if math.isfinite(left) else ""
        named = ", ".join(f"{g.name} {v:.4g}" for g, v in zip(problem.objective.space.gains, gains, strict=True))
        error = scale * np.sqrt(last["terms"][best][TERMS.index("tracking")])
        say(
            f"{done:3d}/{budget.iterations}  loss {np.exp(value):.3e}  rms error {error:.2e} m  "
            f"kept {count - int(last['lost'][best])}/{count}  {named}  ({going} starts{wait})"
        )

    return tell
