"""Rounds of a search, repeated until its result is confirmed.

The first search includes restarts. It is repeated with finer steps if its steps do not resolve the optimum, and with
additional members: validation members that are lost, and members that accurate steps do not hold.
"""

import dataclasses
import itertools
import pathlib
from typing import Any

import jax
import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.judge import StepError, compared, describe, step_error, worst_of
from tuning.objective.members import Members
from tuning.problem import TuningProblem, problem_of
from tuning.search.course import Course, SearchResult, points_of, search_and_restart, training
from tuning.search.multipliers import limited

# Largest numbers of rounds (restarts included), of halvings of the step, and of lost members that join in one round.
MOST_ROUNDS, MOST_HALVINGS, MOST_JOINING = 12, 2, 16
# Members that accurate steps do not hold join with the noise factor NOISE_GROWTH**round: the search's steps hold
# them with their own noise.
NOISE_GROWTH = 1.5


def rounds(
    problem: TuningProblem, start: np.ndarray, out: pathlib.Path, facts: dict[str, Any], resume: bool
) -> SearchResult:
    """Tune from the gains `start` [m] and return the result.

    `out`: directory of the checkpoints. `facts`: settings that a checkpoint must match. `resume`: whether to continue
    from the checkpoints. Raises ValueError if the goal is finite nowhere, or if a checkpoint belongs to another search.
    """
    budget, answers = problem.tune.budget, list[SearchResult]()
    course = Course(problem, training(problem), budget.seed, out, facts, resume)
    x = search_and_restart(course, start)
    for refuted in itertools.count(1):
        if course.all_lost:  # no gains to continue with
            break
        x, error = resolved(course, x)
        held = limited(course, x)
        if held is not x:
            x, error = held, step_error(course.problem, held)
        answer, error, lost = validated(course, x, error)
        answers.append(answer)
        if answer.good or course.interrupted or len(course.past) - course.limit_searches >= MOST_ROUNDS:
            break
        course.members = course.members.joined(_joining(course.problem, lost, error, NOISE_GROWTH**refuted))
        say("the search continues with members that are lost, or that accurate steps do not hold")
        x, _ = course.search(course.around(x))
    if not answers:
        return course.answer(x, None, budget.validation)
    best = min(answers, key=lambda one: (not one.confirmed, one.lost))
    if not best.confirmed and not course.interrupted:
        best = retreated(course, best)
    return dataclasses.replace(best, seconds=course.answer(x, None, 0).seconds)


def resolved(course: Course, x: np.ndarray) -> tuple[np.ndarray, StepError]:
    """Return x [m] and its step error, after a search in finer steps if the steps do not resolve x."""
    while True:
        error = step_error(course.problem, x)
        say(f"step of the search against {course.problem.accurate}: {describe(error)}")
        substeps = finer(course.problem)
        if error.resolved or substeps is None or course.interrupted:
            return x, error
        course.problem = substeps
        say(f"the step is too coarse; the search continues with {course.problem.objective.clock.method}")
        x, _ = course.search(x[None])


def validated(course: Course, x: np.ndarray, error: StepError) -> tuple[SearchResult, StepError, np.ndarray]:
    """Judge x [m] on the validation ensemble, and on its worst members by accurate steps.

    Returns the result, the step error, and the numbers of the lost validation members.
    """
    budget = course.problem.tune.budget
    if course.interrupted or not budget.validation:
        return course.answer(x, error, error.unseen), error, np.zeros(0, int)
    lost, worst = _lost(course.problem, x)
    if not lost.size and not error.refuted and not course.problem.sampled:
        worst = course.problem.objective.chosen(seeds(budget)[1], worst, budget.validation)
        error = step_error(course.problem, x, compared(course.problem).joined(worst))
        say(f"accurate steps, the worst of {budget.validation} members of another seed included: {describe(error)}")
    if lost.size:
        say(f"{lost.size} of {budget.validation} members of another seed are lost")
    return course.answer(x, error, lost.size + error.unseen), error, lost


def retreated(course: Course, best: SearchResult) -> SearchResult:
    """Return an earlier point of the searches that accurate steps confirm, or `best` if there is none."""
    say("accurate steps confirm no answer; earlier points of the search are tried")
    for x in points_of(course.past):
        error = step_error(course.problem, x)
        if not error.refuted:
            answer, *_ = validated(course, x, error)
            if answer.good:
                return answer
    return best


def finer(problem: TuningProblem) -> TuningProblem | None:
    """Return the problem with steps half as long and the same count of rollouts, or None after MOST_HALVINGS."""
    if problem.finer >= 2**MOST_HALVINGS:
        return None
    fine = problem_of(problem.case, problem.tune, finer=2 * problem.finer).limited(problem.limits)
    fine.engine.rollouts = problem.engine.rollouts
    return fine


def _joining(problem: TuningProblem, lost: np.ndarray, error: StepError, louder: float) -> Members:
    """Return the members that join the training ensemble.

    The first of the `lost` validation members join with half of the additional noise of stressed members, which leaves
    a margin. Members that accurate steps do not hold join with `louder` times the noise.
    """
    budget = problem.tune.budget
    those = problem.objective.chosen(seeds(budget)[1], lost[:MOST_JOINING], budget.validation)
    those = those._replace(noise_factor=those.noise_factor * (1 + problem.tune.stress) / 2)
    these = error.unheld._replace(noise_factor=error.unheld.noise_factor * louder)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), those, these)


def _lost(problem: TuningProblem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the validation members lost at x [m], in order of loss, and of those with the largest peak."""
    budget = problem.tune.budget
    count = budget.validation
    members = problem.objective.chosen(seeds(budget)[1], np.arange(count), count)
    terms = problem.engine.terms(x[None], members)
    share = terms["survival"][0]
    return np.argsort(-share, kind="stable")[: int((share > 0).sum())], worst_of(terms["peak"][0])
