"""Where to start: the case's own gains, informed ones, and quasi-random points over decades around them."""

import numpy as np

from ambjax.ensemble.design import points
from tuning.objective.goal import Goal
from tuning.objective.lanes import Engine
from tuning.objective.members import Members, Objective
from tuning.objective.ranges import drawn, ranges
from tuning.objective.shortfalls import Bound

# Share of the members that points meet, and share of the points that goes on: 1/4 after an eighth of the members.
ROUNDS = (8, 4), (4, 1)
# How far from a point its neighbourhoods reach, in coordinates: factors of e^1.5 up or down of each gain, and of e^3.
NEAR, FAR = 1.5, 3.0


def everywhere(
    objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray, count: int, seed: int
) -> np.ndarray:
    """Coordinates [count + 2, m]: the case's gains, the middle of the ranges, and quasi-random points over them.

    With count 0 the case's gains alone, [1, m].
    """
    space = objective.space
    if not count:
        return space.encode(space.clip(start))[None]
    box = ranges(objective, conditions, start)
    cube = points("sobol", seed, len(space), np.arange(count), count)
    middle = np.full((1, len(space)), 0.5)
    gains = np.concatenate([start[None], drawn(space, box, np.concatenate([middle, cube]))])
    return np.stack([space.encode(space.clip(g)) for g in gains])


def around(x: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Coordinates [count + 1, m]: x, and quasi-random points around it, NEAR and FAR by turns."""
    if not count:
        return x[None]
    cube = points("sobol", seed, len(x), np.arange(count), count)
    reach = np.where(np.arange(count) % 2, FAR, NEAR)[:, None]
    return np.concatenate([x[None], x + reach * (2 * cube - 1)])


def screen(engine: Engine, who: Members, x: np.ndarray, keep: int, goal: Goal) -> np.ndarray:
    """The best of points x [K, m], at least `keep`, best first, by successive halving: on few members, then on more.

    Some of the stressed members are there from the first: to be held is what is asked first.
    """
    for part, left in ROUNDS:
        some = who.part(part)
        values = goal.score(x, engine.terms(x, some), some)
        x = x[np.argsort(values, kind="stable")[: max(len(x) // left, 2 * keep)]]
    return x
