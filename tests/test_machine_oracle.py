"""The independent simulator of a machine, checked by itself: closed forms, conservation, one axis alone."""

import math

import numpy as np
import pytest
import sampled_oracle
from axis_oracle import Laws
from machine_oracle import MACHINES, World, machine, rk4, sensitivity, simulate

RIG = MACHINES["rigid"]["plant"]
FREE = {"plant": {"A": 1e-30}, "processor": {"delay": 0.0}, "clock": {"duration": 0.01, "sample_period": 1e-4}}
WITHOUT_GRAVITY = {"kind": "rigid", "m": 3.0, "I_t": 0.1, "I_p": 0.04, "gravity": [0.0, 0.0, 0.0]}
BEARING = {"name": "one", "kind": "radial", "at": 0.1}


def free_motion(rotor, q, q_dot, t, steps=400, **more):
    """q, q' [steps + 1, coordinates] of a rotor whose magnets have no force."""
    world = World(FREE | {"rotor": rotor, "bearing": [BEARING]} | more)
    n = len(world.parts.M)
    rows = [np.concatenate([q, q_dot, 0 * world.start[2 * n :]])]
    rates = lambda t, y: world.rates(t, y, 0.0, t)  # noqa: E731
    for k in range(steps):
        rows.append(rk4(rates, k * t / steps, rows[-1], t / steps))
    rows = np.array(rows)
    return rows[:, :n], rows[:, n : 2 * n]


def test_the_mass_of_a_point():
    parts = machine(MACHINES["five"])
    rotor, places = MACHINES["five"]["rotor"], [-0.2516, -0.2516, 0.2584, 0.2584]
    assert parts.names == ["left.x", "left.y", "right.x", "right.y", "thrust.z"]
    expected = [1 / (1 / rotor["m"] + at**2 / rotor["I_t"]) for at in places] + [rotor["m"]]
    assert parts.m_k == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize("name", MACHINES)
def test_the_bearings_carry_the_weight_by_the_smallest_forces(name):
    parts, rotor = machine(MACHINES[name]), MACHINES[name]["rotor"]
    rigid = parts.b[:, :5]
    weight = -rotor["m"] * np.array([*rotor.get("gravity", (0.0, -9.81, 0.0)), 0.0, 0.0])
    assert np.abs(rigid.T @ parts.F_0 - weight).max() < 1e-12
    rest = np.linalg.svd(rigid.T)[2][np.linalg.matrix_rank(rigid) :]  # forces that cancel each other
    assert np.abs(rest @ parts.F_0).sum() < 1e-12


def test_a_point_moves_with_the_shaft():
    """A turn beta_y about y moves a point at l by l beta_y along x, a turn beta_x by -l beta_x along y."""
    parts = machine(MACHINES["slanted"])
    q, at = np.array([1.0, 2.0, 3.0, 0.01, 0.02]), -0.2516
    point = np.array([1.0 + at * 0.02, 2.0 - at * 0.01])
    assert parts.b[0] @ q == pytest.approx(point.sum() / math.sqrt(2), rel=1e-14)
    assert parts.b[1] @ q == pytest.approx((point[1] - point[0]) / math.sqrt(2), rel=1e-14)


def test_a_sensor_reads_its_own_place():
    """At rest and displaced, the first voltages are those of a rotor at 0 if the errors cancel c q."""
    world = World(MACHINES["bending"])
    q, none = np.array([1e-5, -2e-5, 3e-5, 1e-4, 2e-4, 1e-5, -1e-5, 2e-5, 3e-5]), np.zeros((1, 4))
    bent = 1e-5 - 0.2666 * 2e-4 - 0.55 * 1e-5 + 0.4 * 2e-5  # left.x
    assert world.parts.c[0] @ q == pytest.approx(bent, rel=1e-14)
    u = [
        world.sample(0, world.place(place, np.zeros(4)), [{}] * 4, none, e, substeps=1)[3][2]
        for place, e in ((q, -world.parts.c @ q), (0 * q, np.zeros(4)), (q, np.zeros(4)))
    ]
    assert u[0] == pytest.approx(u[1], abs=1e-9)
    assert np.abs(np.subtract(u[2], u[1])).min() > 1.0


