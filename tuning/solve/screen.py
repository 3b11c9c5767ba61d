"""Starting points of a search, and the screen, which orders them.

The points are the case's gains, the middle of the search ranges, and quasi-random points.
"""

import numpy as np

from ambjax.ensemble.design import design_points
from tuning.problem.goal import Goal
from tuning.problem.lanes import Engine
from tuning.problem.members import Members
from tuning.problem.ranges import Range, from_unit_cube
from tuning.problem.space import Space


def initial_points(space: Space, box: list[Range], start: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return coordinates [count + 2, m]: the gains `start` [m], the middle of the ranges, and quasi-random points.

    `box`: the ranges. If `count` is 0, the result contains only the gains `start`, [1, m].
    """
    if not count:
        return space.encode(space.clip(start))[None]
    cube = design_points("sobol", seed, len(space), np.arange(count), count)
    middle = np.full((1, len(space)), 0.5)
    gains = np.concatenate([start[None], from_unit_cube(space, box, np.concatenate([middle, cube]))])
    return np.stack([space.encode(space.clip(g)) for g in gains])


def screen(engine: Engine, members: Members, x: np.ndarray, goal: Goal) -> np.ndarray:
    """Return the points x [K, m] in the order of their goals on a part of the members, the best first."""
    some = members.part
    return x[np.argsort(goal.score(engine.terms(x, some), some), kind="stable")]
