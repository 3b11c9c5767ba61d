"""An independent simulator of a rotor on several magnetic bearings, in plain NumPy: shares no code with ambjax.

A case is a dictionary with the keys of a case file that has [rotor] with a kind and [processor]. On every axis the
rules are those of `sampled_oracle`; the rotor couples the axes. Readings of the rules where they leave room:
- a bearing's table replaces single keys of the common table; if it names another kind, it replaces the whole table.
- k_z is 0. The model of an axis is lumped, with the axis's own numbers, and does not know the speed.
- default gains follow from the axis's model: m_k, its own magnet; the bandwidth w = sqrt(a dv/dz(0, 0)).
- the first axis of a radial bearing is (cos angle, sin angle, 0), the second (-sin angle, cos angle, 0).
- coordinates: x, y, z, beta_x, beta_y, then for each mode its x and its y; those that [initial] omits are 0.
- initial.i is a number for all axes or one for each. q' = 0; u = 0 before the first voltage; r = 0.
- a load's direction is made a unit vector. A step or pulse jumps at its edges, where a substep ends.
- the base's acceleration, along such a direction, acts as -M times it on the coordinates, which are relative to it.
- a row's u is within +-u_max; i_ref is that before the step, and that of a law without a start its first one.
- an axis is lost at |z_k| >= clearance (0.9 s_0 of the axis), not at a radius; later rows are NaN.
- there is no guard of the readings: the cases switch it off.
- sensitivity: the speed of t = 0; no acceleration, unbalance, load or limit; the equilibrium of r = 0 is found by
  Newton's method, since the static forces bend the modes, so that z_k is not 0 there.
"""

import functools
import itertools
import math
from types import SimpleNamespace

import numpy as np
from axis_oracle import Laws, Magnet, rk4
from oracle import TABLE_1
from sampled_oracle import spans
from scipy.optimize import minimize_scalar

RPM = 2 * math.pi / 60


def merge(common, own):
    """Return the common table with the keys of a bearing's own."""
    result = dict(common)
    for key, value in own.items():
        known = common.get(key, {})
        same = isinstance(value, dict) and value.get("kind", known.get("kind")) == known.get("kind")
        result[key] = merge(known, value) if same else value
    return result


def row(direction, at, shapes, modes):
    """Return b, with b q the displacement of the place along the direction. A mode without a shape does not move it."""
    x, y, z = direction
    shapes = [*shapes, *[0.0] * (modes - len(shapes))]
    return np.array([x, y, z, -at * y, at * x, *(s * d for s in shapes for d in (x, y))])


def machine(case):
    """Return M (its diagonal), D, G, K, gravity, and of the axes: names, tables, b, c, F_0, m_k, g_k."""
    rotor, modes = case["rotor"], case["rotor"].get("modes", [])
    w = np.repeat([2 * math.pi * mode["frequency"] for mode in modes], 2)
    zeta = np.repeat([mode["damping"] for mode in modes], 2)
    m, rigid = rotor["m"], np.zeros(5)
    M = np.array([m, m, m, rotor["I_t"], rotor["I_t"], *np.ones(len(w))])
    G = np.zeros((len(M), len(M)))
    G[3, 4], G[4, 3] = rotor["I_p"], -rotor["I_p"]
    if "Gm" in rotor:  # of mass-normalised coordinates: x, beta_y, x of each mode with y, -beta_x, y of each mode
        x, y = [0, 4, *range(5, len(M), 2)], [1, 3, *range(6, len(M), 2)]
        Gm = rotor["Gm"] * np.sqrt(np.outer(M[x], M[x])) * np.where(np.array(y) == 3, -1.0, 1.0)
        G[np.ix_(x, y)], G[np.ix_(y, x)] = Gm, -Gm.T
    names, tables, b, c = [], [], [], []
    for bearing in case["bearing"]:
        angle, at, shapes = math.radians(bearing.get("angle", 0.0)), bearing.get("at", 0.0), bearing.get("modes", [])
        ways = {"x": (math.cos(angle), math.sin(angle), 0.0), "y": (-math.sin(angle), math.cos(angle), 0.0)}
        if bearing["kind"] == "axial":
            ways, shapes = {"z": (0.0, 0.0, 1.0)}, []
        for letter in bearing.get("axes", ways):
            way = ways[letter]
            names.append(f"{bearing['name']}.{letter}")
            b.append(row(way, at, shapes, len(modes)))
            c.append(row(way, bearing.get("sensor_at", at), bearing.get("sensor_modes", shapes), len(modes)))
            tables.append({key: merge(case.get(key, {}), bearing.get(key, {})) for key in ("plant", "controller")})
    b, c = np.array(b), np.array(c)
    gravity = np.zeros(len(M))
    gravity[:3] = m * np.array(rotor.get("gravity", (0.0, -9.81, 0.0)))
    F_0, m_k = np.linalg.pinv(b[:, :5].T) @ -gravity[:5], 1 / (b[:, :5] ** 2 / M[:5]).sum(1)
    D, K = np.diag(np.append(rigid, 2 * zeta * w)), np.diag(np.append(rigid, w * w))
    return SimpleNamespace(
        M=M, D=D, G=G, K=K, gravity=gravity, names=names, tables=tables, b=b, c=c, F_0=F_0, m_k=m_k, g_k=F_0 / m_k
    )


