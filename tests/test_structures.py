"""Position laws other than the paper's, each against the results of its theory."""

import dataclasses
import tomllib

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from ambjax import rollout
from ambjax.cases.reader import case_from
from ambjax.control import regulator
from ambjax.control.base import default_law
from ambjax.control.sampling import Sampling
from ambjax.laws import current, observer, position
from ambjax.plants import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

RIG = Plant(1.64, 0.0, 1.2566e-6, 208.0, 2.68e-4, 5e-4, 2.5, 1.0)
MODELS = pytest.mark.parametrize("model", [Plant(), RIG], ids=["paper", "rig"])
STILL = Reference(0.0, 0.0, 0.0)


# --- state feedback ---


def weights(model):
    """The weights of the integral of the error, of the error and of the current that `StateFeedback` documents."""
    q_e, r = (0.1 * model.s_0) ** -2, (0.1 * model.i_0) ** -2
    return (0.2 * float(model.pole)) ** 2 * q_e, q_e, r


def linear(model):
    """s and b of z_ddot = s z + b i, by differentiation of Eq. (1)."""
    return (float(jax.grad(model.z_ddot, k)(0.0, 0.0)) for k in (0, 1))


@MODELS
def test_state_feedback_has_the_poles_of_the_symmetric_root_locus(model):
    """The stable roots of p^2 (p^2 - s)^2 = b^2 (q_I - q_e p^2)/r, which need no Riccati equation."""
    law, (s, b) = default_law(position.StateFeedback, model), linear(model)
    law = dataclasses.replace(law, k_aw=np.zeros(()))  # an array is not checked

    def rates(x):  # integral term, z, z_dot; the magnets are linear, and the current is the demanded one
        v_star, rate = law(model, (Measurement(x[1], x[2], 0.0), STILL), x[0])
        i = (v_star - model.dv_dz(0.0, 0.0) * x[1]) / model.dv_di(0.0, 0.0)
        return jnp.stack([rate, x[2], s * x[1] + b * i])

    found = np.sort_complex(np.linalg.eigvals(jax.jacfwd(rates)(jnp.zeros(3))))
    q_I, q_e, r = weights(model)
    mu = np.roots([1.0, -2 * s, s**2 + b**2 * q_e / r, -(b**2) * q_I / r])
    # 1e-8: the Riccati solver's accuracy, with numbers of order one
    np.testing.assert_allclose(found, np.sort_complex(-np.sqrt(mu.astype(complex))), rtol=1e-8)


@MODELS
def test_sampled_state_feedback_minimises_the_cost(model):
    """The cost-to-go of the law's own map is that of value iteration, which needs no Riccati solver."""
    T = 5e-5 if model is RIG else 2e-4
    law = dataclasses.replace(
        default_law(position.StateFeedback, model, Sampling(T, 0.0, True)), k_aw=np.zeros(())
    )  # an array is not checked
    K = np.array([law.k_int, law.k_p, law.k_d])
    s, b = linear(model)
    # the map of one period by integration: independent of the matrix exponential
    F, G = np.eye(3), np.zeros((3, 1))
    F[0, 1] = T
    w = np.sqrt(s)
    F[1:, 1:] = [[np.cosh(w * T), np.sinh(w * T) / w], [w * np.sinh(w * T), np.cosh(w * T)]]
    G[1:, 0] = b * (np.cosh(w * T) - 1) / w**2, b * np.sinh(w * T) / w
    *q, R = weights(model)
    Q = np.diag([*q, 0.0])
    units = np.diag([model.s_0 / w, model.s_0, model.s_0 * w])
    F, G, Q, K = np.linalg.solve(units, F @ units), np.linalg.solve(units, G), units @ Q @ units, K @ units
    P = np.zeros((3, 3))
    for _ in range(20_000):
        gain = np.linalg.solve(G.T @ P @ G + R, G.T @ P @ F)
        P = Q + F.T @ P @ (F - G @ gain)
    # the iteration has converged to 1e-9
    np.testing.assert_allclose(K, gain[0], rtol=1e-7)

    # and a step of the law is this feedback
    def step(x):
        v_star, after = law.step(model, (Measurement(x[1], x[2], 0.0), STILL), x[0] * law.k_int, T)
        i = (v_star - model.dv_dz(0.0, 0.0) * x[1]) / model.dv_di(0.0, 0.0)
        return jnp.stack([i, after / law.k_int])

    found = jax.jacfwd(step)(jnp.zeros(3))
    np.testing.assert_allclose(found[0], [-law.k_int, -law.k_p, -law.k_d], rtol=1e-9)
    np.testing.assert_allclose(found[1], [1, T, 0], atol=1e-12)


