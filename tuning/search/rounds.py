"""Rounds of a search: looks; again in finer steps where its own do not resolve the optimum; again with the members of
a validation ensemble that its gains lose, and with those that accurate steps do not hold, until there is none."""

import dataclasses
import itertools
import pathlib
from typing import Any

import jax
import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.judge import StepError, compared, step_error, worst_of
from tuning.judge import words as step_words
from tuning.objective.members import Members
from tuning.problem import TuningProblem, problem_of
from tuning.search.course import Course, SearchResult, looks, points_of, training
from tuning.search.multipliers import limited

# Rounds in all, looks among them, times that steps are halved, and lost members that join in one round.
MOST_ROUNDS, MOST_HALVINGS, MOST_JOINING = 12, 2, 16
# Members that accurate steps do not hold join with so many times the noise, to this power in later rounds: the search's
# own steps hold them as they are.
LOUDER = 1.5


def rounds(
    problem: TuningProblem, start: np.ndarray, out: pathlib.Path, facts: dict[str, Any], resume: bool
) -> SearchResult:
    """Tune from the gains `start` [m]; `facts` are what the answer depends on, for the checkpoints in `out`.

    Raises ValueError where nothing can be evaluated, and where a checkpoint to go on with is that of another search.
    """
    budget, answers = problem.tune.budget, list[SearchResult]()
    course = Course(problem, training(problem), budget.seed, out, facts, resume)
    x = looks(course, start)
    for refuted in itertools.count(1):
        if course.hopeless:  # nothing to go on with
            break
        x, error = resolved(course, x)
        held = limited(course, x)
        if held is not x:
            x, error = held, step_error(course.problem, held)
        answer, error, lost = validated(course, x, error)
        answers.append(answer)
        if answer.good or course.interrupted or len(course.past) - course.asides >= MOST_ROUNDS:
            break
        course.who = course.who.joined(_joining(course.problem, lost, error, LOUDER**refuted))
        say("the search goes on with members that are lost, or that accurate steps do not hold")
        x, _ = course.search(course.around(x))
    if not answers:
        return course.answer(x, None, budget.validation)
    best = min(answers, key=lambda one: (not one.confirmed, one.lost))
    if not best.confirmed and not course.interrupted:
        best = retreated(course, best)
    return dataclasses.replace(best, seconds=course.answer(x, None, 0).seconds)


def resolved(course: Course, x: np.ndarray) -> tuple[np.ndarray, StepError]:
    """x [m], or what a search from there in finer steps finds, and what the steps are worth there."""
    while True:
        error = step_error(course.problem, x)
        say(f"step of the search against {course.problem.accurate}: {step_words(error)}")
        substeps = finer(course.problem)
        if error.resolved or substeps is None or course.interrupted:
            return x, error
        course.problem = substeps
        say(f"too coarse there; the search goes on with {course.problem.objective.clock.method}")
        x, _ = course.search(x[None])


def validated(course: Course, x: np.ndarray, error: StepError) -> tuple[SearchResult, StepError, np.ndarray]:
    """What a validation ensemble says of x [m], and accurate steps of its worst members; and numbers of the lost."""
    budget = course.problem.tune.budget
    if course.interrupted or not budget.validation:
        return course.answer(x, error, error.unseen), error, np.zeros(0, int)
    lost, worst = _lost(course.problem, x)
    if not lost.size and not error.refuted and not course.problem.sampled:
        worst = course.problem.objective.chosen(seeds(budget)[1], worst, budget.validation)
        error = step_error(course.problem, x, compared(course.problem).joined(worst))
        say(f"accurate steps on the worst of {budget.validation} members of another seed too: {step_words(error)}")
    if lost.size:
        say(f"{lost.size} of {budget.validation} members of another seed are lost")
    return course.answer(x, error, lost.size + error.unseen), error, lost


def retreated(course: Course, best: SearchResult) -> SearchResult:
    """An earlier point of the searches that accurate steps confirm, where there is one: else the best answer."""
    say("no answer is confirmed by accurate steps; they try earlier points of the search")
    for x in points_of(course.past):
        error = step_error(course.problem, x)
        if not error.refuted:
            answer, *_ = validated(course, x, error)
            if answer.good:
                return answer
    return best


def finer(problem: TuningProblem) -> TuningProblem | None:
    """The same problem in steps half as long, or None where they were halved often enough; rollouts are counted on."""
    if problem.finer >= 2**MOST_HALVINGS:
        return None
    fine = problem_of(problem.case, problem.tune, finer=2 * problem.finer).limited(problem.goal.limits)
    fine.engine.rollouts = problem.engine.rollouts
    return fine


def _joining(problem: TuningProblem, lost: np.ndarray, error: StepError, louder: float) -> Members:
    """The first of the lost members, under half the extra noise of the stressed ones: held, and with some margin.

    `lost` are members of the validation ensemble. Those that accurate steps do not hold are `louder` times as noisy.
    """
    budget = problem.tune.budget
    those = problem.objective.chosen(seeds(budget)[1], lost[:MOST_JOINING], budget.validation)
    those = those._replace(loud=those.loud * (1 + problem.tune.stress) / 2)
    these = error.who._replace(loud=error.who.loud * louder)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), those, these)


def _lost(problem: TuningProblem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the validation members that are lost at x [m], first lost first; and of the worst that are held."""
    budget = problem.tune.budget
    count = budget.validation
    who = problem.objective.chosen(seeds(budget)[1], np.arange(count), count)
    terms = problem.engine.terms(x[None], who)
    share = terms["survival"][0]
    return np.argsort(-share, kind="stable")[: int((share > 0).sum())], worst_of(terms["peak"][0])
