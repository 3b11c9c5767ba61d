"""Limits at an optimum: what is reached by the judge's own measure, and the search goes on until all are met.

An optimum exceeds its limits by about (what the multiplier must be - what it is) / penalty; an update closes that gap.
"""

import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.judge import judge
from tuning.objective.limits import PREFIX, Limit
from tuning.search.course import Course

# Updates of the multipliers at one place, at most.
MOST_UPDATES = 6
# Where it pulls, a limit is met from this share below what is allowed, to half of the margin above, or to the least.
BELOW, LEAST = 0.01, 1e-3
# An average that is this share below its limit is not judged: it hardly varies over members.
FAR = 0.1
# Members that judge averages.
FEW = 256


def limited(course: Course, x: np.ndarray) -> np.ndarray:
    """What searches from x [m] find once every limit pulls as strongly as it must; x itself where none is near."""
    for _ in range(MOST_UPDATES):
        goal = course.problem.goal
        numbers = _numbers(course, x)
        limits = tuple(limit.informed(*found) for limit, found in zip(goal.limits, numbers, strict=True))
        course.problem = course.problem.limited(limits)
        pulling = [(limit, judged) for limit, (_, judged) in zip(limits, numbers, strict=True) if limit.multiplier > 0]
        for limit, judged in pulling:
            say(f"limit {limit.name} = {limit.asked:g} {limit.kind.unit}: {judged:.4g} on members of another seed")
        if course.interrupted or all(_met(limit, judged) for limit, judged in pulling):
            break
        course.asides += 1
        x, _ = course.search(x[None])
    return x


def _met(limit: Limit, judged: float) -> bool:
    """Whether a limit that pulls holds what is allowed, and not much less."""
    return -BELOW <= limit.beyond(judged) <= max(limit.margin / 2, LEAST)


def _numbers(course: Course, x: np.ndarray) -> list[tuple[float, float]]:
    """What each limit reaches at x [m], as the search measures it, and as a judge does on members of another seed."""
    problem, budget = course.problem, course.problem.tune.budget
    limits, n = problem.goal.limits, course.who.ordinary
    if not limits:
        return []
    terms = problem.engine.terms(x[None], course.who)
    tuned = [float(limit.kind.tuned(terms[PREFIX + limit.name][0, :n])) for limit in limits]
    each = zip(limits, tuned, strict=True)
    if all(not limit.kind.worst and limit.beyond(ours) < -FAR for limit, ours in each):
        return [(ours, ours) for ours in tuned]
    seed, count = (seeds(budget)[1], budget.validation) if budget.validation else (budget.seed, budget.members)
    if not any(limit.kind.worst for limit in limits):
        count = min(count, FEW)
    columns = judge(problem, x, seed, count)
    return [(ours, limit.reached(columns)) for limit, ours in zip(limits, tuned, strict=True)]
