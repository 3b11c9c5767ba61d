"""The method of multipliers: update the limits' multipliers at an optimum and search again until all limits are met.

The judge evaluates the limited quantities at each optimum, on members that the search does not use. At an optimum, the
excess g of a limit is about (required multiplier - multiplier) / penalty. An update of the multiplier reduces it.

An injection that saturates the voltage measures a larger peak than that of the linear loop, which the search evaluates.
A lower linear peak then may need a higher voltage, which saturates more. So the search limits the voltage instead.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tuning.judge.evaluate import RESOLVED, JudgedMembers, held, judge, rms
from tuning.judge.peaks import injections, injects, reached_of
from tuning.problem.config import seeds
from tuning.problem.goal import Goal
from tuning.problem.limits import PREFIX, SATURATION, Limit
from tuning.problem.members import Members
from tuning.problem.quantities import NEGLIGIBLE
from tuning.solve.course import Course
from tuning.solve.refine import early

# Largest number of searches after updates of the multipliers in one round.
MOST_UPDATES = 6
# Largest number of members on which averages are judged. Limits on worst members need the whole ensemble.
AVERAGING_MEMBERS = 256
# Largest number of members that join at once for each reason.
MOST_JOINING = 8
# Bound of the rms voltage in the next search, relative to a voltage at which injections saturate it.
LOWER = 0.8


class Judged(NamedTuple):
    """An optimum, judged on members of the validation ensemble, or of the training ensemble if tune.validation is 0.

    `x` [m]: coordinates. `numbers`: (the search's value, the judge's value) of each limit by name. `columns` [N]:
    metrics of the judged members. `limits`: those of the search that ended here. `saturated`: linear values of the
    limits that only saturated injections break.
    """

    x: np.ndarray
    numbers: Mapping[str, tuple[float, float]]
    columns: Mapping[str, np.ndarray]
    limits: tuple[Limit, ...] = ()
    saturated: Mapping[str, float] = {}

    def holds(self, limits: Sequence[Limit]) -> bool:
        """Return whether the judge's values are within all limits, without margins."""
        return all(limit.holds(self.numbers[limit.name][1]) for limit in limits if limit.source != SATURATION)

    def linear(self, limit: Limit) -> float:
        """Return the judge's value of a limit, or the linear one if only saturated injections break the limit."""
        return self.saturated.get(limit.name, self.numbers[limit.name][1])


def search_within_limits(course: Course, x: np.ndarray) -> tuple[np.ndarray, bool]:
    """Search from the optimum x [m] until every limit is met (`optima`). Return an optimum and whether it is within.

    The result is the last optimum. If the searches do not converge, it is the optimum of least goal within all limits,
    if there is one: the judge may measure very different values on either side of a limit, and the searches then
    alternate between the sides. Later searches begin with the multipliers of this optimum.
    """
    limits = course.problem.limits
    if not limits:
        return x, True
    seen, converged = optima(course, x)
    within = [one for one in seen if one.holds(limits)]
    if converged or not within:
        return seen[-1].x, bool(within) and within[-1] is seen[-1]
    course.tell("the multipliers of the limits do not converge; the best answer within the limits is taken")
    best = _lowest(course, within, dataclasses.replace(course.problem.goal, limits=()))
    course.problem = course.problem.limited(best.limits)
    return best.x, True


def optima(course: Course, x: np.ndarray, updates: int = MOST_UPDATES) -> tuple[list[Judged], bool]:
    """Judge the optimum x [m], let the members that break a limit join, or update the multipliers, and search again.

    Each search begins at the optimum so far of least goal, with the new members and multipliers.

    Returns the judged optima, the first at x, and whether the last one meets all limits. There are at most `updates`
    searches after updates, and as many after members have joined. After a search that ends where it began, the
    multipliers are updated, and the next search may use CMA-ES. The other searches use it only if all limits are met
    and the descent has ended early. The loop ends early if the course is over, and if a search ends where it began and
    this point is within all limits.
    """
    seen, moved, joins = list[Judged](), True, 0
    while True:
        one = judged_at(course, x)
        seen.append(one)
        last = len(seen) - joins > updates or course.over
        joined = moved and not last and joins < updates and join_breaking(course, one)
        joins += joined
        met = not joined and _updated(course, one, moved)
        if last or (met and not early(course.past[-1])):
            return seen, met
        x, moved = course.again(_lowest(course, seen).x, evolve=met or not moved)


def _lowest(course: Course, seen: Sequence[Judged], goal: Goal | None = None) -> Judged:
    """Return the optimum of least goal. `goal`: None: that of the next search."""
    problem, members = course.problem, course.members
    terms = problem.engine.terms(np.array([one.x for one in seen]), members)
    return seen[int(np.argmin((goal or problem.goal).score(terms, members)))]


def _updated(course: Course, one: Judged, moved: bool) -> bool:
    """Update the multipliers at a judged optimum. Return whether all limits are met there.

    A limit is met if the judge's value is close to the bound, or within it if its multiplier was and stays 0. If the
    search has not `moved`, it suffices that no limit is broken. Tells each limit that is active or not met. If only
    saturated injections break a limit, its multiplier follows the linear value, and the voltage is limited.
    """
    before, numbers = course.problem.limits, one.numbers
    after = tuple(limit.updated(numbers[limit.name][0], one.linear(limit)) for limit in before)
    done = []
    for old, new in zip(before, after, strict=True):
        judged, idle = numbers[new.name][1], old.multiplier == new.multiplier == 0
        close = new.log_excess(judged) >= -NEGLIGIBLE and new.has_reserve(judged)
        done.append(close or (idle and new.log_excess(judged) <= 0) or new.source == SATURATION)
        if not (idle and done[-1]):
            _tell(course, new, judged)
    if one.saturated:
        after = _lower(course, one, after)
    course.problem = course.problem.limited(after)
    return all(done) or (not moved and one.holds(after))


