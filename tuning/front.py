"""The front of error against voltage, and its knee: of the answers near the least error, the one of least voltage.

After the search for the least error e, further searches minimise the rms voltage. Each limits the rms error to a factor
times e, and starts at the best answer so far. The factor of the knee is KNEE. At a low voltage, a few members may have
errors many times those of the others. Validation members with such errors join the training ensemble, and the search
is repeated.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tuning.judge.evaluate import held, judge, rms
from tuning.problem.config import seeds
from tuning.problem.limits import FRONT
from tuning.problem.members import Members
from tuning.solve.course import Course, SearchResult
from tuning.solve.joining import largest_unseen
from tuning.solve.multipliers import holding, join_breaking, judged_members, judged_values, met, search_values
from tuning.validate import validated

# Limits of the rms error relative to the least error: KNEE for the knee, FACTORS for the points of the front. The first
# tune.front factors are used.
KNEE = 1.25
FACTORS = (KNEE, 1.1, 1.5, 1.05, 2.0)
# MOST_SEARCHES_PER_POINT: largest number of searches for a point of the front. Between two searches, the multipliers
# are updated or members join. MOST_VALIDATIONS: largest number of answers that are validated.
MOST_SEARCHES_PER_POINT, MOST_VALIDATIONS = 6, 4
# If the judge's error exceeds its expected value (`_members_to_join`) by more than the share UNEXPECTED, the training
# ensemble lacks members with large errors. The share is below that of the validation, `validation.LARGER` - 1, because
# the error is limited here.
UNEXPECTED = 0.1


class FrontPoint(NamedTuple):
    """An answer, judged on the validation members, or on the training members if tune.validation is 0.

    `factor`: limit of the rms error relative to the least error; 1: the answer of least error. `x` [m]: coordinates.
    `error_m`, `volts`: settled rms error (m) and settled rms voltage (V) of the members that are held; NaN if none is
    held. `sensitivity`: the limited peak of |S|; None if it has no limit. `lost`, `stalled`: number of lost and of
    stalled members among `members`. `within`: whether all limits are met, except that of the front on the error.
    `reserve`: whether they are met with half of their margins.
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
    reserve: bool


def trace_front(course: Course, answer: SearchResult) -> SearchResult:
    """Trace the front from the answer of least error. Return the answer that tune.objective selects.

    After Ctrl-C, or if the validation confirms no other point, the returned answer is `answer`.

    The result contains the point of least error, and then, for each limit of the error in ascending order, the judged
    point of least voltage. Equal points appear once. If `answer` is returned and is not among them, it comes last. If a
    search for a lower voltage finds a smaller error than that of `answer`, this error is taken as the least error.

    There is no front if `answer` holds no member, or if its error or voltage is 0. Raises ValueError as `Course.search`
    does.
    """
    course.problem, x = answer.problem, answer.x
    first, *_ = _judged(course, 1.0, x)
    if not (math.isfinite(first.error_m) and first.error_m > 0 and first.volts > 0):
        course.tell("no front: with the gains of least error, no member is held, or the error or the voltage is 0")
        return answer
    seen, factors = [first], sorted(FACTORS[: answer.problem.tune.budget.front])
    for factor in factors:
        if course.over:
            break
        least = least_of(seen)
        course.tell(
            f"front: least rms voltage with an rms error of at most {factor:g} times the least, {least.error_m:.3g} m"
        )
        course.problem = answer.problem.towards_voltage(least.error_m, least.volts, factor)
        seen += _search_least_voltage(course, factor, seen)
    taken = answer
    if not course.over:
        least, course.problem = least_of(seen), answer.problem
        if answer.problem.tune.objective == "knee":
            course.problem = answer.problem.towards_voltage(least.error_m, least.volts, KNEE)
        taken = _validated_point(course, answer, seen)
    least = least_of(seen)
    points = [least._replace(factor=1.0), *(chosen(seen, factor)._replace(factor=factor) for factor in factors)]
    if not any(point.x is taken.x for point in points):
        points.append(first._replace(factor=round(first.error_m / least.error_m, 3)))
    kept = [point for k, point in enumerate(points) if not any(point.x is other.x for other in points[:k])]
    return dataclasses.replace(taken, front=tuple(kept), history=course.answer(x, None, 0).history)


def least_of(seen: Sequence[FrontPoint]) -> FrontPoint:
    """Return the admissible point of least error."""
    return min(_admissible(seen), key=lambda point: point.error_m)


def chosen(seen: Sequence[FrontPoint], factor: float) -> FrontPoint:
    """Return the admissible point of least voltage with an error of at most `factor` times the least."""
    fit = _admissible(seen)
    least = min(point.error_m for point in fit)
    return min((point for point in fit if point.error_m <= factor * least), key=lambda point: point.volts)