def test_a_free_rotor_keeps_its_momentum_and_nutates():
    """The tilt rate turns forwards, from x to y, at I_p W / I_t, and I_t beta' + W G beta is constant."""
    rotor = WITHOUT_GRAVITY | {"speed": 9000.0}
    W, t = 9000.0 * math.pi / 30, 0.02
    q, v = free_motion(rotor, np.zeros(5), np.array([0.1, -0.2, 0.3, 0.4, 0.5]), t)
    assert v[:, :3] == pytest.approx(np.tile([0.1, -0.2, 0.3], (len(v), 1)), abs=1e-12)
    G = np.array([[0.0, 0.04], [-0.04, 0.0]])
    momentum = 0.1 * v[:, 3:] + W * q[:, 3:] @ G.T
    assert np.abs(momentum - momentum[0]).max() < 1e-9  # RK4 keeps linear invariants: rounding of 400 steps
    turn = (v[:, 4] - 1j * v[:, 3]) / (v[0, 4] - 1j * v[0, 3])  # of a point, along x + i y
    exact = np.exp(1j * 0.04 * W / 0.1 * np.linspace(0, t, len(v)))
    assert np.abs(turn - exact).max() < 1e-7  # 400 steps of RK4 over 7.5 rad: error 7.5 (7.5/400)^4/120


@pytest.mark.parametrize("acceleration", [0.0, 2e5])
def test_the_unbalance_response_of_a_free_rotor(acceleration):
    """The centre of mass circles the axis of rotation: x + i y = -U/m exp(i (theta + phi)), at any theta(t)."""
    rotor = WITHOUT_GRAVITY | {"speed": 3000.0, "acceleration": acceleration}
    W, rate, t = 3000.0 * math.pi / 30, acceleration * math.pi / 30, 0.02
    times, e, phase = np.linspace(0, t, 401), 120e-6 / 3.0, math.radians(40.0)
    path = -e * np.exp(1j * (W * times + rate * times**2 / 2 + phase))
    start = 1j * W * path[0]
    load = [{"at": 0.0, "amount": 120.0, "phase": 40.0}]
    q, _ = free_motion(
        rotor, np.array([path[0].real, path[0].imag, 0, 0, 0]), np.array([start.real, start.imag, 0, 0, 0]), t,
        unbalance=load,
    )  # fmt: skip
    assert np.abs(q[:, 0] + 1j * q[:, 1] - path).max() < 1e-7 * e
    assert np.abs(q[:, 2:]).max() < 1e-20  # the magnets' area is not quite 0


def test_a_load_turns_and_bends_the_rotor():
    """A force F at l: the accelerations F/m, -l F_y/I_t, l F_x/I_t, and those of the modes by its shapes."""
    rotor = WITHOUT_GRAVITY | {"kind": "modal", "modes": [{"frequency": 100.0, "damping": 0.01}]}
    load = {"at": 0.2, "direction": [3.0, 4.0, 0.0], "kind": "constant", "value": 10.0}
    for shapes in ([], [0.5]):
        world = World(FREE | {"rotor": rotor, "bearing": [BEARING], "load": [load | {"modes": shapes}]})
        found = world.rates(0.0, world.start, 0.0, 0.0)[7:14]
        expected = [2.0, 8 / 3, 0.0, -0.2 * 8 / 0.1, 0.2 * 6 / 0.1, *(np.array([6.0, 8.0]) * sum(shapes))]
        assert found == pytest.approx(expected, abs=1e-12)


def test_a_free_mode_decays():
    rotor = WITHOUT_GRAVITY | {"kind": "modal", "modes": [{"frequency": 80.0, "damping": 0.1}]}
    q, _ = free_motion(rotor, np.array([0, 0, 0, 0, 0, 1e-3, 2e-3]), np.zeros(7), 0.02)
    times, w = np.linspace(0, 0.02, 401), 2 * math.pi * 80.0
    fast, slow = w * math.sqrt(1 - 0.01), 0.1 * w
    exact = np.exp(-slow * times) * (np.cos(fast * times) + slow / fast * np.sin(fast * times))
    assert q[:, 5:] == pytest.approx(np.outer(exact, [1e-3, 2e-3]), abs=1e-10)


