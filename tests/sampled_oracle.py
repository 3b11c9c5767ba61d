"""An independent simulator of the sampled loop, in plain Python, NumPy and SciPy: shares no code with ambjax.

Sample n, t_n = n T: the plant is measured (errors, converter); observer, prediction, position, inversion and
current law step once; u_n acts from t_n + delay T until t_{n+1} + delay T, u = 0 before; the plant alone moves on.
Readings of the rules where they leave room, so that another program can follow them:
- a converter of b bits has steps of 2 range / 2^b, rounds half to even, and ends at -range and range - 1 step;
  it converts z and i. The complementary observer begins at z_measured of sample 0 unless z_hat is given.
- observers that estimate the velocity take none: it is 0 at sample 0. z and i pass, but the Kalman filter's z. Its
  model's acceleration, of the measured z and i, is linear between samples. Explicit: Euler on the continuous law.
- the closed form is the implicit adaptive law with gamma = inf, whatever the discretisation: it keeps the i_ref
  of the sample before, so that i_ref' is that of what was measured, disturbances included, and begins without a
  jump unless i_ref is given.
- the super-twisting law, implicit, is set-valued: p is for the explicit form only.
- a row's u is u_n within +-u_max; the limit is also what the PI law's anti-windup knows of the supply.
- the position sensor's low-pass begins at z, the amplifier at 0 V; scale and offset come after the low-pass, then
  noise, the converter last. The dead band is taken off the amplifier's voltage; at the current limit the voltage that
  would push |i| on is what keeps it.
- q_i moves the measured current: i_1' by q_i, i_2' by -q_i.
- faults come last: `outliers[n]` is added to the converted reading of z, `dropouts[n]` takes its place. The guard is
  that of docs/processor.md.
- lost: |z| = touch s_0. The singular curve: the first sample at which dv/di(z, i_ref) <= 0 at what the laws took.
- a scaled force beyond what any current gives: the current of the one nearest to it.
"""

import functools
import itertools
import math
from dataclasses import dataclass, field

import numpy as np
import oracle
from oracle import TABLE_1, Body, _edges, _pulse, _reference
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

SUBSTEP = 2.5e-5  # s, at most, of the fast way: z within 1e-12 m of DOP853 over 400 samples
SLIVER = 1e-9  # of a period: a piece shorter than this is rounding, not a piece


@dataclass(frozen=True)
class World(oracle.World):
    """More observers: ("difference", {"w"}), ("kalman", {"w"}), ("ired-1", {"L"}), ("ired-2", {"L"})."""

    kind: str = "lumped"  # or "two-coil": of the true plant; the controller's model is always lumped
    period: float = 1e-4
    delay: float = 1.0  # samples
    discretisation: str = "implicit"  # or "explicit"
    predict: bool = True
    bits: int | None = None
    range_z: float = 5e-3
    range_i: float = 0.5
    touch: float = 0.9
    offset: float = 0.0  # m
    gain: float = 1.0
    bandwidth: float | None = None  # Hz, of the position sensor
    amplifier: dict = field(default_factory=dict)  # {"bandwidth" Hz, "slew" V/s, "dead_band" V, "i_max" A}
    guard: dict | None = None  # {"z", "z_dot", "i", "noise", "speed", "samples"}, every number
    outliers: dict = field(default_factory=dict)  # sample: m
    dropouts: dict = field(default_factory=dict)  # sample: what is read, m


@dataclass(frozen=True)
class Run:
    """Rows [samples] at t_n, NaN after the loss; times in s.

    `seen` [samples, 3]: z, z_dot, i as the laws receive them. `read` [samples]: the reading of z.
    """

    t: np.ndarray
    z: np.ndarray
    z_dot: np.ndarray
    i: np.ndarray
    i_ref: np.ndarray
    u: np.ndarray
    v_star: np.ndarray
    seen: np.ndarray
    read: np.ndarray
    lost_at: float
    singular_at: float


