"""Every metric of metrics.json, computed from the independent solution (tests/oracle.py) at all of its steps.

Integrals are additional states of the solution. This module shares no code with ambjax. The solver resolves the fast
motion between samples.
"""

import itertools
import math

import numpy as np
from oracle import Loop, _reference
from scipy.integrate import solve_ivp

GAUSS, WEIGHTS = np.polynomial.legendre.leggauss(3)


class Integrals(Loop):
    """The loop with integrals as additional states.

    They are those of u, u^2, the copper loss, i^2 and the squares of both coil currents.
    """

    def __init__(self, world):
        super().__init__(world)
        self.scale = np.append(self.scale, [1e-2, 1.0, 1e-3, 1e-5, 1e-3, 1e-3])

    def start(self, noise):
        return np.append(super().start(noise), [0.0] * 6)

    def _rates(self, t, *y):
        rates, signals = super()._rates(t, *y[:-6])
        heat = 2 * self.true.R * (self.true.i_0**2 + y[2] ** 2)
        coils = (self.true.i_0 + y[2]) ** 2, (self.true.i_0 - y[2]) ** 2
        return (*rates, signals[0], signals[0] ** 2, heat, y[2] ** 2, *coils), signals


def metrics(world, samples, period, settle, noise=None, rtol=1e-7, numbers=None):
    """Return the metrics of `samples` sample periods from rest.

    `noise[k]`: errors of z, z_dot, i, held over sample k. `numbers` computes other quantities from the solution. The
    error `rtol` of a step is a thousandth of the least tolerance of the tests.
    """
    numbers = numbers or _numbers
    t = np.arange(samples + 1) * period
    noise = np.zeros((samples, 3)) if noise is None else np.asarray(noise)
    loop = Integrals(world)
    y, stop = loop.start(noise[0]), 0.9 * loop.true.s_0

    def touched(t, y):
        return abs(y[0]) - stop

    touched.terminal = True
    rows, squares, integrals, lost_at = [], [], {0.0: y[-6:]}, math.inf
    for a, b in loop.pieces(t, set(t), noise):
        more = {"jac": loop.jacobian, "dense_output": True, "events": touched}
        run = solve_ivp(loop.rates, (a, b), y, "Radau", rtol=rtol, atol=1e-3 * rtol * loop.scale, **more)
        assert run.success, run.message
        for at, x in zip(run.t, run.y.T, strict=True):
            u, e, v_tilde, r = loop.signals(at, x)
            beyond = _singular(loop.true, x[0], x[2] - e)
            magnet = _magnet(loop.true, x[0], x[2])
            rows.append((at, x[0], x[0] - r, x[2], u, e, v_tilde, _sigma(world, at, x), beyond, *magnet))
        for left, right in itertools.pairwise(run.t):  # z is smooth: a rule of order 6 in every step
            nodes = (left + right) / 2 + (right - left) / 2 * GAUSS
            r = np.array([_reference(world.reference, at)[0] for at in nodes])
            squares.append((left, (right - left) / 2 * np.sum(WEIGHTS * (run.sol(nodes)[0] - r) ** 2)))
        y = run.y[:, -1]
        integrals[b] = y[-6:]
        if run.status == 1:
            lost_at = float(run.t[-1])
            rest, y = math.copysign(stop, y[0]), y
            times = np.append(t[t > lost_at], t[-1])
            gone = np.array([rest - _reference(world.reference, at)[0] for at in times])
            integrals = {at: x for at, x in integrals.items() if at < lost_at} | {lost_at: y[-6:]}
            return numbers(np.array(rows), squares, integrals, t, settle, stop, lost_at, (times, gone))
    return numbers(np.array(rows), squares, integrals, t, settle, stop, lost_at, None)


def _sigma(world, t, x):
    r, r_1, *_ = _reference(world.reference, t)
    return x[1] - r_1 + world.position[1]["c"] * (x[0] - r)


def _singular(plant, z, i_ref):
    """Return the expression of Eq. (9): 0 on C, positive on the side of the origin."""
    return z * z + 2 * plant.s_0 * i_ref * z / plant.i_0 + plant.s_0 * plant.s_0


def _magnet(plant, z, i):
    """Return the larger flux density of the two cores (T), and the force (N).

    The flux density is mu_0 n i/(2 gap), and the force of each core A B^2/mu_0.
    """
    densities = [
        plant.mu_0 * plant.n * current / (2 * gap)
        for current, gap in ((plant.i_0 + i, plant.s_0 - z), (plant.i_0 - i, plant.s_0 + z))
    ]
    upper, lower = (plant.A * b * b / plant.mu_0 for b in densities)
    return max(map(abs, densities)), upper - lower


