"""Breakdown of the loss: the contribution of each term, and the parts of the minimised goal."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from tuning.problem.goal import Goal, shown
from tuning.problem.loss import COSTS, HELD, TERMS, outcomes, weigh
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem

# The loss of one member as a formula. The costs are factors of the error.
FORMULA = f"{' + '.join(HELD)} + (tracking + peak) x (1 + {' + '.join(COSTS)})"
Facts = dict[str, Any]


def contributions(weights: Sequence[float], terms: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the contribution of each term to the loss of each unstressed member [N]; the sum is `weigh`."""
    each = {name: weights[k] * np.asarray(terms[name]) for k, name in enumerate(TERMS)}
    error = sum(values for name, values in each.items() if name not in (*COSTS, *HELD))
    return {name: error * values if name in COSTS else values for name, values in each.items()}


def loss_breakdown(goal: Goal, columns: dict[str, np.ndarray]) -> Facts:
    """Return, for an ensemble, the mean value and mean contribution of each term, the mean loss, and the risk.

    `columns`: the columns of `judge`; the terms [N] are named "loss.tracking" and so on.
    """
    terms = {name: np.asarray(columns[f"loss.{name}"]) for name in TERMS}
    adds = contributions(goal.weights, terms)
    losses = weigh(goal.weights, terms, np.zeros(len(terms["survival"]), bool))
    return {
        "mean": {name: float(values.mean()) for name, values in terms.items()},
        "adds": {name: float(values.mean()) for name, values in adds.items()},
        "loss": float(losses.mean()),
        "risk": float(goal.risk(jnp.asarray(losses))),
    }


def minimised(problem: TuningProblem, x: np.ndarray, members: Members) -> Facts:
    """Return the parts of the minimised goal at x [m]: (risk + held) x penalty x limits = total."""
    goal, n = problem.goal, members.ordinary
    terms = {k: v[0] for k, v in problem.engine.terms(x[None], members).items()}
    losses, *reached = outcomes(goal.weights, terms, members.stressed)
    penalty = float(goal.penalty(jnp.asarray(x)))
    pull = float(goal.pull(jnp.stack([jnp.asarray(one[:n]) for one in reached], -1))) if reached else 0.0
    parts = {
        "ordinary": n,
        "risk": float(goal.ordinary_risk(jnp.asarray(np.stack([losses, *reached], -1)[:n]))),
        "survival_only": len(losses) - n,
        "held": float(losses[n:].mean()) if len(losses) > n else 0.0,
        "penalty": float(np.exp(goal.weight * penalty)),
        "limits": float(shown(pull)),
    }
    total = (parts["risk"] + parts["held"]) * parts["penalty"] * parts["limits"]
    return parts | {"total": total, "of": _of(goal)}


def _of(goal: Goal) -> str:
    """Describe what the risk is."""
    if not goal.minimised:
        return f"{goal.risk} of the loss"
    square = f"mean square of {goal.minimised} in units of {1 / float(goal.unit):.4g} V"
    return f"{square}, plus {goal.risk} of clearance + survival"
