"""What is minimised over an ensemble: one number from the members' losses and the gains."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import Array

from tuning.objective.conditions import Bound, shortfall
from tuning.objective.loss import weigh
from tuning.objective.members import Members
from tuning.objective.risk import Risk
from tuning.space import Space


@dataclasses.dataclass(frozen=True)
class Goal:
    """What is minimised: the log of the risk of the weighed losses, plus the conditions' shortfall times `weight`.

    The mean loss of stressed members is added to the others' risk.
    """

    space: Space
    weights: tuple[float, ...]
    risk: Risk
    conditions: tuple[Bound, ...]
    weight: float
    margin: float

    def __call__(self, losses: Array, x: Array, ordinary: int) -> Array:
        """The goal at coordinates x [m], where members have these losses [N]; the first are `ordinary`."""
        risk, stressed = self.risk(losses[:ordinary]), losses[ordinary:]
        loss = risk + (jnp.mean(stressed) if stressed.size else 0.0)
        return jnp.log(loss + 1e-30) + self.weight * self.penalty(x)

    def penalty(self, x: Array) -> Array:
        """Shortfall of the theorem's conditions at x [m]."""
        return shortfall(dict(zip(self.space.paths, self.space.gains_at(x), strict=True)), self.conditions, self.margin)

    def score(self, x: np.ndarray, terms: dict[str, np.ndarray], who: Members) -> np.ndarray:
        """The goal [S] at x [S, m] from the terms [S, N] of members [N]; +inf where it is not a number."""
        losses = weigh(self.weights, terms, who.stressed)
        each = zip(losses, x, strict=True)
        values = np.array([self(jnp.asarray(one), jnp.asarray(at), who.ordinary) for one, at in each])
        return np.where(np.isfinite(values), values, np.inf)
