"""Of what the loss is made, so that a reader can add it up: what each term adds, and what the search minimised."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from tuning.objective.goal import Goal
from tuning.objective.loss import COSTS, HELD, TERMS, outcomes, weigh
from tuning.objective.members import Members
from tuning.problem import TuningProblem

# The loss of one member in words. Costs multiply: they count relative to the error.
FORMULA = f"{' + '.join(HELD)} + (tracking + peak) x (1 + {' + '.join(COSTS)})"
Facts = dict[str, Any]


def contributions(weights: Any, terms: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What each term adds to the loss of each member [N], none of them stressed: they sum to `weigh`."""
    each = {name: weights[k] * np.asarray(terms[name]) for k, name in enumerate(TERMS)}
    error = sum(values for name, values in each.items() if name not in (*COSTS, *HELD))
    return {name: error * values if name in COSTS else values for name, values in each.items()}


def table(goal: Goal, columns: dict[str, np.ndarray]) -> Facts:
    """Means over an ensemble, by term: its value and what it adds to the loss; the mean loss, and its risk.

    `columns`: those of `judge`, the terms [N] named "loss.tracking" and so on.
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
    """What the search brought down, at x [m]: the parts of its goal, (risk + held) x penalty x limits = total."""
    goal, n = problem.goal, members.ordinary
    terms = {k: v[0] for k, v in problem.engine.terms(x[None], members).items()}
    losses, *reached = outcomes(goal.weights, terms, members.stressed)
    penalty = float(goal.penalty(jnp.asarray(x)))
    pull = float(goal.pull(jnp.stack([jnp.asarray(one[:n]) for one in reached], -1))) if reached else 0.0
    parts = {
        "ordinary": n,
        "risk": float(goal.risk(jnp.asarray(losses[:n]))),
        "asked_to_be_held": len(losses) - n,
        "held": float(losses[n:].mean()) if len(losses) > n else 0.0,
        "penalty": float(np.exp(goal.weight * penalty)),
        "limits": float(np.exp(pull)),
    }
    total = (parts["risk"] + parts["held"]) * parts["penalty"] * parts["limits"]
    return parts | {"total": total, "of": str(goal.risk)}