def simulate(world, samples, noise=None, fast=False):
    """Rows 0 .. samples - 1. `noise[n]`: errors of z, z_dot, i at sample n. `fast`: RK4 in place of DOP853."""
    noise = np.zeros((samples, 3)) if noise is None else np.asarray(noise)
    plant, controller = Driven(world, Magnets(world, 2 if world.kind == "two-coil" else 1)), Controller(world)
    y, rows, lost_at, singular_at = plant.start, np.full((samples, 10), np.nan), math.inf, math.inf
    for n in range(samples):
        output = plant.output(y)
        z_read, *others = _measurement(world, plant.sensed(y), noise[n].tolist())
        z_read = world.dropouts.get(n, z_read + world.outliers.get(n, 0.0))
        *row, singular, seen = controller.sample(n, (z_read, *others))
        rows[n] = *output, *row, *seen, z_read
        singular_at = min(singular_at, n * world.period if singular else math.inf)
        y, touched = _sample(world, plant, controller, n, y, fast) if n < samples - 1 else (y, None)
        if touched is not None:
            lost_at = n * world.period + touched
            break
    t, (z, z_dot, i, i_ref, u, v_star) = np.arange(samples) * world.period, rows[:, :6].T
    return Run(t, z, z_dot, i, i_ref, u, v_star, rows[:, 6:9], rows[:, 9], lost_at, singular_at)


def _measurement(world, output, errors):
    z, z_dot, i = output
    z, z_dot, i = (x + error for x, error in zip((world.gain * z + world.offset, z_dot, i), errors, strict=True))
    return conversion(z, world.bits, world.range_z), z_dot, conversion(i, world.bits, world.range_i)


def conversion(x, bits, limit):
    """Return the output of a converter of `bits` bits over +-limit; x itself without bits."""
    if bits is None:
        return x
    code = round(x * 2 ** (bits - 1) / limit)
    return min(max(code, -(2 ** (bits - 1))), 2 ** (bits - 1) - 1) * limit / 2 ** (bits - 1)


def spans(delay, end):
    """Pieces (start, stop, lag) of the samples 0 to `end` after t_n, in which u_{n - lag} acts."""
    edges = sorted({0.0, end} | {delay - k for k in range(math.ceil(delay)) if delay - k < end})
    return [(a, b, math.ceil(delay - (a + b) / 2)) for a, b in itertools.pairwise(edges)]


def _sample(world, plant, controller, n, y, fast):
    """The plant at t_{n+1}, and seconds after t_n at which it touched down, or None."""
    T, signals = world.period, (world.q_z, world.q_v, world.q_i)
    inside = {edge - n * T for signal in signals for edge in _edges(signal)}
    for start, stop, lag in spans(world.delay, 1.0):
        first, last = start * T, stop * T
        cuts = sorted({first, last} | {x for x in inside if first + SLIVER * T < x < last - SLIVER * T})
        for a, b in itertools.pairwise(cuts):
            q_z, q_v, q_i = (_pulse(signal, n * T + (a + b) / 2) for signal in signals)
            rates = functools.partial(plant.rates, u=controller.voltage(n - lag), q_z=q_z + plant.body.a * q_v, q_i=q_i)
            y, touched = (_small_steps if fast else _accurate)(rates, y, b - a, plant)
            if touched is not None:
                return y, a + touched
    return y, None


def _accurate(rates, y, span, plant):
    def clearance(_, y):
        return plant.stop - abs(y[0])

    clearance.terminal = True
    run = solve_ivp(
        lambda _, y: rates(y.tolist()), (0.0, span), y, "DOP853", events=clearance, first_step=span, rtol=1e-12,
        atol=1e-15 * plant.scale,
    )  # fmt: skip
    assert run.success, run.message
    return run.y[:, -1].tolist(), (run.t[-1] if run.status == 1 else None)


def _small_steps(rates, y, span, plant):
    count = math.ceil(span / SUBSTEP * (1 - SLIVER))
    h = span / count
    for k in range(count):
        following = rk4(rates, y, h)
        if abs(following[0]) >= plant.stop:
            part = brentq(lambda x, y=y: abs(rk4(rates, y, x)[0]) - plant.stop, 0.0, h, xtol=1e-17)
            return following, k * h + part
        y = following
    return y, None


def rk4(rates, y, h):
    """One step of the classical Runge-Kutta method."""
    k_1 = rates(y)
    k_2 = rates([x + h / 2 * k for x, k in zip(y, k_1, strict=True)])
    k_3 = rates([x + h / 2 * k for x, k in zip(y, k_2, strict=True)])
    k_4 = rates([x + h * k for x, k in zip(y, k_3, strict=True)])
    return [x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip(y, k_1, k_2, k_3, k_4, strict=True)]


