"""An independent solution of the closed loop, in plain Python, NumPy and SciPy: shares no code with ambjax.

It writes out Eqs. (1)-(3), (5), (6) and (11), each smoothed sign 2/pi arctan(p x) with its own p, and
the alternative laws, with every derivative by hand. A jump of an input is never inside a step: the
integration is cut there, and at every sample while measurement errors are held.
"""

import cmath
import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp

TABLE_1 = {
    "m": 0.588, "k_z": -754.0, "mu_0": 1.25e-6, "n": 1480.0, "A": 0.121, "s_0": 5e-3, "i_0": 0.25, "R": 41.44, "g": 9.81
}  # fmt: skip
REST = ("constant", {"value": 0.0})
QUIET = ("pulse", {"amplitude": 0.0, "start": 0.0, "stop": 0.0})


@dataclass(frozen=True)
class World:
    """Numbers only, SI units. A law, a reference or a disturbance is (kind, its parameters)."""

    plant: dict = field(default_factory=dict)  # what differs from Table 1
    model: dict = field(default_factory=dict)  # what the controller believes to differ from the true plant
    observer: tuple = ("direct", {})  # ("complementary", {"l"[, "z_hat"]})
    # or ("super-twisting", {"c", "k_1", "k_2", "p"})
    position: tuple = ("sliding-mode", {"c": 17.0, "k": 25.0, "p": 25.0})
    inversion: tuple = ("adaptive", {"gamma": 7.5e4, "p": 25.0, "i_ref": 0.0})  # ("closed-form", {"i_ref"})
    current: tuple = ("sliding-mode", {"k_i": 152.0, "p": 25.0})  # ("pi", {"k_p", "k_int", "k_aw"})
    reference: tuple = REST
    q_z: tuple = QUIET  # m/s^2
    q_v: tuple = QUIET  # A^2/m^2, times the true plant's kappa / (4 m)
    q_i: tuple = QUIET  # A/s
    initial: tuple = (0.0, 0.0, 0.0)  # z, z_dot, i
    u_max: float = math.inf


def solve(world, t, noise=None, rtol=1e-10, method="Radau"):
    """z at the times t (from 0, one per sample). `noise[k]`: errors of z, z_dot, i held from t[k] to t[k + 1]."""
    cuts = {0.0, t[-1]} if noise is None else set(t)
    noise = np.zeros((len(t), 3)) if noise is None else np.asarray(noise)
    loop = Loop(world)
    y, z = loop.start(noise[0]), np.full(len(t), np.nan)
    z[0] = y[0]
    how = {"jac": loop.jacobian} if method == "Radau" else {}
    for a, b in loop.pieces(t, cuts, noise):
        inside = (t > a) & (t <= b)
        at = np.union1d(t[inside], b)
        run = solve_ivp(loop.rates, (a, b), y, method, at, rtol=rtol, atol=1e-3 * rtol * loop.scale, **how)
        assert run.success, run.message
        z[inside], y = run.y[0][: inside.sum()], run.y[:, -1]
    return z


def _edges(signal):
    kind, p = signal
    if kind == "pulse":
        return [p["start"], p["stop"]]
    return [p["start"], p["start"] + p["duration"]] if kind == "smoothstep" else []


def _pulse(signal, t):
    _, p = signal
    return p["amplitude"] if p["start"] <= t < p["stop"] else 0.0


def _reference(signal, t):
    """r, r', r'', r'''."""
    kind, p = signal
    if kind == "sine":
        w = 2 * math.pi * p["frequency"]
        s, c = p["amplitude"] * math.sin(w * t), p["amplitude"] * math.cos(w * t)
        return s, w * c, -w * w * s, -(w**3) * c
    if kind == "smoothstep":
        height, T = p["amplitude"], p["duration"]
        s = (t - p["start"]) / T
        if s <= 0 or s >= 1:
            return (0.0 if s <= 0 else height), 0.0, 0.0, 0.0
        return (
            height * (10 * s**3 - 15 * s**4 + 6 * s**5),
            height * (30 * s**2 - 60 * s**3 + 30 * s**4) / T,
            height * (60 * s - 180 * s**2 + 120 * s**3) / T**2,
            height * (60 - 360 * s + 360 * s**2) / T**3,
        )
    return p["value"], 0.0, 0.0, 0.0


