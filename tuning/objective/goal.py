"""What is minimised over an ensemble: one number from the members' terms."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from tuning.objective.conditions import Bound, shortfall
from tuning.objective.problem import Members, weigh
from tuning.objective.risk import Risk


@dataclasses.dataclass(frozen=True)
class Goal:
    """What is minimised: the log of the risk of the weighted losses, plus the conditions' shortfall.

    Members after the `ordinary` first are stressed ones: their mean loss is added to the others' risk.
    """

    weights: tuple[float, ...]
    risk: Risk
    conditions: tuple[Bound, ...]
    weight: float
    margin: float

    def of(self, losses: Array, ordinary: int, shortfalls: Any) -> Array:
        """The goal from the losses [N] of the members."""
        risk = self.risk(losses[:ordinary])
        stressed = losses[ordinary:]
        return jnp.log(risk + (jnp.mean(stressed) if stressed.size else 0.0) + 1e-30) + self.weight * shortfalls

    def penalty(self, space: Any, x: Array) -> Array:
        """Shortfall of the theorem's conditions at x [m]."""
        return shortfall(dict(zip(space.paths, space.gains_at(x), strict=True)), self.conditions, self.margin)

    def score(self, space: Any, x: np.ndarray, terms: dict[str, np.ndarray], who: Members) -> np.ndarray:
        """The goal [S] from terms [S, N] of members [N]; +inf where it is not a number."""
        losses, ordinary = weigh(self.weights, terms, who.stressed), who.ordinary
        each = zip(losses, x, strict=True)
        values = np.array(
            [self.of(jnp.asarray(one), ordinary, self.penalty(space, jnp.asarray(at))) for one, at in each]
        )
        return np.where(np.isfinite(values), values, np.inf)
