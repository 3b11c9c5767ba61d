"""The independent simulator of the sampled loop, checked by itself: hand-computed cases, limits, conservation."""

import itertools
import math

import numpy as np
import oracle
import pytest
import sampled_oracle
from profiles import THOROUGH
from sampled_oracle import QUIET, TABLE_1, Lumped, TwoCoil, World, conversion, current_for, relax, sgn, simulate, twist
from scipy.integrate import solve_ivp

SINE = ("sine", {"amplitude": 2.5e-3, "frequency": 2.0})
PULSE = ("pulse", {"amplitude": 1.0, "start": 0.5, "stop": 0.7})  # the paper's: 1 A^2/m^2
WRONG = {"m": 0.588 * 1.1, "k_z": -754.0 * 0.9, "R": 41.44 * 1.1, "A": 0.121 * 0.9}
# slopes at zero of at most 2500 1/s, far below the 1e5 samples a second of the checks of order
SMOOTH = {
    "inversion": ("adaptive", {"gamma": 1e9, "p": 4e-6, "i_ref": 0.0}),
    "reference": SINE,
    "q_z": ("pulse", {"amplitude": 1.0, "start": 0.00503, "stop": 0.01107}),
}


def twisting(k_1, p):
    return "super-twisting", {"c": 17.0, "k_1": k_1, "k_2": 50.0, "p": p}


def random_cases(size):
    """w of both signs, h and p over many decades."""
    rng = np.random.default_rng(1)
    decades, signs = rng.uniform([-9, -9, -6], [6, 6, 9], (size, 3)), rng.choice([-1, 1], size)
    return [(sign * 10**a, 10**b, 10**c) for sign, (a, b, c) in zip(signs, decades, strict=True)]


@pytest.mark.parametrize("infinite", [False, True])
def test_relax_solves_its_equation(infinite):
    for w, h, p in random_cases(3000):
        y = relax(w, h, math.inf if infinite else p)
        assert y * w >= 0
        assert abs(y) <= abs(w)
        assert relax(-w, h, p) == -relax(w, h, p)
        if infinite:  # outside the band w moves by h; inside it comes to rest
            assert y == (math.copysign(abs(w) - h, w) if abs(w) > h else 0.0)
        else:  # a few roundings of the largest term, carried through the slope 1 + h sgn_p' by the y next to it
            slope = 1 + h * 2 / math.pi * p / (1 + (p * y) ** 2)
            assert abs(y + h * sgn(y, p) - w) <= 4 * np.finfo(float).eps * (abs(w) + h + slope * abs(y))


def test_relax_converges_to_clipping_and_is_the_identity_for_a_zero_gain():
    assert relax(0.3, 0.1, 1e12) == pytest.approx(relax(0.3, 0.1, math.inf), rel=1e-10)
    assert relax(0.3, 0.0, 25.0) == 0.3


@pytest.mark.parametrize("name", ["lumped", "two-coil"])
def test_a_rotor_at_rest_stays_at_rest(name):
    """The scaled force balances weight and spring, and u = R i, so all rates are 0 at every height."""
    plant = (TwoCoil if name == "two-coil" else Lumped)(World())
    body = plant.body
    for z in (0.0, 1e-3, -3e-3):
        i = current_for(body, z, (body.g - body.stiffness * z) / body.a)
        y = [z, 0.0, body.i_0 + i, body.i_0 - i] if name == "two-coil" else [z, 0.0, i]
        assert plant.output(y)[2] == pytest.approx(i, rel=1e-14)
        # roundings of 10 m/s^2 and of the 1e2 A/s that each voltage alone would drive
        assert np.abs(plant.rates(y, body.R * i)).max() < 1e-12


