"""The neighbourhood of the optimum: slices of the goal, and sensitivities."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem

# Coordinates of the points of a slice, relative to the optimum: a gain times about e^-1.5 to e^1.5.
REACH = np.linspace(-1.5, 1.5, 13)


@dataclasses.dataclass(frozen=True)
class Slices:
    """Slices of the goal along each gain through the optimum: gains, goals (logarithms), lost members; each [m, k]."""

    gains: np.ndarray
    goals: np.ndarray
    lost: np.ndarray
    risks: np.ndarray
    """logarithms of the goal of least error (`TuningProblem.error_goal`), without the terms of the limits"""

    def sensitivity(self) -> np.ndarray:
        """Return the increase of exp(`risks`), in per cent, if one gain changes by a factor of e^0.25, by gain [m].

        The gain is multiplied or divided by this factor, whichever is worse. The number has no meaning if `more_lost`
        is above 0: the loss of a rotor costs about 1e6 times as much as an error.
        """
        middle = len(REACH) // 2
        beside = np.maximum(self.risks[:, middle - 1], self.risks[:, middle + 1])
        return 100 * np.expm1(beside - self.risks[:, middle])

    def more_lost(self) -> np.ndarray:
        """Return the number of additional lost members if one gain changes as in `sensitivity`, for each gain [m]."""
        middle = len(REACH) // 2
        beside = np.maximum(self.lost[:, middle - 1], self.lost[:, middle + 1])
        return np.maximum(beside - self.lost[:, middle], 0)

    def lowest(self) -> tuple[int, int, float]:
        """Return the number of the gain and of the point on its slice with the lowest goal, and the decrease there.

        The decrease of the goal is a logarithm; it is 0 if no point is lower. Points that lose more members than the
        optimum do not count.
        """
        middle = len(REACH) // 2
        drop = np.where(self.lost <= self.lost[:, [middle]], self.goals[:, [middle]] - self.goals, 0.0)
        j, k = np.unravel_index(int(np.argmax(np.where(np.isfinite(drop), drop, 0.0))), drop.shape)
        return int(j), int(k), max(float(drop[j, k]), 0.0)


def slices(problem: TuningProblem, x: np.ndarray, members: Members) -> Slices:
    """Return the slices of the goal through x [m], one gain at a time."""
    m, space = len(x), problem.objective.space
    at = np.repeat(x[None], m * len(REACH), axis=0)
    for j in range(m):
        at[j * len(REACH) : (j + 1) * len(REACH), j] += REACH
    terms = problem.engine.terms(at, members)
    both = problem.goal, problem.error_goal
    goals, risks = (goal.score(at, terms, members).reshape(m, -1) for goal in both)
    gains = np.stack([np.asarray(space.gains_at(jnp.asarray(one))) for one in at])
    own = np.stack([gains[j * len(REACH) : (j + 1) * len(REACH), j] for j in range(m)])
    return Slices(own, goals, (terms["survival"] > 0).sum(axis=1).reshape(m, -1), risks)
