"""Rounds of a search, repeated until its result is confirmed.

The first search includes restarts. It is repeated with finer steps if its steps do not resolve the optimum, and with
additional members: validation members that are lost, and members that accurate steps do not hold. Then the front of
error against voltage is traced, if the case asks for it.
"""

import dataclasses
import itertools
import pathlib
from typing import Any

import numpy as np

from ambjax.commands.outputs import say
from tuning.judge import StepError, describe, step_error
from tuning.problem import TuningProblem, problem_of
from tuning.search.course import Course, SearchResult, points_of, search_and_restart, training
from tuning.search.front import traced
from tuning.search.multipliers import limited
from tuning.search.validation import joining, validated

# Largest numbers of rounds (restarts included), and of halvings of the step.
MOST_ROUNDS, MOST_HALVINGS = 12, 2


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
            x, error = held, None
        answer, error, lost = validated(course, x, error)
        answers.append(answer)
        if answer.good or course.interrupted or len(course.past) - course.limit_searches >= MOST_ROUNDS:
            break
        course.members = course.members.joined(joining(course.problem, lost, error, refuted))
        say("the search continues with members that are lost, or that accurate steps do not hold")
        x, _ = course.search(course.around(x))
    if not answers:
        return course.answer(x, None, budget.validation)
    best = min(answers, key=lambda one: (not one.confirmed, one.lost))
    if not best.confirmed and not course.interrupted:
        best = retreated(course, best)
    if problem.front and best.good and not course.interrupted:
        course.members = best.members
        best = traced(course, best)
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
    fine = problem_of(problem.case, problem.tune, finer=2 * problem.finer, front=problem.front).limited(problem.limits)
    fine.engine.rollouts = problem.engine.rollouts
    return fine
