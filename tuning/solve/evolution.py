"""CMA-ES: a derivative-free search for goals whose derivatives do not lead to a minimum.

A population is drawn from a normal distribution. Its better half updates the mean, the covariance and the step size.
The parameters are the defaults of N. Hansen, The CMA Evolution Strategy: A Tutorial, arXiv:1604.00772 (2023), Table 1,
without negative weights.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from tuning.solve.descent import FIRST_RADIUS

# A search has converged if PATIENCE populations in a row do not lower `CmaState.level`, a logarithm, by STALL.
STALL, PATIENCE = 0.01, 6


class CmaState(NamedTuple):
    """State of the distribution: mean [m], step size, covariance [m, m] in units of size^2, evolution paths [m]."""

    mean: Any
    size: Any
    covariance: Any
    path: Any
    """evolution path in coordinates of unit covariance, which adapts the step size"""
    drift: Any
    """evolution path of the mean, which adapts the covariance"""
    drawn: Any
    """number of populations so far; -1: the search does not use CMA-ES"""
    level: Any
    """lowest weighted mean of the better half of a population, updated only if it falls by STALL"""
    stale: Any
    """number of populations since the last update of `level`"""

    @property
    def reach(self) -> float:
        """Standard deviation along the longest axis."""
        return float(self.size * np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def converged(self) -> bool:
        """Whether the search has converged. Whole populations decide, because one point may be better by chance."""
        return bool(self.stale >= PATIENCE)


class Rates(NamedTuple):
    """Parameters in m dimensions: `weights` of the better half [h], and their `effective` number.

    `size`, `drift`: learning rates of the evolution paths `path` and `drift`. `damping`: of the step size. `one`,
    `many`: learning rates of the rank-one and the rank-many (rank-mu) update of the covariance.
    """

    weights: np.ndarray
    effective: float
    size: float
    damping: float
    drift: float
    one: float
    many: float


def rates(m: int) -> Rates:
    """Return the default parameters for m dimensions."""
    half = population(m) // 2
    weights = math.log((population(m) + 1) / 2) - np.log(np.arange(1, half + 1))
    weights = weights / weights.sum()
    e = float(1 / (weights**2).sum())
    size = (e + 2) / (m + e + 5)
    damping = 1 + 2 * max(0.0, math.sqrt((e - 1) / (m + 1)) - 1) + size
    drift = (4 + e / m) / (m + 4 + 2 * e / m)
    one = 2 / ((m + 1.3) ** 2 + e)
    many = min(1 - one, 2 * (0.25 + e + 1 / e - 2) / ((m + 2) ** 2 + e))
    return Rates(weights, e, size, damping, drift, one, many)


def population(m: int) -> int:
    """Return the population size in m dimensions."""
    return 4 + int(3 * math.log(m))


def initial_state(mean: np.ndarray) -> CmaState:
    """Return the initial distribution around a point [m]. Its step size is that of the first step of a descent."""
    m = len(mean)
    return CmaState(
        mean, np.array(FIRST_RADIUS), np.eye(m), np.zeros(m), np.zeros(m), np.array(0), np.array(np.inf), np.array(0)
    )


def idle_state(m: int) -> CmaState:
    """Return a distribution in m dimensions that is not in use."""
    return initial_state(np.zeros(m))._replace(drawn=np.array(-1))


def next_population(state: CmaState, seed: int) -> np.ndarray:
    """Return the next population [n, m]."""
    m = len(state.mean)
    normal = np.random.default_rng([seed, int(state.drawn)]).standard_normal((population(m), m))
    return state.mean + state.size * normal @ _root(state.covariance).T


def updated(state: CmaState, points: np.ndarray, values: np.ndarray) -> CmaState:
    """Return the distribution after an update with the values [n] of its last population, `points` [n, m]."""
    m, now = len(state.mean), int(state.drawn) + 1
    r = rates(m)
    order = np.argsort(values, kind="stable")[: len(r.weights)]
    steps = (points[order] - state.mean) / state.size
    step = r.weights @ steps
    unit = np.linalg.solve(_root(state.covariance), step)
    path = (1 - r.size) * state.path + math.sqrt(r.size * (2 - r.size) * r.effective) * unit
    expected = math.sqrt(m) * (1 - 1 / (4 * m) + 1 / (21 * m**2))
    length = float(np.linalg.norm(path))
    steady = length / math.sqrt(1 - (1 - r.size) ** (2 * now)) < (1.4 + 2 / (m + 1)) * expected
    drift = (1 - r.drift) * state.drift + steady * math.sqrt(r.drift * (2 - r.drift) * r.effective) * step
    kept = 1 - r.one - r.many + (not steady) * r.one * r.drift * (2 - r.drift)
    covariance = kept * state.covariance + r.one * np.outer(drift, drift) + r.many * (steps.T * r.weights) @ steps
    size = state.size * math.exp(min(1.0, (r.size / r.damping) * (length / expected - 1)))
    level = float(r.weights @ values[order])
    better = level < state.level - STALL
    level, stale = (level, 0) if better else (state.level, state.stale + 1)
    mean = state.mean + state.size * step
    return CmaState(mean, np.array(size), covariance, path, drift, np.array(now), np.array(level), np.array(stale))


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return the symmetric square root of a covariance [m, m]."""
    squares, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    return (axes * np.sqrt(np.maximum(squares, 1e-20))) @ axes.T
