"""A NumPy program written from the pages `processor.md`, `model.md` and `laws.md` alone agrees with `simulate`.

It shares no code with the simulator or the other oracles. Each law is a function that returns its output and its next
state, as the pages order them.
"""

import math

import numpy as np
import pytest

import ambjax
from ambjax.cases.reader import case_from

M, N_TURNS, AREA, S_0, I_0, R, G = 1.64, 208.0, 2.68e-4, 5e-4, 2.5, 1.0, 9.81
MU_0, T, SAMPLES, U_MAX = 1.2566e-6, 5e-5, 50, 12.0
KAPPA = MU_0 * N_TURNS**2 * AREA
A, L = KAPPA / 4 / M, KAPPA / (2 * S_0)
START = np.array([5e-5, 1e-3, 0.1])  # m, m/s, A
AMPLITUDE, W = 2e-5, 2 * np.pi * 40.0


def v(z, i):
    return ((I_0 + i) / (S_0 - z)) ** 2 - ((I_0 - i) / (S_0 + z)) ** 2


def current_for(z, force):
    """Root of Eq. (3) that stays finite at z = 0."""
    up, down = 1 / (S_0 - z) ** 2, 1 / (S_0 + z) ** 2
    a, b, c = up - down, 2 * I_0 * (up + down), I_0**2 * (up - down) - force
    return -2 * c / (b + math.sqrt(b * b - 4 * a * c))


def rates(y, u):
    z, z_dot, i = y
    return np.array([z_dot, A * v(z, i) - G, 2 * z_dot / (S_0 + z) * i + 2 * (S_0 + z) / KAPPA * (u - R * i)])


def rk4(y, u, h):
    a = rates(y, u)
    b = rates(y + h / 2 * a, u)
    c = rates(y + h / 2 * b, u)
    return y + h / 6 * (a + 2 * b + 2 * c + rates(y + h * c, u))


def sgn(x, p):
    return 2 / np.pi * math.atan(p * x)


def relaxed(x, h, p):
    """Solve y + h sgn_p(y) = x by bisection."""
    low, high = sorted((x, x - math.copysign(h, x)))
    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if middle + h * sgn(middle, p) < x else (low, middle)
    return low


def sliding(y, r, _, c=300.0, k=50.0, p=40.0):
    e, e_dot = y[0] - r[0], y[1] - r[1]
    return (-c * e_dot + r[2] + G - k * sgn(relaxed(e_dot + c * e, T * k, p), p)) / A, None


def integral_sliding(y, r, x, c=300.0, c_int=2e4, k=50.0, p=40.0):
    e, e_dot, x = y[0] - r[0], y[1] - r[1], x or 0.0
    sign = sgn(relaxed(e_dot + c * e + c_int * x, T * k, p), p)
    return (-c * e_dot - c_int * e + r[2] + G - k * sign) / A, x + T * e


def pid(y, r, state, k_p=3e5, k_int=3e7, k_d=1e3, w_f=1e4, k_aw=20.0):
    e, e_dot = y[0] - r[0], y[1] - r[1]
    d, x = state or (e_dot, 0.0)
    d = (d + T * w_f * e_dot) / (1 + T * w_f)
    free = r[2] + G - k_p * e - k_d * d  # a v_star + x
    return (free - x) / A, (d, (x + T * (k_int * e + k_aw * (free - A * v(y[0], y[2])))) / (1 + T * k_aw))


def chain(y, r, state, k_p=2e4, k_int=5e5, k_d=20.0, w_f=1e4, k_aw=300.0):
    z, _, i = y
    stiffness, per_ampere = 4 * I_0**2 / S_0**3, 4 * I_0 / S_0**2
    e, c = z - r[0], 2 / T
    x, e_before, d = (0.0, e, 0.0) if state is None else state
    d = (k_d * c * (e - e_before) - (1 - c / w_f) * d) / (1 + c / w_f)
    i_star = (r[2] - A * stiffness * r[0] + G) / (A * per_ampere) - (k_p * e + x + T * k_int * e / 2 + d)
    h = T * k_aw
    return stiffness * z + per_ampere * i_star, (x + T * k_int * e + h / (1 + h) * (i_star - i), e, d)


def adaptive(y, v_star, i_ref, gamma=1e11, p=1e-6):
    i_ref = 0.0 if i_ref is None else i_ref
    return i_ref, current_for(y[0], v_star - relaxed(v_star - v(y[0], i_ref), T * gamma, p))


def closed_form(y, v_star, i_ref):
    after = current_for(y[0], v_star)
    return after if i_ref is None else i_ref, after


def linearised(y, v_star, i_ref):
    after = (v_star - 4 * I_0**2 / S_0**3 * y[0]) / (4 * I_0 / S_0**2)
    return after if i_ref is None else i_ref, after


