"""The integrators as mathematics: order, stability, step control, and which of them is chosen."""

import dataclasses
import functools
import math
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import METHODS

import ambjax as amb
from ambjax.cases.template_text import template
from ambjax.simulation.folds import Rms
from ambjax.simulation.integrate import Begin, InitialValueProblem
from ambjax.simulation.method import QUIET_TIGHT, QUIET_TOLERANCE, TIGHT, TOLERANCE
from ambjax.simulation.trajectory import ALIVE, STALLED, TOUCHED

FIXED = {"Euler": (amb.solvers.Euler, 1), "RK4": (amb.solvers.RK4, 4), "Rodas3": (amb.solvers.Rodas3, 3)}
REPAIRED = amb.Cascade()
SMOOTH = amb.Cascade(inversion=amb.laws.inversion.Adaptive(gamma=1e9, p=25e-6))
TRACKING = amb.Scenario(reference=amb.signals.Sine(2.5e-3, 2.0), q_v=amb.signals.Pulse(1.0, 0.01, 0.02))


def problem(rates, scale=1.0, status=lambda state: jnp.zeros((), jnp.int32)):
    return InitialValueProblem(lambda t: t, rates, scale, status)


@functools.partial(jax.jit, static_argnames=("rates",))
def end_of(method, rates, t, span, state):
    scale = jax.tree.map(jnp.ones_like, state)
    return method.advance(problem(rates, scale), Begin(t, state, method.start(span)), span).state


def curved(t, state):
    """p' = p q cos t, q' = -q^2 cos t: p = 1 + sin t and q = 1/p. Nonlinear and not autonomous."""
    p, q = state
    return p * q * jnp.cos(t), -(q**2) * jnp.cos(t)


def curved_error(method, spans=1):
    """Return the error after several consecutive spans, so that one program serves all step lengths."""
    p, end = 1 + math.sin(1.5), (jnp.asarray(1.0), jnp.asarray(1.0))
    for n in range(spans):
        end = end_of(method, curved, 1.5 * n / spans, 1.5 / spans, end)
    return max(abs(float(end[0]) - p), abs(float(end[1]) - 1 / p))


def slope(x, y):
    return np.polyfit(np.log(x), np.log(y), 1)[0]


every_fixed = pytest.mark.parametrize(("method", "order"), FIXED.values(), ids=FIXED)
every_method = pytest.mark.parametrize("method", METHODS, ids=str)


