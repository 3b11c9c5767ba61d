"""Validation of an answer on members that the search does not use."""

import dataclasses
import math
from typing import NamedTuple

import jax
import numpy as np

from ambjax.linear import suspects
from tuning.judge.evaluate import StepError, comparison_members, describe, rms, stability, step_error, worst_of
from tuning.problem.members import FEW, Members
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.course import Course, SearchResult
from tuning.solve.multipliers import MOST_JOINING, largest_unseen

# If the rms error of the validation members exceeds that of the training members by more than this factor, the training
# ensemble lacks members with large errors.
LARGER = 1.5


class Validation(NamedTuple):
    """Result of `validated`.

    `result`: the answer. `error`: its step error. `lost`: numbers of the validation members that are lost, the earliest
    loss first. `large`: numbers of members with larger errors than the training members have. `unstable`: numbers of
    further members whose loop is not stable, at most FEW; none if FEW^2 have joined the training ensemble.
    """

    result: SearchResult
    error: StepError
    lost: np.ndarray
    large: np.ndarray
    unstable: np.ndarray

    @property
    def failed(self) -> bool:
        """Whether members join the training ensemble (`joining`)."""
        return not self.result.good or self.large.size + self.unstable.size > 0


def validated(course: Course, x: np.ndarray, error: StepError | None = None) -> Validation:
    """Evaluate x [m] on the validation ensemble, with the steps of the search.

    In continuous time, if no member is lost and the step error does not refute x, the worst members are simulated again
    with accurate steps. `error`: the step error at x, if it is known.
    """
    problem, count, none = course.problem, course.problem.tune.budget.validation, np.zeros(0, int)
    error = step_error(problem, x) if error is None else error
    if course.interrupted or not count:
        return Validation(course.answer(x, error, error.unconfirmed), error, none, none, none)
    course.tell(f"validating the answer on {count} members")
    terms = terms_at(problem, x, problem.validation(np.arange(count)))
    share = terms["survival"]
    lost = np.argsort(-share, kind="stable")[: int((share > 0).sum())]
    if not lost.size and not error.refuted and not problem.sampled:
        worst = problem.validation(worst_of(terms["peak"]))
        error = step_error(problem, x, comparison_members(problem).joined(worst))
        course.tell(f"accurate steps, with the worst of {count} validation members: {describe(error)}")
    if lost.size:
        course.tell(f"{lost.size} of {count} validation members are lost")
    errors = np.where(share > 0, -math.inf, np.sqrt(terms["tracking"]))
    overall = rms(errors[share <= 0]) if (share <= 0).any() else math.inf
    found = course.answer(x, error, lost.size + error.unconfirmed, overall)
    trained = terms_at(problem, x, course.members)["tracking"][: course.members.ordinary]
    large = largest_unseen(course, errors) if overall > LARGER * math.sqrt(trained.mean()) else none
    unstable = _unstable(course, x, suspects(terms["peak"], share <= 0)) if found.good else none
    found = dataclasses.replace(found, unstable=unstable.size)
    joined = course.members.member[course.members.quiet > 0]
    more = np.setdiff1d(unstable, joined)[:FEW] if len(joined) < FEW**2 else none
    return Validation(found, error, lost, large, more)


def _unstable(course: Course, x: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return the numbers of those of these validation members whose loops are not stable at x [m]."""
    course.tell(f"testing whether the loops of {numbers.size} of them are stable")
    bad = numbers[~stability(course.problem, x, course.problem.validation(numbers)).stable]
    if bad.size:
        course.tell(f"{bad.size} of them are held, but not stable")
    return bad


def joining(course: Course, found: Validation) -> Members:
    """Return the training ensemble with the members that failed.

    The first MOST_JOINING of the lost members, and the members that are lost or stall with accurate steps, join as
    stressed ones with half of the additional noise of these, as a margin. Members with large errors join as ordinary
    ones. So do members that are not stable, in a quiet run: what remains of the displaced start counts as an error.
    """
    problem, those = course.problem, course.problem.validation(found.lost[:MOST_JOINING])
    both: Members = jax.tree.map(lambda a, b: np.concatenate([a, b]), those, found.error.unheld)
    members = course.members.joined(both._replace(noise_factor=both.noise_factor * (1 + problem.tune.stress) / 2))
    quiet = problem.validation(found.unstable)
    quiet = quiet._replace(quiet=np.ones(len(quiet.member)))
    others = f"{found.large.size} of large errors and {len(quiet.member)} in quiet runs"
    course.tell(f"{len(both.member)} lost members, {others} join the training ensemble")
    return members.joined(problem.validation(found.large), stressed=False).joined(quiet, stressed=False)


def terms_at(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, np.ndarray]:
    """Return the terms of the loss by name, each [N], of members [N] at x [m]."""
    return {name: values[0] for name, values in problem.engine.terms(x[None], members).items()}
