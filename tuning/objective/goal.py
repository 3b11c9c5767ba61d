"""The goal: one number, minimised by the search, from the losses of the members and the gains."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from tuning.objective.limits import Limit
from tuning.objective.loss import outcomes
from tuning.objective.members import Members
from tuning.objective.risk import Risk
from tuning.objective.shortfalls import Bound, shortfall
from tuning.space import Space


@dataclasses.dataclass(frozen=True)
class Goal:
    """The function that a search minimises.

    goal = log(risk(losses) + mean(losses of stressed members)) + weight * shortfall(conditions) + sum(limit.pull).
    The risk and the limits include ordinary members only. `margin` is the relative margin of the conditions.
    """

    space: Space
    weights: tuple[float, ...]
    risk: Risk
    conditions: tuple[Bound, ...]
    weight: float
    margin: float
    limits: tuple[Limit, ...] = ()

    def __call__(self, outcomes: Array, x: Array, ordinary: int) -> Array:
        """Return the goal at coordinates x [m].

        `outcomes` [N, 1 + L]: the weighted loss and the limited quantities of each member. The first `ordinary` members
        are not stressed.
        """
        losses = outcomes[:, 0]
        risk, stressed = self.risk(losses[:ordinary]), losses[ordinary:]
        loss = risk + (jnp.mean(stressed) if stressed.size else 0.0)
        return jnp.log(loss + 1e-30) + self.weight * self.penalty(x) + self.pull(outcomes[:ordinary, 1:])

    def penalty(self, x: Array) -> Array:
        """Return the shortfall of the theorem's conditions at coordinates x [m]."""
        return shortfall(dict(zip(self.space.paths, self.space.gains_at(x), strict=True)), self.conditions, self.margin)

    def pull(self, held: Array) -> Any:
        """Return the sum of the limits' terms for the limited quantities `held` [N, L] of the ordinary members."""
        return sum(limit.pull(held[:, j]) for j, limit in enumerate(self.limits))

    def score(self, x: np.ndarray, terms: dict[str, np.ndarray], members: Members) -> np.ndarray:
        """Return the goal [S] at x [S, m] from the terms [S, N] of members [N]; +inf where it is not finite."""
        each = zip(np.stack(outcomes(self.weights, terms, members.stressed), -1), x, strict=True)
        values = np.array([self(jnp.asarray(one), jnp.asarray(at), members.ordinary) for one, at in each])
        return np.where(np.isfinite(values), values, np.inf)
