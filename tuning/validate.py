"""Validation of an answer on members that the search does not use, and the members with large errors."""

import math
from typing import NamedTuple

import numpy as np

from tuning.judge.evaluate import StepError, comparison_members, describe, rms, step_error, worst_of
from tuning.problem.config import seeds
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.course import Course, SearchResult
from tuning.solve.joining import largest_unseen

# If the rms error of the validation members exceeds that of the training members by more than this factor, the training
# ensemble lacks members with large errors.
LARGER = 1.5


class Validation(NamedTuple):
    """Result of `validated`.

    `result`: the answer. `error`: its step error. `lost`: numbers of the validation members that are lost, the earliest
    loss first. `large`: numbers of those with large errors, which join the training ensemble if `result` is good.
    """

    result: SearchResult
    error: StepError
    lost: np.ndarray
    large: np.ndarray


def validated(course: Course, x: np.ndarray, error: StepError | None = None) -> Validation:
    """Evaluate x [m] on the validation ensemble, with the steps of the search.

    In continuous time, if no member is lost and the step error does not refute x, the worst members are simulated again
    with accurate steps. `error`: the step error at x, if it is known.
    """
    problem, budget = course.problem, course.problem.tune.budget
    error = step_error(problem, x) if error is None else error
    if course.interrupted or not budget.validation:
        return Validation(course.answer(x, error, error.unconfirmed), error, np.zeros(0, int), np.zeros(0, int))
    count = budget.validation
    course.tell(f"validating the answer on {count} members")
    terms = _terms(problem, x, problem.objective.chosen(seeds(budget)[1], np.arange(count), count))
    share = terms["survival"]
    lost = np.argsort(-share, kind="stable")[: int((share > 0).sum())]
    if not lost.size and not error.refuted and not problem.sampled:
        worst = problem.objective.chosen(seeds(budget)[1], worst_of(terms["peak"]), count)
        error = step_error(problem, x, comparison_members(problem).joined(worst))
        course.tell(f"accurate steps, with the worst of {count} validation members: {describe(error)}")
    if lost.size:
        course.tell(f"{lost.size} of {count} validation members are lost")
    errors = _rms_errors(terms)
    found = course.answer(x, error, lost.size + error.unconfirmed, _overall(errors))
    return Validation(found, error, lost, _large(course, x, errors))


def _large(course: Course, x: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return `largest_unseen` if the rms of `errors` [N] exceeds that of the training members by LARGER, else none."""
    training = _rms_errors(_terms(course.problem, x, course.members.unstressed))
    return largest_unseen(course, errors) if _overall(errors) > LARGER * _overall(training) else np.zeros(0, int)


def _terms(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, np.ndarray]:
    """Return the terms of the loss by name, each [N], of members [N] at x [m]."""
    return {name: values[0] for name, values in problem.engine.terms(x[None], members).items()}


def _rms_errors(terms: dict[str, np.ndarray]) -> np.ndarray:
    """Return the rms errors [N] of the members, relative to s_0; -inf for a member that is lost."""
    return np.where(terms["survival"] > 0, -math.inf, np.sqrt(terms["tracking"]))


def _overall(errors: np.ndarray) -> float:
    """Return the rms over the members that are held; inf if all are lost."""
    held = errors[np.isfinite(errors)]
    return rms(held) if held.size else math.inf