def test_two_coils_conserve_energy_and_flux():
    """The energy is kinetic, of the spring, of the weight, and kappa/4 (i_1^2/(s_0 - z) + i_2^2/(s_0 + z)).

    The power is that of the voltages minus the copper loss.
    """
    plant = TwoCoil(World())
    body, rng = plant.body, np.random.default_rng(2)
    for z, z_dot, i_1, i_2, u in rng.uniform(-1, 1, (50, 5)) * [4e-3, 1.0, 1.0, 1.0, 200.0]:
        rates = plant.rates([z, z_dot, i_1, i_2], u)
        upper, lower, bias = body.s_0 - z, body.s_0 + z, body.R * body.i_0
        gradient = [
            -2 * body.k_z * z + body.m * body.g + body.kappa / 4 * ((i_1 / upper) ** 2 - (i_2 / lower) ** 2),
            body.m * z_dot,
            body.kappa / 2 * i_1 / upper,
            body.kappa / 2 * i_2 / lower,
        ]
        power = (bias + u) * i_1 + (bias - u) * i_2 - body.R * (i_1**2 + i_2**2)
        terms = np.multiply(gradient, rates)
        assert abs(terms.sum() - power) < 1e-12 * np.abs(terms).max()
        for current, rate, gap, gap_dot, voltage in (
            (i_1, rates[2], upper, -z_dot, bias + u), (i_2, rates[3], lower, z_dot, bias - u)
        ):  # fmt: skip
            flux_dot = body.kappa / 2 * (rate / gap - current * gap_dot / gap**2)
            assert flux_dot == pytest.approx(voltage - body.R * current, rel=1e-11, abs=1e-9)


def test_the_difference_between_two_coils_and_the_lumped_plant_has_its_closed_form():
    """With i_1 = i_0 + i and i_2 = i_0 - i, the force is equal.

    In di/dt, the gap is s_0 in place of s_0 + z, and the motional terms differ.
    """
    two, one = TwoCoil(World()), Lumped(World())
    body, rng = two.body, np.random.default_rng(3)
    for z, z_dot, i, u in rng.uniform(-1, 1, (50, 4)) * [4e-3, 1.0, 0.2, 200.0]:
        _, z_ddot, i_1, i_2 = two.rates([z, z_dot, body.i_0 + i, body.i_0 - i], u)
        _, expected, i_dot = one.rates([z, z_dot, i], u)
        assert z_ddot == pytest.approx(expected, rel=1e-13)
        gap = 2 * -z / body.kappa * (u - body.R * i)
        motion = z_dot * ((body.i_0 + i) / (body.s_0 - z) + (body.i_0 - i) / (body.s_0 + z)) / 2
        difference = gap - motion - 2 * z_dot * i / (body.s_0 + z)
        assert (i_1 - i_2) / 2 - i_dot == pytest.approx(difference, rel=1e-10, abs=1e-10)
    y = [1e-3, 0.1, 0.3, 0.2]
    pushed = np.subtract(two.rates(y, 5.0, q_z=0.3, q_i=0.7), two.rates(y, 5.0))
    assert pushed == pytest.approx([0.0, 0.3, 0.7, -0.7], abs=1e-12)


def test_two_coils_with_a_fixed_rotor_equal_the_lumped_plant():
    """At z = 0 with a mass of 1e15 kg the rotor does not move, and i follows the same exponential."""
    heavy = {"m": 1e15, "g": 0.0, "k_z": 0.0}
    options = {"plant": heavy, "initial": (0.0, 0.0, 0.1), "u_max": 200.0}
    one, two = (simulate(World(kind=kind, **options), 300) for kind in ("lumped", "two-coil"))
    assert np.abs(one.i - two.i).max() < 1e-12


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.5, 2.0])
def test_the_voltage_switches_after_the_delay(delay, fast):
    """A single coil under u_n = k_p (i_ref - i_n). Between switchings i decays to u/R with the rate 2 s_0 R / kappa."""
    k_p, i_ref, T = 1e5, 0.01, 1e-4
    world = World(
        plant={"m": 1e12, "g": 0.0, "k_z": 0.0}, delay=delay, predict=False, period=T,
        position=("sliding-mode", {"c": 0.0, "k": 0.0, "p": 25.0}),
        inversion=("adaptive", {"gamma": 0.0, "p": 25.0, "i_ref": i_ref}),
        current=("pi", {"k_p": k_p, "k_int": 0.0, "k_aw": 0.0}),
    )  # fmt: skip
    run = simulate(world, 60, fast=fast)
    body = Lumped(world).body
    i, given = 0.0, [0.0, 0.0, 0.0]  # the last voltage is u_n
    first, parts = {0.0: (1, [1.0]), 0.5: (2, [0.5, 0.5]), 1.0: (2, [1.0]), 1.5: (3, [0.5, 0.5]), 2.0: (3, [1.0])}[
        delay
    ]
    for n in range(60):
        given.append(k_p * (i_ref - i))
        assert run.i[n] == pytest.approx(i, abs=1e-13)
        assert run.u[n] == pytest.approx(given[-1], abs=1e-8)
        for k, part in enumerate(parts):
            decay = math.exp(-2 * body.s_0 * body.R / body.kappa * part * T)
            i = decay * i + (1 - decay) * given[-first + k] / body.R


