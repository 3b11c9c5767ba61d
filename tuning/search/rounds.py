"""Rounds of a study: looks, each a search around the answer of those before it, for one may end at a cliff behind which
it goes on; again in finer steps where their own do not resolve the optimum; again with the members of a validation
ensemble that its gains lose, and with those that accurate steps do not hold, until there is none."""

import dataclasses
import itertools
import math
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.objective.loss import TERMS
from tuning.objective.problem import Members
from tuning.search.keeper import Keeper, Search
from tuning.search.optimise import best_of, search
from tuning.search.screen import around, everywhere
from tuning.study import StepError, Study, compared, step_error, study_of, worst_of
from tuning.study import words as step_told

CHECKPOINT = "checkpoint"
# Rounds in all, looks among them, times that steps are halved, and lost members that join in one round.
MOST_ROUNDS, MOST_LOOKS, MOST_HALVINGS, MOST_JOINING = 12, 5, 2, 16
# A look must gain this share of the loss; two in a row that do not are the last. One alone is chance: what it draws of
# the neighbourhood may miss the better optimum.
GAIN = 0.01
# Members that accurate steps do not hold join with so many times the noise, to this power in later rounds: the search's
# own steps hold them as they are.
LOUDER = 1.5
# Points of the paths of all rounds that are tried with accurate steps where no answer was confirmed.
RETREATS = 12


@dataclasses.dataclass(frozen=True)
class Answer:
    """What the rounds found: gains at x [m], the study and members that they were last judged by, and how it went."""

    study: Study
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
        """And no validation member is lost."""
        return self.confirmed and self.lost == 0


