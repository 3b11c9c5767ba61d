"""Members of the validation ensemble that join the training ensemble, because they failed."""

import math
from collections.abc import Mapping, Sequence

import jax
import numpy as np

from tuning.judge.evaluate import StepError, held
from tuning.problem.config import seeds
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.course import Course

# Largest numbers of lost members, and of members with large values of a limited mean, that join at once.
MOST_LOST, MOST_LARGE = 16, 8
# Largest number of members that join because they break a limit on the worst member.
MOST_BREAKING = 4
# If the judged mean of a limited quantity exceeds its expected value by more than this share, the training ensemble
# lacks members with large values.
UNEXPECTED = 0.1


def largest_unseen(course: Course, values: np.ndarray, most: int = MOST_LARGE) -> np.ndarray:
    """Return the numbers of at most `most` validation members, not in the training ensemble, with the largest values.

    `values` [N]: of the validation members; -inf for a member that is left out.
    """
    members, seed = course.members, seeds(course.problem.tune.budget)[1]
    values = values.copy()
    values[members.unstressed.member[members.unstressed.seed == seed]] = -math.inf
    largest = np.argsort(-values, kind="stable")[:most]
    return largest[np.isfinite(values[largest])]


def breaking(
    course: Course, numbers: Sequence[tuple[float, float]], columns: Mapping[str, np.ndarray]
) -> Members | None:
    """Return the validation members that explain a broken limit and are not in the training ensemble, or None.

    For a limit on the worst member, they are at most MOST_BREAKING members that break it, if the judged value lacks
    reserve. For a limit on a mean, they are the members with the largest values, if the judged value breaks the limit
    and exceeds its expected value, the search's value times `Limit.ratio`, by more than UNEXPECTED.

    `numbers`: the values of the search and of the judge for each limit. `columns` [N]: metrics of the judged members.
    """
    problem, budget = course.problem, course.problem.tune.budget
    if not budget.validation:
        return None
    found = np.zeros(0, int)
    for limit, (tuned, judged) in zip(problem.limits, numbers, strict=True):
        excess = np.where(held(columns), limit.log_excesses(columns), -math.inf)
        if limit.kind.worst and not limit.has_reserve(judged):
            found = np.append(found, largest_unseen(course, np.where(excess > 0, excess, -math.inf), MOST_BREAKING))
        elif not limit.kind.worst and not limit.holds(judged) and judged > (1 + UNEXPECTED) * limit.ratio * tuned:
            found = np.append(found, largest_unseen(course, excess))
    total = len(columns["lost_at_s"])
    return problem.objective.chosen(seeds(budget)[1], np.unique(found), total) if found.size else None


def joining(problem: TuningProblem, lost: np.ndarray, error: StepError) -> Members:
    """Return the members that join the training ensemble.

    They are the first MOST_LOST of the `lost` validation members, and the members that are lost or stall with accurate
    steps. They join with half of the additional noise of stressed members, as a margin.
    """
    budget = problem.tune.budget
    those = problem.objective.chosen(seeds(budget)[1], lost[:MOST_LOST], budget.validation)
    both: Members = jax.tree.map(lambda a, b: np.concatenate([a, b]), those, error.unheld)
    return both._replace(noise_factor=both.noise_factor * (1 + problem.tune.stress) / 2)
