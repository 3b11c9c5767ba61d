"""Quality of the gradient: agreement of three ways to compute it, growth with the horizon, signal-to-noise ratio."""

import dataclasses
from typing import TypeVar

import numpy as np

from tuning.objective.lanes import Engine
from tuning.objective.loss import weigh
from tuning.objective.members import Members, Objective
from tuning.problem import TuningProblem

Number = TypeVar("Number", float, np.ndarray)

# Number of samples over which the three ways are compared, number of members, and step of the differences.
SAMPLES, FEW, STEP = 500, 4, 1e-3
# Largest relative differences at which two ways agree: forward and reverse mode; central differences with the steps
# STEP and STEP / 2 (beyond it the step does not resolve the slope); their extrapolation and the modes.
MODES, STEADY, AGREE = 1e-6, 0.05, 1e-3
# Differences below these shares of the largest derivative and of the loss count as rounding errors.
NOTHING, ROUNDING = 1e-6, 1e-9
AGREED = "agree"
# Horizons, as shares of the run, for which the norm of the gradient is computed; the whole run is added.
HORIZONS = (0.125, 0.25, 0.5)


def _shorter(problem: TuningProblem, samples: int) -> Objective:
    """Return the objective over fewer samples; the settled part starts at the same share of them."""
    objective = problem.objective
    clock = dataclasses.replace(objective.clock, samples=samples)
    # at least one sample is settled
    settle = min(objective.loss.settle * samples / objective.clock.samples, (samples - 1) * clock.sample_period)
    return dataclasses.replace(objective, clock=clock, loss=dataclasses.replace(objective.loss, settle=settle))


def three_ways(problem: TuningProblem, x: np.ndarray) -> dict[str, object]:
    """Compute the gradient [m] of the mean loss at x [m] by forward mode, reverse mode and extrapolated differences.

    Returns plain data. `coarse`, `fine`: central differences with the steps STEP and STEP / 2. `verdicts`: for each
    gain, whether the three agree (`agreement`). `agree`: whether they agree for every gain.
    """
    objective = _shorter(problem, min(SAMPLES, problem.objective.clock.samples))
    members = objective.members(problem.tune.budget.seed, min(FEW, problem.tune.budget.members))
    weights = problem.error_goal.weights
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
    verdicts = [agreement(a, b, c, d, floor) for a, b, c, d in columns]
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


def extrapolated(coarse: Number, fine: Number) -> Number:
    """Return Richardson's extrapolation of central differences with a step and with half of it."""
    return (4 * fine - coarse) / 3


def agreement(forward: float, reverse: float, coarse: float, fine: float, floor: float) -> str:
    """Return AGREED if three ways to a derivative agree, else a description of the difference.

    `coarse`, `fine`: central differences with the steps STEP and STEP / 2. Differences below `floor` are ignored.
    """

    def apart(a: float, b: float) -> float:
        """Return the difference beyond `floor`, relative to the larger number."""
        return max(abs(a - b) - floor, 0.0) / max(abs(a), abs(b), floor)

    if not np.isfinite([forward, reverse, coarse, fine]).all():
        return "a derivative is not finite"
    if apart(forward, reverse) > MODES:
        return f"forward and reverse mode differ by {100 * apart(forward, reverse):.2g} %: rounding grows along the run"
    if apart(coarse, fine) > STEADY:
        return f"differences are inconclusive: {coarse:.2e} with a step of {STEP:g}, {fine:.2e} with {STEP / 2:g}"
    found = extrapolated(coarse, fine)
    if apart(found, forward) > AGREE:
        return f"differences differ from both modes by {100 * apart(found, forward):.2g} % with both steps"
    return AGREED


def against_horizon(problem: TuningProblem, x: np.ndarray, members: Members) -> list[dict[str, float]]:
    """Return, by horizon (s), the norm of the gradient of the log of the mean loss, and the share of lost members.

    Only a part of the members is simulated (`Members.part(4)`). A horizon with a loss of 0, possible over one or two
    samples, has no row.
    """
    rows, all_ = [], problem.objective.clock.samples
    for samples in sorted({max(round(share * all_), 1) for share in (*HORIZONS, 1.0)}):
        objective = _shorter(problem, samples)
        engine = problem.engine if samples == all_ else Engine(objective, settle=float(objective.loss.settle))
        few = members.part(4)
        outcomes, slopes, terms = engine.gradient(x[None], few, problem.error_goal.weights)
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


def signal_to_noise(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, object]:
    """Return the mean gradient of the log loss over members, its standard error, and their ratio, by gain.

    `lost`: share of lost members.
    """
    outcomes, slopes, terms = problem.engine.gradient(x[None], members, problem.error_goal.weights)
    relative = slopes[0, :, 0] / outcomes[0, :, 0].mean()
    error = relative.std(axis=0, ddof=1) / np.sqrt(len(relative)) if len(relative) > 1 else np.full(len(x), np.nan)
    return {
        "gradient": relative.mean(axis=0),
        "standard_error": error,
        "ratio": np.abs(relative.mean(axis=0)) / error,
        "lost": float((terms["survival"] > 0).mean()),
    }


def gradient_report(problem: TuningProblem, x: np.ndarray, members: Members) -> dict[str, object]:
    """Return the data of the whole gradient report at coordinates x [m].

    The gradient is that of the loss, also if the search minimised the voltage.
    """
    return {
        "gains": problem.objective.space.paths,
        "three_ways": three_ways(problem, x),
        "horizons": against_horizon(problem, x, members),
        "noise": signal_to_noise(problem, x, members),
    }