@dataclasses.dataclass
class Course:
    """Searches in a row: `past`; the study and members that they have come to, and what a checkpoint is told."""

    study: Study
    who: Members
    out: pathlib.Path
    told: dict[str, Any]
    resume: bool
    past: list[Search] = dataclasses.field(default_factory=list)
    began: float = dataclasses.field(default_factory=time.perf_counter)

    def search(self, points: np.ndarray) -> tuple[np.ndarray, float]:
        """The best point [m] that a search from these [K, m] finds, and its goal."""
        tune, number = self.study.tune, len(self.past) + 1
        path = self.out / f"{CHECKPOINT}-{number}.npz"
        kept = search(
            self.study.engine, self.study.goal, self.who, points, keep=tune.budget.starts,
            iterations=tune.budget.iterations, name=tune.optimiser, rate=tune.learning_rate,
            keeper=Keeper(path, self.told, number), resume=self.resume, tell=_teller(self.study),
        )  # fmt: skip
        if kept.ended:
            say(f"round {number}: its search had ended; what it found is taken from {path}")
        if kept.interrupted and not kept.history:  # before anything new was found
            if not self.past:
                raise KeyboardInterrupt
            kept = dataclasses.replace(self.past.pop(), interrupted=True)
        self.past.append(kept)
        return _best(kept)

    def around(self, x: np.ndarray) -> np.ndarray:
        """Points around x for the next search."""
        budget = self.study.tune.budget
        return around(x, budget.screen, budget.seed + len(self.past))

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the last search."""
        return self.past[-1].interrupted

    @property
    def hopeless(self) -> bool:
        """Whether the last search lost every member."""
        past = self.past[-1].history
        return int(past["lost"][-1][int(np.argmin(past["value"][-1]))]) == past["members"][-1]

    def answer(self, x: np.ndarray, error: StepError | None, lost: int) -> Answer:
        """What x is, as far as it is known now."""
        seconds = time.perf_counter() - self.began + sum(kept.earlier for kept in self.past)
        return Answer(self.study, self.who, x, error, _joined(self.past), lost, seconds)


def rounds(study: Study, start: np.ndarray, out: pathlib.Path, told: dict[str, Any], resume: bool) -> Answer:
    """Tune from the gains `start` [m]; `told` is what the answer depends on, for the checkpoints in `out`.

    Raises ValueError where nothing can be evaluated, and where a checkpoint to go on with is that of another search.
    """
    budget, found = study.tune.budget, []
    course = Course(study, training(study), out, told, resume)
    x, value = course.search(everywhere(study.objective, study.goal.conditions, start, budget.screen, budget.seed))
    if not course.hopeless and budget.screen:
        x = looks(course, x, value)
    for refuted in itertools.count(1):
        if course.hopeless:  # nothing to go on with
            break
        x, error = resolved(course, x)
        answer, error, lost = validated(course, x, error)
        found.append(answer)
        if answer.good or course.interrupted or len(course.past) >= MOST_ROUNDS:
            break
        course.who = course.who.joined(_joining(course.study, lost, error, LOUDER**refuted))
        say("the search goes on with members that are lost, or that accurate steps do not hold")
        x, _ = course.search(course.around(x))
    if not found:
        return course.answer(x, None, budget.validation)
    best = min(found, key=lambda one: (not one.confirmed, one.lost))
    if not best.confirmed and not course.interrupted:
        best = retreated(course, best)
    return dataclasses.replace(best, seconds=course.answer(x, None, 0).seconds)


def looks(course: Course, x: np.ndarray, value: float) -> np.ndarray:
    """The best point [m] of searches around what is best so far, until that is worth no more."""
    seen = [(value, x)]  # on the same members, in the same steps
    while look_again([value for value, _ in seen]) and not course.interrupted:
        x, value = course.search(course.around(x))
        seen.append((value, x))
        x = min(seen, key=lambda look: look[0])[1]
    return x


def look_again(goals: Sequence[float]) -> bool:
    """Whether another look is worth its rollouts after looks that ended at these goals, logarithms."""
    best = [math.inf, *itertools.accumulate(goals, min)]
    gained = [before - after > GAIN for before, after in itertools.pairwise(best)]
    return len(goals) < MOST_LOOKS and any(gained[-2:])


def resolved(course: Course, x: np.ndarray) -> tuple[np.ndarray, StepError]:
    """x [m], or what a search from there in finer steps finds, and what the steps are worth there."""
    while True:
        error = step_error(course.study, x)
        say(f"step of the search against adaptive RODAS3: {step_told(error)}")
        substeps = finer(course.study)
        if error.resolved or substeps is None or course.interrupted:
            return x, error
        course.study = substeps
        say(f"too coarse there; the search goes on with {course.study.objective.clock.method}")
        x, _ = course.search(x[None])


def validated(course: Course, x: np.ndarray, error: StepError) -> tuple[Answer, StepError, np.ndarray]:
    """What a validation ensemble says of x [m], and accurate steps of its worst members; and numbers of the lost."""
    budget = course.study.tune.budget
    if course.interrupted or not budget.validation:
        return course.answer(x, error, error.unseen), error, np.zeros(0, int)
    lost, worst = _lost(course.study, x)
    if not lost.size and not error.refuted:
        worst = course.study.objective.chosen(seeds(budget)[1], worst, budget.validation)
        error = step_error(course.study, x, compared(course.study).joined(worst))
        say(f"accurate steps on the worst of {budget.validation} members of another seed too: {step_told(error)}")
    if lost.size:
        say(f"{lost.size} of {budget.validation} members of another seed are lost")
    return course.answer(x, error, lost.size + error.unseen), error, lost


def retreated(course: Course, best: Answer) -> Answer:
    """An earlier point of the searches that accurate steps confirm, where there is one: else the best answer."""
    say("no answer is confirmed by accurate steps; they try earlier points of the search")
    for x in _path(course.past):
        error = step_error(course.study, x)
        if not error.refuted:
            answer, *_ = validated(course, x, error)
            if answer.good:
                return answer
    return best


def _path(past: list[Search]) -> np.ndarray:
    """Points [K, m] that the searches were at, best first: the best ones, and fewer and fewer of the others."""
    x = np.concatenate([np.asarray(kept.history["x"]).reshape(-1, kept.starts.best.shape[-1]) for kept in past])
    value = np.concatenate([np.asarray(kept.history["value"]).ravel() for kept in past])
    _, first = np.unique(np.where(np.isfinite(value), value, np.inf), return_index=True)
    chosen = np.unique((np.linspace(0, np.sqrt(len(first) - 1), RETREATS).round(6) ** 2).astype(int))
    return x[first[chosen]]


def training(study: Study) -> Members:
    """The ensemble that is tuned on: ordinary members, then stressed ones."""
    tune = study.tune
    return study.objective.training(
        tune.budget.seed, tune.budget.members, tune.budget.stressed, tune.stress, tune.gain_margin
    )


def _best(kept: Search) -> tuple[np.ndarray, float]:
    x, value = best_of(kept)
    if not np.isfinite(value):
        raise ValueError(
            "tune: the loss or its derivative is not a finite number at any start that was tried. Look at the case "
            "with 'ambjax simulate' (does u chatter?), or change tune.screen and tune.bounds."
        )
    return x, value


def finer(study: Study) -> Study | None:
    """The same study in steps half as long, or None where they were halved often enough; rollouts are counted on."""
    if study.finer >= 2**MOST_HALVINGS:
        return None
    fine = study_of(study.case, study.tune, finer=2 * study.finer)
    fine.engine.rollouts = study.engine.rollouts
    return fine


def _joining(study: Study, lost: np.ndarray, error: StepError, louder: float) -> Members:
    """The first of the lost members, under half the extra noise of the stressed ones: held, and with some margin.

    `lost` are members of the validation ensemble. Those that accurate steps do not hold are `louder` times as noisy.
    """
    budget, problem = study.tune.budget, study.objective
    those = problem.chosen(seeds(budget)[1], lost[:MOST_JOINING], budget.validation)
    those = those._replace(loud=those.loud * (1 + study.tune.stress) / 2)
    these = error.who._replace(loud=error.who.loud * louder)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), those, these)


def _lost(study: Study, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the validation members that are lost at x [m], first lost first; and of the worst that are held."""
    budget = study.tune.budget
    count = budget.validation
    who = study.objective.chosen(seeds(budget)[1], np.arange(count), count)
    terms = study.engine.terms(x[None], who)
    share = terms["survival"][0]
    return np.argsort(-share, kind="stable")[: int((share > 0).sum())], worst_of(terms["peak"][0])


