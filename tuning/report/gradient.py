"""What a gradient is worth: three ways to the same number, growth with the horizon, signal against noise."""

import dataclasses
from typing import Any

import numpy as np

from tuning.objective.engine import Engine
from tuning.objective.loss import weigh
from tuning.objective.members import Members
from tuning.problem import Problem

# Samples over which the three ways are compared, members that take part, and the step of the differences.
SAMPLES, FEW, STEP = 500, 4, 1e-3
HORIZONS = (0.125, 0.25, 0.5)


def _shorter(problem: Problem, samples: int) -> Any:
    """The objective over fewer samples; settled from the same share of them on."""
    objective = problem.objective
    clock = dataclasses.replace(objective.clock, samples=samples)
    # and a sample at least is settled
    settle = min(objective.loss.settle * samples / objective.clock.samples, (samples - 1) * clock.sample_period)
    return dataclasses.replace(objective, clock=clock, loss=dataclasses.replace(objective.loss, settle=settle))


def three_ways(problem: Problem, x: np.ndarray) -> dict[str, Any]:
    """Gradient [m] of the mean loss at x [m] by forward and reverse mode and by Richardson-extrapolated differences."""
    objective = _shorter(problem, min(SAMPLES, problem.objective.clock.samples))
    who = objective.members(problem.tune.budget.seed, min(FEW, problem.tune.budget.members))
    weights = problem.goal.weights
    settle = float(np.asarray(objective.loss.settle))
    forward, reverse = (Engine(objective, settle=settle, mode=mode, lanes=16) for mode in ("forward", "reverse"))
    by_forward = forward.gradient(x[None], who, weights)[1][0, :, 0].mean(axis=0)
    by_reverse = reverse.gradient(x[None], who, weights)[1][0, :, 0].mean(axis=0)
    steps = np.concatenate([s * STEP * np.eye(len(x)) for s in (1, -1, 0.5, -0.5)])
    terms = forward.terms(x + steps, who)
    values = weigh(weights, terms, who.stressed).mean(axis=1)
    up, down, half_up, half_down = np.reshape(values, (4, len(x)))
    differences = (4 * (half_up - half_down) / STEP - (up - down) / (2 * STEP)) / 3
    return {
        "forward": by_forward,
        "reverse": by_reverse,
        "differences": differences,
        "samples": objective.clock.samples,
    }


def against_horizon(problem: Problem, x: np.ndarray, who: Members) -> list[dict[str, float]]:
    """Norm of the gradient of the log of the mean loss, and share of lost members, by horizon in s; where it is 0,
    as it may be over a sample or two, there is no log, and no row."""
    rows, all_ = [], problem.objective.clock.samples
    for samples in sorted({max(round(share * all_), 1) for share in (*HORIZONS, 1.0)}):
        objective = _shorter(problem, samples)
        engine = problem.engine if samples == all_ else Engine(objective, settle=float(objective.loss.settle))
        few = who.part(4)
        outcomes, slopes, terms = engine.gradient(x[None], few, problem.goal.weights)
        if not outcomes[0, :, 0].mean():
            continue
        rows.append(
            {
                "horizon_s": float(samples * np.asarray(objective.clock.sample_period)),
                "norm": float(np.linalg.norm(slopes[0, :, 0].mean(axis=0) / outcomes[0, :, 0].mean())),
                "lost": float((terms["survival"] > 0).mean()),
            }
        )
    return rows


def signal_to_noise(problem: Problem, x: np.ndarray, who: Members) -> dict[str, Any]:
    """Mean of the members' gradients over its standard error, by gain; each member is a seed of its own."""
    outcomes, slopes, terms = problem.engine.gradient(x[None], who, problem.goal.weights)
    relative = slopes[0, :, 0] / outcomes[0, :, 0].mean()
    error = relative.std(axis=0, ddof=1) / np.sqrt(len(relative)) if len(relative) > 1 else np.full(len(x), np.nan)
    return {
        "gradient": relative.mean(axis=0),
        "standard_error": error,
        "ratio": np.abs(relative.mean(axis=0)) / error,
        "lost": float((terms["survival"] > 0).mean()),
    }


def report(problem: Problem, x: np.ndarray, who: Members) -> dict[str, Any]:
    """All of it, at coordinates x [m]."""
    return {
        "gains": problem.objective.space.paths,
        "three_ways": three_ways(problem, x),
        "horizons": against_horizon(problem, x, who),
        "noise": signal_to_noise(problem, x, who),
    }