OBSERVERS = [observer.Kalman, observer.Difference, observer.Complementary, observer.IRED1, observer.IRED2]


@pytest.mark.parametrize("kind", [position.StateFeedback, position.PID, current.ProportionalIntegral, *OBSERVERS])
def test_the_written_gains_are_those_designed_for_the_paper_s_plant(kind):
    written, designed = kind(), default_law(kind, Plant())
    for field in dataclasses.fields(written):
        if "steepness" in field.metadata:  # three digits are written
            assert getattr(written, field.name) == pytest.approx(float(getattr(designed, field.name)), rel=5e-3)


@pytest.mark.parametrize("period", [2.5e-5, 1e-4])  # 1/(4 T) is above and below ten times the pole of the magnets
def test_the_default_current_loop_has_fifty_degrees_of_phase_margin_with_a_sample_of_delay(period):
    law = default_law(current.ProportionalIntegral, RIG, Sampling(period, 1.0, True))
    w = np.geomspace(1e-2, 10, 100_000) * law.k_p / RIG.L
    loop = (law.k_p + law.k_int / (1j * w)) / (1j * w * RIG.L + RIG.R) * np.exp(-1.5j * w * period)
    crossing = np.argmin(np.abs(np.abs(loop) - 1))
    assert 50 < np.degrees(np.angle(-loop[crossing])) < 90
    # the integral adds 3 %, and the resistance takes less
    assert w[crossing] == pytest.approx(min(10 * RIG.pole, 1 / (4 * period)), rel=0.05)


# its springs are 1e9 times stiffer than its magnets
SPRINGS = "[plant]\nmu_0 = 9.8e-6\nn = 359.0\nA = 1.7e-7\ni_0 = 1e-6\n"


def test_a_case_without_optimal_gains_must_give_gains():
    case = SPRINGS + '[controller.position]\nkind = "state-feedback"\n'
    wanted = r"controller\.position: the model has no .*optimal gains.*Give all of k_aw, k_d, k_int, k_p\."
    with pytest.raises(ValueError, match=wanted):
        case_from(tomllib.loads(case))
    given = case_from(tomllib.loads(case + "k_p = 1.0\nk_d = 1.0\nk_int = 1.0\nk_aw = 1.0\n"))
    assert given.cascade.position == position.StateFeedback(1.0, 1.0, 1.0, 1.0)


def test_the_default_gains_depend_on_the_sample_period():
    case = '[controller.position]\nkind = "state-feedback"\nk_p = 200.0\n[clock]\nsample_period = 2e-4\n[processor]\n'
    found, wanted = case_from(tomllib.loads(case)).cascade.position, regulator.optimal_gains(Plant(), 2e-4)
    assert (found.k_int, found.k_p, found.k_d) == (wanted[0], 200.0, wanted[2])


# --- feedback linearisation ---


