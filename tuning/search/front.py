"""The front of error against voltage, and its knee: the least voltage of all answers nearly as good as the best.

From the answer of least error e, searches minimise the rms voltage with the rms error limited to a factor times e; each
begins at the best answer before. The factor of the knee is KNEE. At a low voltage the error of a few members may be
many times that of the others. Such validation members join the training ensemble, and the search is repeated.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.judge import held, judge, rms
from tuning.objective.limits import FRONT
from tuning.objective.members import Members
from tuning.search.course import Course, SearchResult
from tuning.search.multipliers import holding, judged_members, judged_values, met, search_values
from tuning.search.validation import largest_unseen, validated

# Error limit of the knee, and those of the front in the order in which tune.front adds them, relative to the least.
KNEE = 1.25
FACTORS = (KNEE, 1.1, 1.5, 1.05, 2.0)
# Largest numbers of searches for a point, with an update of the multipliers or new members between two, and of answers
# that are validated.
UPDATES, TRIES = 6, 4
# If the error of the judge exceeds the one that the search expects by more than this share, the training ensemble lacks
# the members of large errors. The share is smaller than `validation.LARGER`, because the error is limited here.
RARE = 0.1


class FrontPoint(NamedTuple):
    """An answer, judged on members of another seed than the training ensemble.

    `factor`: limit of the rms error relative to the least; 1: the answer of least error. `x` [m]: coordinates.
    `error_m`, `volts`: settled rms error (m) and voltage (V) of the members held, NaN without any. `sensitivity`:
    peak of |S| as it is limited; None if it is not. `lost`, `stalled`: of `members` members. `within`: whether
    all limits except that of the error are met.
    """

    factor: float
    x: np.ndarray
    error_m: float
    volts: float
    sensitivity: float | None
    lost: int
    stalled: int
    members: int
    within: bool


def trace_front(course: Course, answer: SearchResult) -> SearchResult:
    """Trace the front from the answer of least error. Return the answer that tune.objective selects.

    The result holds the points of the front in order of the error limit: for each limit the judged answer of least
    voltage. A search for less voltage may find a smaller error than the answer's; it is then the least error. Raises
    ValueError as `Course.search` does.
    """
    course.problem, x = answer.problem, answer.x
    first, *_ = _judged(course, 1.0, x)
    if not (math.isfinite(first.error_m) and first.error_m > 0 and first.volts > 0):
        say("no front: the answer of least error holds no member, or has no error or voltage")
        return answer
    seen, factors = [first], sorted(FACTORS[: answer.problem.tune.budget.front])
    for factor in factors:
        if course.interrupted:
            break
        least = least_of(seen)
        say(f"front: least rms voltage with an rms error of at most {factor:g} times the least, {least.error_m:.3g} m")
        course.problem = answer.problem.towards_voltage(least.error_m, least.volts, factor)
        seen += _search_least_voltage(course, factor, seen)
    taken = answer
    if not course.interrupted:
        least, course.problem = least_of(seen), answer.problem
        if answer.problem.tune.objective == "knee":
            course.problem = answer.problem.towards_voltage(least.error_m, least.volts, KNEE)
        taken = _valid(course, answer, seen)
    least = least_of(seen)
    points = [least._replace(factor=1.0), *(chosen(seen, factor)._replace(factor=factor) for factor in factors)]
    if not any(point.x is taken.x for point in points):
        points.append(first._replace(factor=round(first.error_m / least.error_m, 3)))
    kept = [point for k, point in enumerate(points) if not any(point.x is other.x for other in points[:k])]
    return dataclasses.replace(taken, front=tuple(kept), history=course.answer(x, None, 0).history)


def least_of(seen: Sequence[FrontPoint]) -> FrontPoint:
    """Return the point of least error of those that `_fit` returns."""
    return min(_fit(seen), key=lambda point: point.error_m)


def chosen(seen: Sequence[FrontPoint], factor: float) -> FrontPoint:
    """Return the point of least voltage of those with an error of at most `factor` times the least.

    Only points that `_fit` returns count.
    """
    fit = _fit(seen)
    least = min(point.error_m for point in fit)
    return min((point for point in fit if point.error_m <= factor * least), key=lambda point: point.volts)


def _fit(seen: Sequence[FrontPoint]) -> list[FrontPoint]:
    """Return the points that lose no more members than the first, and that meet all limits if the first does."""
    first = seen[0]
    return [
        point
        for point in seen
        if math.isfinite(point.error_m)
        and point.lost + point.stalled <= first.lost + first.stalled
        and (point.within or not first.within)
    ]


def _search_least_voltage(course: Course, factor: float, seen: Sequence[FrontPoint]) -> list[FrontPoint]:
    """Search for the least voltage within the limits from the best point in `seen`. Return the answer of each search.

    After each search either the multipliers are updated, or members join the training ensemble; then the next search
    begins at the best point so far.
    """
    points, x = list[FrontPoint](), chosen(seen, factor).x
    for _ in range(UPDATES):
        course.limit_searches += 1
        start = x
        x, _ = course.search(start[None])
        point, numbers, columns = _judged(course, factor, x)
        points.append(point)
        limits = tuple(limit.updated(*pair) for limit, pair in zip(course.problem.limits, numbers, strict=True))
        say(f"judged {point.volts:.4g} V at an rms error of {point.error_m:.3g} m")
        both = zip(limits, numbers, strict=True)
        if course.interrupted or all(
            met(limit, judged) or (not limit.multiplier and limit.log_excess(judged) <= 0)
            for limit, (_, judged) in both
        ):
            break
        if np.array_equal(x, start) and holding(limits, numbers):
            break
        more = _rare(course, numbers, columns)
        if more is None:
            course.problem = course.problem.limited(limits)
        else:
            say("validation members of large errors join the training ensemble; the search is repeated")
            course.members = course.members.joined(more, stressed=False)
            x = chosen([*seen, *points], factor).x
    return points


def _rare(course: Course, numbers: Sequence[tuple[float, float]], columns: Mapping[str, np.ndarray]) -> Members | None:
    """Return the validation members of the largest errors that are to join; None if the search expects such errors.

    `numbers`: the values of the search and of the judge for each limit. `columns` [N]: metrics of the judged members.
    """
    problem, budget = course.problem, course.problem.tune.budget
    limit, (tuned, judged) = next(
        (limit, pair) for limit, pair in zip(problem.limits, numbers, strict=True) if limit.name == "rms_error_m"
    )
    if not budget.validation or limit.holds(judged) or judged <= (1 + RARE) * limit.ratio * tuned:
        return None
    errors = np.where(held(columns), columns["settled_rms_error_m"], -math.inf)
    worst = largest_unseen(course, errors)
    return problem.objective.chosen(seeds(budget)[1], worst, len(errors)) if worst.size else None


def _valid(course: Course, answer: SearchResult, seen: list[FrontPoint]) -> SearchResult:
    """Return the point that tune.objective selects if it is valid, else the next best; the given answer if none is.

    Points that are not valid are removed from `seen`.
    """
    knee = answer.problem.tune.objective == "knee"
    for _ in range(TRIES):
        best = chosen(seen, KNEE) if knee else least_of(seen)
        if best is seen[0]:
            return answer
        found = validated(course, best.x).result
        if found.good:
            return found
        say(f"the answer of {best.volts:.4g} V is not taken: it loses members, or accurate steps do not confirm it")
        seen[:] = [point for point in seen if point is not best]
    return answer


def _judged(
    course: Course, factor: float, x: np.ndarray
) -> tuple[FrontPoint, list[tuple[float, float]], dict[str, np.ndarray]]:
    """Judge x [m] on members of the validation ensemble, or of the training ensemble without one.

    Returns the point, each limit's value of the search and of the judge, and the metrics of the members judged.
    """
    problem, budget = course.problem, course.problem.tune.budget
    seed, count = (seeds(budget)[1], budget.validation) if budget.validation else (budget.seed, budget.members)
    columns, tuned = judge(problem, x, seed, judged_members(problem.limits, count)), search_values(course, x)
    values = judged_values(problem, x, seed, columns, tuned)
    alive = held(columns)
    error, volts = (
        rms(columns[name][alive]) if alive.any() else math.nan for name in ("settled_rms_error_m", "settled_rms_u_V")
    )
    each = dict(zip((limit.name for limit in problem.limits), values, strict=True))
    within = all(limit.holds(each[limit.name]) for limit in problem.limits if limit.source != FRONT)
    lost, stalled = (int(columns[name].sum()) for name in ("lost", "stalled"))
    point = FrontPoint(factor, x, error, volts, each.get("sensitivity"), lost, stalled, len(alive), within)
    return point, list(zip(tuned, values, strict=True)), columns
