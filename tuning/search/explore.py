"""What surrounds the optimum: slices of the loss, sensitivities, and the front of error against voltage."""

import dataclasses
from typing import Any

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
    """The goal along each gain through the optimum: gains [m, k], goals [m, k] (logs), lost members [m, k]."""

    gains: np.ndarray
    goals: np.ndarray
    lost: np.ndarray

    def sensitivity(self) -> np.ndarray:
        """By how much the risk grows, in per cent, when a gain is off by a factor e^0.25: the worse side, [m].

        Of a gain with `more_lost` it is no measure: losing a rotor costs some 1e6 times an error.
        """
        middle = len(REACH) // 2
        beside = np.maximum(self.goals[:, middle - 1], self.goals[:, middle + 1])
        return 100 * np.expm1(beside - self.goals[:, middle])

    def more_lost(self) -> np.ndarray:
        """Members lost beyond those of the answer when a gain is off by a factor e^0.25: the worse side, [m]."""
        middle = len(REACH) // 2
        beside = np.maximum(self.lost[:, middle - 1], self.lost[:, middle + 1])
        return np.maximum(beside - self.lost[:, middle], 0)

    def lowest(self) -> tuple[int, int, float]:
        """Gain and point of its slice where the goal is lowest, and by how much, a logarithm; 0 where nothing is lower.

        Points that lose more members than the answer do not count.
        """
        middle = len(REACH) // 2
        drop = np.where(self.lost <= self.lost[:, [middle]], self.goals[:, [middle]] - self.goals, 0.0)
        j, k = np.unravel_index(int(np.argmax(np.where(np.isfinite(drop), drop, 0.0))), drop.shape)
        return int(j), int(k), max(float(drop[j, k]), 0.0)


def slices(problem: TuningProblem, x: np.ndarray, who: Members) -> Slices:
    """Slices through x [m], one gain at a time."""
    m, space = len(x), problem.objective.space
    at = np.repeat(x[None], m * len(REACH), axis=0)
    for j in range(m):
        at[j * len(REACH) : (j + 1) * len(REACH), j] += REACH
    terms = problem.engine.terms(at, who)
    goals = problem.goal.score(at, terms, who).reshape(m, -1)
    gains = np.stack([np.asarray(space.gains_at(jnp.asarray(one))) for one in at])
    own = np.stack([gains[j * len(REACH) : (j + 1) * len(REACH), j] for j in range(m)])
    return Slices(own, goals, (terms["survival"] > 0).sum(axis=1).reshape(m, -1))


def pareto(
    problem: TuningProblem, x: np.ndarray, who: Members, *, points: int = 6, iterations: int = 8
) -> list[dict[str, Any]]:
    """The front of settled tracking error against rms voltage: a family of weights of the effort, refined at once.

    The first has the search's own; voltage at its limit is worth from as much as the error to a thousand times that.
    Each is judged on the members of the training ensemble itself, none stressed, in the finer steps: on those that it
    holds. A point that holds none is left out.
    """
    space = problem.objective.space
    weights = np.tile(problem.goal.weights, (points, 1))
    weights[1:, TERMS.index("effort")] = np.geomspace(1.0, 1000.0, points - 1)
    descent = Descent(problem.goal, BFGS, 0.0)
    family = SearchState(descent.begin(jnp.tile(jnp.asarray(x), (points, 1))), np.ones(points, bool))
    for _ in range(iterations):
        if family.active.any():
            iterate(problem.engine, problem.goal, who, family, descent, weights)
            family.active &= np.asarray(family.starts.length) > SHORTEST
    best = np.asarray(family.starts.best)
    metrics = problem.judging.metrics(best, who.unstressed)["metrics"]
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