def _numbers(rows, squares, integrals, samples, settle, stop, lost_at, gone):
    t, z, e_z, i, u, e, v_tilde, sigma, beyond, flux, force = rows.T
    end = samples[-1]
    late, driven = t >= settle, min(end, lost_at)
    # per sample: the mean of u
    edges = np.array([at for at in samples if at < driven] + [driven])
    means = np.diff([integrals[at][0] for at in edges]) / np.diff(edges)
    total, settled = integrals[driven], integrals.get(settle, integrals[driven])
    begun, square = np.array(squares).T

    def peak(x, mask=None):
        return float(np.abs(x if mask is None else x[mask]).max(initial=0.0))

    def reached(x, band):
        return float(t[np.abs(x) <= band][0]) if (np.abs(x) <= band).any() else math.inf

    rest, after = np.zeros(0), 0.0
    if gone is not None:
        times, rest = gone
        after = float(np.trapezoid(rest**2, times))
    return {
        "max_abs_error_m": max(peak(e_z), peak(rest)),
        "rms_error_m": math.sqrt((square.sum() + after) / end),
        "settled_max_abs_error_m": max(peak(e_z, late), peak(rest)),
        "settled_rms_error_m": math.sqrt((square[begun >= settle].sum() + after) / (end - settle)),
        "settled_max_abs_sigma_m_per_s": peak(sigma, late),
        "settled_max_abs_v_tilde_A2_per_m2": peak(v_tilde, late),
        "settled_max_abs_current_error_A": peak(e, late),
        "sigma_reached_s": reached(sigma, 1e-3),
        "v_tilde_reached_s": reached(v_tilde, 0.1),
        "current_error_reached_s": reached(e, 1e-3),
        "max_abs_u_V": peak(u),
        "rms_u_V": math.sqrt(total[1] / driven),
        "settled_rms_u_V": math.sqrt(max(total[1] - settled[1], 0.0) / max(driven - settle, 1e-30)),
        "chatter_V": float(np.abs(np.diff(means[edges[:-1] >= settle])).sum()),
        "max_abs_i_A": peak(i),
        "rms_i_A": math.sqrt(total[3] / driven),
        "rms_i_1_A": math.sqrt(total[4] / driven),
        "rms_i_2_A": math.sqrt(total[5] / driven),
        "copper_loss_W": total[2] / driven,
        "max_flux_T": peak(flux),
        "max_abs_force_N": peak(force),
        "force_used": 0.0,
        "clearance_used": max(peak(z), stop if gone is not None else 0.0) / stop,
        "settled_clearance_used": max(peak(z, late), stop if gone is not None else 0.0) / stop,
        "refused": 0,
        "lost": gone is not None,
        "stalled": False,
        "lost_at_s": lost_at,
        "singular_at_s": float(t[beyond <= 0][0]) if (beyond <= 0).any() else math.inf,
    }


def costs(rows, squares, integrals, samples, settle, stop, lost_at, gone, *, s_0, u_scale, near, band):
    """Return the terms of the loss and the limited quantities of the tuner, for a rotor that is held.

    The clearance is relative to a stop at `near`, and the settling to `band`. Quantities that the tuner evaluates at
    the samples are evaluated at the samples here too, except settling and overshoot, which are evaluated at all steps.
    """
    assert gone is None
    t, z, e_z = rows.T[:3]
    end, n = samples[-1], len(samples) - 1
    at = np.searchsorted(t, samples[:-1])  # z is continuous: either side of a sample does
    late = samples[:-1] >= settle
    halfway = (np.abs(z - e_z)[at] + near) / 2
    beyond = np.maximum((np.abs(z[at]) - halfway) / (near - halfway), 0.0)
    moves = np.diff([integrals[b][0] - integrals[a][0] for a, b in itertools.pairwise(samples)]) / (end / n)
    r = z - e_z
    low, high = (fold.accumulate(np.append(z[0], r))[1:] for fold in (np.minimum, np.maximum))
    k = np.flatnonzero(np.abs(e_z) > band)[-1]
    (t_0, t_1), (a, b) = t[k : k + 2], np.abs(e_z[k : k + 2])
    return {
        "effort": integrals[end][1] / end / u_scale**2,
        "chatter": np.sum(moves**2) / n / u_scale**2,
        "peak": np.mean((e_z[at][late] / s_0) ** 16) ** (2 / 16),
        "clearance": np.mean(beyond**2),
        "chatter_V_per_s": np.abs(moves[late[:-1]]).sum() / (end - settle),
        "settling_s": t_0 + (t_1 - t_0) * (a - band) / (a - b),
        "overshoot_m": max(np.max(z - high), np.max(low - z)),
    }
