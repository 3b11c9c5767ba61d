"""Validation of an answer on members that the search has not seen, and the members that join the search after it."""

import jax
import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.judge import StepError, comparison_members, describe, step_error, worst_of
from tuning.objective.members import Members
from tuning.problem import TuningProblem
from tuning.search.course import Course, SearchResult

# Largest number of lost members that join at once.
MOST_JOINING = 16
# Members that are lost with accurate steps are held with the steps of the search. They therefore join with more noise,
# by the factor NOISE_GROWTH**number in round number `number`.
NOISE_GROWTH = 1.5


def validated(
    course: Course, x: np.ndarray, error: StepError | None = None
) -> tuple[SearchResult, StepError, np.ndarray]:
    """Judge x [m] on the validation ensemble, and on its worst members by accurate steps.

    `error`: the step error at x, if it is known. Returns the result, the step error, and the numbers of the lost
    validation members.
    """
    budget = course.problem.tune.budget
    error = step_error(course.problem, x) if error is None else error
    if course.interrupted or not budget.validation:
        return course.answer(x, error, error.unseen), error, np.zeros(0, int)
    lost, worst = _lost(course.problem, x)
    if not lost.size and not error.refuted and not course.problem.sampled:
        worst = course.problem.objective.chosen(seeds(budget)[1], worst, budget.validation)
        error = step_error(course.problem, x, comparison_members(course.problem).joined(worst))
        say(f"accurate steps, with the worst of {budget.validation} validation members: {describe(error)}")
    if lost.size:
        say(f"{lost.size} of {budget.validation} validation members are lost")
    return course.answer(x, error, lost.size + error.unseen), error, lost


def joining(problem: TuningProblem, lost: np.ndarray, error: StepError, number: int) -> Members:
    """Return the members that join the training ensemble.

    The first of the `lost` validation members join with half of the additional noise of stressed members, which leaves
    a margin. Members that are lost with accurate steps join with NOISE_GROWTH**number times their noise. `number`: of
    the round, from 1.
    """
    budget = problem.tune.budget
    those = problem.objective.chosen(seeds(budget)[1], lost[:MOST_JOINING], budget.validation)
    those = those._replace(noise_factor=those.noise_factor * (1 + problem.tune.stress) / 2)
    these = error.unheld._replace(noise_factor=error.unheld.noise_factor * NOISE_GROWTH**number)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), those, these)


def _lost(problem: TuningProblem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the validation members that are lost at x [m], and of those with the largest peak error.

    The lost members are in the order in which they are lost.
    """
    budget = problem.tune.budget
    count = budget.validation
    members = problem.objective.chosen(seeds(budget)[1], np.arange(count), count)
    terms = problem.engine.terms(x[None], members)
    share = terms["survival"][0]
    return np.argsort(-share, kind="stable")[: int((share > 0).sum())], worst_of(terms["peak"][0])