@every_fixed
def test_order_on_a_problem_with_known_solution(method, order):
    substeps = np.array([16, 32, 64, 128])
    errors = [curved_error(method(2), n // 2) for n in substeps]
    # 128 steps are well inside the asymptotic range and far above rounding (1e-10 at order 4).
    assert slope(1 / substeps, errors) == pytest.approx(order, abs=0.15)


def test_dop853_on_a_problem_with_known_solution():
    # From the first steps whose error falls steadily to the last with one well above rounding (2e-13); few points.
    substeps = np.array([4, 6, 8, 12])
    errors = [curved_error(amb.solvers.DOP853(2), n // 2) for n in substeps]
    assert slope(1 / substeps, errors) == pytest.approx(8, abs=0.7)


@every_fixed
def test_a_jump_on_the_edge_of_a_step_keeps_the_order(method, order):
    pulse = amb.signals.Pulse(2.0, 0.3, 0.6)  # neither is a binary fraction: 3 * 0.1 > 0.3 in floating point

    def pulsed(t, y):
        return -(y**2) * jnp.cos(t) + pulse(t)

    def pushed(t, y):
        return -(y**2) * jnp.cos(t) + 2.0

    def free(t, y):
        return -(y**2) * jnp.cos(t)

    def split(method, n):
        y = end_of(method(3 * n), free, 0.0, 0.3, jnp.asarray(1.0))
        y = end_of(method(3 * n), pushed, 0.3, 0.3, y)
        return float(end_of(method(4 * n), free, 0.6, 0.4, y))

    substeps = np.array([2, 4, 8])
    ends = [float(end_of(method(10 * int(n)), pulsed, 0.0, 1.0, jnp.asarray(1.0))) for n in substeps]
    # The same steps, so only rounding differs (80 of them), and the inset of the stages: 1e-15 of a step.
    assert ends == pytest.approx([split(method, int(n)) for n in substeps], rel=1e-13)
    errors = np.abs(np.array(ends) - split(amb.solvers.RK4, 1000))
    assert slope(1 / substeps, errors) == pytest.approx(order, abs=0.3)  # steps from 0.1 on: coarse


def test_rodas3_damps_infinitely_fast_decay_in_one_step():
    def decay(t, y):
        return -1e12 * y

    # R(z) falls like 1/z for a stiffly accurate method: 1e-12 times a small constant.
    assert abs(float(end_of(amb.solvers.Rodas3(1), decay, 0.0, 1.0, jnp.asarray(1.0)))) < 1e-11


def test_rodas3_follows_a_slow_solution_of_a_stiff_problem():
    def prothero_robinson(t, y):
        return -1e8 * (y - jnp.sin(t)) + jnp.cos(t)

    end = float(end_of(amb.solvers.Rodas3(100), prothero_robinson, 0.0, 1.0, jnp.asarray(0.0)))
    # Rounding of the right-hand side, 1e8 eps, and an error that stiffness cannot amplify: h^2 / 1e8 at worst.
    assert end == pytest.approx(math.sin(1.0), abs=1e-10)


@pytest.mark.parametrize("method", [amb.solvers.Euler, amb.solvers.RK4], ids=lambda m: m.__name__)
@pytest.mark.parametrize(("share", "grows"), [(0.97, False), (1.03, True)])
def test_the_stability_limit_separates_decay_from_growth(method, share, grows):
    def decay(t, y):
        return -y

    end = abs(float(end_of(method(200), decay, 0.0, 200 * share * method.limit, jnp.asarray(1.0))))
    assert (end > 1e2) if grows else (end < 1e-2)  # 3 % off the limit is at least 5 % a step, 200 times


@every_method
def test_a_step_of_length_0_does_not_change_the_state(method):
    """The state of a lost rotor is frozen by steps of length 0. It is equal bit by bit."""
    state = (jnp.asarray(0.3), jnp.asarray(-0.7))
    assert end_of(method, curved, 0.2, 0.0, state) == state


@pytest.mark.parametrize("method", [amb.solvers.AdaptiveRodas3, amb.solvers.AdaptiveCashKarp])
def test_adaptive_error_falls_with_the_tolerance(method):
    tolerances = np.array([1e-5, 1e-6, 1e-7, 1e-8, 1e-9])
    errors = [curved_error(method(tolerance=tol)) for tol in tolerances]
    # Error per step h^3 = tolerance and global error h^3: proportional. The same with h^5.
    assert slope(tolerances, errors) == pytest.approx(1.0, abs=0.15)
    assert all(errors < 10 * tolerances)


def test_a_stalled_rollout_has_the_status_stalled_and_finite_values():
    clock = amb.Clock(50, 1e-4, amb.solvers.AdaptiveRodas3(tolerance=1e-12, most_steps=3))
    trajectory = amb.rollout(REPAIRED, TRACKING, clock).trajectory
    assert trajectory.lost_why.startswith("stalled")
    assert 0 < float(trajectory.lost_at) <= 1e-4
    assert all(np.isfinite(x).all() for x in trajectory.rows)


@every_method
def test_integration_stops_at_the_first_invalid_state_and_returns_the_last_valid_one(method):
    def status(y):
        return jnp.where(y < 0.55, 0, 2).astype(jnp.int32)

    begin = Begin(3.0, jnp.asarray(0.0), method.start(1.0))
    out = method.advance(problem(lambda t, y: jnp.ones(()), status=status), begin, 1.0)
    assert int(out.code) == 2
    assert float(out.state) < 0.55 <= float(out.t) - 3.0  # y = t - 3: the time is that of the bad state
    if step := method.step_size(1.0):
        last = math.floor(0.55 / step)
        assert (float(out.state), float(out.t)) == pytest.approx((last * step, 3 + (last + 1) * step))


@pytest.mark.parametrize("method", [*METHODS[1:-1], amb.solvers.AdaptiveCashKarp(1e-3)], ids=str)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_time_of_a_touchdown_is_that_of_the_crossing_inside_a_step(method, side):
    """A free fall with a drag that makes z a cubic: z = side (t^2/2 + t^3/6) reaches 0.6 inside a step of a third."""

    def rates(t, state):
        return state[1], side * (1 + t)

    def status(state):
        return jnp.where(jnp.abs(state[0]) >= 0.6, TOUCHED, ALIVE).astype(jnp.int32)

    fall = problem(rates, (1.0, 1.0), status)._replace(motion=lambda state: state, limit=0.6)
    zero = jnp.zeros(())
    out = method.advance(fall, Begin(0.0, (zero, zero), method.start(2.0)), 2.0)
    assert int(out.code) == TOUCHED
    exact = float(np.real(np.roots([1 / 6, 1 / 2, 0.0, -0.6])[2]))
    # Methods of order 3 and more are exact for this cubic, and so is the cubic between the ends of a step.
    assert float(out.t) == pytest.approx(exact, rel=1e-12)
    one = lambda x: method.advance(fall, Begin(0.0, (x, zero), method.start(2.0)), 2.0).t  # noqa: E731
    assert float(jax.jacfwd(one)(zero)) == 0.0  # the time is no function of the state to JAX


# Not Rodas3 with three steps: a fixed implicit step may leap over the pole and never see it.
@pytest.mark.parametrize("method", [amb.solvers.Euler(3), amb.solvers.RK4(3), amb.solvers.AdaptiveRodas3()], ids=str)
def test_a_divergent_solution_ends_with_a_status_and_a_finite_state(method):
    def status(y):
        return jnp.where(jnp.abs(y) < 1e3, 0, 2).astype(jnp.int32)

    p = problem(lambda t, y: jnp.exp(y), status=status)
    out = method.advance(p, Begin(0.0, jnp.asarray(0.0), method.start(10.0)), 10.0)  # y = -log(1 - t)
    assert int(out.code) in (2, STALLED)
    assert np.isfinite(float(out.state))


@pytest.mark.parametrize("method", [amb.solvers.Euler(1), amb.solvers.RK4(1)], ids=str)
def test_an_explicit_step_beyond_its_limit_is_refused(method):
    limit = method.limit / (2 / math.pi * 7.5e4 * 25.0)
    with pytest.raises(ValueError, match=rf"stable only up to {limit:.3g} s.*inversion law has slope 1\.19e\+06"):
        amb.rollout(REPAIRED, TRACKING, amb.Clock(10, 1e-4, method))
    just_inside = amb.Clock(10, 0.99 * limit, method)
    assert amb.solvers.with_method(just_inside, REPAIRED, TRACKING) is just_inside


def test_method_choice():
    noisy = dataclasses.replace(TRACKING, sensor=amb.sensors.Sensor(1e-6))
    # a sensor without noise changes nothing
    for quiet in (None, amb.sensors.Sensor(), amb.sensors.Sensor(gain=1.1, offset=1e-6)):
        scenario = dataclasses.replace(TRACKING, sensor=quiet)
        assert amb.solvers.choose_method(SMOOTH, scenario, 1e-4) == amb.solvers.AdaptiveCashKarp(QUIET_TIGHT)
        assert amb.solvers.choose_method(REPAIRED, scenario, 1e-4) == amb.solvers.AdaptiveRodas3(QUIET_TOLERANCE)
    assert amb.solvers.choose_method(SMOOTH, noisy, 1e-4) == amb.solvers.DOP853(1)
    for kink in (
        {"u_max": 100.0},
        {"q_z": amb.signals.Pulse(1.0, 0.01003, 0.02)},
        {"reference": amb.signals.Step(1e-4, 0.00103)},
    ):
        one = dataclasses.replace(noisy, **kink)
        assert amb.solvers.choose_method(SMOOTH, one, 1e-4) == amb.solvers.AdaptiveCashKarp(TIGHT)
    assert amb.solvers.choose_method(REPAIRED, noisy, 1e-4) == amb.solvers.AdaptiveRodas3(TOLERANCE)
    assert isinstance(amb.solvers.choose_method(REPAIRED, TRACKING, 1e-4), amb.solvers.AdaptiveRodas3)
    assert isinstance(amb.solvers.choose_method(REPAIRED, TRACKING, 1e-4, reverse=True), amb.solvers.Rodas3)
    assert isinstance(amb.solvers.choose_method(SMOOTH, TRACKING, 1e-4, reverse=True), amb.solvers.RK4)
    mine = amb.Clock(method=amb.solvers.Rodas3(4))
    assert amb.solvers.with_method(mine, REPAIRED, TRACKING) is mine


def test_the_chosen_steps_resolve_the_loads():
    """One step of RK4 sees a constant in a sine of twice the sampling rate."""
    held, world = amb.Cascade(processor=amb.Processor()), amb.Scenario(q_f=amb.signals.Sine(1.0, 2e4))
    for cascade, reverse in ((held, False), (SMOOTH, True)):
        step = amb.solvers.choose_method(cascade, world, 1e-4, reverse=reverse).step_size(1e-4)
        assert 0.45 < 2 * np.pi * 2e4 * step <= 0.5
    with pytest.raises(ValueError, match=r"a load of 1e\+07 Hz needs 12567 steps in a sample"):
        amb.solvers.choose_method(held, amb.Scenario(base=amb.signals.Sine(1.0, 1e7)), 1e-4)
    load = {"kind": "sine", "amplitude": 1.0, "frequency": 2e4, "direction": [0.0, 1.0, 0.0]}
    assert amb.read_machine(tomllib.loads(template("machine")) | {"base": [load]}).clock.method.substeps == 13


# R / L of a wide gap times the sample is 12: two substeps, which suffice for the motion, are unstable
LIGHT = {"n": 50.0, "A": 1e-4, "mu_0": 1.2566e-6, "s_0": 5e-4, "i_0": 1.0, "m": 0.1, "R": 10.0, "k_z": 0.0}


@pytest.mark.parametrize("kind", [amb.plants.Plant, amb.plants.TwoCoil])
def test_the_chosen_step_resolves_coils_that_settle_within_a_sample(kind):
    plant, period = kind(**LIGHT), 2e-4
    sampled, world = amb.Cascade(processor=amb.Processor()), amb.Scenario(plant=plant)
    at = lambda z: jax.jacfwd(plant.rates)(plant.start(amb.world.sensor.Measurement(z, 0.0, 0.0)), 0.0)  # noqa: E731
    steepest = max(np.abs(np.linalg.eigvals(_matrix(at(z)))).max() for z in (-0.9 * 5e-4, 0.9 * 5e-4))
    method = amb.solvers.choose_method(sampled, world, period)
    assert isinstance(method, amb.solvers.RK4)
    assert 0.4 < steepest * method.step_size(period) < 0.5
    wide = amb.Cascade(inversion=amb.laws.inversion.Adaptive(1e3, 25.0))
    for cascade in (sampled, wide):
        with pytest.raises(ValueError, match=r"only up to 4.6e-05 s, .*current in the coils has slope 6.05e\+04"):
            amb.solvers.with_method(amb.Clock(10, period, amb.solvers.RK4(2)), cascade, world)

    @functools.partial(jax.jit, static_argnums=0)
    def moved(substeps):
        held = InitialValueProblem(
            lambda t: (), lambda _, x: plant.rates(x, 10.0), plant.scale(), lambda x: jnp.int32(0)
        )
        start = plant.start(amb.world.sensor.Measurement(*map(jnp.asarray, (1e-4, 0.0, -0.2))))
        return plant.measurement(amb.solvers.RK4(substeps).advance(held, Begin(0.0, start, ()), period).state)

    error = np.abs(np.subtract(moved(method.substeps), moved(20 * method.substeps)))
    np.testing.assert_array_less(error, [1e-11, 1e-6, 1e-6])
    sprung = dataclasses.replace(world, plant=kind(**LIGHT | {"k_z": -2e6}))  # 4e6 N/m: 6325 1/s
    assert amb.solvers.choose_method(sampled, sprung, period).step_size(period) * 6325 < 0.02
    stiff = dataclasses.replace(world, plant=dataclasses.replace(plant, R=1e4))
    assert isinstance(amb.solvers.choose_method(sampled, stiff, period), amb.solvers.AdaptiveRodas3)
    assert amb.solvers.choose_method(sampled, stiff, period, reverse=True) == amb.solvers.Rodas3(64)


def _matrix(jacobian):
    """Matrix of the derivatives; an absent state has neither a row nor a column."""
    return np.array([[float(x) for x in row if not isinstance(x, tuple)] for row in jacobian if len(row)])


@pytest.mark.parametrize("p", [1e3, 1e6, 1e9])
def test_a_sign_as_steep_as_a_relay_does_not_stall_the_adaptive_method(p):
    """The limit p -> infinity exists (the sliding mode). The layer narrows as 1/p, here from 1e-8 A to 1e-14 A."""
    noisy = dataclasses.replace(TRACKING, sensor=amb.sensors.Sensor(1e-6))
    cascade = amb.Cascade(inversion=amb.laws.inversion.Adaptive(p=p))
    found = [
        amb.rollout(cascade, noisy, amb.Clock(300, 1e-4, step))
        for step in (amb.solvers.AdaptiveRodas3(), amb.solvers.Slide(64))
    ]
    assert not np.isfinite(found[0].trajectory.lost_at)
    z, expected = (np.asarray(f.trajectory.rows.z) for f in found)
    # of a motion of 1e-3 m; both methods have errors of this size here
    np.testing.assert_allclose(z, expected, rtol=0, atol=2e-8)


@pytest.mark.slow
def test_the_default_clock_works_under_jit_and_in_both_modes_of_differentiation():
    """The programs contain a short run, without rows and signals: reverse mode through adaptive steps compiles long."""
    clock, scenario = amb.Clock(10), amb.Scenario(initial=amb.Initial(1e-4))

    def error(gamma):
        cascade = dataclasses.replace(REPAIRED, inversion=dataclasses.replace(REPAIRED.inversion, gamma=gamma))
        return amb.rollout(cascade, scenario, clock, fold=Rms("e_z"), record_every=0).metrics

    gamma = 7.5e4
    value, forward = jax.jit(lambda x: jax.jvp(error, (x,), (1.0,)))(gamma)
    assert value == pytest.approx(float(error(gamma)), abs=1e-8)  # m; tests/test_oracle.py
    # the same steps in both modes, so that only rounding differs
    np.testing.assert_allclose(jax.jit(jax.value_and_grad(error))(gamma), (value, forward), rtol=1e-9)


def test_a_fixed_number_of_steps_is_not_chosen_from_traced_values():
    def chosen(gamma):
        cascade = amb.Cascade(inversion=amb.laws.inversion.Adaptive(gamma=gamma, p=25e-6))
        return amb.solvers.with_method(amb.Clock(10), cascade, TRACKING, reverse=True).sample_period

    with pytest.raises(ValueError, match="clock = Cascade: it must be a Clock"):
        amb.solvers.with_method(REPAIRED, TRACKING, amb.Clock(10))
    with pytest.raises(ValueError, match=r"with_method\(clock, cascade, scenario, reverse=True\)"):
        jax.jit(chosen)(1e9)
