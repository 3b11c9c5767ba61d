"""The neighbourhood of the optimum: slices of the goal, sensitivities, and the Pareto front of error and voltage."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from tuning.judge import held, rms
from tuning.objective.loss import TERMS
from tuning.objective.members import Members
from tuning.optimisers import BFGS
from tuning.problem import TuningProblem
from tuning.search.descent import Descent
from tuning.search.iteration import iterate
from tuning.search.keeper import SearchState
from tuning.search.optimise import SHORTEST

# Coordinates of the slices: factors of about e^-1.5 to e^1.5 of a gain.
REACH = np.linspace(-1.5, 1.5, 13)


@dataclasses.dataclass(frozen=True)
class Slices:
    """Slices of the goal along each gain through the optimum: gains, goals (logs) and lost members, each [m, k]."""

    gains: np.ndarray
    goals: np.ndarray
    lost: np.ndarray
    risks: np.ndarray
    """the goals without the terms of the limits"""

    def sensitivity(self) -> np.ndarray:
        """Return the growth of the risk in per cent when a gain is off by a factor e^0.25, the worse side, [m].

        It has no meaning for a gain with `more_lost` > 0: the loss of a rotor costs about 1e6 times an error.
        """
        middle = len(REACH) // 2
        beside = np.maximum(self.risks[:, middle - 1], self.risks[:, middle + 1])
        return 100 * np.expm1(beside - self.risks[:, middle])

    def more_lost(self) -> np.ndarray:
        """Return the number of additional lost members when a gain is off by a factor e^0.25, the worse side, [m]."""
        middle = len(REACH) // 2
        beside = np.maximum(self.lost[:, middle - 1], self.lost[:, middle + 1])
        return np.maximum(beside - self.lost[:, middle], 0)

    def lowest(self) -> tuple[int, int, float]:
        """Return the gain and the point of its slice with the lowest goal, and the decrease of the goal there.

        The decrease is a logarithm, and 0 if no point is lower. Points that lose more members than the optimum do not
        count.
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
    free = dataclasses.replace(problem.goal, limits=())
    goals, risks = (goal.score(at, terms, members).reshape(m, -1) for goal in (problem.goal, free))
    gains = np.stack([np.asarray(space.gains_at(jnp.asarray(one))) for one in at])
    own = np.stack([gains[j * len(REACH) : (j + 1) * len(REACH), j] for j in range(m)])
    return Slices(own, goals, (terms["survival"] > 0).sum(axis=1).reshape(m, -1), risks)


def pareto(
    problem: TuningProblem, x: np.ndarray, members: Members, *, points: int = 6, iterations: int = 8
) -> list[dict[str, object]]:
    """Return the Pareto front of settled rms error and rms voltage, from optima for several weights of the effort.

    The first point has the search's own weight, the others 1 to 1000. All are refined at once. Each is judged in the
    judge's steps on the ordinary training members that it holds. A point that holds no member is left out.
    """
    space = problem.objective.space
    weights = np.tile(problem.goal.weights, (points, 1))
    weights[1:, TERMS.index("effort")] = np.geomspace(1.0, 1000.0, points - 1)
    descent = Descent(problem.goal, BFGS, 0.0)
    family = SearchState(descent.begin(jnp.tile(jnp.asarray(x), (points, 1))), np.ones(points, bool))
    for _ in range(iterations):
        if family.active.any():
            iterate(problem.engine, problem.goal, members, family, descent, weights)
            family.active &= np.asarray(family.starts.length) > SHORTEST
    best = np.asarray(family.starts.best)
    metrics = problem.judging.metrics(best, members.unstressed)["metrics"]
    alive = held(metrics)
    rows = [
        {
            "effort_weight": float(w[TERMS.index("effort")]),
            "settled_rms_error_m": rms(metrics["settled_rms_error_m"][n][alive[n]]),
            "settled_rms_u_V": rms(metrics["settled_rms_u_V"][n][alive[n]]),
            "lost": int(metrics["lost"][n].sum()),
            "stalled": int(metrics["stalled"][n].sum()),
            "gains": dict(zip(space.paths, np.asarray(space.gains_at(jnp.asarray(best[n]))).tolist(), strict=True)),
        }
        for n, w in enumerate(weights)
        if alive[n].any()
    ]
    return sorted(rows, key=lambda row: row["settled_rms_u_V"])