class Magnets:
    """Eqs. (1), (2); y = z, z_dot, and i or i_1 (upper), i_2 (lower), where each coil has its own gap and flux."""

    def __init__(self, world, coils=1):
        self.body = Body(TABLE_1 | world.plant)
        (z, z_dot, i), i_0 = world.initial, self.body.i_0
        self.start, self.stop = [z, z_dot, *([i] if coils == 1 else [i_0 + i, i_0 - i])], world.touch * self.body.s_0
        self.scale = np.array([1e-3, 1e-2, *[0.1] * coils])

    def output(self, y):
        return y if len(y) == 3 else (y[0], y[1], (y[2] - y[3]) / 2)

    def rates(self, y, u, q_z=0.0, q_i=0.0):
        (z, z_dot, *currents), body = y, self.body
        i_dots = body.current_rates(z, z_dot, currents, u)
        z_ddot = body.stiffness * z + body.a * body.force(z, currents) - body.g + q_z
        return z_dot, z_ddot, *(rate + q for rate, q in zip(i_dots, (q_i, -q_i), strict=False))


class Driven:
    """A plant with an amplifier and the low-pass of its position sensor.

    The state is that of the plant, then those of the other two, if present.
    """

    def __init__(self, world, plant):
        self.plant, self.body, self.stop, self.u_max = plant, plant.body, plant.stop, world.u_max
        given = world.amplifier
        self.sensor, self.follow = world.bandwidth, given.get("bandwidth")
        self.slew, self.dead, self.i_max = (given.get(name) for name in ("slew", "dead_band", "i_max"))
        assert self.follow or not self.slew  # else its rate would jump
        self.start = plant.start + [plant.start[0]] * bool(self.sensor) + [0.0] * bool(self.follow)
        more = [1e-3] * bool(self.sensor) + [100.0] * bool(self.follow)
        self.scale = np.concatenate([plant.scale, more])

    def output(self, y):
        return self.plant.output(y[: len(self.plant.start)])

    def sensed(self, y):
        z, z_dot, i = self.output(y)
        return (y[len(self.plant.start)] if self.sensor else z), z_dot, i

    def rates(self, y, u, q_z=0.0, q_i=0.0):
        own, more, i = y[: len(self.plant.start)], [], self.output(y)[2]
        if self.sensor:
            more.append(2 * math.pi * self.sensor * (y[0] - y[len(own)]))
        if self.follow:
            rate, most = 2 * math.pi * self.follow * (u - y[-1]), self.slew or math.inf
            u = y[-1]
            more.append(min(max(rate, -most), most))
        u = math.copysign(max(abs(u) - (self.dead or 0.0), 0.0), u)
        if self.i_max and abs(i) >= self.i_max:
            still, driven = (self.output(self.plant.rates(own, volt, q_z, q_i))[2] for volt in (0.0, 1.0))
            hold = min(max(still / (still - driven), -self.u_max), self.u_max)
            u = hold if (u - hold) * i > 0 else u
        return [*self.plant.rates(own, u, q_z, q_i), *more]


def sgn(x, p):
    """2/pi arctan(p x); the sign of x for p = inf, 0 at 0."""
    return (x > 0) - (x < 0) if p == math.inf else 2 / math.pi * math.atan(p * x)


def relax(w, h, p):
    """Return w+ with w+ + h sgn_p(w+) = w, to rounding; for p = inf with the set-valued sign."""
    y = max(abs(w) - h, 0.0)
    if p < math.inf and h < math.inf:
        # y + h sgn_p(y) - |w| rises and is concave: Newton's steps from the left never pass the root
        for _ in range(200):
            slope = 1 + h * 2 / math.pi * p / (1 + (p * y) * (p * y))
            following = y + (abs(w) - y - h * sgn(y, p)) / slope
            if following <= y:
                break
            y = following
    return math.copysign(y, w)


def twist(x, state, k_1, k_2, T):
    """Proper implicit super-twisting: (u, next state) for x+ = x + T u. Seeber, Andritsch, Automatica 173 (2025)."""
    over = abs(x) - k_2 * T * T
    if over <= 0:
        return state - 2 * x / T, state - x / T
    root = 2 * over / (T * k_1 + math.sqrt(T * T * k_1 * k_1 + 4 * over))
    following = state - math.copysign(k_2 * T, x)
    return 2 * following - state - math.copysign(k_1 * root, x), following


LAMBDA = {1: (1.5, 1.1), 2: (2.0, 2.12, 1.1)}


def robust_differentiator(f, x, L, T):
    """f' and the next states x_0 .. x_m: the implicit robust exact differentiator. Seeber, arXiv 2404.02770."""
    m, lam = len(x) - 1, LAMBDA[len(x) - 1]
    b = f - sum(T**k * one for k, one in enumerate(x))
    B, r = abs(b) / (L * T ** (m + 1)), 0.0
    x = list(x)
    if lam[m] >= B:
        x[m] += b / T**m
    else:
        polynomial = np.polynomial.Polynomial([lam[m] - B, *reversed(lam[:m]), 1.0])
        r = brentq(polynomial, 0.0, 1 + B, xtol=1e-300, rtol=1e-15)
        x[m] += lam[m] * L * T * math.copysign(1.0, b)
    for k in reversed(range(m)):
        x[k] += T * x[k + 1] + lam[k] * L * T ** (m - k + 1) * math.copysign(r ** (m - k), b)
    return x[1] if m == 1 else x[1] + T / 2 * x[2], x


