"""Validation of an answer on members that the search does not use."""

import math
from typing import NamedTuple

import jax
import numpy as np

from tuning.judge.evaluate import StepError, comparison_members, describe, rms, step_error, worst_of
from tuning.problem.config import seeds
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.course import Course, SearchResult

# Largest number of lost members that join the training ensemble at once.
MOST_LOST = 16


class Validation(NamedTuple):
    """Result of `validated`.

    `result`: the answer. `error`: its step error. `lost`: numbers of the validation members that are lost, the earliest
    loss first.
    """

    result: SearchResult
    error: StepError
    lost: np.ndarray


def validated(course: Course, x: np.ndarray, error: StepError | None = None) -> Validation:
    """Evaluate x [m] on the validation ensemble, with the steps of the search.

    In continuous time, if no member is lost and the step error does not refute x, the worst members are simulated again
    with accurate steps. `error`: the step error at x, if it is known.
    """
    problem, budget = course.problem, course.problem.tune.budget
    error = step_error(problem, x) if error is None else error
    if course.interrupted or not budget.validation:
        return Validation(course.answer(x, error, error.unconfirmed), error, np.zeros(0, int))
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
    errors = np.sqrt(terms["tracking"][share <= 0])
    overall = rms(errors) if errors.size else math.inf
    return Validation(course.answer(x, error, lost.size + error.unconfirmed, overall), error, lost)


def joining(problem: TuningProblem, lost: np.ndarray, error: StepError) -> Members:
    """Return the members that join the training ensemble.

    They are the first MOST_LOST of the `lost` validation members, and the members that are lost or stall with accurate
    steps. They join with half of the additional noise of stressed members, as a margin.
    """
    budget = problem.tune.budget
    those = problem.objective.chosen(seeds(budget)[1], lost[:MOST_LOST], budget.validation)
    both: Members = jax.tree.map(lambda a, b: np.concatenate([a, b]), those, error.unheld)
    return both._replace(noise_factor=both.noise_factor * (1 + problem.tune.stress) / 2)


def _terms(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, np.ndarray]:
    """Return the terms of the loss by name, each [N], of members [N] at x [m]."""
    return {name: values[0] for name, values in problem.engine.terms(x[None], members).items()}