def field_of(world, u):
    """Eqs. (1), (2) with the voltages u, written as a function of time."""
    body = Lumped(world).body
    pulses = (world.q_z, world.q_v, world.q_i)

    def rates(t, y):
        z, z_dot, i = y
        n = math.floor(t / world.period - world.delay)
        q_z, q_v, q_i = (p["amplitude"] * (p["start"] <= t < p["stop"]) for _, p in pulses)
        v = ((body.i_0 + i) / (body.s_0 - z)) ** 2 - ((body.i_0 - i) / (body.s_0 + z)) ** 2
        z_ddot = 2 * body.k_z / body.m * z + body.kappa / 4 / body.m * (v + q_v) - body.g + q_z
        volts = u[n] if n >= 0 else 0.0
        gap = body.s_0 + z
        return [z_dot, z_ddot, 2 * z_dot / gap * i + 2 * gap / body.kappa * (volts - body.R * i) + q_i]

    return rates


@pytest.mark.parametrize("delay", [0.0, 0.3, 0.5, 1.0, 1.5, 2.0])
def test_the_prediction_agrees_with_the_plant_between_samples(delay):
    """The motion is integrated separately, and divided at switchings and edges of pulses.

    `seen` is this solution after the delay.
    """
    world = World(
        delay=delay, reference=SINE, u_max=150.0,
        q_z=("pulse", {"amplitude": 0.1, "start": 1e-2 + 1.3e-5, "stop": 2e-2 + 7.7e-5}),
        q_v=("pulse", {"amplitude": -0.5, "start": 0.4e-2 + 1.3e-5, "stop": 1e-2 + 2.2e-5}),
        q_i=("pulse", {"amplitude": 0.2, "start": 1.5e-2, "stop": 2.3e-2}),
    )  # fmt: skip
    N, T = 300, world.period
    run = simulate(world, N)
    ticks = np.arange(N) * T
    edges = [p[key] for _, p in (world.q_z, world.q_v, world.q_i) for key in ("start", "stop")]
    ends = np.unique(np.round(np.concatenate([ticks, ticks + delay % 1 * T, edges]), 12))
    assert run.lost_at == math.inf
    y, at, rates = np.zeros(3), {0.0: np.zeros(3)}, field_of(world, run.u)
    for a, b in itertools.pairwise(ends):
        # a field that is constant in time inside the piece: no edge is met, whatever the rounding of t
        held = lambda t, y, middle=(a + b) / 2: rates(middle, y)  # noqa: E731
        y = solve_ivp(held, (a, b), y, "DOP853", rtol=1e-13, atol=1e-16).y[:, -1]
        at[b] = y
    expected = np.array([at[t] for t in np.round(ticks, 12)])
    assert np.abs(run.z - expected[:, 0]).max() < 1e-12
    assert np.abs(run.i - expected[:, 2]).max() < 1e-11
    inside = [n for n in range(N) if round(ticks[n] + delay * T, 12) in at]
    ahead = np.array([at[round(ticks[n] + delay * T, 12)] for n in inside])
    calm = np.array([all(not (ticks[n] - T < edge < ticks[n] + 3 * T) for edge in edges) for n in inside])
    pushed = np.array(
        [any(p["start"] <= ticks[n] < p["stop"] for _, p in (world.q_z, world.q_v, world.q_i)) for n in inside]
    )
    assert (calm & ~pushed).sum() > 50
    # RK4 over T: (528 T)^5 / 120 of the motion
    assert np.abs(run.seen[inside] - ahead)[calm & ~pushed].max(axis=0) == pytest.approx([0, 0, 0], abs=3e-9)