class World:
    """The rotor under its magnets, unbalance and loads: y = q, q', currents [1 or 2, axes]."""

    def __init__(self, case, still=False):
        self.parts = parts = machine(case)
        self.T, self.delay = case["clock"]["sample_period"], case["processor"].get("delay", 1.0)
        self.u_max = math.inf if still else case.get("actuator", {}).get("u_max", math.inf)
        each = zip(parts.tables, parts.m_k, parts.g_k, strict=True)
        self.laws = [Laws(case, tables, m, g) for tables, m, g in each]
        rigid = case.get("controller", {}).get("coordinates") == "rigid-body"
        self.act = RigidLaws(case, parts, self.laws).step if rigid else self.by_axis
        models = [TABLE_1 | tables["plant"] for tables in parts.tables]
        self.magnet = Magnet({name: np.array([one[name] for one in models]) for name in TABLE_1})
        self.coils = 2 if case.get("plant", {}).get("kind") == "two-coil" else 1
        self.stop = case.get("run", {}).get("clearance", 0.9 * self.magnet.s_0)
        rotor, n = case["rotor"], len(parts.M)
        self.speed, self.gain = RPM * rotor.get("speed", 0.0), 0.0 if still else RPM * rotor.get("acceleration", 0.0)
        modes, self.masses, self.loads = (n - 5) // 2, [], []
        for one in () if still else case.get("unbalance", ()):
            x, y = (row(way, one["at"], one.get("modes", []), modes) for way in ((1, 0, 0), (0, 1, 0)))
            self.masses.append((1e-6 * one["amount"], math.radians(one.get("phase", 0.0)), x, y))
        for one in () if still else case.get("load", ()):
            way = np.array(one["direction"]) / np.linalg.norm(one["direction"])
            self.loads.append((one, row(way, one["at"], one.get("modes", []), modes)))
        for one in () if still else case.get("base", ()):
            way = np.array(one["direction"]) / np.linalg.norm(one["direction"])
            self.loads.append((one, -parts.M * np.append(way, np.zeros(n - 3))))
        initial = case.get("initial", {})
        q = np.zeros(n)
        q[: len(initial.get("q", ()))] = initial.get("q", ())
        self.start = self.place(q, np.broadcast_to(initial.get("i", 0.0), len(parts.names)))

    def place(self, q, i):
        """Return the state at rest at q with the currents i of the axes."""
        i_0 = self.magnet.i_0
        return np.concatenate([q, 0 * q, *([i] if self.coils == 1 else [i_0 + i, i_0 - i])])

    def split(self, y):
        n = len(self.parts.M)
        return y[:n], y[n : 2 * n], y[2 * n :].reshape(self.coils, -1)

    def rates(self, t, y, u, middle):
        """`middle`: a time within the step, at which signals with jumps are taken."""
        parts, (q, q_dot, currents) = self.parts, self.split(y)
        z, z_dot, W = parts.b @ q, parts.b @ q_dot, self.speed + self.gain * t
        force = parts.b.T @ (self.magnet.kappa / 4 * self.magnet.force(z, currents)) + parts.gravity
        for amount, phase, x, y_row in self.masses:
            angle = self.speed * t + self.gain * t * t / 2 + phase
            c, s = math.cos(angle), math.sin(angle)
            force = force + amount * ((W * W * c + self.gain * s) * x + (W * W * s - self.gain * c) * y_row)
        for one, b in self.loads:
            force = force + signal(one, t, middle) * b
        q_ddot = (force - (parts.D + W * parts.G) @ q_dot - parts.K @ q) / parts.M
        return np.concatenate([q_dot, q_ddot, *self.magnet.current_rates(z, z_dot, currents, u)])

    def by_axis(self, states, readings, past, u_max, W):
        steps = [
            law.step(state, reading, past[:, k], u_max)
            for k, (law, state, reading) in enumerate(zip(self.laws, states, readings, strict=True))
        ]
        return tuple(zip(*steps, strict=True))

    def sample(self, n, y, states, past, e=0.0, substeps=8):
        """Return y, the laws' states and the voltages [lags, axes] of sample n + 1, the row, the time of a loss."""
        parts, (q, q_dot, currents) = self.parts, self.split(y)
        i = currents[0] if self.coils == 1 else (currents[0] - currents[1]) / 2
        readings = zip(parts.c @ q + e, parts.c @ q_dot, i, strict=True)
        W = self.speed + self.gain * n * self.T
        u, states, i_ref = self.act(states, list(readings), past, self.u_max, W)
        given = np.vstack([u, past])
        edges = [edge / self.T - n for one, _ in self.loads for edge in (one.get("start"), one.get("stop")) if edge]
        for start, stop, lag in spans(self.delay, 1.0):
            cuts = sorted({start, stop, *(edge for edge in edges if start + 1e-9 < edge < stop - 1e-9)})
            for a, b in itertools.pairwise(cuts):
                h, middle = (b - a) * self.T / substeps, (n + (a + b) / 2) * self.T
                for k in range(substeps):
                    rates = functools.partial(self.rates, u=given[lag], middle=middle)
                    y = rk4(rates, (n + a) * self.T + k * h, y, h)
                    if (abs(np.real(parts.b @ y[: len(parts.M)])) >= self.stop).any():
                        return y, states, given[:-1], (i, i_ref, u), (n + a) * self.T + (k + 1) * h
        return y, states, given[:-1], (i, i_ref, u), None


