"""Rounds of a study: looks, each a search around the answer of those before it, for one may end at a cliff behind which
it goes on; again in finer steps where their own do not resolve the optimum; again with the members of a validation
ensemble that its gains lose, until none is."""

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

from ambjax.outputs import say
from tuning.config import seeds
from tuning.loss import TERMS
from tuning.objective import Members
from tuning.optimise import Keeper, Search, best_of, search
from tuning.screen import around, everywhere
from tuning.study import REFERENCE_MEMBERS, StepError, Study, step_error, study_of
from tuning.study import told as step_told

CHECKPOINT = "checkpoint"
# Rounds in all, looks among them, times that steps are halved, and lost members that join in one round.
MOST_ROUNDS, MOST_LOOKS, MOST_HALVINGS, MOST_JOINING = 12, 5, 2, 16
# A look must gain this share of the loss; two in a row that do not are the last. One alone is chance: what it draws of
# the neighbourhood may miss the better optimum.
GAIN = 0.01


@dataclasses.dataclass(frozen=True)
class Answer:
    """What the rounds found: gains at x [m], the study and members that they were last judged by, and how it went."""

    study: Study
    who: Members
    x: np.ndarray
    error: StepError | None
    history: dict[str, np.ndarray]
    lost: int
    """members of the validation ensemble, and those that only an accurate step loses"""
    seconds: float
    """in all, those before a resume included"""


def rounds(study: Study, start: np.ndarray, out: pathlib.Path, told: Any, resume: bool) -> Answer:
    """Tune from the gains `start` [m]. Raises ValueError where nothing can be evaluated."""
    tune, halvings, found = study.tune, 0, []
    looks: list[tuple[float, np.ndarray]] = []  # goals and answers, on the same members, in the same steps
    looking = tune.budget.screen > 0
    points = everywhere(study.objective, study.goal.conditions, start, tune.budget.screen, tune.budget.seed)
    who = training(study)
    past: list[Search] = []
    began = time.perf_counter()

    def answer(error: StepError | None, lost: int) -> Answer:
        seconds = time.perf_counter() - began + sum(kept.earlier for kept in past)
        return Answer(study, who, x, error, _joined(past), lost, seconds)

    for round in itertools.count(1):
        path = out / f"{CHECKPOINT}-{round}.npz"
        kept = search(
            study.engine, study.goal, who, points, keep=tune.budget.starts, iterations=tune.budget.iterations,
            name=tune.optimiser, rate=tune.learning_rate, keeper=Keeper(path, [told, round]),
            resume=resume and path.exists(), tell=_teller(study),
        )  # fmt: skip
        if kept.interrupted and not kept.history:  # before anything new was found
            if not past:
                raise KeyboardInterrupt
            kept = dataclasses.replace(past.pop(), interrupted=True)
        past.append(kept)
        x, value = _best(kept)
        if int(kept.history["lost"][-1][int(np.argmin(kept.history["value"][-1]))]) == kept.history["members"][-1]:
            return answer(None, tune.budget.validation)  # nothing to go on with
        if looking:
            looks.append((value, x))
            x = min(looks, key=lambda look: look[0])[1]
            looking = look_again([value for value, _ in looks]) and not kept.interrupted
        if looking:
            points = around(x, tune.budget.screen, tune.budget.seed + round)
            continue
        error = step_error(study, x)
        say(f"step of the search against adaptive RODAS3: {step_told(error.relative)}")
        if not error.resolved and halvings < MOST_HALVINGS and not kept.interrupted:
            halvings, points = halvings + 1, x[None]
            study = _finer(study, 2**halvings)
            say(f"too coarse there; the search goes on with {study.objective.clock.method}")
            continue
        lost = _lost(study, x) if tune.budget.validation and not kept.interrupted else np.zeros(0, int)
        found.append(answer(error, len(lost) + len(error.lost)))
        if not found[-1].lost or kept.interrupted or round >= MOST_ROUNDS:
            return dataclasses.replace(min(found, key=lambda one: one.lost), seconds=found[-1].seconds)
        who = who.joined(_joining(study, lost, error.lost))
        points = around(x, tune.budget.screen, tune.budget.seed + round)
        say(
            f"{len(lost)} of {tune.budget.validation} members of another seed are lost, and {len(error.lost)} of "
            f"{REFERENCE_MEMBERS} under adaptive RODAS3: the search goes on with them"
        )
    raise AssertionError("unreachable: the rounds are counted")


def look_again(goals: Sequence[float]) -> bool:
    """Whether another look is worth its rollouts after looks that ended at these goals, logarithms."""
    best = [math.inf, *itertools.accumulate(goals, min)]
    gained = [before - after > GAIN for before, after in itertools.pairwise(best)]
    return len(goals) < MOST_LOOKS and any(gained[-2:])


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


def _finer(study: Study, finer: int) -> Study:
    """The same study in finer steps; rollouts go on being counted."""
    fine = study_of(study.case, study.tune, finer=finer)
    fine.engine.rollouts = study.engine.rollouts
    return fine


def _joining(study: Study, lost: np.ndarray, unseen: list[int]) -> Members:
    """The first of the lost members, under half the extra noise of the stressed ones: held, and with some margin.

    `lost` are members of the validation ensemble, `unseen` of the training ensemble.
    """
    budget, problem = study.tune.budget, study.objective
    those = problem.chosen(seeds(budget)[1], lost[:MOST_JOINING], budget.validation)
    these = problem.chosen(seeds(budget)[0], np.array(unseen, int), budget.members)
    both = jax.tree.map(lambda a, b: np.concatenate([a, b]), those, these)
    return both._replace(loud=both.loud * (1 + study.tune.stress) / 2)


def _lost(study: Study, x: np.ndarray) -> np.ndarray:
    """Numbers of the validation members that are lost at x [m], first lost first."""
    budget = study.tune.budget
    count = budget.validation
    who = study.objective.chosen(seeds(budget)[1], np.arange(count), count)
    share = study.engine.terms(x[None], who)["survival"][0]
    return np.argsort(-share, kind="stable")[: int((share > 0).sum())]


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