@pytest.mark.parametrize("delay", [1, 2])
def test_prediction_is_of_fifth_order(delay):
    """Before the first voltage acts, the error of one RK4 step of the plant decreases as T^5."""
    errors = []
    for T in (5e-5, 2.5e-5):
        run = simulate(World(period=T, delay=float(delay), initial=(1e-3, 0.05, 0.1)), delay + 1)
        errors.append(abs(run.seen[0, 1] - run.z_dot[delay]))
    assert errors[0] / errors[1] == pytest.approx(32, rel=0.1)


CONFIGURATIONS = {
    "direct": {},
    "no delay": {"delay": 0.0},
    "half a sample": {"delay": 0.5},
    "not predicted": {"delay": 1.5, "predict": False},
    "wrong model": {"model": WRONG, "initial": (1e-4, 0.0, 0.0)},
    "limited supply, pi": {"current": ("pi", {"k_p": 8e4, "k_int": 2e6, "k_aw": 200.0}), "u_max": 60.0},
    "complementary": {"observer": ("complementary", {"l": 50.0, "z_hat": 1e-5})},
    # undisturbed: in continuous time its feed-forward is that of the nominal motion, here that of what was measured
    "closed form": {"inversion": ("closed-form", {}), "q_z": QUIET},
    "super-twisting, smooth": {"position": twisting(k_1=40.0, p=100.0), "discretisation": "explicit"},
    # the steep one stands for the set-valued one, which it nears with 1/p
    "super-twisting, set-valued": {"position": twisting(k_1=4.0, p=1e5), "discretisation": "implicit"},
}
FAST = {
    ("direct", "implicit"),
    ("half a sample", "explicit"),
    ("complementary", "implicit"),
    ("closed form", "explicit"),
    ("super-twisting, set-valued", "implicit"),
    ("limited supply, pi", "explicit"),
}
QUICK = {name for name, _ in FAST}


def how_slow(name, discretisation):
    """Return the mark of a case. Each configuration is slow or fast in at least one of its discretisations."""
    if (name, discretisation) in FAST:
        return ()
    first = CONFIGURATIONS[name].get("discretisation", "implicit")
    return pytest.mark.slow if name not in QUICK and discretisation == first else pytest.mark.thorough


ORDERS = [
    pytest.param(name, discretisation, marks=how_slow(name, discretisation))
    for name, options in CONFIGURATIONS.items()
    for discretisation in ("implicit", "explicit")
    if options.get("discretisation", discretisation) == discretisation
]


@pytest.mark.parametrize(("name", "discretisation"), ORDERS)
def test_the_sampled_loop_converges_to_continuous_time_with_order_one(name, discretisation):
    """Explicit and implicit laws, with and without delay, have the same limit as T -> 0."""
    options = SMOOTH | CONFIGURATIONS[name] | {"discretisation": discretisation}
    names = set(oracle.World.__dataclass_fields__) & set(options)
    start = {}
    if name == "closed form":  # no jump of i_ref at the start: the current that is wanted there is there
        i = simulate(World(**options), 1).i_ref[0]
        start = {"initial": (0.0, 0.0, i)}
    t, errors = np.arange(25) * 5e-4, []
    expected = oracle.solve(oracle.World(**{key: options[key] for key in names} | start), t, rtol=1e-9)
    for T in (5e-6, 2.5e-6):
        every = round(5e-4 / T)
        run = simulate(World(**options | start, period=T), 24 * every + 1, fast=True)
        errors.append(np.abs(run.z[::every] - expected).max())
    assert errors[0] < 0.02 * np.abs(expected).max()
    assert 1.7 < errors[0] / errors[1] < 2.3


def test_set_valued_signs_are_the_limit_of_steep_signs():
    laws = [
        {
            "position": ("sliding-mode", {"c": 17.0, "k": 25.0, "p": p}),
            "inversion": ("adaptive", {"gamma": 7.5e4, "p": p}),
            "current": ("sliding-mode", {"k_i": 152.0, "p": p}),
        }
        for p in (1e12, math.inf)
    ]
    steep, true = (simulate(World(**law, reference=SINE), 100, fast=True) for law in laws)
    assert np.abs(steep.z - true.z).max() < 1e-10  # of 1 mm