class Coordinate(Laws):
    """Observer and position law of one rigid coordinate, which demand an acceleration. All gains are given.

    In the place of a current stands the acceleration that the currents of all magnets give, without the weight.
    """

    def __init__(self, case, weight, name):
        controller, self.T = case["controller"], case["clock"]["sample_period"]
        tables = {stage: controller.get(stage, {}) for stage in ("observer", "position")}
        part = {"beta_x": "tilt", "beta_y": "tilt", "z": "axial"}.get(name)
        tables = merge(tables, controller.get(part, {}))
        self.kind = {"observer": tables["observer"].get("kind", "direct"), "position": tables["position"]["kind"]}
        self.gains = tables
        self.model = SimpleNamespace(a=1.0, g=-weight, v=lambda z, acceleration: acceleration)


class RigidLaws:
    """Rigid-body coordinates: readings to coordinates, accelerations to forces, then the inner loops of the axes.

    The prediction integrates the rigid rotor with its nominal magnets, without gyroscopic terms unless they are
    compensated; W is that of the sample. The PID unwinds towards the acceleration by the measured currents.
    """

    def __init__(self, case, parts, laws):
        self.axes, controller, names = laws, case["controller"], ("x", "y", "z", "beta_x", "beta_y")
        held = np.flatnonzero((parts.b[:, :5] != 0).any(0))
        self.B, self.C, self.M = parts.b[:, held], parts.c[:, held], parts.M[held]
        self.weight, self.G = (parts.gravity / parts.M)[held], parts.G[np.ix_(held, held)]
        self.G = self.G * controller.get("compensate_gyroscopics", False)
        self.laws = [Coordinate(case, weight, names[k]) for k, weight in zip(held, self.weight, strict=True)]
        self.kappa = np.array([law.model.kappa for law in laws])

    def by_magnets(self, z, i):
        v = np.array([law.model.v(*each) for law, *each in zip(self.axes, z, i, strict=True)])
        return self.B.T @ (self.kappa / 4 * v) / self.M

    def rates(self, y, u, W):
        n = len(self.M)
        q, v, i = y[:n], y[n : 2 * n], y[2 * n :]
        z, z_dot = self.B @ q, self.B @ v
        given = zip(self.axes, z, z_dot, i[:, None], u, strict=True)
        moved = [law.model.current_rates(*each)[0] for law, *each in given]
        return np.concatenate([v, self.by_magnets(z, i) + self.weight - W * self.G @ v / self.M, moved])

    def step(self, states, readings, past, u_max, W):
        c, n, first = len(self.axes), len(self.laws), self.axes[0]
        states = [dict(state) for state in states] + [{} for _ in range(c + n - len(states))]
        y, y_dot, i = np.array(readings).T
        q, v = np.linalg.pinv(self.C) @ y, np.linalg.pinv(self.C) @ y_dot
        given = zip(self.laws, states[c:], q, v, self.by_magnets(self.B @ q, i), strict=True)
        q, v, _ = np.array([law.observe(state, each) for law, state, *each in given]).T
        if first.predict:
            x = np.concatenate([q, v, i])
            for a, b, lag in spans(first.delay, first.delay):
                x = rk4(lambda _, x, u=past[lag - 1]: self.rates(x, u, W), 0.0, x, (b - a) * first.T)
            q, v, i = x[:n], x[n : 2 * n], x[2 * n :]
        z, z_dot = self.B @ q, self.B @ v
        given = zip(self.laws, states[c:], q, v, self.by_magnets(z, i), strict=True)
        wanted = np.array([law.position(state, *each) for law, state, *each in given])
        F = np.linalg.pinv(self.B.T) @ (self.M * wanted + W * self.G @ v)
        u, i_ref = [], []
        for k, (law, state) in enumerate(zip(self.axes, states, strict=False)):
            following = law.inversion(state, z[k], F[k] / (law.model.kappa / 4))
            i_ref.append(state.get("i_ref", following))
            u.append(law.current(state, z[k], z_dot[k], i[k], i_ref[k], (following - i_ref[k]) / law.T, u_max))
            state["i_ref"] = following
        return u, states, i_ref


