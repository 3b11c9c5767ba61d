"""The front of error against voltage, and its knee: of the answers near the least error, the one of least voltage.

After the search for the least error e, further searches minimise the rms voltage. Each limits the rms error to a factor
times e, and starts at that answer so far at which its goal is lowest. The factor of the knee is KNEE. At a low voltage,
a few members may have errors many times those of the others. Validation members with such errors join the training
ensemble, and the search is repeated.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tuning.judge.evaluate import held, rms
from tuning.problem.limits import FRONT
from tuning.solve.course import Course, SearchResult
from tuning.solve.multipliers import MOST_UPDATES, Judged, judged_at, optima
from tuning.solve.refine import screen
from tuning.validate import validated

# Limits of the rms error relative to the least error: KNEE for the knee, FACTORS for the points of the front. The first
# tune.front factors are used, and further ones until there are tune.front points besides that of least error.
KNEE, *_ = FACTORS = (1.25, 1.1, 1.5, 2.0, 1.05, 3.0)
# First multiplier of the limit on the error at the knee: 1.5 % more voltage for 1 % less error.
MULTIPLIER = 3.0


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
    first = _point(course, judged_at(course, x))
    if not (math.isfinite(first.error_m) and first.error_m > 0 and first.volts > 0):
        course.tell("no front: with the gains of least error, no member is held, or the error or the voltage is 0")
        return answer
    seen, factors, count = [first], list[float](), answer.problem.tune.budget.front
    scale = MULTIPLIER * math.sqrt(math.log(KNEE))
    for factor in FACTORS:
        if course.over or (len(factors) >= count and len({id(chosen(seen, one)) for one in (1.0, *factors)}) > count):
            break
        factors.append(factor)
        least = least_of(seen)
        course.tell(
            f"front: least rms voltage with an rms error of at most {factor:g} times the least, {least.error_m:.3g} m"
        )
        # Near the least error, the error is quadratic in the logarithm of the voltage.
        multiplier = scale / math.sqrt(math.log(factor))
        course.problem = answer.problem.towards_voltage(least.error_m, least.volts, factor, multiplier)
        points = np.array([point.x for point in seen])
        start = screen(course.problem.engine, course.members, points, course.problem.goal)[0][0]
        found, _ = course.again(start, evolve=False)
        # Half as many updates of the multipliers are sufficient except at the knee: each of their optima is a point of
        # the front for its own error.
        updates = MOST_UPDATES if factor == KNEE else MOST_UPDATES // 2
        seen += [_point(course, one) for one in optima(course, found, updates)[0]]
        (error,) = (limit for limit in course.problem.limits if limit.source == FRONT)
        scale = error.multiplier * math.sqrt(math.log(factor))
    taken = answer
    if not course.interrupted:
        least, course.problem = least_of(seen), answer.problem
        if answer.problem.tune.objective == "knee":
            course.problem = answer.problem.towards_voltage(least.error_m, least.volts, KNEE, MULTIPLIER)
        taken = _validated_point(course, answer, seen)
    least = least_of(seen)
    points = [least._replace(factor=1.0), *(chosen(seen, factor)._replace(factor=factor) for factor in sorted(factors))]
    if not any(point.x is taken.x for point in points):
        points.append(first._replace(factor=round(first.error_m / least.error_m, 3)))
    kept = [point for k, point in enumerate(points) if not any(point.x is other.x for other in points[:k])]
    return dataclasses.replace(taken, front=tuple(kept), history=course.history)


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


def _validated_point(course: Course, answer: SearchResult, seen: list[FrontPoint]) -> SearchResult:
    """Return the best point that the validation confirms, or `answer` if it confirms none.

    tune.objective determines which point is the best. Points that are not confirmed are removed from `seen`.
    """
    knee = answer.problem.tune.objective == "knee"
    while True:
        best = chosen(seen, KNEE) if knee else least_of(seen)
        if best is seen[0]:
            return answer
        found = validated(course, best.x).result
        if found.good and not found.unstable > answer.unstable:
            return found
        why = "it loses members, is not stable, or accurate steps do not confirm it"
        course.tell(f"the answer of {best.volts:.4g} V is rejected: {why}")
        seen[:] = [point for point in seen if point is not best]


def _point(course: Course, one: Judged) -> FrontPoint:
    """Return a judged optimum as a point of the front."""
    columns, limits = one.columns, course.problem.limits
    alive = held(columns)
    error, volts = (
        rms(columns[name][alive]) if alive.any() else math.nan for name in ("settled_rms_error_m", "settled_rms_u_V")
    )
    values = {name: judged for name, (_, judged) in one.numbers.items()}
    others = [limit for limit in limits if limit.asked]
    within = all(limit.holds(values[limit.name]) for limit in others)
    reserve = all(limit.has_reserve(values[limit.name]) for limit in others)
    lost, stalled = (int(columns[name].sum()) for name in ("lost", "stalled"))
    return FrontPoint(1.0, one.x, error, volts, values.get("sensitivity"), lost, stalled, len(alive), within, reserve)
