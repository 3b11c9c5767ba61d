"""LQG of a whole rotor: a Kalman filter of rotor, magnets and delay, and an optimal feedback of its estimate.

The filter also estimates a constant force at each magnet, and the feedback keeps the rotor centred in the magnets under
these forces and the weight. The sensors then read what the bending of the shaft moves them by.
"""

from typing import Any, NamedTuple

import numpy as np

from ambjax.control.regulator import riccati_gain
from ambjax.numerics.records import Scalar, bounded, leaf, record
from ambjax.numerics.small_matrices import held


def _size(unit: str, most: float, doc: str) -> Any:
    """Declare a weight or a standard deviation. None: its default for the machine."""
    return leaf(default=None, unit=unit, above=0, at_most=most, doc=doc)


@record
class LqgWeights:
    """Weights of the design. The feedback minimises the sum of the squares of displacements and commands, each
    relative to its weight; the filter assumes white noise of readings and forces with these standard deviations.
    """

    error: Scalar | None = _size("m", 1.0, "displacement at a sensor that costs as much as `current`; none: s_0/400")
    current: Scalar | None = _size(
        "A", 1e6, "current, and the command that changes it in 1/w, w the pole of the magnets; none: i_0/10"
    )
    noise: Scalar | None = _size(
        "m", 1.0, "noise of a reading, and that of a current as a share of `current`; none: s_0/2000"
    )
    force: Scalar | None = _size(
        "N", 1e9, "force at each magnet, another one in each sample; none: that of the current i_0"
    )
    drift: Scalar | None = _size(
        "N/s", 1e12, "change of the constant force at each magnet in a second; none: 0.03 w times `force`"
    )
    bending: Scalar = bounded(
        0.3, "1", 0, 1e3,
        "force on each bending mode of its own, as a share of `force` at the magnet where its shape is largest",
    )  # fmt: skip


class LinearCoils(NamedTuple):
    """Linear magnets and coils of the c axes, each [c]: F = k_s z + k_i i, i' = (u - R i)/L + motional z'.

    If the command is a current, R = 1, and L is the time constant of the amplifier (s).
    """

    k_s: np.ndarray
    k_i: np.ndarray
    R: np.ndarray
    L: np.ndarray
    motional: np.ndarray


class RotorModel(NamedTuple):
    """M q'' + D q' + K q = B' F + weight [n], with z = B q at the magnets and C q at the sensors, [c, n] each.

    D contains the gyroscopic matrix at one speed. `constant`: the weight and the forces that carry it, [n].
    """

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    B: np.ndarray
    C: np.ndarray
    constant: np.ndarray