@MODELS
def test_feedback_linearisation_makes_the_mechanics_linear(model):
    law = default_law(position.FeedbackLinearisation, model)
    random = np.random.default_rng(1)
    for z, z_dot, r, r_dot, r_ddot in random.uniform(-0.5, 0.5, (50, 5)) * model.s_0 * [1, 100, 1, 100, 1e4]:
        inputs = Measurement(z, z_dot, 0.0), Reference(r, r_dot, r_ddot)
        v_star, _ = law(model, inputs, ())
        if 4 * model.i_0**2 + 4 * model.s_0 * z * v_star <= 0:
            continue  # no current gives this force
        i = model.current_for(z, v_star)  # exact inversion
        e_ddot = model.z_ddot(z, i) - r_ddot
        # rounding of terms of some 1e3 m/s^2
        np.testing.assert_allclose(e_ddot, -law.k_p * (z - r) - law.k_d * (z_dot - r_dot), rtol=1e-9, atol=1e-9)
    # a double pole at -w
    np.testing.assert_allclose(np.roots([1, law.k_d, law.k_p]), -model.pole, rtol=1e-6)


# --- the chain of filters ---

CHAIN = position.FilterChain(
    k_p=300.0, k_int=2e4, k_d=0.5, w_f=2e4, k_aw=2e-30, w_z=900.0, w_p=4e3, w_1=3e3, width_1=0.4, depth_1=0.1, w_2=2e4,
    width_2=0.7, depth_2=0.3, w_lp=1.5e4,
)  # fmt: skip


def transfer(law, state, T, j):
    """The response of i_star to z at the points j (1/s, or z with a period T), from the law's differentiated map."""
    flat, back = jax.flatten_util.ravel_pytree(jax.tree.map(jnp.asarray, state))

    def f(x, z):
        inputs = Measurement(z, 0.0, 0.0), STILL
        v, after = law(Plant(), inputs, back(x)) if T is None else law.step(Plant(), inputs, back(x), T)
        i = (v - Plant().dv_dz(0.0, 0.0) * z) / Plant().dv_di(0.0, 0.0)
        return i, jax.flatten_util.ravel_pytree(after)[0]

    (C, D), (A, B) = jax.jacfwd(f, (0, 1))(flat, 0.0)
    return np.array([np.asarray(C) @ np.linalg.solve(x * np.eye(len(B)) - A, B) + D for x in j])


def sections(law):
    """The parts of the chain as numerator and denominator in s, and the frequency of the bilinear transform's match."""
    k = law
    return [
        ([k.k_p + k.k_d * k.w_f, k.k_p * k.w_f + k.k_int, k.k_int * k.w_f], [1, k.w_f, 0], None),
        ([1 / k.w_z, 1], [1 / k.w_p, 1], None),
        *(([1, d * b * w, w**2], [1, b * w, w**2], w)
          for w, b, d in ((k.w_1, k.width_1, k.depth_1), (k.w_2, k.width_2, k.depth_2))),
        ([k.w_lp**2], [1, 2**0.5 * k.w_lp, k.w_lp**2], None),
    ]  # fmt: skip


FREQUENCIES = 2 * np.pi * np.array([1.0, 30.0, 100.0, 3e3 / (2 * np.pi), 700.0, 2e3, 4e3])


def test_the_chain_is_the_product_of_its_transfer_functions():
    found = transfer(CHAIN, CHAIN.init(Plant()), None, 1j * FREQUENCIES)
    wanted = np.prod([scipy.signal.freqs(b, a, FREQUENCIES)[1] for b, a, _ in sections(CHAIN)], axis=0)
    np.testing.assert_allclose(found, -wanted, rtol=1e-9)  # a product of a dozen numbers, and a linear system


@pytest.mark.parametrize("T", [5e-5, 1e-4])
def test_the_sampled_chain_is_scipy_s_bilinear_transform_of_each_part(T):
    found = transfer(CHAIN, CHAIN.init(Plant()), T, np.exp(1j * FREQUENCIES * T))
    wanted = 1.0
    for b, a, w in sections(CHAIN):
        fs = 1 / T if w is None else w / np.tan(w * T / 2) / 2
        wanted = wanted * scipy.signal.freqz(*scipy.signal.bilinear(b, a, fs), FREQUENCIES * T)[1]
    np.testing.assert_allclose(found, -wanted, rtol=1e-8)
    # at its centre a notch has exactly its depth; without it the chain is 1/depth larger
    at, off = np.exp([1j * CHAIN.w_1 * T]), dataclasses.replace(CHAIN, depth_1=1.0)
    ratio = transfer(CHAIN, CHAIN.init(Plant()), T, at) / transfer(off, CHAIN.init(Plant()), T, at)
    np.testing.assert_allclose(ratio, CHAIN.depth_1, rtol=1e-9)