def test_implicit_super_twisting_stays_in_its_band():
    """For x+ = x + T (u + w) with |w+ - w| <= L T, |x| ends at or below L T^2.

    Without disturbance, x is exactly 0 after finitely many samples.
    """
    T, k_1, k_2, L = 1e-3, 12.0, 40.0, 30.0
    rng = np.random.default_rng(4)
    for bound in (L, 0.0):
        x, state, w, late = 0.05, 0.0, 0.0, []
        for n in range(4000):
            u, state = twist(x, state, k_1, k_2, T)
            x += T * (u + w)
            w += bound * T * rng.choice([-1.0, 1.0])
            late.append(abs(x) if n > 2000 else 0.0)
        # roundings of T u beside L T^2
        assert max(late) <= bound * T * T + 1e-15


def test_a_converter_rounds_and_saturates():
    lsb = 5e-3 / 2**11
    counts = np.array([0.4, 0.6, -0.6, 1.5, 2.5, 2047.4, 2047.6, 1e9, -2048.4, -1e9])
    codes = [conversion(x * lsb, 12, 5e-3) / lsb for x in counts]
    assert codes == pytest.approx([0, 1, -1, 2, 2, 2047, 2047, 2047, -2048, -2048], rel=1e-14)
    run = simulate(World(bits=14, delay=0.0, reference=SINE), 100, fast=True)
    assert np.abs(run.seen[:, 0] - run.z).max() <= 5e-3 / 2**14 * (1 + 1e-9)
    assert np.array_equal(np.round(run.seen[:, 2] / (0.5 / 2**13)) * 0.5 / 2**13, run.seen[:, 2])
    assert np.array_equal(run.seen[:, 1], run.z_dot)


def test_sensor_errors_are_added_and_the_observer_is_stepped():
    noise = np.random.default_rng(5).normal(size=(200, 3)) * [1e-6, 1e-4, 1e-4]
    run = simulate(
        World(observer=("complementary", {"l": 300.0}), predict=False, reference=SINE), 200, noise, fast=True
    )
    assert np.array_equal(run.seen[:, 1:], np.array([run.z_dot, run.i]).T + noise[:, 1:])
    measured, z_hat = run.z + noise[:, 0], run.seen[:, 0]
    assert z_hat[0] == measured[0]
    steps = 1e-4 * (run.seen[:-1, 1] + 300.0 * (measured - z_hat)[:-1])
    assert np.abs(np.diff(z_hat) - steps).max() < 1e-17


@pytest.mark.parametrize(("delay", "predict"), [(0.0, True), (0.5, True), (1.5, True), (1.5, False)])
def test_the_reference_is_that_of_the_instant_at_which_the_voltage_acts(delay, predict):
    """With c = k = 0 the law demands the force of spring and weight, and r_ddot.

    Without prediction, they are those at the sample.
    """
    world = World(
        delay=delay, predict=predict, reference=SINE, position=("sliding-mode", {"c": 0.0, "k": 0.0, "p": 25.0})
    )
    run, body = simulate(world, 30, fast=True), Lumped(world).body
    t = (np.arange(30) + (delay if predict else 0)) * world.period
    w = 2 * math.pi * 2.0
    expected = (-2 * body.k_z / body.m * run.seen[:, 0] + body.g - w * w * 2.5e-3 * np.sin(w * t)) / body.a
    assert run.v_star == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("T", [1e-4, 3.3e-3])
def test_a_touchdown_between_samples_ends_the_run(T, fast):
    """Free fall from z = 0 to -0.9 s_0 without magnetic field and voltage takes sqrt(2 0.9 s_0 / g)."""
    world = World(
        plant={"A": 1e-15, "R": 0.0, "k_z": 0.0}, period=T, predict=False,
        position=("sliding-mode", {"c": 0.0, "k": 0.0, "p": 1.0}),
        inversion=("adaptive", {"gamma": 0.0, "p": 25.0}), current=("sliding-mode", {"k_i": 0.0, "p": 25.0}),
    )  # fmt: skip
    run = simulate(world, math.ceil(0.05 / T), fast=fast)
    assert run.lost_at == pytest.approx(math.sqrt(2 * 0.9 * 5e-3 / 9.81), rel=1e-12)
    assert np.array_equal(np.isfinite(run.z), run.t < run.lost_at)


