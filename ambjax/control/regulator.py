"""Optimal gains (LQR) of a state feedback with integral action, for the mechanics linearised at the origin."""

import numpy as np

from ambjax.control.force import linear_mechanics
from ambjax.numerics.small_matrices import held
from ambjax.world.plant import Plant

# Weights: the error, as a share of s_0, and the current, as a share of i_0, that cost the same.
ERROR, CURRENT = 0.1, 0.1
# An error that lasts for the time 1/(INTEGRAL w) has an integral that costs as much as the error itself.
INTEGRAL = 0.2
# Longest sample period for which gains are designed, times the fastest rate of the mechanics.
LONGEST = 0.5
# Most doublings of the horizon: 2^60 samples.
MOST_DOUBLINGS = 60


def discretised(A: np.ndarray, B: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the map of one period (s) with the input held; the integral takes a step of explicit Euler."""
    from scipy.linalg import expm

    F, G = np.eye(3), np.zeros((3, 1))
    F[0, 1], (F[1:, 1:], G[1:]) = period, held(A[1:, 1:], B[1:], period, expm)
    return F, G


def riccati_gain(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, continuous: bool = False) -> np.ndarray:
    """Return K of the feedback u = -K x that minimises the integral, or sum, of x'Q x + u'R u for x' or x+ = A x + B u.

    With A', B' and the covariances of the noises in the places of A, B, Q and R, K' is the gain of the Kalman filter.
    Raises ValueError if the Riccati equation has no solution in floating-point numbers.
    """
    try:
        if continuous:
            import scipy.linalg

            return np.linalg.solve(R, B.T @ scipy.linalg.solve_continuous_are(A, B, Q, R))
        P = doubled(A, B, Q, R)
        return np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    except (np.linalg.LinAlgError, ValueError):
        raise ValueError("the model has no optimal gains: its Riccati equation has no finite solution") from None


def doubled(A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the stabilising solution of the discrete Riccati equation, by doubling of the horizon.

    E. K.-W. Chu, H.-Y. Fan, W.-W. Lin and C.-S. Wang, Int. J. Control 77 (2004) 767-788. Unlike SciPy's solver, it does
    not reorder eigenvalues, which fails for lightly damped modes. Raises ValueError if it does not converge.
    """
    G, P, n = B @ np.linalg.solve(R, B.T), Q, len(A)
    for _ in range(MOST_DOUBLINGS):
        before = P
        W = np.linalg.solve(np.eye(n) + G @ P, np.hstack([A, G]))
        G, P, A = G + A @ W[:, n:] @ A.T, P + A.T @ P @ W[:, :n], A @ W[:, :n]
        G, P = (G + G.T) / 2, (P + P.T) / 2
        if np.linalg.norm(P - before) <= np.finfo(float).eps * np.linalg.norm(P):
            return P
    raise ValueError("no convergence")


def optimal_gains(model: Plant, period: float | None = None) -> np.ndarray:
    """Return the gains K [3] of the feedback i = -K x, x = (integral of the error, error, its rate), in SI units.

    It minimises the integral, or sum, of a cost by Bryson's rule (A. E. Bryson and Y.-C. Ho, Applied Optimal Control,
    1975, 5.2), with the weights ERROR, CURRENT and INTEGRAL.

    `model`: its parameters are concrete numbers. `period`: sample period, s, replaced by LONGEST over the fastest rate
    if it is longer; None: continuous time. Raises ValueError if the Riccati equation has no solution in floating-point
    numbers, or if a gain is not positive, as for a rotor on springs much stiffer than the magnets.
    """
    # x' = A x + B i in the unit of time 1/w and the units of error and current that cost the same: numbers of order one
    (s, b), w = map(float, linear_mechanics(model)), float(model.pole)
    error, current = ERROR * float(model.s_0), CURRENT * float(model.i_0)
    A = np.array([[0, 1, 0], [0, 0, 1], [0, s / w**2, 0.0]])
    B = np.array([[0], [0], [b * current / (error * w**2)]])
    if period is not None:
        fastest = max(1.0, abs(A[2, 1]) ** 0.5)
        A, B = discretised(A, B, min(period * w, LONGEST / fastest))
    K = riccati_gain(A, B, np.diag([INTEGRAL**2, 1.0, 0.0]), np.eye(1), period is None)
    gains = K[0] * np.array([w, 1.0, 1 / w]) * current / error
    if not np.all((gains > 0) & np.isfinite(gains)):
        raise ValueError(f"the model has no positive optimal gains: {', '.join(f'{x:.3g}' for x in gains)}")
    return gains
