"""Observers that estimate the velocity: motions with exact estimates, poles, and the loop with each of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ambjax import Cascade, Clock, Scenario, rollout
from ambjax.cases.reader import case_from
from ambjax.control import inversion
from ambjax.control.exact import LAM, WIDTH
from ambjax.control.observer import IRED1, IRED2, Complementary, Difference, Direct, Kalman, Predicted
from ambjax.plants import Plant
from ambjax.sensors import Sensor
from ambjax.signals import Sine
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import reference_at

MODEL = Plant()
T = 1e-4
ESTIMATORS = [Difference(), Kalman(), IRED1(), IRED2()]
EACH = pytest.mark.parametrize("law", ESTIMATORS, ids=lambda x: type(x).__name__)


def estimates(law, z, i=None, model=MODEL, period=T, state=None):
    """z and z_dot estimated at every sample of z, m, and i, A."""
    z, i = jnp.asarray(z), jnp.zeros(len(z)) if i is None else jnp.asarray(i)
    state = law.init(model, Measurement(z[0], 0.0, i[0])) if state is None else state

    def step(state, sample):
        estimate, state = law.step(model, Measurement(sample[0], 0.0, sample[1]), state, period)
        return state, (estimate.z, estimate.z_dot)

    return (np.asarray(x) for x in jax.lax.scan(step, jax.tree.map(jnp.asarray, state), (z, i))[1])


def motion(t, m=np):
    """Return a motion of the rotor with its derivatives: a reference, and an oscillation of 50 Hz."""
    w, fast = 4 * np.pi, 100 * np.pi
    z = 1e-3 * m.sin(w * t) + 2e-5 * m.sin(fast * t)
    z_dot = 1e-3 * w * m.cos(w * t) + 2e-5 * fast * m.cos(fast * t)
    return z, z_dot, -1e-3 * w**2 * m.sin(w * t) - 2e-5 * fast**2 * m.sin(fast * t)


def current_of(z, z_ddot, q=0.0):
    """Return the current with which the model has this motion under the disturbance q, m/s^2."""
    return MODEL.current_for(z, (z_ddot - q + MODEL.g - 2 * MODEL.k_z / MODEL.m * z) / MODEL.a)


# --- inputs of the observers ---


@EACH
def test_the_estimate_does_not_depend_on_the_measured_velocity(law):
    assert law.estimates_velocity
    assert type(law).estimates_velocity
    measured = Measurement(1e-4, 0.02, 0.01)
    state = law.init(MODEL, measured)
    for form in (lambda m: law(MODEL, m, state), lambda m: law.step(MODEL, m, state, T)):
        for by in jax.tree.leaves(jax.jacfwd(lambda v, form=form: form(measured._replace(z_dot=v)))(0.02)):
            assert by == 0
    # the first estimate: where it is measured, at rest
    first, _ = law.step(MODEL, measured, state, T)
    assert first == Measurement(1e-4, 0.0, 0.01)


# --- what they are exact for ---


@pytest.mark.parametrize(("law", "degree"), [(Difference(), 1), (IRED1(), 1), (IRED2(), 2)])
def test_the_estimates_are_exact_for_polynomials(law, degree):
    """They are exact from any start.

    The filter needs about 20 time constants, the differentiators finitely many steps.
    """
    t = np.arange(3000) * T
    z, z_dot = 1e-3 - 0.02 * t + (degree - 1) * 0.3 * t**2, -0.02 + (degree - 1) * 0.6 * t
    start = jax.tree.map(lambda x: x + 1e-4, law.init(MODEL, Measurement(1e-3, 0.0, 0.0)))
    through, estimate = estimates(law, z, state=start)
    assert np.array_equal(through, z)
    late = 100 if degree == 2 else 200
    # rounding of z, 2e-18 m, over T, a few times
    np.testing.assert_allclose(estimate[late:], z_dot[late:], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("law", "order", "bound"), [(IRED1(30.0), 1, 1.0), (IRED2(1e4), 2, 1.0)])
def test_errors_of_the_differentiators(law, order, bound):
    """Without noise, for f'' and f''' below L, the errors are below T L and T^2 L, and of the stated order in T."""
    errors = []
    for period in (2e-4, 1e-4):
        t = np.arange(round(0.3 / period)) * period
        z, z_dot, _ = motion(t)
        _, estimate = estimates(law, z, period=period)
        errors.append(np.abs(estimate - z_dot)[len(t) // 2 :].max())
        assert errors[-1] < bound * law.L * period**order
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.1)


def test_the_kalman_filter_estimates_a_constant_disturbance():
    """If the acceleration is linear between samples, as along a cubic, the error decays to 0."""
    t, q = np.arange(1500) * T, -0.7
    z, z_dot, z_ddot = 1e-3 - 0.02 * t + 0.3 * t**2 - t**3, -0.02 + 0.6 * t - 3 * t**2, 0.6 - 6 * t
    law = Kalman(800.0)
    z_hat, v_hat = estimates(law, z, current_of(z, z_ddot, q))
    # (1 + 120 + 120^2/2) e^-120 of what it began with; rounding of accelerations of 20 m/s^2 over 1/w
    np.testing.assert_allclose(z_hat[-10:], z[-10:], rtol=0, atol=1e-17)
    np.testing.assert_allclose(v_hat[-10:], z_dot[-10:], rtol=0, atol=1e-14)
    # at rest, off centre
    measured = Measurement(2e-3, 0.0, current_of(2e-3, 0.0, q))
    state = law.init(MODEL, measured)
    for _ in range(600):
        estimate, state = law.step(MODEL, measured, state, T)
    assert state.d == pytest.approx(q, rel=1e-12)
    assert estimate.z == pytest.approx(2e-3, rel=1e-13)
    assert abs(estimate.z_dot) < 1e-14


# --- poles and noise ---


def flat(state):
    return jnp.stack([state.z, state.z_dot, state.d])


@pytest.mark.parametrize(("w", "z"), [(1.0, -3e-3), (800.0, 0.0), (3e4, 2e-3)])
def test_errors_of_the_kalman_filter_have_three_equal_poles(w, z):
    """The characteristic polynomial does not depend on the position.

    It is (x - q)^3 on a processor and (x + w)^3 in continuous time.
    """
    law, measured = Kalman(w), Measurement(z, 0.0, 0.02)

    def of(x, form):
        return flat(form(MODEL, measured, Predicted(*x, 5.0))[1])

    x = jnp.asarray([z + 1e-4, 0.01, -0.3])
    sampled = jax.jacfwd(of)(x, lambda *a: law.step(*a, T))
    # in units of T, so that rounding is measured against 1
    units = np.diag([1.0, T, T * T])
    q = np.exp(-w * T)
    np.testing.assert_allclose(
        np.poly(units @ sampled @ np.linalg.inv(units)), np.poly([q] * 3), rtol=0, atol=1e-12
    )  # fmt: skip
    continuous = units @ jax.jacfwd(of)(x, law) @ np.linalg.inv(units) * T
    np.testing.assert_allclose(np.poly(continuous), np.poly([-w * T] * 3), rtol=0, atol=1e-12 * (1 + w * T) ** 3)


# --- continuous time ---


@pytest.mark.parametrize(("law", "order"), [(Difference(), 2), (Kalman(), 1)], ids=lambda x: type(x).__name__)
def test_the_sampled_observers_converge_to_continuous_time(law, order):
    """The backward difference lags by half a sample, and its sampled low-pass leads by the same time."""
    ends = np.arange(5, 21) * 1e-3

    def state_of(x):
        return Predicted(*x) if isinstance(law, Kalman) else x[0]

    def of(t, x):
        z, _, z_ddot = motion(t, jnp)
        return law(MODEL, Measurement(z, 0.0, current_of(z, z_ddot, 0.3)), state_of(x))

    def rates(t, x):
        return jnp.stack(jax.tree.leaves(of(t, x)[1]))

    z, _, z_ddot = motion(0.0)
    start = np.ravel(law.init(MODEL, Measurement(z, 0.0, current_of(z, z_ddot, 0.3))))
    run = solve_ivp(jax.jit(rates), (0, ends[-1]), start, "RK45", ends, rtol=1e-9, atol=1e-12)
    expected = jax.vmap(of)(ends, run.y.T)[0].z_dot
    errors = []
    for period in (2e-5, 1e-5):
        z, _, z_ddot = motion(np.arange(round(ends[-1] / period) + 1) * period)
        _, given = estimates(law, z, current_of(z, z_ddot, 0.3), period=period)
        errors.append(np.abs(given[np.round(ends / period).astype(int)] - expected).max())
    assert errors[0] < 2e-3
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.1)


@pytest.mark.parametrize("law", [IRED1(10.0), IRED2(1e4)], ids=lambda x: type(x).__name__)
def test_the_differentiators_in_continuous_time(law):
    """They are exact except for the smoothed sign, which delays them by about (width/L)^(1/(m+1)) seconds."""
    order = 1 if isinstance(law, IRED1) else 2
    late = (WIDTH * MODEL.s_0 / law.L) ** (1 / (order + 1))
    assert law.slope(MODEL) == pytest.approx(LAM[order][0] / late)

    def rates(t, x):
        return jnp.stack(law(MODEL, Measurement(motion(t, jnp)[0], 0.0, 0.0), tuple(x))[1])

    ends = np.linspace(0.05, 0.06, 20)
    run = solve_ivp(
        jax.jit(rates), (0, ends[-1]), np.zeros(order + 1), "Radau", ends, rtol=1e-8, atol=1e-12,
        jac=jax.jit(jax.jacfwd(rates, 1)),
    )  # fmt: skip
    # late by lam_0 / lam_1 widths for the order 1; order 2 knows the acceleration
    assert np.abs(run.y[1] - motion(ends)[1]).max() < 2 * late * np.abs(motion(ends)[2]).max()


# --- the cascade behind them ---


def right(law, z, z_dot):
    """Return a state for which the estimate is z and z_dot, where z is measured."""
    z, v, zero = jnp.asarray(z), jnp.asarray(z_dot), jnp.zeros(())
    if isinstance(law, Difference):
        return z - v / law.w
    if isinstance(law, Kalman):
        return Predicted(z, v, zero, MODEL.z_ddot(z, 0.02))
    return (z, v, zero)[: 2 if isinstance(law, IRED1) else 3]


@EACH
@pytest.mark.parametrize("law_i", [inversion.Adaptive(), inversion.ClosedForm()], ids=lambda x: type(x).__name__)
def test_an_exact_estimate_gives_the_command_of_a_measured_velocity(law, law_i):
    """In continuous time; on a processor: tests/test_sampled.py. This includes i_ref' of the closed form.

    It uses the rate of the estimate, because the velocity is not measured.
    """
    z, z_dot, i, reference = 1e-3, 0.03, 0.02, reference_at(Sine(2.5e-3, 2.0), 0.11)

    def commands(law, velocity):
        cascade, measured = Cascade(law, inversion=law_i), Measurement(*map(jnp.asarray, (z, velocity, i)))
        state = cascade.init(measured)
        if law != Direct():
            state = state._replace(observer=right(law, z, z_dot))
        return cascade(measured, state, reference, 200.0)[0]

    expected, given = commands(Direct(), z_dot), commands(law, 0.0)
    assert abs(expected.i_ref_dot) > 1
    for name, a, b in zip(expected._fields, given, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize(
    "law",
    [pytest.param(x, id=type(x).__name__, marks=pytest.mark.thorough if n else ()) for n, x in enumerate(ESTIMATORS)],
)
def test_observers_in_continuous_time_with_sensor_noise_hold_the_rotor(law):
    """The compiler aborts if no code reads a measurement; here it does not abort, and the rotor is held."""
    world = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-7, 0.0, 1e-5))
    trajectory = rollout(Cascade(law), world, Clock(300, 1e-4)).trajectory
    assert trajectory.lost_at == np.inf
    assert np.isfinite(np.asarray(trajectory.rows.u)).all()


@pytest.mark.parametrize("kind", ["ired-1", "ired-2"])
def test_the_sliding_step_is_refused_with_a_differentiator(kind):
    """The sliding step would integrate it by Heun's method, far beyond its stability limit."""
    case = {"controller": {"observer": {"kind": kind}}, "clock": {"method": "sliding"}}
    with pytest.raises(ValueError, match=r"^clock.method = \"sliding\": .* an observer other than \"ired-1\""):
        case_from(case)
    case_from(case | {"controller": {"observer": {"kind": "kalman"}}})


@pytest.mark.slow
@pytest.mark.parametrize("law", [inversion.Adaptive(), inversion.ClosedForm()], ids=lambda law: type(law).__name__)
def test_the_laws_use_the_estimate_of_the_observer(law):
    """The observer has its own estimate of the position.

    The measured position then changes rates only, not the commands at the same instant.
    """
    cascade = Cascade(Complementary(l=7.0), inversion=law)
    reference = reference_at(Sine(2.5e-3, 2.0), 0.013)
    state = cascade.init(Measurement(jnp.asarray(2e-4), jnp.asarray(0.0), jnp.asarray(0.0)))

    def outputs(z, estimate):
        command, rates = cascade(Measurement(z, 3e-3, 0.02), state._replace(observer=estimate), reference, 200.0)
        decided = [command.v_star, command.v_tilde, command.i_ref]
        if isinstance(law, inversion.Adaptive):  # a static inversion passes the estimate's rate on to i_ref' and u
            decided += [command.i_ref_dot, command.u]
        return jnp.stack(decided), rates.observer

    (by_z, by_estimate), rates = jax.jacfwd(outputs, (0, 1))(1e-4, 2e-4)
    np.testing.assert_array_equal(by_z, 0.0 * by_z)
    assert abs(by_estimate[0]) > 1.0
    np.testing.assert_allclose(rates, (7.0, -7.0), rtol=1e-12)
