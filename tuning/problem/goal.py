"""The goal: the number that the search minimises, computed from the losses of the members."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.extend import Scalar, record, static
from tuning.problem.limits import LimitTerm
from tuning.problem.loss import outcomes
from tuning.problem.members import Members
from tuning.problem.quantities import KINDS, TINY

# Largest goal, a logarithm, whose exponential does not overflow.
MOST = np.log(np.finfo(float).max)


def shown(goal: np.ndarray | float) -> np.ndarray:
    """Return exp(`goal`), at most exp(MOST), for a text or a picture. It is huge if a limit is far from met."""
    return np.exp(np.minimum(goal, MOST))


@dataclasses.dataclass(frozen=True)
class CVaR:
    """Conditional value at risk: the mean of the worst share 1 - alpha of the losses; with alpha = 0, their mean.

    Rockafellar and Uryasev, J. Risk 2 (2000) 21-41. It equals the minimum over q of
    q + mean(max(l - q, 0)) / (1 - alpha), which lies at the alpha quantile. If (1 - alpha) N is not whole, the last of
    the worst members counts in part.
    """

    alpha: float = 0.0

    def __call__(self, losses: Array) -> Array:
        count = losses.shape[0]
        share = (1 - self.alpha) * count
        weights = jnp.clip(share - jnp.arange(count), 0.0, 1.0) / share
        return jnp.sum(weights * jnp.sort(losses)[::-1])

    def __str__(self) -> str:
        return f"CVaR({self.alpha:g})" if self.alpha else "mean"


@record
class Goal:
    """The function that a search minimises, a pytree whose leaves are the limits' numbers.

    goal = log(risk(losses) + mean(losses of stressed members)) + sum(limits).
    The risk and the limits include ordinary members only.
    `quantities`: names of the limited or minimised quantities, in the order of their columns in `outcomes`.
    `minimised`: one of these names, or empty. If it is not empty, the square of `unit` times this quantity is added to
    the risk. The caller then sets the weights of errors and costs to 0 (`TuningProblem.towards_voltage`).
    """

    weights: tuple[float, ...] = static()
    risk: CVaR = static()
    limits: tuple[LimitTerm, ...] = ()
    quantities: tuple[str, ...] = static(default=())
    minimised: str = static(default="")
    unit: Scalar = 1.0

    def __call__(self, outcomes: Array, ordinary: int) -> Array:
        """Return the goal.

        `outcomes` [N, 1 + L]: the weighted loss and the `quantities` of each member. The first `ordinary`
        members are not stressed.
        """
        columns = {name: outcomes[:ordinary, 1 + k] for k, name in enumerate(self.quantities)}
        stressed, loss = outcomes[ordinary:, 0], self.risk(outcomes[:ordinary, 0])
        if self.minimised:
            loss = loss + (self.unit * KINDS[self.minimised].tuned(columns[self.minimised])) ** 2
        loss = loss + (jnp.mean(stressed) if stressed.size else 0.0)
        return jnp.log(loss + TINY) + sum(term(columns[term.name]) for term in self.limits)

    def score(self, terms: dict[str, np.ndarray], members: Members) -> np.ndarray:
        """Return the goal [S] of S points from their terms [S, N] of members [N]; +inf where it is not finite."""
        each = np.stack(outcomes(self.weights, terms, members.stressed, self.quantities), -1)
        values = np.array([_compiled(self, one, members.ordinary) for one in each])
        return np.where(np.isfinite(values), values, np.inf)


_compiled = jax.jit(Goal.__call__, static_argnames="ordinary")