@pytest.mark.parametrize("kind", ["lumped", "two-coil"])
def test_fixed_steps_agree_with_the_accurate_solution(kind):
    """The error of RK4 with steps of at most 25 us is below the tolerances of the tests that use these steps."""
    world = World(
        kind=kind, reference=SINE, delay=1.5, u_max=200.0,
        q_v=("pulse", {"amplitude": 1.0, "start": 0.01003, "stop": 0.02}),
    )  # fmt: skip
    slow, fast = (simulate(world, 400, fast=fast) for fast in (False, True))
    assert np.abs(slow.z - fast.z).max() < 1e-12
    assert np.abs(slow.i_ref - fast.i_ref).max() < 1e-10


def settled_rms(run):
    """m, over 0.2 s to 1 s."""
    return np.sqrt(np.mean((run.z - 2.5e-3 * np.sin(4 * np.pi * run.t))[run.t >= 0.2] ** 2))


def repaired(rate, **options):
    return settled_rms(simulate(World(period=1 / rate, reference=SINE, q_v=PULSE, **options), rate + 1, fast=True))


@pytest.mark.slow
def test_known_errors_of_the_repaired_gains(monkeypatch):
    """The errors are those of another simulator, to its two digits.

    The position law is explicit, the others are implicit.
    """
    explicit = {"discretisation": "explicit", "delay": 0.0}
    assert repaired(10_000, **explicit) == pytest.approx(8.4e-5, abs=0.05e-5)
    if THOROUGH:
        assert repaired(50_000, **explicit) == pytest.approx(1.2e-5, abs=0.05e-5)
    delayed = {"delay": 1.0, "predict": False}
    # all laws implicit: the share of sigma is smaller by 1 + T k sgn_p'(0) = 1.04, and the error larger
    assert repaired(10_000, delay=0.0) == pytest.approx(8.5e-5 * 1.04, abs=0.06e-5)
    assert repaired(10_000, **delayed) == pytest.approx(8.6e-5 * 1.04, abs=0.06e-5)

    position = sampled_oracle.Controller._position

    def explicit_position(self, *args):
        self.implicit = False
        v_star, self.implicit = position(self, *args), True
        return v_star

    monkeypatch.setattr(sampled_oracle.Controller, "_position", explicit_position)
    assert repaired(10_000, delay=0.0) == pytest.approx(8.5e-5, abs=0.05e-5)
    assert repaired(10_000, **delayed) == pytest.approx(8.6e-5, abs=0.05e-5)


@pytest.mark.parametrize("delay", [0.0, 1.0])
def test_gains_tuned_in_continuous_time_lose_the_rotor_when_stepped_explicitly(delay):
    """The gains of task A lose the rotor at about 13 ms. With implicit steps they hold it."""
    gains = {
        "position": ("sliding-mode", {"c": 140.5, "k": 1158.0, "p": 25.0}),
        "inversion": ("adaptive", {"gamma": 1.869e7, "p": 25.0}),
        "current": ("sliding-mode", {"k_i": 92.3, "p": 25.0}),
    }
    noise = np.random.default_rng(6).normal(size=(1001, 3)) * [1e-6, 1e-4, 1e-4]
    options = {"reference": SINE, "u_max": 200.0, "delay": delay, "predict": False, **gains}
    lost = simulate(World(**options, discretisation="explicit"), 1001, noise, fast=True)
    assert lost.lost_at == pytest.approx(0.0134, abs=0.0005)
    assert lost.singular_at < lost.lost_at
    assert simulate(World(**options), 1001, noise, fast=True).lost_at == math.inf


def test_table_1_is_the_default():
    assert Lumped(World()).body.kappa == pytest.approx(0.3313, abs=1e-4)
    assert TABLE_1["m"] == 0.588