def one_axis(kind="lumped", **options):
    """The options of sampled_oracle, and the tables of a case with the same meaning."""
    gains = {
        "observer": ("direct", {}),
        "position": ("sliding-mode", {"c": 600.0, "k": 100.0, "p": 9.0}),
        "inversion": ("adaptive", {"gamma": 7e10, "p": 0.0025, "i_ref": 0.0}),
        "current": ("sliding-mode", {"k_i": 3000.0, "p": 2.5}),
    }
    delay = options.pop("delay", 1.0)
    rest = {name: options.pop(name) for name in list(options) if name in ("discretisation", "predict")}
    gains |= options
    case = {
        "plant": RIG | {"kind": kind},
        "controller": {stage: {"kind": name, **numbers} for stage, (name, numbers) in gains.items()},
        "processor": {"delay": delay} | rest,
        "actuator": {"u_max": 30.0},
        "clock": {"duration": 0.01, "sample_period": 5e-5},
    }
    return {"kind": kind, "delay": delay, "u_max": 30.0, "period": 5e-5} | rest | gains, case


PI = ("pi", {"k_p": 70.0, "k_int": 9e4, "k_aw": 1200.0})
GENTLE = ("adaptive", {"gamma": 2e10, "p": 4e-7, "i_ref": 0.1})
ALONE = [
    one_axis(),
    one_axis(delay=0.0),
    one_axis(kind="two-coil", delay=1.5, predict=False, current=PI, inversion=("closed-form", {})),
    one_axis(observer=("kalman", {"w": 2000.0})),
    one_axis(observer=("difference", {"w": 6000.0}), delay=2.0),
    one_axis(observer=("complementary", {"l": 13.0}), delay=0.5, current=PI),
    one_axis(discretisation="explicit", observer=("kalman", {"w": 2000.0}), inversion=GENTLE, predict=False),
]


@pytest.mark.parametrize(("options", "case"), ALONE)
def test_every_axis_of_a_rotor_that_does_not_couple_them_equals_the_axis_alone(options, case):
    """With l^2 = I_t/m at both ends, a force at one end does not move the other: each has the mass m/2."""
    rotor = {"kind": "rigid", "m": 3.0, "I_t": 0.12, "I_p": 0.05}
    ends = [{"name": name, "kind": "radial", "at": at} for name, at in (("left", -0.2), ("right", 0.2))]
    rotor_case = case | {"rotor": rotor, "bearing": ends, "initial": {"q": [2e-5, 1e-5, 0.0, 1e-4, 2e-4]}}
    found = simulate(rotor_case, 1 if options["delay"] % 1 else 2)  # substeps as long as those of sampled_oracle
    assert found.lost_at == math.inf
    for k, name in enumerate(found.axes):
        plant = RIG | {"m": 1.5, "k_z": 0.0, "g": 9.81 * name.endswith("y")}
        world = sampled_oracle.World(plant=plant, initial=(found.z[0, k], 0.0, 0.0), **options)
        alone = sampled_oracle.simulate(world, len(found.t), fast=True)
        assert np.abs(found.z[:, k] - alone.z).max() < 1e-16  # m; roundings
        assert np.abs(found.i[:, k] - alone.i).max() < 1e-12
        assert np.abs(found.i_ref[:, k] - alone.i_ref).max() < 1e-12
        assert np.abs(found.u[:, k] - alone.u).max() < 1e-9


@pytest.mark.parametrize(("form", "left"), [("implicit", 1 / 1.5), ("explicit", 0.5)])
def test_the_filter_of_the_pid_follows_a_step_of_the_velocity(form, left):
    """With w_f T = 0.5, each step leaves this share of the error. The explicit form uses the filter before its step."""
    gains = {"kind": "pid", "k_p": 0.0, "k_int": 0.0, "k_d": 1.0, "k_aw": 0.0, "w_f": 5e3}
    case = {"clock": {"sample_period": 1e-4}, "processor": {"discretisation": form}}
    law, state, demands = Laws(case, {"plant": RIG, "controller": {"position": gains}}, 1.5, 9.81), {}, []
    for velocity in (0.0, 1.0, 1.0, 1.0):
        demands.append(9.81 - law.model.a * law.position(state, 0.0, velocity, 0.0))
    steps = np.arange(4) if form == "implicit" else np.array([0, 0, 1, 2])
    assert demands == pytest.approx(1 - left**steps, abs=1e-12)


