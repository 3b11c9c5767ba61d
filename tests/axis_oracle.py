"""The cascade of one axis of `machine_oracle`, with implicit steps, in plain NumPy: shares no code with ambjax.

Every function also takes complex numbers with a small imaginary part, which then carries a derivative.
"""

import math

import numpy as np
from sampled_oracle import relax, spans

PAPER = {"mu_0": 1.25e-6, "n": 1480.0, "A": 0.121, "s_0": 5e-3, "i_0": 0.25, "R": 41.44}


class Magnet:
    """Eqs. (2) and (3) of one axis, or of all axes if its numbers are arrays."""

    def __init__(self, numbers, m=math.nan, g=math.nan):
        for name, value in (PAPER | numbers).items():
            setattr(self, name, value)
        self.kappa = self.mu_0 * self.n**2 * self.A
        self.m, self.g, self.a = m, g, self.kappa / (4 * m)
        self.v_i, self.v_z = 4 * self.i_0 / self.s_0**2, 4 * self.i_0**2 / self.s_0**3

    def v(self, z, i):
        return ((self.i_0 + i) / (self.s_0 - z)) ** 2 - ((self.i_0 - i) / (self.s_0 + z)) ** 2

    def current_for(self, z, v):
        """Return the root i of v(z, i) = v that stays finite at z = 0; beyond the largest force, its vertex."""
        up, down = (self.s_0 - z) ** -2, (self.s_0 + z) ** -2
        half, curve, last = self.i_0 * (up + down), up - down, self.i_0**2 * (up - down) - v
        square = half * half - curve * last
        return -last / (half + square**0.5) if np.real(square) >= 0 else -half / curve

    def force(self, z, currents):
        """Return v of the currents [1 or 2, axes]."""
        if len(currents) == 1:
            return self.v(z, currents[0])
        return (currents[0] / (self.s_0 - z)) ** 2 - (currents[1] / (self.s_0 + z)) ** 2

    def rates(self, z, z_dot, currents, u):
        """Return the rates of the currents [1 or 2, axes]."""
        up, down, bias = self.s_0 - z, self.s_0 + z, self.R * self.i_0
        if len(currents) == 1:
            i = currents[0]
            return np.array([2 * z_dot * i / down + 2 * down / self.kappa * (u - self.R * i)])
        i, j = currents
        return np.array([
            2 * up / self.kappa * (bias + u - self.R * i) - i * z_dot / up,
            2 * down / self.kappa * (bias - u - self.R * j) + j * z_dot / down,
        ])  # fmt: skip


def defaults(magnet, T, given):
    """Return the default gains of every law, by stage and kind. `given`: the table of the position law."""
    w, paper = math.sqrt(magnet.a * magnet.v_z), Magnet(PAPER, 0.588)
    w_c, L, s_0, i_0 = min(10 * w, 1 / (4 * T)), magnet.kappa / (2 * magnet.s_0), magnet.s_0, magnet.i_0
    speed = paper.s_0 * math.sqrt(paper.a * paper.v_z) / (s_0 * w)
    p = 25 * speed if "k" in given else math.pi / (w * s_0)
    p_v, p_i = 25 * (paper.i_0 / paper.s_0 * s_0 / i_0) ** 2, 25 * paper.i_0 / i_0
    return {
        "observer": {"direct": {}, "kalman": {"w": 3 * w}},
        "position": {
            "sliding-mode": {"c": w, "k": w * w * s_0 / 2, "p": p},
            "pid": {"k_p": 1.25 * w * w, "k_int": w**3 / 4, "k_d": 2 * w, "w_f": 20 * w, "k_aw": w / 20},
        },
        "inversion": {
            "adaptive": {"gamma": 4 * w * (i_0 / s_0) ** 2, "p": p_v, "i_ref": 0.0},
            "closed-form": {},
            "linearised": {},
        },
        "current": {
            "sliding-mode": {"k_i": w_c * math.pi / (2 * p_i), "p": p_i},
            "pi": {"k_p": w_c * L, "k_int": w_c**2 * L / 4, "k_aw": w_c / 4},
        },
    }


def sgn(x, p):
    return np.sign(np.real(x)) if p == math.inf else 2 / math.pi * np.arctan(p * x)


def share(w, h, p):
    """Return (w - relax(w, h, p)) / h; of a complex w with a small imaginary part, its derivative too."""
    if h == 0:
        return sgn(w, p)
    if p == math.inf:
        return w / h if abs(np.real(w)) < h else np.sign(np.real(w))
    y = relax(float(np.real(w)), h, p)
    if np.iscomplexobj(w):
        y += (w - y - h * sgn(y, p)) / (1 + h * 2 / math.pi * p / (1 + (p * y) ** 2))
    return sgn(y, p)


def rk4(rates, t, y, h):
    k_1 = rates(t, y)
    k_2 = rates(t + h / 2, y + h / 2 * k_1)
    k_3 = rates(t + h / 2, y + h / 2 * k_2)
    return y + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + rates(t + h, y + h * k_3))


