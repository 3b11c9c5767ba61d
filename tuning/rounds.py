"""Rounds: solve, validate, let the members that failed join the training ensemble, repeat. Then the front.

If the gains of the case are better than every answer, they are the answer.
"""

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ambjax.results.outputs import described
from tuning.events import Listener
from tuning.front import trace_front
from tuning.judge.evaluate import StepError, describe, step_error
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.course import Course, SearchResult, first_search, training
from tuning.solve.multipliers import judged_at, search_within_limits
from tuning.validate import joining, terms_at, validated

# Largest number of rounds, and of halvings of the step.
MOST_ROUNDS, MOST_HALVINGS = 12, 2
# Share of tune.minutes for the searches and validations. The rest is for the judgement and the report.
SEARCHING = 0.7


def rounds(
    problem: TuningProblem,
    start: np.ndarray,
    out: pathlib.Path,
    facts: dict[str, Any],
    resume: bool,
    listen: Listener = lambda event: None,
) -> SearchResult:
    """Tune from the gains `start` [m], SI units, and return the result.

    `out`: directory of the checkpoints. `facts`: settings that a checkpoint must match. `resume`: whether to continue
    from the checkpoints. `listen`: receives the events.

    The result is the confirmed answer that loses the fewest members; of several such answers, a stable one, of those
    one within all limits, and of those the one of least error on the validation ensemble. If a front is traced, the
    result is the answer that `trace_front` selects.

    Raises ValueError if the goal is finite at no starting point, or if a checkpoint belongs to another search.
    """
    budget, answers = problem.tune.budget, list[SearchResult]()
    course = Course(
        problem, training(problem), budget.seed, out, facts, resume, listen, SEARCHING * problem.tune.minutes
    )
    x = first_search(course, start)
    while not course.all_lost:
        x, error, within = solved(course, x)
        found = validated(course, x, error)
        answers.append(dataclasses.replace(found.result, within=within))
        if not found.failed or course.over or len(answers) >= MOST_ROUNDS:
            break
        course.members = joining(course, found)
        x, _ = course.again(x)
    if not answers:
        return course.answer(x, None, budget.validation)
    best = _best_of(answers)
    if not (course.interrupted or (course.over and best.within)):
        best = _best_of([best, *_given(course, start, best)])
    if problem.front and best.good and not course.over:
        course.members = best.members
        best = described("the front of error against voltage", lambda: trace_front(course, best)) or best
    return dataclasses.replace(best, seconds=course.seconds, complete=not course.over)


def solved(course: Course, x: np.ndarray) -> tuple[np.ndarray, StepError | None, bool]:
    """Search from x [m] with steps that are fine enough and multipliers by which the limits are met.

    Returns an optimum [m], its step error if it is known, and whether it is within the limits.
    """
    fine, error = with_fine_steps(course, x)
    x, within = search_within_limits(course, fine)
    return x, error if x is fine else None, within


def _best_of(answers: Sequence[SearchResult]) -> SearchResult:
    """Return the best answer: confirmed, with the fewest lost members, stable, within all limits, of least error."""
    rank = lambda one: (not one.confirmed, one.lost, one.unstable > 0, not one.within, one.validation_error)  # noqa: E731
    return min(answers, key=rank)


def _given(course: Course, start: np.ndarray, best: SearchResult) -> list[SearchResult]:
    """Return the gains of the case, `start` [m], as a validated answer if they may be better than `best`.

    They are validated if they hold all training members, and if `best` is not stable, breaks a limit or has a larger
    error than theirs on these members.
    """
    space = course.problem.objective.space
    x = space.encode(space.clip(start))
    terms = terms_at(course.problem, x, course.members)
    error = math.sqrt(terms["tracking"][: course.members.ordinary].mean())
    if (terms["survival"] > 0).any() or (best.within and not best.unstable and error >= best.validation_error):
        return []
    within = judged_at(course, x).holds(course.problem.limits)
    return [dataclasses.replace(validated(course, x).result, within=within)]


def with_fine_steps(course: Course, x: np.ndarray) -> tuple[np.ndarray, StepError]:
    """Return coordinates [m] whose step error is small enough, and this error.

    The first candidate is `x`; the others are the results of searches that continue from it in finer steps. There are
    at most MOST_HALVINGS such searches. The last step error is returned even if it is still too large.
    """
    while True:
        course.tell(f"comparing the steps of the search with {course.problem.accurate}")
        error = step_error(course.problem, x)
        course.tell(f"steps of the search compared with {course.problem.accurate}: {describe(error)}")
        substeps = finer(course.problem)
        if error.resolved or substeps is None or course.over:
            return x, error
        course.problem = substeps
        course.tell(f"these steps are too coarse; the search continues with {course.problem.objective.clock.method}")
        x, _ = course.again(x)


def finer(problem: TuningProblem) -> TuningProblem | None:
    """Return the problem with steps half as long, or None after MOST_HALVINGS."""
    return problem.refined() if problem.finer < 2**MOST_HALVINGS else None