def test_a_notch_beyond_the_nyquist_frequency_stays_stable():
    chain, T = dataclasses.replace(CHAIN, w_2=3e5), 1e-4
    flat, back = jax.flatten_util.ravel_pytree(jax.tree.map(jnp.asarray, chain.init(Plant())))

    def after(x):
        moved = chain.step(Plant(), (Measurement(0.0, 0.0, 0.0), STILL), back(x), T)[1]
        return jax.flatten_util.ravel_pytree(moved)[0]

    poles = np.abs(np.linalg.eigvals(jax.jacfwd(after)(flat)))
    assert np.sum(poles > 1 - 1e-9) == 1  # the integral
    assert np.max(poles) < 1 + 1e-9


def test_the_integral_of_the_chain_does_not_wind_up_while_the_supply_is_limited():
    chain, far = position.FilterChain(k_aw=300.0), Measurement(1e-3, 0.0, 0.05)
    (_, state), T = chain.step(Plant(), (far, STILL), chain.init(Plant()), 1e-4), 1e-4
    step = jax.jit(lambda state: chain.step(Plant(), (far, STILL), state, T))
    for _ in range(3000):  # the error stays, the current does not move: the demand comes to rest beside it
        v, state = step(state)
    i_star = (v - Plant().dv_dz(0.0, 0.0) * far.z) / Plant().dv_di(0.0, 0.0)
    leak = chain.k_aw * T / (1 + chain.k_aw * T)
    assert float(i_star - far.i) == pytest.approx(-chain.k_int * T * far.z / leak, rel=1e-6)


# --- integral sliding mode ---


@pytest.mark.parametrize("kind", ["sliding-mode", "integral-sliding-mode"])
def test_a_constant_force_leaves_no_offset_with_the_integral(kind):
    """q_z = 5 m/s^2 within the boundary layer. Without the integral, e = tan(pi q_z/2k)/(p c) by Eqs. (5), (12)."""
    raw = {
        "controller": {"position": {"kind": kind, "k": 25.0, "p": 25.0}, "inversion": {"gamma": 1e6, "p": 2.0}},
        "disturbance": {"q_z": {"kind": "constant", "value": 5.0}},
        "clock": {"duration": 1.5},
    }
    case = case_from(raw)
    rows = rollout(case.cascade, case.scenario, case.clock).trajectory.rows
    offset = {"sliding-mode": np.tan(np.pi * 5 / 50) / (25 * 17), "integral-sliding-mode": 0.0}[kind]
    # with the integral two poles at 8.4 1/s: (1 + 12.5) exp(-12.5) of 0.8 mm are left of the transient
    np.testing.assert_allclose(rows.z[-1], offset, atol=2e-7, rtol=1e-3)


def test_the_integral_sliding_mode_steps_the_sign_implicitly():
    """p = inf (None here), within the band k T: the sign takes s to zero in one period, T s' = -s; x steps by T e."""
    law, model, T = position.IntegralSlidingMode(p=None), Plant(), 1e-3
    motion = Measurement(1e-4, 3e-3, 0.0)
    v_star, x = law.step(model, (motion, STILL), 2e-5, T)
    s = 3e-3 + 17 * 1e-4 + 70 * 2e-5
    z_ddot = 2 * model.k_z / model.m * 1e-4 + model.a * v_star - model.g
    assert abs(s) < law.k * T
    np.testing.assert_allclose(z_ddot + 17 * 3e-3 + 70 * 1e-4, -s / T, rtol=1e-11)
    assert x == 2e-5 + T * 1e-4
