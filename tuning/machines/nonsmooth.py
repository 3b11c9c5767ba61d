"""BFGS with a weak Wolfe line search, for functions that are not smooth at their minima, such as a largest peak.

Lewis and Overton, Nonsmooth optimization via quasi-Newton methods, Math. Program. 141 (2013), 135-163.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Largest change of a coordinate in a step.
LONGEST = 0.5


class Value(NamedTuple):
    """A point [m], the value of a function there, and its gradient [m]. A value of inf has no gradient."""

    x: np.ndarray
    f: float
    gradient: np.ndarray


Function = Callable[[np.ndarray], Value]


def minimise(function: Function, start: Value, iterations: int, stop: Callable[[Value], bool]) -> Value:
    """Return the lowest point that BFGS finds from `start`. `stop`: called after each step, ends the search."""
    now, H = start, 0.01 * np.eye(len(start.x))  # the first step has no estimate of the curvature
    for number in range(iterations):
        after = _line_search(function, now, -H @ now.gradient)
        if after is None:
            break
        s, y = after.x - now.x, after.gradient - now.gradient
        now = after
        if stop(now):
            break
        if s @ y > 0:
            if number == 0:
                H = np.eye(len(s)) * (s @ y) / (y @ y)
            left = np.eye(len(s)) - np.outer(s, y) / (s @ y)
            H = left @ H @ left.T + np.outer(s, s) / (s @ y)
    return now


def _line_search(function: Function, now: Value, direction: np.ndarray) -> Value | None:
    """Return a point that meets the weak Wolfe conditions, or the last one that is low enough; None: there is none.

    The constants of the conditions are 1e-4 and 0.5, as in the paper.
    """
    direction = direction * min(1.0, LONGEST / max(float(np.abs(direction).max()), 1e-300))
    slope, low, high, step, found = float(now.gradient @ direction), 0.0, math.inf, 1.0, None
    if not slope < 0:
        return None
    for _ in range(25):
        trial = function(now.x + step * direction)
        if not trial.f <= now.f + 1e-4 * step * slope:
            high = step
        elif trial.gradient @ direction < 0.5 * slope and step * np.abs(direction).max() < 2 * LONGEST:
            low, found = step, trial
        else:
            return trial
        step = (low + high) / 2 if math.isfinite(high) else 2 * step
    return found
