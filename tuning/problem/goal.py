"""The goal: the number that the search minimises, computed from the losses of the members and from the gains."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.extend import Scalar, record, static
from tuning.problem.limits import LimitTerm
from tuning.problem.loss import outcomes
from tuning.problem.members import Members
from tuning.problem.quantities import KINDS
from tuning.problem.risk import Risk
from tuning.problem.shortfalls import Bound, shortfall
from tuning.problem.space import Space

# Largest goal, a logarithm, whose exponential does not overflow.
MOST = np.log(np.finfo(float).max)


def shown(goal: np.ndarray | float) -> np.ndarray:
    """Return exp(`goal`), at most exp(MOST), for a text or a picture. It is huge if a limit is far from met."""
    return np.exp(np.minimum(goal, MOST))


@record
class Goal:
    """The function that a search minimises, a pytree whose leaves are `weight`, `margin` and the limits' numbers.

    goal = log(risk(losses) + mean(losses of stressed members)) + weight * shortfall(conditions) + sum(limits).
    The risk and the limits include ordinary members only. `margin` is the relative margin of the conditions.
    `quantities`: names of the limited or minimised quantities, in the order of their columns in `outcomes`.
    `minimised`: one of these names, or empty. If it is not empty, the square of `unit` times this quantity is added to
    the risk. The caller then sets the weights of errors and costs to 0 (`TuningProblem.towards_voltage`).
    """

    space: Space = static()
    weights: tuple[float, ...] = static()
    risk: Risk = static()
    conditions: tuple[Bound, ...] = static()
    weight: Scalar
    margin: Scalar
    limits: tuple[LimitTerm, ...] = ()
    quantities: tuple[str, ...] = static(default=())
    minimised: str = static(default="")
    unit: Scalar = 1.0

    def __call__(self, outcomes: Array, x: Array, ordinary: int) -> Array:
        """Return the goal at coordinates x [m].

        `outcomes` [N, 1 + L]: the weighted loss and the `quantities` of each member. The first `ordinary`
        members are not stressed.
        """
        stressed = outcomes[ordinary:, 0]
        loss = self.ordinary_risk(outcomes[:ordinary]) + (jnp.mean(stressed) if stressed.size else 0.0)
        return jnp.log(loss + 1e-30) + self.weight * self.penalty(x) + self.pull(outcomes[:ordinary, 1:])

    def ordinary_risk(self, outcomes: Array) -> Array:
        """Return the risk of the ordinary members' `outcomes` [N, 1 + L], plus the square of the minimised quantity."""
        risk = self.risk(outcomes[:, 0])
        if not self.minimised:
            return risk
        values = outcomes[:, 1 + self.quantities.index(self.minimised)]
        return risk + (self.unit * KINDS[self.minimised].tuned(values)) ** 2

    def penalty(self, x: Array) -> Array:
        """Return the shortfall of the theorem's conditions at coordinates x [m]."""
        return shortfall(dict(zip(self.space.paths, self.space.gains_at(x), strict=True)), self.conditions, self.margin)

    def pull(self, held: Array) -> Array | int:
        """Return the sum of the limits' terms for the quantities `held` [N, L] of the ordinary members."""
        return sum(term(held[:, self.quantities.index(term.name)]) for term in self.limits)

    def score(self, x: np.ndarray, terms: dict[str, np.ndarray], members: Members) -> np.ndarray:
        """Return the goal [S] at x [S, m] from the terms [S, N] of members [N]; +inf where it is not finite."""
        each = zip(np.stack(outcomes(self.weights, terms, members.stressed), -1), x, strict=True)
        values = np.array([_compiled(self, one, at, members.ordinary) for one, at in each])
        return np.where(np.isfinite(values), values, np.inf)


@partial(jax.jit, static_argnames="ordinary")
def _compiled(goal: Goal, outcomes: Array, x: Array, ordinary: int) -> Array:
    return goal(outcomes, x, ordinary)