def _admissible(seen: Sequence[FrontPoint]) -> list[FrontPoint]:
    """Return the points that hold at least as many members as the first point, and meet all limits if it does.

    The limit of the front does not count. If the first point keeps half of the margin of each limit, the returned
    points do so too. They need this reserve: the values of the held-out members may exceed those of the judged members
    by a few per cent.
    """
    first = seen[0]
    return [
        point
        for point in seen
        if math.isfinite(point.error_m)
        and point.lost + point.stalled <= first.lost + first.stalled
        and (point.within or not first.within)
        and (point.reserve or not first.reserve)
    ]


def _search_least_voltage(course: Course, factor: float, seen: Sequence[FrontPoint]) -> list[FrontPoint]:
    """Search for the least voltage within the limits, from the best point in `seen`. Return the judged answers.

    The searches end when each limit is met (`met`), or is not exceeded and has the multiplier 0. They also end after
    Ctrl-C, and if a search ends where it began and this point is within all limits. Otherwise the multipliers are
    updated, and the next search starts at the last answer. If validation members have large errors, they join the
    training ensemble instead, and the next search starts at the best point so far.
    """
    points, x = list[FrontPoint](), chosen(seen, factor).x
    for _ in range(MOST_SEARCHES_PER_POINT):
        course.limit_searches += 1
        start = x
        x, _ = course.search(start[None])
        point, numbers, columns = _judged(course, factor, x)
        points.append(point)
        limits = tuple(limit.updated(*pair) for limit, pair in zip(course.problem.limits, numbers, strict=True))
        course.tell(f"judged {point.volts:.4g} V at an rms error of {point.error_m:.3g} m")
        both = zip(limits, numbers, strict=True)
        if course.over or all(
            met(limit, judged) or (not limit.multiplier and limit.log_excess(judged) <= 0)
            for limit, (_, judged) in both
        ):
            break
        if np.array_equal(x, start) and holding(limits, numbers):
            break
        if join_breaking(course, numbers, columns):
            continue
        more = _members_to_join(course, numbers, columns)
        if more is None:
            course.problem = course.problem.limited(limits)
        else:
            course.tell("validation members with large errors join the training ensemble; the search is repeated")
            course.members = course.members.joined(more, stressed=False)
            x = chosen([*seen, *points], factor).x
    return points


def _members_to_join(
    course: Course, numbers: Sequence[tuple[float, float]], columns: Mapping[str, np.ndarray]
) -> Members | None:
    """Return the validation members that join the training ensemble; None if none joins.

    They are those with the largest errors that are not in the training ensemble. They join if the judge's rms error
    breaks its limit and exceeds its expected value by more than UNEXPECTED. The expected value is the search's value
    times `Limit.ratio`.

    `numbers`: the values of the search and of the judge for each limit. `columns` [N]: metrics of the judged members.
    """
    problem, budget = course.problem, course.problem.tune.budget
    limit, (tuned, judged) = next(
        (limit, pair) for limit, pair in zip(problem.limits, numbers, strict=True) if limit.name == "rms_error_m"
    )
    if not budget.validation or limit.holds(judged) or judged <= (1 + UNEXPECTED) * limit.ratio * tuned:
        return None
    errors = np.where(held(columns), columns["settled_rms_error_m"], -math.inf)
    worst = largest_unseen(course, errors)
    return problem.objective.chosen(seeds(budget)[1], worst, len(errors)) if worst.size else None


def _validated_point(course: Course, answer: SearchResult, seen: list[FrontPoint]) -> SearchResult:
    """Return the best point that the validation confirms, or `answer` if it confirms none.

    tune.objective determines which point is the best. Points that are not confirmed are removed from `seen`.
    """
    knee = answer.problem.tune.objective == "knee"
    for _ in range(MOST_VALIDATIONS):
        best = chosen(seen, KNEE) if knee else least_of(seen)
        if best is seen[0]:
            return answer
        found = validated(course, best.x).result
        if found.good:
            return found
        course.tell(
            f"the answer of {best.volts:.4g} V is rejected: it loses members, or accurate steps do not confirm it"
        )
        seen[:] = [point for point in seen if point is not best]
    return answer


def _judged(
    course: Course, factor: float, x: np.ndarray
) -> tuple[FrontPoint, list[tuple[float, float]], dict[str, np.ndarray]]:
    """Judge x [m] on members of the validation ensemble, or of the training ensemble if tune.validation is 0.

    Returns the point, the search's and the judge's value of each limit, and the metrics of the judged members.
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
    others = [limit for limit in problem.limits if limit.source != FRONT]
    within = all(limit.holds(each[limit.name]) for limit in others)
    reserve = all(limit.has_reserve(each[limit.name]) for limit in others)
    lost, stalled = (int(columns[name].sum()) for name in ("lost", "stalled"))
    point = FrontPoint(factor, x, error, volts, each.get("sensitivity"), lost, stalled, len(alive), within, reserve)
    return point, list(zip(tuned, values, strict=True)), columns