@pytest.mark.parametrize("name", MACHINES)
def test_the_machines_are_held_and_stable(name):
    case = MACHINES[name]
    run, loop = simulate(case, 1), sensitivity(case, substeps=1)
    assert run.lost_at == math.inf
    assert len(run.t) >= 200
    assert np.abs(run.z[-1]).max() < 3e-5
    assert loop.stable
    assert max(peak for peak, _ in loop.peaks) < 3.0
    assert loop.sigma_max[0] >= max(peak for peak, _ in loop.peaks)


def test_a_rotor_without_voltage_is_lost():
    case = MACHINES["rigid"] | {"actuator": {"u_max": 0.0}}
    run = simulate(case, 1)
    lost = round(run.lost_at / 5e-5 + 0.5)
    assert np.isfinite(run.z[:lost]).all()
    assert np.isnan(run.z[lost:]).all()
    assert np.abs(run.z[lost - 1]).max() < 4.5e-4


@pytest.mark.parametrize("name", ["five", "run-up"])
def test_the_sensitivity_is_that_of_an_injected_sine(name):
    """e on one axis at 1/32 of the sampling rate, small; the reading of each axis over its last period, per e."""
    world, axis, period, size = World(MACHINES[name], still=True), 1, 32, 1e-10
    loop = sensitivity(MACHINES[name], [1 / (period * world.T)], substeps=1)
    readings = []
    for sign in (1, -1):  # half the difference of the two runs is linear in e
        y, states, past = world.start, [{} for _ in world.laws], np.zeros((math.ceil(world.delay), len(world.laws)))
        rows = []
        for n in range(1600):
            e = np.zeros(len(world.laws))
            e[axis] = sign * size * math.cos(2 * math.pi * n / period)
            rows.append(world.parts.c @ y[: len(world.parts.M)] + e)
            y, states, past, *_ = world.sample(n, y, states, past, e, substeps=1)
        readings.append(np.array(rows[-period:]))
    wave = np.exp(-2j * math.pi * np.arange(1600 - period, 1600) / period)
    S = wave @ (readings[0] - readings[1]) / (period * size)
    assert np.abs(S - loop.S[0][:, axis]).max() < 1e-5


def test_the_eigenvalues_of_a_published_rotor():
    """The test rig of AMrotor under springs -k_s and a PID in currents, from its table of shapes, at 0 rpm.

    The expected values come from a finite-element model. Damping in proportion to stiffness, 5e-7 s, gives theirs.
    """
    frequencies = [22.38, 105.57, 176.53, 212.87, 607.4]
    modes = [{"frequency": f, "damping": 5e-7 * math.pi * f} for f in frequencies]
    ends = [
        {"name": "left", "kind": "radial", "at": -0.2516, "modes": [-0.4587, -0.0004, 0.1728, 0.136, -0.2031]},
        {"name": "right", "kind": "radial", "at": 0.2584, "modes": [-0.4649, 0.0419, 0.088, -0.1208, -0.0117]},
    ]
    parts = machine({"rotor": MACHINES["rigid"]["rotor"] | {"modes": modes}, "bearing": ends})
    k_i, k_s, (k_p, k_int, k_d), n = 50.0, 1e5, (5000.0, 1500.0, 5.0), len(parts.M)
    magnets, inverse = parts.b.T @ parts.b, np.diag(1 / parts.M)
    A = np.block([
        [np.zeros((n, n)), np.eye(n), np.zeros((n, 4))],
        [inverse @ ((k_s - k_i * k_p) * magnets - parts.K), -inverse @ (parts.D + k_i * k_d * magnets),
         -k_i * k_int * inverse @ parts.b.T],
        [parts.b, np.zeros((4, n + 4))],
    ])  # fmt: skip
    found = np.linalg.eigvals(A)
    found = found[found.imag > 1.0]
    found = found[np.argsort(found.imag)][::2]  # each in x and in y
    real = [-0.50, -127.45, -128.93, -0.50, -6.04, -5.20, -8.91]
    imaginary = [16.72, 59.22, 61.10, 105.59, 176.75, 213.03, 607.5]
    assert found.real == pytest.approx(real, abs=0.05)  # the shapes are printed to four digits
    assert found.imag / (2 * math.pi) == pytest.approx(imaginary, abs=0.05)
