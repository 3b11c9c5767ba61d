"""What is minimised over an ensemble: one number from the members' losses and the gains."""

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
    """What is minimised: the log of the risk of the weighed losses, plus the conditions' shortfall times `weight`,
    plus the pull of the limits.

    The mean loss of stressed members is added to the others' risk; limits are not theirs.
    """

    space: Space
    weights: tuple[float, ...]
    risk: Risk
    conditions: tuple[Bound, ...]
    weight: float
    margin: float
    limits: tuple[Limit, ...] = ()

    def __call__(self, outcomes: Array, x: Array, ordinary: int) -> Array:
        """The goal at coordinates x [m], of outcomes [N, 1 + L]: losses, and what limits hold. The first members are
        `ordinary`."""
        losses = outcomes[:, 0]
        risk, stressed = self.risk(losses[:ordinary]), losses[ordinary:]
        loss = risk + (jnp.mean(stressed) if stressed.size else 0.0)
        return jnp.log(loss + 1e-30) + self.weight * self.penalty(x) + self.pull(outcomes[:ordinary, 1:])

    def penalty(self, x: Array) -> Array:
        """Shortfall of the theorem's conditions at x [m]."""
        return shortfall(dict(zip(self.space.paths, self.space.gains_at(x), strict=True)), self.conditions, self.margin)

    def pull(self, held: Array) -> Any:
        """What the limits add, of what members hold [N, L]."""
        return sum(limit.pull(held[:, j]) for j, limit in enumerate(self.limits))

    def score(self, x: np.ndarray, terms: dict[str, np.ndarray], who: Members) -> np.ndarray:
        """The goal [S] at x [S, m] from the terms [S, N] of members [N]; +inf where it is not a number."""
        each = zip(np.stack(outcomes(self.weights, terms, who.stressed), -1), x, strict=True)
        values = np.array([self(jnp.asarray(one), jnp.asarray(at), who.ordinary) for one, at in each])
        return np.where(np.isfinite(values), values, np.inf)
