"""Starting points of a search, and the screen, which selects the best of them.

The points are the case's gains, the middle of the search ranges, and quasi-random points.
"""

import numpy as np

from ambjax.ensemble.design import design_points
from tuning.problem.goal import Goal
from tuning.problem.lanes import Engine
from tuning.problem.members import Members, Objective
from tuning.problem.ranges import from_unit_cube, ranges
from tuning.problem.shortfalls import Bound

# Rounds of the screen (a, b): one member in a is simulated, and one point in b is kept, but at least 2 `keep` points
# and at least the members that `Members.part` keeps.
ROUNDS = (8, 4), (4, 1)
# Half-widths of the two neighbourhoods of a point, in coordinates: factors of e^1.5 and e^3 of each gain.
NEAR, FAR = 1.5, 3.0


def initial_points(
    objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray, count: int, seed: int
) -> np.ndarray:
    """Return coordinates [count + 2, m]: the gains `start` [m], the middle of the ranges, and quasi-random points.

    If `count` is 0, the result contains only the gains `start`, [1, m].
    """
    space = objective.space
    if not count:
        return space.encode(space.clip(start))[None]
    box = ranges(objective, conditions, start)
    cube = design_points("sobol", seed, len(space), np.arange(count), count)
    middle = np.full((1, len(space)), 0.5)
    gains = np.concatenate([start[None], from_unit_cube(space, box, np.concatenate([middle, cube]))])
    return np.stack([space.encode(space.clip(g)) for g in gains])


def around(x: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return coordinates [count + 1, m]: x [m], and quasi-random points, alternately within NEAR and FAR of x."""
    if not count:
        return x[None]
    cube = design_points("sobol", seed, len(x), np.arange(count), count)
    reach = np.where(np.arange(count) % 2, FAR, NEAR)[:, None]
    return np.concatenate([x[None], x + reach * (2 * cube - 1)])


def screen(engine: Engine, members: Members, x: np.ndarray, keep: int, goal: Goal) -> np.ndarray:
    """Return the best of points x [K, m], at least `keep`, best first, by successive halving over members.

    Each round includes stressed members.
    """
    for part, left in ROUNDS:
        some = members.part(part)
        values = goal.score(x, engine.terms(x, some), some)
        x = x[np.argsort(values, kind="stable")[: max(len(x) // left, 2 * keep)]]
    return x