def _atan(x):
    return cmath.atan(x) if isinstance(x, complex) else math.atan(x)


class Body:
    """One set of the numbers of Table 1, and Eq. (3)."""

    def __init__(self, numbers):
        self.__dict__.update(numbers)
        self.kappa = self.mu_0 * self.n * self.n * self.A
        self.a = self.kappa / (4 * self.m)
        self.stiffness = 2 * self.k_z / self.m

    def v(self, z, i):
        up, down = (self.i_0 + i) / (self.s_0 - z), (self.i_0 - i) / (self.s_0 + z)
        return up * up - down * down

    def v_i(self, z, i):
        up, down = self.s_0 - z, self.s_0 + z
        return 2 * (self.i_0 + i) / (up * up) + 2 * (self.i_0 - i) / (down * down)

    def v_z(self, z, i):
        up, down = self.s_0 - z, self.s_0 + z
        return 2 * (self.i_0 + i) * (self.i_0 + i) / (up * up * up) + 2 * (self.i_0 - i) * (self.i_0 - i) / down**3

    def current(self, z, v):
        """The root in i of (U - D) i^2 + 2 i_0 (U + D) i + i_0^2 (U - D) - v = 0 that is finite as U -> D.

        Beyond the largest force: the current of the nearest one.
        """
        U, D = 1 / ((self.s_0 - z) * (self.s_0 - z)), 1 / ((self.s_0 + z) * (self.s_0 + z))
        half, last = self.i_0 * (U + D), self.i_0 * self.i_0 * (U - D) - v
        square = half * half - (U - D) * last
        return -last / (half + square**0.5) if square.real >= 0 else -half / (U - D)

    def force(self, z, currents):
        """v of the current i, or of the currents of the upper and the lower coil."""
        if len(currents) == 1:
            return self.v(z, *currents)
        up, down = currents[0] / (self.s_0 - z), currents[1] / (self.s_0 + z)
        return up * up - down * down

    def current_rates(self, z, z_dot, currents, u):
        """Eq. (2) of the current i, or of each coil with its own gap and the voltage R i_0 +- u."""
        up, down, bias = self.s_0 - z, self.s_0 + z, self.R * self.i_0
        if len(currents) == 1:
            (i,) = currents
            return (2 * z_dot / down * i + 2 * down / self.kappa * (u - self.R * i),)
        i, j = currents
        return (
            2 * up / self.kappa * (bias + u - self.R * i) - i * z_dot / up,
            2 * down / self.kappa * (bias - u - self.R * j) + j * z_dot / down,
        )


