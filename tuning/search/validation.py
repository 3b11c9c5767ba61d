"""Validation of an answer on members that the search does not use, and the members that then join the search."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from tuning.config import seeds
from tuning.judge import StepError, comparison_members, describe, held, rms, step_error, worst_of
from tuning.objective.members import Members
from tuning.problem import TuningProblem
from tuning.search.course import Course, SearchResult

# Largest numbers of lost members, and of members with large errors, that join at once.
MOST_LOST, MOST_LARGE = 16, 8
# Largest number of members that join because they break a limit on the worst member.
MOST_BREAKING = 4
# If the rms error of the validation members exceeds that of the training members by more than this factor, the training
# ensemble lacks members with large errors.
LARGER = 1.5
# Members that are lost with accurate steps are held with the steps of the search. They therefore join with more noise,
# by the factor NOISE_GROWTH**number in round number `number`.
NOISE_GROWTH = 1.5


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
    course: Course, numbers: Sequence[tuple[float, float]], columns: Mapping[str, np.ndarray] | None
) -> Members | None:
    """Return the validation members that break a limit on the worst member and are not in the training ensemble.

    At most MOST_BREAKING for each limit whose judged value lacks reserve; None if there is none.

    `numbers`: the values of the search and of the judge for each limit. `columns` [N]: metrics of the judged members;
    None if they were not simulated.
    """
    problem, budget = course.problem, course.problem.tune.budget
    if columns is None or not budget.validation:
        return None
    found = np.zeros(0, int)
    for limit, (_, judged) in zip(problem.limits, numbers, strict=True):
        if limit.kind.worst and not limit.has_reserve(judged):
            excess = np.where(held(columns), limit.log_excesses(columns), -math.inf)
            found = np.append(found, largest_unseen(course, np.where(excess > 0, excess, -math.inf), MOST_BREAKING))
    total = len(columns["lost_at_s"])
    return problem.objective.chosen(seeds(budget)[1], np.unique(found), total) if found.size else None


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


def joining(problem: TuningProblem, lost: np.ndarray, error: StepError, number: int) -> Members:
    """Return the members that join the training ensemble.

    The first MOST_LOST of the `lost` validation members join with half of the additional noise of stressed members, as
    a margin. Members that are lost or stall with accurate steps join with NOISE_GROWTH**number times their noise.
    `number`: of the round, from 1.
    """
    budget = problem.tune.budget
    those = problem.objective.chosen(seeds(budget)[1], lost[:MOST_LOST], budget.validation)
    those = those._replace(noise_factor=those.noise_factor * (1 + problem.tune.stress) / 2)
    these = error.unheld._replace(noise_factor=error.unheld.noise_factor * NOISE_GROWTH**number)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), those, these)
