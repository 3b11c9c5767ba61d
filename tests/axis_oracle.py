"""The cascade of one axis of `machine_oracle`, with implicit steps, in plain NumPy: shares no code with ambjax.

Every function also takes complex numbers with a small imaginary part, which then carries a derivative.
"""

import math

import numpy as np
from oracle import TABLE_1, Body
from sampled_oracle import kalman, relax, spans


class Magnet(Body):
    """Eqs. (2) and (3) of one axis, or of all axes if its numbers are arrays. Without springs."""

    def __init__(self, numbers, m=math.nan, g=math.nan):
        super().__init__(TABLE_1 | numbers | {"m": m, "g": g, "k_z": 0.0})


def defaults(magnet, T, given):
    """Return the default gains of every law, by stage and kind. `given`: the table of the position law."""
    w, paper = math.sqrt(magnet.a * magnet.v_z(0.0, 0.0)), Magnet({}, TABLE_1["m"])
    w_c, L, s_0, i_0 = min(10 * w, 1 / (4 * T)), magnet.kappa / (2 * magnet.s_0), magnet.s_0, magnet.i_0
    speed = paper.s_0 * math.sqrt(paper.a * paper.v_z(0.0, 0.0)) / (s_0 * w)
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
        return np.array([z_dot, model.a * model.v(z, i) - model.g, *model.current_rates(z, z_dot, [i], u)])

    def observe(self, state, reading):
        """Update the observer and return its estimate of z, z', i."""
        (z, z_dot, i), T, kind, gains = reading, self.T, self.kind["observer"], self.gains["observer"]
        if kind == "direct":
            return z, z_dot, i
        f = self.model.a * self.model.v(z, i) - self.model.g
        estimate = state.get("z_hat", z), state.get("v_hat", 0.0), state.get("d_hat", 0.0)
        z_hat, v, d = kalman(z, f, estimate, state.get("f"), gains["w"], T)
        state.update(z_hat=z_hat, v_hat=v, d_hat=d, f=f)
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
            return (v_star - model.v_z(0.0, 0.0) * z) / model.v_i(0.0, 0.0)
        if kind == "closed-form":
            return model.current(z, v_star)
        i_ref = state.setdefault("i_ref", gains["i_ref"])
        w, h = v_star - model.v(z, i_ref), T * gains["gamma"]
        return model.current(z, v_star - w + h * share(w, h, gains["p"]))

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
