"""The smallest delay of the command that makes a loop unstable, by NumPy for reports, by JAX with derivatives."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from ambjax.linear.state_space import StateSpace
from ambjax.numerics.small_matrices import array_module

# PARTS: number of parts of a sample for which crossings of |L| = 1 are found. TURNS: number of further turns of L.
PARTS, TURNS = 16, 3
# Number of starts of Newton's method, and of its steps; step of log f and of the delay in its difference quotients.
STARTS, STEPS, STEP = 8, 8, 1e-5
# Largest |log(-L)| at a solution, and largest change of log f from its start.
SOLVED, FAR = 1e-5, 0.5


@functools.partial(np.errstate(all="ignore"))
def command_delay(system: StateSpace, f: Any) -> Any:
    """Return the smallest additional delay (s) of the command that makes a stable loop unstable; inf if none does.

    `f`: frequencies of the scan [F], Hz, ascending; on a processor up to half the sampling rate. A delay of the held
    command by a part of a sample changes the phase of L and, near half the sampling rate, also its magnitude.
    Newton's method therefore solves L = -1 for the frequency and the delay. The derivative is that of the implicit
    function.
    """
    np_ = array_module(system.A)
    fixed = lax.stop_gradient(system) if np_ is jnp else system
    # of delays, s: a sample, or in continuous time a part of a period of the highest frequency
    unit = 1 / f[-1] if system.period is None else np_.asarray(system.period)
    steps = STEP * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])

    def around(x: Any) -> tuple[Any, Any, Any]:
        """Return log(-L), which is 0 at a solution, and its derivatives with respect to both x [K, 2]."""
        at = (x + steps[:, None]).reshape(-1, 2)
        L = fixed.loop_transfer(np_.exp(at[:, 0]), "command", unit * at[:, 1]).reshape(5, -1)
        return np_.log(-L[0]), np_.log(L[1] / L[2]) / (2 * STEP), np_.log(L[3] / L[4]) / (2 * STEP)

    def step(_: Any, x: Any) -> Any:
        error, along, across = around(x)
        moves = np_.stack([_cross(error, across), _cross(along, error)], 1) / _cross(along, across)[:, None]
        return np_.where(np_.isfinite(moves), x - moves, x)

    start = _starts(fixed, f, unit)
    x = np_.where(np_.isfinite(start), start, 0.0)
    x = lax.fori_loop(0, STEPS, step, x) if np_ is jnp else functools.reduce(lambda x, n: step(n, x), range(STEPS), x)
    error, along, across = around(x)
    valid = np_.isfinite(start[:, 1]) & (x[:, 1] > 0) & (abs(error) < SOLVED)
    valid &= (abs(x[:, 0] - start[:, 0]) < FAR) & (x[:, 0] <= np_.log(f[-1]) + SOLVED)
    k = np_.argmin(np_.where(valid, x[:, 1], np.inf))
    # one more Newton step, with the derivatives of the system
    error = np_.log(-system.loop_transfer(np_.exp(x[k, :1]), "command", unit * x[k, 1])[0])
    rate = np_.where(valid[k], _cross(along[k], across[k]), 1.0)
    return np_.where(valid[k], unit * (x[k, 1] - _cross(along[k], np_.where(valid[k], error, 0.0)) / rate), np.inf)


def _cross(a: Any, b: Any) -> Any:
    """Return the determinant of the real and imaginary parts of two numbers."""
    return a.real * b.imag - a.imag * b.real


def _starts(system: StateSpace, f: Any, unit: Any) -> Any:
    """Return the logarithm of the frequency (Hz) and the additional delay of starts [STARTS, 2]; delay inf: none.

    |L| depends only on the part of a sample by which the command is delayed. The crossings of |L| = 1 are therefore
    found for PARTS parts. At each crossing, the phase of L gives the delay that rotates L to -1. It is a start if it
    ends with nearly the same part of a sample.
    """
    np_, sampled = array_module(system.A), system.period is not None
    parts, slack = ((np_.arange(PARTS)[:, None] + 0.5) / PARTS, 1 / PARTS) if sampled else (np_.zeros((1, 1)), np.inf)
    own = system.known_path.delay
    L = system.loop_transfer(f, "command", unit * (parts - own))
    size, log_f = np_.log(abs(L)), np_.log(f)
    share = size[:, :-1] / (size[:, :-1] - size[:, 1:])
    at = log_f[:-1] + share * (log_f[1:] - log_f[:-1])
    turn = np_.exp(at) * unit
    whole = (np_.angle(-L[:, :-1]) + share * np_.angle(L[:, 1:] / L[:, :-1])) / (2 * np.pi * turn)
    whole += np_.ceil((own - parts - (slack if sampled else 0.0) - whole) * turn) / turn
    samples = whole + np_.arange(TURNS)[:, None, None] / turn
    near = (abs(samples - np_.round(samples)) <= slack) & (size[:, :-1] * size[:, 1:] < 0)
    late = np_.where(near, parts + samples - own, np.inf)
    both = np_.stack([np_.broadcast_to(at, late.shape), late], -1).reshape(-1, 2)
    if sampled:
        both = np_.concatenate([both, _alternating(system, unit)])
    return both[np_.argsort(both[:, 1])[:STARTS]]


def _alternating(system: StateSpace, unit: Any) -> Any:
    """Return starts up to two samples at which a pole lies near z = -1, where L is real, in the form of `_starts`."""
    np_ = array_module(system.A)
    late, nyquist = np_.arange(2 * PARTS + 1) / PARTS, 0.5 / unit
    distance = 1 + system.loop_transfer(nyquist[None], "command", unit * late[:, None])[:, 0].real
    between = late[:-1] + distance[:-1] / (distance[:-1] - distance[1:]) / PARTS
    between = np_.where(distance[:-1] * distance[1:] < 0, between, np.inf)
    return np_.stack([np_.full(between.shape, 1.0) * np_.log(nyquist), between], 1)