class DesignedController(NamedTuple):
    """x+ = A x + B w + a + E (clip(u) - u), u = C x + D w + b, w = (-y, i): names as in `StateSpaceLaw`."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    E: np.ndarray
    a: np.ndarray
    b: np.ndarray
    steady: np.ndarray
    start: np.ndarray


class SampledRotor(NamedTuple):
    """x+ = F x + G u + f, y = H x, with x = (q, q', i, past commands, newest first) and y = (readings, currents)."""

    F: np.ndarray
    G: np.ndarray
    f: np.ndarray
    H: np.ndarray
    pushed: np.ndarray


def sampled_model(rotor: RotorModel, coils: LinearCoils, period: float, delay: float) -> SampledRotor:
    """Return the map of one sample. `pushed` [N, c]: effect of constant forces (N) at the magnets. `delay`: samples."""
    from scipy.linalg import expm

    n, c = len(rotor.M), len(coils.R)
    inverse, zero = np.linalg.inv(rotor.M), np.zeros
    pull = inverse @ rotor.B.T
    A = np.block([
        [zero((n, n)), np.eye(n), zero((n, c))],
        [inverse @ (rotor.B.T * coils.k_s @ rotor.B - rotor.K), -inverse @ rotor.D, pull * coils.k_i],
        [zero((c, n)), coils.motional[:, None] * rotor.B, -np.diag(coils.R / coils.L)],
    ])  # fmt: skip
    u = np.vstack([zero((2 * n, c)), np.diag(1 / coils.L)])
    force = np.vstack([zero((n, c)), pull, zero((c, c))])
    constant = np.concatenate([zero(n), inverse @ rotor.constant, zero(c)])[:, None]
    late = delay - np.floor(delay)

    step, effects = held(A, np.hstack([u, force, constant]), period, expm)
    rest, new = held(A, u, (1 - late) * period, expm)
    _, old = held(A, u, late * period, expm)
    kept = int(np.ceil(delay))
    by_lag = [zero(new.shape) for _ in range(kept + 1)]
    by_lag[int(np.floor(delay))] += new
    if late:
        by_lag[kept] += rest @ old
    past = zero((kept * c, len(A) + kept * c))
    past[c:, len(A) : len(A) + max(kept - 1, 0) * c] = np.eye(max(kept - 1, 0) * c)
    F = np.vstack([np.hstack([step, *by_lag[1:]]), past])
    G = np.vstack([by_lag[0], *([np.eye(c)] if kept else []), zero((max(kept - 1, 0) * c, c))])
    more = zero((kept * c, c))
    H = np.block([[rotor.C, zero((c, len(F) - n))], [zero((c, 2 * n)), np.eye(c), zero((c, kept * c))]])
    return SampledRotor(F, G, np.concatenate([effects[:, -1], more[:, 0]]), H, np.vstack([effects[:, c : 2 * c], more]))


def design(
    rotor: RotorModel, coils: LinearCoils, weights: dict[str, float], w: float, period: float, delay: float
) -> DesignedController:
    """Return the controller of a model; `w`: pole of the magnets, 1/s. Raises ValueError without a Riccati solution."""
    model, n, c = sampled_model(rotor, coils, period, delay), len(rotor.M), len(coils.R)
    N, error, current, force = len(model.F), weights["error"], weights["current"], weights["force"]
    # in units of the characteristic sizes, all numbers are of order one
    command = current * (coils.R + w * coils.L)
    rows = np.abs(rotor.B).max(0) + np.abs(rotor.C).max(0)
    q = error / np.where(rows > 0, rows, 1.0)
    scale = np.concatenate([q, w * q, np.full(c, current), np.tile(command, (N - 2 * n - c) // c)])
    unit = np.concatenate([np.full(c, error), np.full(c, current)])
    model = SampledRotor(
        model.F * scale / scale[:, None], model.G * command / scale[:, None], model.f / scale,
        model.H * scale / unit[:, None], model.pushed * force / scale[:, None],
    )  # fmt: skip
    K = riccati_gain(model.F, model.G, model.H.T @ model.H, np.eye(c))
    F, H, L, now = _filter(model, rotor, weights, scale, period)
    x_rest, u_rest = _rest(model, rotor.B * scale[:n] / error)
    feedback, b = np.hstack([-K, K @ x_rest[:, :c] + u_rest[:, :c]]), K @ x_rest[:, c] + u_rest[:, c]
    G = np.vstack([model.G, np.zeros((c, c))])
    C, D = feedback @ (np.eye(N + c) - now @ H), feedback @ now
    signs, start = np.concatenate([-np.ones(c), np.ones(c)]) / unit, np.zeros((N + c, 2 * c))
    rigid = np.linalg.pinv(rotor.C[:, rotor.K.diagonal() == 0])
    start[: len(rigid), :c] = -rigid / scale[: len(rigid), None]
    start[2 * n : 2 * n + c, c:] = np.eye(c) / current
    sagged = np.append(x_rest[:, c], np.zeros(c))
    return DesignedController(
        A=F - L @ H + G @ C,
        B=(L + G @ D) * signs,
        C=C * command[:, None],
        D=D * command[:, None] * signs,
        E=G / command,
        a=np.concatenate([model.f, np.zeros(c)]) + G @ b,
        b=b * command,
        steady=start,
        start=sagged - start @ (signs * unit * (H @ sagged) * unit),
    )


def _filter(
    model: SampledRotor, rotor: RotorModel, weights: dict[str, float], scale: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return F and H of the model with constant forces at the magnets as further states, and the gains of its filter.

    The gains L, of x+ = F x + G u + L (y - H x), and M, of the estimate x + M (y - H x) at the sample: L = F M.
    """
    N, c, n = len(model.F), model.G.shape[1], len(rotor.M)
    force, noise = weights["force"], weights["noise"] / weights["error"]
    F = np.block([[model.F, model.pushed], [np.zeros((c, N)), np.eye(c)]])
    H = np.hstack([model.H, np.zeros((2 * c, c))])
    Q = np.zeros((N + c, N + c))
    Q[:N, :N] = model.pushed @ model.pushed.T
    Q[N:, N:] = np.eye(c) * (weights["drift"] * period / force) ** 2
    bent = np.flatnonzero(rotor.K.diagonal() > 0)
    Q[n + bent, n + bent] += (weights["bending"] * force * period * np.abs(rotor.B).max(0)[bent] / scale[n + bent]) ** 2
    L = riccati_gain(F.T, H.T, Q, np.eye(2 * c) * noise**2).T
    # past commands are known, so that they have no gain at the sample
    unknown, now = np.r_[: 2 * n + c, N : N + c], np.zeros_like(L)
    now[unknown] = np.linalg.solve(F[np.ix_(unknown, unknown)], L[unknown])
    return F, H, L, now


def _rest(model: SampledRotor, at_magnets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return states and commands [., c + 1] of a rotor that rests in the centres of its magnets.

    The columns are for a constant force at each magnet, and for the weight. `at_magnets` [c, n]: displacements there.
    """
    (N, c), n = model.G.shape, at_magnets.shape[1]
    centred = np.hstack([at_magnets, np.zeros((c, N - n + c))])
    table = np.vstack([np.hstack([np.eye(N) - model.F, -model.G]), centred])
    right = np.block([[model.pushed, model.f[:, None]], [np.zeros((c, c + 1))]])
    rest = np.linalg.lstsq(table, right, rcond=None)[0]
    return rest[:N], rest[N:]
