"""Limits at an optimum: what is reached by the judge's own measure, and the search goes on until all are met.

An optimum exceeds its limits by about (what the multiplier must be - what it is) / penalty; an update closes that gap.
"""

import numpy as np

from ambjax.commands.outputs import say
from tuning.config import seeds
from tuning.judge import judge
from tuning.objective.limits import BELOW, PENALTY, PREFIX, Limit
from tuning.search.course import Course

# Updates of the multipliers at one place, at most.
MOST_UPDATES = 6
# What an excess must fall by.
LEAST = 1e-3
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
        stuck = [limit for limit, (_, judged) in zip(goal.limits, numbers, strict=True) if _stuck(limit, judged)]
        if stuck:
            names = ", ".join(limit.name for limit in stuck)
            say(f"a steeper pull has not lowered {names}: its multiplier stays, and the held-out members judge it")
            break
        course.problem = course.problem.limited(limits)
        done = []
        for before, after, (_, judged) in zip(goal.limits, limits, numbers, strict=True):
            idle = before.multiplier == after.multiplier == 0
            done.append(_met(after, judged) or (idle and after.beyond(judged) <= 0))
            if not (idle and done[-1]):
                say(f"limit {after.name} = {after.asked:g} {after.kind.unit}: {judged:.4g} on members of another seed")
        if course.interrupted or all(done):
            break
        course.asides += 1
        x, _ = course.search(x[None])
    return x


def _stuck(limit: Limit, judged: float) -> bool:
    """Whether a limit is exceeded as it was before its pull became steeper."""
    excess = limit.beyond(judged)
    return limit.penalty > PENALTY and excess > limit.margin + LEAST and 0 < limit.missed < excess + LEAST


def _met(limit: Limit, judged: float) -> bool:
    """Whether what is allowed is held, and made use of."""
    return -BELOW <= limit.beyond(judged) <= limit.margin / 2


def _numbers(course: Course, x: np.ndarray) -> list[tuple[float, float]]:
    """What each limit reaches at x [m], as the search measures it, and as a judge does on members of another seed."""
    problem, budget = course.problem, course.problem.tune.budget
    limits, n = problem.goal.limits, course.who.ordinary
    if not limits:
        return []
    terms = problem.engine.terms(x[None], course.who)
    tuned = [float(limit.kind.tuned(terms[PREFIX + limit.name][0, :n])) for limit in limits]
    known = [limit.ratio * ours for limit, ours in zip(limits, tuned, strict=True)]
    if all(not limit.kind.worst and limit.beyond(one) < -FAR for limit, one in zip(limits, known, strict=True)):
        return list(zip(tuned, known, strict=True))
    seed, count = (seeds(budget)[1], budget.validation) if budget.validation else (budget.seed, budget.members)
    if not any(limit.kind.worst for limit in limits):
        count = min(count, FEW)
    columns = judge(problem, x, seed, count)
    return [(ours, limit.reached(columns)) for limit, ours in zip(limits, tuned, strict=True)]