def signal(one, t, middle):
    """Return the value of a load, N."""
    kind = one["kind"]
    if kind == "sine":
        return one["amplitude"] * math.sin(2 * math.pi * one["frequency"] * t + one.get("phase", 0.0))
    return one["amplitude"] * (one["start"] <= middle < one.get("stop", math.inf))


def simulate(case, substeps=8):
    """Return the rows t [N], z, i, u, i_ref [N, axes], q [N, coordinates], NaN after a loss, and `lost_at`."""
    world = World(case)
    parts, y = world.parts, world.start
    N = round(case["clock"]["duration"] / world.T)
    states, past = [{} for _ in parts.names], np.zeros((math.ceil(world.delay), len(parts.names)))
    q, rows, lost_at = np.full((N, len(parts.M)), np.nan), np.full((N, 3, len(parts.names)), np.nan), math.inf
    for n in range(N):
        q[n] = y[: len(parts.M)]
        y, states, past, rows[n], touched = world.sample(n, y, states, past, substeps=substeps)
        if touched is not None and n < N - 1:
            lost_at = touched
            break
    i, i_ref, u = rows.transpose(1, 0, 2)
    return SimpleNamespace(
        t=world.T * np.arange(N), axes=parts.names, z=q @ parts.b.T, q=q, i=i, u=u, i_ref=i_ref, lost_at=lost_at
    )