def kalman(z, f, estimate, before, w, T):
    """Return the next z, z_dot, d. `f`, `before`: acceleration of the model now and at the last sample, if any."""
    z_hat, v, d = estimate
    if before is not None:
        z_hat += T * v + T * T * (before / 3 + f / 6 + d / 2)
        v += T * ((before + f) / 2 + d)
    e, q = z - z_hat, math.exp(-w * T)
    return z_hat + (1 - q**3) * e, v + 1.5 * (1 - q) ** 2 * (1 + q) / T * e, d + (1 - q) ** 3 / T**2 * e


class Velocity:
    """An observer without a measured velocity: z and z_dot from the samples of z and i."""

    def __init__(self, world, acceleration):
        (self.kind, gains), self.T, self.acceleration = world.observer, world.period, acceleration
        self.gain, self.implicit, self.known = *gains.values(), world.discretisation == "implicit", None

    def __call__(self, z, i):
        form = {"difference": self._difference, "kalman": self._kalman}.get(self.kind, self._robust)
        return form(z, self.acceleration(z, i))

    def _difference(self, z, _):
        if self.implicit:
            before, v = self.known or (z, 0.0)
            pole = math.exp(-self.gain * self.T)
            self.known = z, pole * v + (1 - pole) * (z - before) / self.T
            return self.known
        slow = z if self.known is None else self.known
        v = self.gain * (z - slow)
        self.known = slow + self.T * v
        return z, v

    def _kalman(self, z, f):
        T, w = self.T, self.gain
        z_hat, v, d, before = self.known or (z, 0.0, 0.0, None)
        if not self.implicit:
            e = z - z_hat
            self.known = z_hat + T * (v + 3 * w * e), v + T * (f + d + 3 * w * w * e), d + T * w**3 * e, f
            return z_hat, v
        z_hat, v, d = kalman(z, f, (z_hat, v, d), before, w, T)
        self.known = z_hat, v, d, f
        return z_hat, v

    def _robust(self, z, _):
        assert self.implicit
        order = int(self.kind[-1])
        v, self.known = robust_differentiator(z, self.known or [z, *[0.0] * order], self.gain, self.T)
        return z, v