def _joined(past: list[Search]) -> dict[str, np.ndarray]:
    """The histories of all rounds in a row; a round with fewer starts repeats its own."""
    width = max(len(kept.active) for kept in past)

    def wide(rows: Any) -> np.ndarray:
        rows = np.asarray(rows)
        return rows if rows.ndim < 2 or rows.shape[1] == width else np.repeat(rows[:, :1], width, axis=1)

    names = past[0].history
    return {name: np.concatenate([wide(kept.history[name]) for kept in past if kept.history]) for name in names}


def _teller(study: Study) -> Callable[[Search, float], None]:
    """What is said after each iteration."""
    scale = float(np.asarray(study.objective.loss.s_0))
    budget, spent = study.tune.budget, []

    def tell(kept: Search, seconds: float) -> None:
        spent.append(seconds)
        x, value = best_of(kept)
        gains = np.asarray(study.objective.space.gains_at(jnp.asarray(x)))
        best = int(np.argmin(kept.history["value"][-1]))
        count = int(kept.history["members"][-1])
        terms, lost = kept.history["terms"][-1][best], int(kept.history["lost"][-1][best])
        # the first iteration compiles, and says nothing about the others
        each = float(np.median(spent[1:])) if len(spent) > 1 else math.nan
        left = (budget.iterations - kept.iteration + kept.since) * each * kept.active.sum() / len(kept.active)
        wait = f", at most {left:.0f} s left in this phase" if math.isfinite(left) else ""
        named = ", ".join(f"{g.name} {v:.4g}" for g, v in zip(study.objective.space.gains, gains, strict=True))
        say(
            f"{kept.iteration - kept.since:3d}/{budget.iterations}  loss {np.exp(value):.3e}  "
            f"rms error {scale * np.sqrt(terms[TERMS.index('tracking')]):.2e} m  kept {count - lost}"
            f"/{count}  {named}  ({kept.active.sum()} starts{wait})"
        )

    return tell
