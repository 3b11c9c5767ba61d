"""What a gradient is worth: three ways to the same number, growth with the horizon, signal against noise."""

import dataclasses
from typing import Any

import numpy as np

from tuning.objective.lanes import Engine
from tuning.objective.loss import weigh
from tuning.objective.members import Members
from tuning.problem import TuningProblem

# Samples over which the three ways are compared, members that take part, and the step of the differences.
SAMPLES, FEW, STEP = 500, 4, 1e-3
# By what share of the derivative two ways may differ and agree: both modes by rounding; differences of the steps STEP
# and STEP / 2 with each other, or the step resolves no slope; and their extrapolation with the modes.
MODES, STEADY, AGREE = 1e-6, 0.05, 1e-3
# Shares of the largest derivative and of the loss below which two ways agree: rounding.
NOTHING, ROUNDING = 1e-6, 1e-9
AGREED = "agree"
HORIZONS = (0.125, 0.25, 0.5)


def _shorter(problem: TuningProblem, samples: int) -> Any:
    """The objective over fewer samples; settled from the same share of them on."""
    objective = problem.objective
    clock = dataclasses.replace(objective.clock, samples=samples)
    # and a sample at least is settled
    settle = min(objective.loss.settle * samples / objective.clock.samples, (samples - 1) * clock.sample_period)
    return dataclasses.replace(objective, clock=clock, loss=dataclasses.replace(objective.loss, settle=settle))


def three_ways(problem: TuningProblem, x: np.ndarray) -> dict[str, Any]:
    """Gradient [m] of the mean loss at x [m] by forward and reverse mode and by Richardson-extrapolated differences.

    `coarse`, `fine`: the central differences of the steps STEP and STEP / 2 that are extrapolated. `verdicts`: by gain,
    whether the three agree (`verdict`); `agree`: whether they do for every gain.
    """
    objective = _shorter(problem, min(SAMPLES, problem.objective.clock.samples))
    members = objective.members(problem.tune.budget.seed, min(FEW, problem.tune.budget.members))
    weights = problem.goal.weights
    settle = float(np.asarray(objective.loss.settle))
    forward, reverse = (Engine(objective, settle=settle, mode=mode, lanes=16) for mode in ("forward", "reverse"))
    by_forward = forward.gradient(x[None], members, weights)[1][0, :, 0].mean(axis=0)
    by_reverse = reverse.gradient(x[None], members, weights)[1][0, :, 0].mean(axis=0)
    steps = np.concatenate([s * STEP * np.eye(len(x)) for s in (1, -1, 0.5, -0.5)])
    terms = forward.terms(x + steps, members)
    values = weigh(weights, terms, members.stressed).mean(axis=1)
    up, down, half_up, half_down = np.reshape(values, (4, len(x)))
    coarse, fine = (up - down) / (2 * STEP), (half_up - half_down) / STEP
    floor = float(max(NOTHING * np.abs([by_forward, by_reverse]).max(), ROUNDING * np.abs(values).max()))
    columns = zip(by_forward, by_reverse, coarse, fine, strict=True)
    verdicts = [verdict(a, b, c, d, floor) for a, b, c, d in columns]
    return {
        "forward": by_forward,
        "reverse": by_reverse,
        "differences": extrapolated(coarse, fine),
        "coarse": coarse,
        "fine": fine,
        "verdicts": verdicts,
        "agree": all(one == AGREED for one in verdicts),
        "samples": objective.clock.samples,
    }


def extrapolated(coarse: Any, fine: Any) -> Any:
    """Richardson's extrapolation of central differences with a step and its half."""
    return (4 * fine - coarse) / 3


def verdict(forward: float, reverse: float, coarse: float, fine: float, floor: float) -> str:
    """Whether three ways to a derivative agree, in words: AGREED, or what was measured that speaks against it.

    `coarse`, `fine`: central differences of the steps STEP and STEP / 2. What differs by less than `floor` agrees.
    """

    def apart(a: float, b: float) -> float:
        """The difference beyond `floor`, as a share of the larger."""
        return max(abs(a - b) - floor, 0.0) / max(abs(a), abs(b), floor)

    if not np.isfinite([forward, reverse, coarse, fine]).all():
        return "no finite number by every way"
    if apart(forward, reverse) > MODES:
        return f"forward and reverse mode differ by {100 * apart(forward, reverse):.2g} %: rounding grows along the run"
    if apart(coarse, fine) > STEADY:
        return f"differences decide nothing: {coarse:.2e} with a step of {STEP:g}, {fine:.2e} with {STEP / 2:g}"
    found = extrapolated(coarse, fine)
    if apart(found, forward) > AGREE:
        return f"differences differ from both modes by {100 * apart(found, forward):.2g} %, whatever their step"
    return AGREED


def against_horizon(problem: TuningProblem, x: np.ndarray, members: Members) -> list[dict[str, float]]:
    """Norm of the gradient of the log of the mean loss, and share of lost members, by horizon in s; where it is 0,
    as it may be over a sample or two, there is no log, and no row."""
    rows, all_ = [], problem.objective.clock.samples
    for samples in sorted({max(round(share * all_), 1) for share in (*HORIZONS, 1.0)}):
        objective = _shorter(problem, samples)
        engine = problem.engine if samples == all_ else Engine(objective, settle=float(objective.loss.settle))
        few = members.part(4)
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


def signal_to_noise(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, Any]:
    """Mean of the members' gradients over its standard error, by gain; each member is a seed of its own."""
    outcomes, slopes, terms = problem.engine.gradient(x[None], members, problem.goal.weights)
    relative = slopes[0, :, 0] / outcomes[0, :, 0].mean()
    error = relative.std(axis=0, ddof=1) / np.sqrt(len(relative)) if len(relative) > 1 else np.full(len(x), np.nan)
    return {
        "gradient": relative.mean(axis=0),
        "standard_error": error,
        "ratio": np.abs(relative.mean(axis=0)) / error,
        "lost": float((terms["survival"] > 0).mean()),
    }


def report(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, Any]:
    """All of it, at coordinates x [m]."""
    return {
        "gains": problem.objective.space.paths,
        "three_ways": three_ways(problem, x),
        "horizons": against_horizon(problem, x, members),
        "noise": signal_to_noise(problem, x, members),
    }