def sliding_current(y, i_ref, after, _, k_i=4000.0, p=2.0):
    z, z_dot, i = y
    sign = sgn(relaxed(i - i_ref, T * k_i, p), p)
    return KAPPA / 2 / (S_0 + z) * (-2 * z_dot * i / (S_0 + z) + (after - i_ref) / T - k_i * sign) + R * i, None


def pi(y, i_ref, after, x, k_p=40.0, k_int=5e4, k_aw=1000.0):
    error, x = i_ref - y[2], x or 0.0
    u = k_p * error + L * (after - i_ref) / T + x
    return u, x + T * (k_int * error + k_aw * (np.clip(u, -U_MAX, U_MAX) - u))


def dead_beat(y, i_ref, after, _, share=0.5):
    z, z_dot, i = y
    b = 2 * (S_0 + z) / KAPPA
    pole = 2 * z_dot / (S_0 + z) - b * R
    return (after + (1 - share) * (i - i_ref) - math.exp(pole * T) * i) / (math.expm1(pole * T) / pole * b), None


def simulate(position, inversion, current, delay, predict):
    """Return z and u at the samples."""
    whole, part = divmod(delay, 1.0)
    y, past, states, rows = START, [0.0] * 12, [None] * 3, []
    for n in range(SAMPLES):
        t, seen = n * T, y
        if predict:
            t += delay * T
            lengths = [min(max(delay - lag, 0.0), 1.0) * T for lag in range(12)]
            for u, h in reversed([*zip(past, lengths, strict=True)]):
                seen = rk4(seen, u, h)
        r = AMPLITUDE * np.array([math.sin(W * t), W * math.cos(W * t), -(W**2) * math.sin(W * t)])
        v_star, states[0] = position(seen, r, states[0])
        i_ref, states[1] = inversion(seen, v_star, states[1])
        u, states[2] = current(seen, i_ref, states[1], states[2])
        past = [float(np.clip(u, -U_MAX, U_MAX)), *past[:-1]]
        rows.append((y[0], past[0]))
        for command, time in ((past[int(whole) + 1], part * T), (past[int(whole)], (1 - part) * T)):
            for _ in range(8):
                y = rk4(y, command, time / 8)
    return np.array(rows).T


@pytest.mark.parametrize(
    ("laws", "tables", "delay", "predict"),
    [
        pytest.param(
            (sliding, adaptive, sliding_current),
            ({"kind": "sliding-mode", "c": 300.0, "k": 50.0, "p": 40.0},
             {"kind": "adaptive", "gamma": 1e11, "p": 1e-6}, {"kind": "sliding-mode", "k_i": 4000.0, "p": 2.0}),
            1.5, True, marks=pytest.mark.slow,
        ),
        (
            (pid, linearised, pi),
            ({"kind": "pid", "k_p": 3e5, "k_int": 3e7, "k_d": 1e3, "w_f": 1e4, "k_aw": 20.0},
             {"kind": "linearised"}, {"kind": "pi", "k_p": 40.0, "k_int": 5e4, "k_aw": 1000.0}),
            1.0, False,
        ),
        pytest.param(
            (integral_sliding, closed_form, dead_beat),
            ({"kind": "integral-sliding-mode", "c": 300.0, "c_int": 2e4, "k": 50.0, "p": 40.0},
             {"kind": "closed-form"}, {"kind": "dead-beat", "share": 0.5}),
            1.0, True, marks=pytest.mark.slow,
        ),
        pytest.param(
            (chain, closed_form, pi),
            ({"kind": "chain", "k_p": 2e4, "k_int": 5e5, "k_d": 20.0, "w_f": 1e4, "k_aw": 300.0},
             {"kind": "closed-form"}, {"kind": "pi", "k_p": 40.0, "k_int": 5e4, "k_aw": 1000.0}),
            1.4, False, marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_a_program_written_from_the_pages_agrees(laws, tables, delay, predict):
    raw = {
        "plant": {"m": M, "k_z": 0.0, "mu_0": MU_0, "n": N_TURNS, "A": AREA, "s_0": S_0, "i_0": I_0, "R": R, "g": G},
        "controller": dict(zip(("position", "inversion", "current"), tables, strict=True)),
        "processor": {"delay": delay, "predict": predict},
        "actuator": {"u_max": U_MAX},
        "reference": {"kind": "sine", "amplitude": AMPLITUDE, "frequency": 40.0},
        "initial": {"z": START[0], "z_dot": START[1], "i": START[2]},
        "sensor": {"std_z_dot": 0.0},
        "clock": {"duration": SAMPLES * T, "sample_period": T},
        "run": {"settle": 0.0},
    }
    rows = ambjax.simulate(case_from(raw)).trajectory.rows
    z, u = simulate(*laws, delay, predict)
    assert np.abs(rows.u).max() == U_MAX  # the supply limits a command
    np.testing.assert_allclose(rows.z, z, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows.u, u, rtol=1e-7)