class Loop:
    """y = z, z_dot, i, then the states of the laws that have one, in the order of the cascade."""

    def __init__(self, world):
        numbers = TABLE_1 | world.plant
        self.world, self.true, self.model = world, Body(numbers), Body(numbers | world.model)
        laws = (world.observer, world.position, world.inversion, world.current)
        self.kinds, self.gains = zip(*laws, strict=True)
        sizes = {"complementary": 1e-3, "super-twisting": 1.0, "adaptive": 0.1, "pi": 10.0}
        self.scale = np.array([1e-3, 1e-2, 0.1] + [sizes[k] for k in self.kinds if k in sizes])

    def start(self, noise):
        measured = self.world.initial[0] + float(noise[0])
        first = {"complementary": self.gains[0].get("z_hat", measured), "super-twisting": 0.0, "pi": 0.0}
        first["adaptive"] = self.gains[2].get("i_ref", 0.0)
        return np.array([*self.world.initial, *(first[k] for k in self.kinds if k in first)])

    def pieces(self, t, cuts, noise):
        """Yield the intervals between jumps of the inputs and `cuts`, with the errors and pulses of each set."""
        inputs = (self.world.q_z, self.world.q_v, self.world.q_i)
        jumps = {edge for signal in (self.world.reference, *inputs) for edge in _edges(signal) if 0 < edge < t[-1]}
        for a, b in itertools.pairwise(sorted(jumps | cuts)):
            middle = (a + b) / 2
            self.held = noise[min(np.searchsorted(t, middle), len(noise)) - 1].tolist()
            self.pushed = [_pulse(signal, middle) for signal in inputs]
            yield a, b

    def rates(self, t, y):
        return np.array(self._rates(t, *y.tolist())[0])

    def signals(self, t, y):
        """u as applied, e = i - i_ref, v_tilde, and r."""
        return self._rates(t, *y.tolist())[1]

    def jacobian(self, t, y):
        """By complex steps: f(y + i h e_j) has imaginary part h df/dy_j, without cancellation."""
        columns = []
        for j in range(len(y)):
            shifted = [complex(x, 1e-30 if k == j else 0.0) for k, x in enumerate(y)]
            columns.append([x.imag * 1e30 for x in self._rates(t, *shifted)[0]])
        return np.array(columns).T

    def _rates(self, t, z, z_dot, i, *states):
        states, more = list(states), []
        model, true, (e_z, e_z_dot, e_i), (q_z, q_v, q_i) = self.model, self.true, self.held, self.pushed
        r, r_1, r_2, r_3 = _reference(self.world.reference, t)
        seen, w, j = z + e_z, z_dot + e_z_dot, i + e_i

        x, x_dot = seen, w  # what the laws take for z, and its true rate
        if self.kinds[0] == "complementary":
            x = states.pop(0)
            x_dot = w + self.gains[0]["l"] * (seen - x)
            more.append(x_dot)

        # Position: v_star, and v_star_dot along the nominal motion.
        gains = self.gains[1]
        c, p = gains["c"], gains["p"]
        sigma = w - r_1 + c * (x - r)
        w_dot = model.stiffness * x + model.a * model.v(x, j) - model.g
        sigma_dot = w_dot - r_2 + c * (x_dot - r_1)
        sgn, sgn_slope = 2 / math.pi * _atan(p * sigma), 2 / math.pi * p / (1 + (p * sigma) * (p * sigma))
        if self.kinds[1] == "super-twisting":
            twist, q = states.pop(0), sigma * sigma + 1 / p**2
            robust = twist - gains["k_1"] * sigma / q**0.25
            twist_dot = -gains["k_2"] * sgn
            robust_dot = twist_dot - gains["k_1"] * (q**-0.25 - sigma * sigma / 2 * q**-1.25) * sigma_dot
            more.append(twist_dot)
        else:
            robust, robust_dot = -gains["k"] * sgn, -gains["k"] * sgn_slope * sigma_dot
        v_star = (-model.stiffness * x - c * (w - r_1) + r_2 + model.g + robust) / model.a
        v_star_dot = (-model.stiffness * x_dot - c * (w_dot - r_2) + r_3 + robust_dot) / model.a

        gains = self.gains[2]
        if self.kinds[2] == "adaptive":
            i_ref = states.pop(0)
            error = 2 / math.pi * _atan(gains["p"] * (v_star - model.v(x, i_ref)))
            i_ref_dot = gains["gamma"] * error / model.v_i(x, i_ref)
            more.append(i_ref_dot)
        else:  # v(x, i_ref) = v_star, so v_z x_dot + v_i i_ref_dot = v_star_dot
            i_ref = model.current(x, v_star)
            i_ref_dot = (v_star_dot - model.v_z(x, i_ref) * x_dot) / model.v_i(x, i_ref)

        gains, gap, limit = self.gains[3], model.s_0 + x, self.world.u_max
        if self.kinds[3] == "pi":
            integral = states.pop(0)
            u = gains["k_p"] * (i_ref - j) + model.kappa / (2 * model.s_0) * i_ref_dot + integral
            applied = self._limited(u, limit)
            more.append(gains["k_int"] * (i_ref - j) + gains["k_aw"] * (applied - u))
        else:
            robust = gains["k_i"] * 2 / math.pi * _atan(gains["p"] * (j - i_ref))
            u = model.kappa / (2 * gap) * (-2 * w / gap * j + i_ref_dot - robust) + model.R * j
            applied = self._limited(u, limit)

        z_ddot = true.stiffness * z + true.a * true.v(z, i) - true.g + q_z + true.a * q_v
        (i_dot,) = true.current_rates(z, z_dot, (i,), applied)
        return (z_dot, z_ddot, i_dot + q_i, *more), (applied, i - i_ref, v_star - model.v(x, i_ref), r)

    @staticmethod
    def _limited(u, limit):
        return u if -limit <= u.real <= limit else math.copysign(limit, u.real)