class Controller:
    """The cascade: the states of its laws, and the voltages that it computed."""

    def __init__(self, world):
        self.world, self.model = world, Magnets(World(plant=world.plant | world.model))
        self.z_hat = world.observer[1].get("z_hat")
        if world.observer[0] not in ("direct", "complementary"):
            self.velocity = Velocity(world, lambda z, i: self.model.rates((z, 0.0, i), 0.0)[1])
        self.i_ref, self.integral, self.twist, self.voltages = world.inversion[1].get("i_ref"), 0.0, 0.0, []
        self.implicit = world.discretisation == "implicit"
        self.expected, self.left, self.refused, self.i_ref_shown = (0.0, 0.0, 0.0), 0, 0, 0.0

    def sample(self, n, measured):
        """Apply the guard to the readings, and call `step` with the result."""
        guard, T, body = self.world.guard, self.world.period, self.model.body
        if guard is None:
            return self.step(n, measured)
        t, (z, _, i), before = (guard["samples"] - self.left + 1) * T, self.expected, self.left
        pull = body.a * ((body.i_0 + abs(i)) / (body.s_0 - abs(z))) ** 2
        near = before == 0 or abs(measured[0] - z) <= guard["noise"] + t * (guard["speed"] + t / 2 * pull)
        estimated = self.world.observer[0] not in ("direct", "complementary")
        fine = [
            near and abs(measured[0]) <= guard["z"],
            estimated or abs(measured[1]) <= guard["z_dot"],
            abs(measured[2]) <= guard["i"],
        ]
        taken = [x if ok else y for x, y, ok in zip(measured, self.expected, fine, strict=True)]
        self.left = guard["samples"] if all(fine) else max(before - 1, 0)
        self.refused += not all(fine)
        if not all(fine) and before == 0:
            self.voltages.append(0.0)
            return self.i_ref_shown, 0.0, math.nan, False, (math.nan,) * 3
        found = self.step(n, taken)
        self.i_ref_shown = found[0]
        velocity, pieces = self.velocity_now, spans(self.world.delay, 1.0)
        u = sum((b - a) * self.voltage(n - lag) for a, b, lag in pieces)
        _, z_ddot, i_dot = self.model.rates((taken[0], velocity, taken[2]), u)
        self.expected = taken[0] + T * velocity + T * T / 2 * z_ddot, velocity + T * z_ddot, taken[2] + T * i_dot
        return found

    def voltage(self, n):
        return self.voltages[n] if n >= 0 else 0.0

    def step(self, n, measured):
        """Return the result of one step of the laws.

        It is i_ref before the step, u_n, v_star, whether the curve C is crossed, and the (z, z_dot, i) used by the
        laws.
        """
        world = self.world
        estimate = self._estimate(measured)
        self.velocity_now = estimate[1]
        seen = self._prediction(n, estimate)
        r = _reference(world.reference, (n + (world.delay if world.predict else 0)) * world.period)
        v_star = self._position(seen, r)
        if self.i_ref is None:
            self.i_ref = 0.0 if world.inversion[0] == "adaptive" else self.model.body.current(seen[0], v_star)
        i_ref, following = self.i_ref, self._inversion(seen[0], v_star)
        u = self._current(seen, (following - i_ref) / world.period)
        self.i_ref = following
        self.voltages.append(u)
        return i_ref, u, v_star, self.model.body.v_i(seen[0], i_ref) <= 0, seen

    def _estimate(self, measured):
        (kind, gains), (z, z_dot, i) = self.world.observer, measured
        if kind == "direct":
            return [z, z_dot, i]
        if kind != "complementary":
            return [*self.velocity(z, i), i]
        z_hat = z if self.z_hat is None else self.z_hat
        self.z_hat = z_hat + self.world.period * (z_dot + gains["l"] * (z - z_hat))
        return [z_hat, z_dot, i]

    def _prediction(self, n, y):
        if self.world.predict and self.world.delay:
            for a, b, lag in spans(self.world.delay, self.world.delay):
                y = rk4(functools.partial(self.model.rates, u=self.voltage(n - lag)), y, (b - a) * self.world.period)
        return y

    def _share(self, w, h, p):
        """Return (w - relax(w, h, p)) / h without cancellation; sgn_p(w) for explicit steps."""
        if not self.implicit or h == 0:
            return sgn(w, p)
        return min(max(w / h, -1.0), 1.0) if p == math.inf else sgn(relax(w, h, p), p)

    def _position(self, seen, reference):
        (kind, gains), T, body = self.world.position, self.world.period, self.model.body
        (z, z_dot, _), (r, r_dot, r_ddot, _) = seen, reference
        sigma = z_dot - r_dot + gains["c"] * (z - r)
        if kind == "sliding-mode":
            robust = -gains["k"] * self._share(sigma, T * gains["k"], gains["p"])
        elif self.implicit:
            robust, self.twist = twist(sigma, self.twist, gains["k_1"], gains["k_2"], T)
        else:
            robust = self.twist - gains["k_1"] * sigma / (sigma * sigma + gains["p"] ** -2) ** 0.25
            self.twist -= T * gains["k_2"] * sgn(sigma, gains["p"])
        return (-body.stiffness * z - gains["c"] * (z_dot - r_dot) + r_ddot + body.g + robust) / body.a

    def _inversion(self, z, v_star):
        """Return i_ref of the next sample."""
        (kind, gains), T, body = self.world.inversion, self.world.period, self.model.body
        w, gamma, p = v_star - body.v(z, self.i_ref), gains.get("gamma", math.inf), gains.get("p", math.inf)
        if kind == "adaptive" and not self.implicit:
            return self.i_ref + T * gamma * sgn(w, p) / body.v_i(z, self.i_ref)
        return body.current(z, v_star - relax(w, T * gamma, p))

    def _current(self, seen, rate):
        (kind, gains), T, body, (z, z_dot, i) = self.world.current, self.world.period, self.model.body, seen
        e, limit = i - self.i_ref, self.world.u_max
        if kind == "pi":
            u = -gains["k_p"] * e + body.kappa / (2 * body.s_0) * rate + self.integral
            held = min(max(u, -limit), limit)
            self.integral += T * (-gains["k_int"] * e + gains["k_aw"] * (held - u))
            return held
        robust, gap = gains["k_i"] * self._share(e, T * gains["k_i"], gains["p"]), body.s_0 + z
        u = body.kappa / (2 * gap) * (-2 * z_dot * i / gap + rate - robust) + body.R * i
        return min(max(u, -limit), limit)