def _lower(course: Course, one: Judged, limits: Sequence[Limit]) -> tuple[Limit, ...]:
    """Return the limits with a limit on the rms voltage that is LOWER times the voltage of the judged members."""
    alive = held(one.columns)
    volts = LOWER * rms(one.columns["settled_rms_u_V"][alive]) if alive.any() else 0.0
    if not volts > 0:
        return tuple(limits)
    own = next((limit for limit in limits if limit.name == "rms_u_V"), Limit("rms_u_V", volts))
    own = dataclasses.replace(own, threshold=min(volts, own.threshold), source=SATURATION, history=())
    course.tell(f"injections saturate the voltage; the search continues with at most {own.threshold:.3g} V rms")
    return tuple(sorted([*(one for one in limits if one.name != own.name), own], key=lambda limit: limit.name))


def _tell(course: Course, limit: Limit, judged: float) -> None:
    course.tell(f"limit {limit.name} = {limit.threshold:g} {limit.kind.unit}: judged {judged:.4g}")


def join_breaking(course: Course, one: Judged) -> bool:
    """Let the members that break a limit join the training ensemble (`breaking`). Return whether there are any.

    The search then measures these members itself, so that the limits on worst members need no correction by a ratio.
    """
    more = breaking(course, one.numbers, one.columns)
    if more is None:
        return False
    limits = course.problem.limits
    for limit in limits:
        judged = one.numbers[limit.name][1]
        if limit.kind.worst and not limit.has_reserve(judged):
            _tell(course, limit, judged)
    course.tell(f"{len(more.member)} validation members that break a limit join the training ensemble")
    course.members = course.members.joined(more, stressed=False)
    reset = (dataclasses.replace(limit, ratio=1.0) if limit.kind.worst else limit for limit in limits)
    course.problem = course.problem.limited(tuple(reset))
    return True


def largest_unseen(course: Course, values: np.ndarray) -> np.ndarray:
    """Return the numbers of the MOST_JOINING validation members of largest values, not in the training ensemble.

    `values` [N]: of the validation members; -inf for a member that is left out.
    """
    members, seed = course.members, seeds(course.problem.tune.budget)[1]
    values = values.copy()
    values[members.member[~members.stressed & (members.seed == seed)]] = -math.inf
    largest = np.argsort(-values, kind="stable")[:MOST_JOINING]
    return largest[np.isfinite(values[largest])]


def breaking(
    course: Course, numbers: Mapping[str, tuple[float, float]], columns: Mapping[str, np.ndarray]
) -> Members | None:
    """Return the validation members that explain a broken limit and are not in the training ensemble, or None.

    For a limit on the worst member, they are members that break it, if the judged value lacks
    reserve. For a limit on a mean, they are the members with the largest values, if the judged value breaks the limit
    and exceeds its expected value, the search's value times `Limit.ratio`, by more than RESOLVED.

    `numbers`: the values of the search and of the judge by limit. `columns` [N]: metrics of the judged members.
    """
    problem, budget = course.problem, course.problem.tune.budget
    if not budget.validation:
        return None
    found = np.zeros(0, int)
    for limit in problem.limits:
        tuned, judged = numbers[limit.name]
        excess = np.where(held(columns), limit.log_excess(limit.values(columns)), -math.inf)
        if limit.kind.worst and not limit.has_reserve(judged):
            found = np.append(found, largest_unseen(course, np.where(excess > 0, excess, -math.inf)))
        elif not limit.kind.worst and not limit.holds(judged) and judged > (1 + RESOLVED) * limit.ratio * tuned:
            found = np.append(found, largest_unseen(course, excess))
    total = len(columns["lost_at_s"])
    return problem.objective.chosen(seeds(budget)[1], np.unique(found), total) if found.size else None


def judged_at(course: Course, x: np.ndarray) -> Judged:
    """Return the values of the limits at x [m], on all members of the ensemble if a limit concerns the worst member.

    On a processor, injections into the worst members count too, as for the held-out members.
    """
    problem, budget = course.problem, course.problem.tune.budget
    seed, count = (seeds(budget)[1], budget.validation) if budget.validation else (budget.seed, budget.members)
    if not any(limit.kind.worst for limit in problem.limits):
        count = min(count, AVERAGING_MEMBERS)
    course.tell(f"judging the limits on {count} members")
    of = JudgedMembers(problem, x, seed, judge(problem, x, seed, count))
    terms, n = problem.engine.terms(x[None], course.members), course.members.ordinary
    injected = injections(of) if injects(problem) else None
    numbers, saturated = dict[str, tuple[float, float]](), dict[str, float]()
    for limit in problem.limits:
        tuned = float(limit.kind.tuned(terms[PREFIX + limit.name][0, :n]))
        judged, linear = reached_of(limit, of.columns, injected), limit.reached(of.columns)
        numbers[limit.name] = tuned, judged
        nonlinear = injected is not None and not injected.decides and injected.saturates
        if nonlinear and judged > (1 + RESOLVED) * linear and not limit.has_reserve(judged):
            saturated[limit.name] = linear
    return Judged(x, numbers, of.columns, problem.limits, saturated)