class Loop:
    """The map of one period, x -> x+, at rest: x = y, the laws' states and the voltages on their way, in one array."""

    def __init__(self, case, substeps):
        self.world, self.substeps = World(case, still=True), substeps
        parts, magnets = self.world.parts, self.world.magnet
        a = magnets.kappa / 4
        i = np.array([law.model.current(0.0, F / k) for law, F, k in zip(self.world.laws, parts.F_0, a, strict=True)])
        y, past = self.world.place(0 * parts.M, i), np.tile(magnets.R * i, (math.ceil(self.world.delay), 1))
        _, self.states, *_ = self.world.sample(0, y, [{"i_ref": one} for one in i], past, substeps=1)
        self.axes = len(parts.names)
        self.guess = self.pack(y, self.states, past)
        n = len(parts.M)
        held = (parts.b != 0).any(0) | (parts.K.diagonal() != 0)
        self.kept = np.append(np.tile(held, 2), np.full(len(self.guess) - 2 * n, True))

    def pack(self, y, states, past):
        return np.concatenate([y, [number for state in states for number in state.values()], past.ravel()])

    def __call__(self, x, e):
        y, x = x[: len(self.world.start)], x[len(self.world.start) :]
        states = []
        for state in self.states:
            states.append(dict(zip(state, x, strict=False)))
            x = x[len(state) :]
        past = x.reshape(-1, self.axes)
        y, states, past, *_ = self.world.sample(0, y, states, past, e, self.substeps)
        states = [{name: new[name] for name in old} for old, new in zip(self.states, states, strict=True)]
        return self.pack(y, states, past)

    def jacobian(self, x):
        """Return A and B of x+ = A x + B e, by complex steps."""
        n, axes, tiny = len(x), self.axes, 1e-30
        ways = np.eye(n + axes) * tiny * 1j
        columns = [self(x + way[:n], way[n:]).imag / tiny for way in ways]
        return np.split(np.array(columns).T, [n], axis=1)

    def equilibrium(self):
        x, none, kept = self.guess, np.zeros(self.axes), self.kept
        for _ in range(20):
            A, _ = self.jacobian(x)
            change = (self(x, none) - x)[kept]
            move = np.linalg.solve(np.eye(len(change)) - A[np.ix_(kept, kept)], change)
            x[kept] += move
            if abs(move[: len(self.world.parts.M)]).max() < 1e-14:
                return x
        raise ArithmeticError("no equilibrium found")


def sensitivity(case, substeps=8):
    """Return the peaks of |S_kk| of every axis and of the largest singular value, and whether the loop is stable.

    S [axes, axes] is the reading of a row per e of a column. The peaks, from 0 to 0.45/T, are refined.
    """
    loop = Loop(case, substeps)
    x, T = loop.equilibrium(), loop.world.T
    A, B = loop.jacobian(x)
    kept = loop.kept
    A, B = A[np.ix_(kept, kept)], B[kept]
    C = np.zeros((len(B.T), len(x)))
    C[:, : len(loop.world.parts.M)] = loop.world.parts.c
    C, one, poles = C[:, kept], np.eye(len(A)), np.linalg.eigvals(A)

    def figures(f):
        matrix = np.eye(len(C)) + C @ np.linalg.solve(np.exp(2j * math.pi * f * T) * one - A, B)
        return np.append(abs(matrix.diagonal()), np.linalg.norm(matrix, 2))

    near = abs(np.angle(poles)) / (2 * math.pi * T)
    grid = np.unique([0.0, *np.geomspace(1.0, 0.45 / T, 600), *near[(near > 1) & (near < 0.45 / T)]])
    values = np.array([figures(f) for f in grid])
    peaks = []
    for k, best in enumerate(values.argmax(0)):
        low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
        found = minimize_scalar(
            lambda f, k=k: -figures(f)[k], bounds=(low, high), method="bounded", options={"xatol": 1e-6 * high}
        )
        peaks.append((-found.fun, found.x) if -found.fun > values[best, k] else (values[best, k], grid[best]))
    return SimpleNamespace(peaks=peaks[:-1], sigma_max=peaks[-1], stable=abs(poles).max() < 1)