class Laws:
    """The cascade of one axis. Its state is a dictionary of numbers, empty at the start."""

    def __init__(self, case, tables, m, g):
        self.T, processor, controller = case["clock"]["sample_period"], case["processor"], tables["controller"]
        self.model = Magnet(tables["plant"] | controller.get("model", {}), m, g)
        self.velocity = case.get("sensor", {}).get("velocity", True)
        self.delay = processor.get("delay", 1.0)
        self.predict = processor.get("predict", self.delay > 0)
        known = defaults(self.model, self.T, controller.get("position", {}))
        self.kind, self.gains = {}, {}
        for stage, kinds in known.items():
            given = controller.get(stage, {})
            self.kind[stage] = given.get("kind", next(iter(kinds)))
            self.gains[stage] = kinds[self.kind[stage]] | given

    def step(self, state, reading, past, u_max):
        """Return u, the next state, and i_ref before the step. `past`: the voltages u_{n-1}, u_{n-2}, ..."""
        state = dict(state)
        seen = self.observe(state, reading)
        if self.predict:
            for a, b, lag in spans(self.delay, self.delay):
                rates = lambda _, y, u=past[lag - 1]: self.model_rates(y, u)  # noqa: E731
                seen = rk4(rates, 0.0, np.array(seen), (b - a) * self.T)
        v_star = self.position(state, *seen)
        following = self.inversion(state, seen[0], v_star)
        i_ref = state.get("i_ref", following)
        u = self.current(state, *seen, i_ref, (following - i_ref) / self.T, u_max)
        state["i_ref"] = following
        return u, state, i_ref

    def model_rates(self, y, u):
        (z, z_dot, i), model = y, self.model
        return np.array([z_dot, model.a * model.v(z, i) - model.g, model.rates(z, z_dot, [i], u)[0]])

    def observe(self, state, reading):
        """Update the observer and return its estimate of z, z', i."""
        (z, z_dot, i), T, kind, gains = reading, self.T, self.kind["observer"], self.gains["observer"]
        if kind == "direct":
            return z, z_dot, i
        z_hat, v, d, w = state.get("z_hat", z), state.get("v_hat", 0.0), state.get("d_hat", 0.0), gains["w"]
        f = self.model.a * self.model.v(z, i) - self.model.g
        if "f" in state:
            z_hat = z_hat + T * v + T**2 * (state["f"] / 3 + f / 6 + d / 2)
            v = v + T * ((state["f"] + f) / 2 + d)
        e, q = z - z_hat, math.exp(-w * T)
        z_hat, v = z_hat + (1 - q**3) * e, v + 1.5 * (1 - q) ** 2 * (1 + q) / T * e
        state.update(z_hat=z_hat, v_hat=v, d_hat=d + (1 - q) ** 3 / T**2 * e, f=f)
        return z_hat, v, i

    def position(self, state, z, z_dot, i):
        T, model, gains = self.T, self.model, self.gains["position"]
        if self.kind["position"] == "sliding-mode":
            c, k = gains["c"], gains["k"]
            return (-c * z_dot + model.g - k * share(z_dot + c * z, T * k, gains["p"])) / model.a
        d, x, w, k_aw = state.get("d", z_dot), state.get("x", 0.0), gains["w_f"], gains["k_aw"]
        following = (d + T * w * z_dot) / (1 + T * w)
        demand = model.g - gains["k_p"] * z - gains["k_d"] * following - x
        rate = gains["k_int"] * z + k_aw * (demand - model.a * model.v(z, i))
        state.update(d=following, x=x + T * rate / (1 + T * k_aw))
        return demand / model.a

    def inversion(self, state, z, v_star):
        """Return the i_ref of the next sample."""
        T, model, gains, kind = self.T, self.model, self.gains["inversion"], self.kind["inversion"]
        if kind == "linearised":
            return (v_star - model.v_z * z) / model.v_i
        if kind == "closed-form":
            return model.current_for(z, v_star)
        i_ref = state.setdefault("i_ref", gains["i_ref"])
        w, h = v_star - model.v(z, i_ref), T * gains["gamma"]
        return model.current_for(z, v_star - w + h * share(w, h, gains["p"]))

    def current(self, state, z, z_dot, i, i_ref, rate, u_max):
        T, model, gains, e = self.T, self.model, self.gains["current"], i - i_ref
        if self.kind["current"] == "pi":
            x = state.get("x_i", 0.0)
            u = x - gains["k_p"] * e + model.kappa / (2 * model.s_0) * rate
            held = limit(u, u_max)
            state["x_i"] = x + T * (-gains["k_int"] * e + gains["k_aw"] * (held - u))
            return held
        gap, k = model.s_0 + z, gains["k_i"]
        robust = k * share(e, T * k, gains["p"])
        return limit(model.kappa / (2 * gap) * (-2 * z_dot * i / gap + rate - robust) + model.R * i, u_max)


def limit(u, u_max):
    return u if abs(np.real(u)) <= u_max else u_max * np.sign(np.real(u))
