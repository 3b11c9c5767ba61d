"""Integral and terminal sliding modes against the motions that their theory predicts."""

import dataclasses
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough

from ambjax import Cascade, Initial, Scenario
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.laws import position
from ambjax.linear import linearise
from ambjax.numerics.smooth import smooth_sign
from ambjax.plants import Plant
from ambjax.signals import Sine
from ambjax.simulation.loop import ClosedLoop
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

MODEL, STILL = Plant(), Reference(0.0, 0.0, 0.0)


def motion_of(law, e, e_dot, q, T, samples):
    """Return error and rate at each sample under the stepped law; the demanded force acts at once and is held."""

    def sample(carry, k):
        e, e_dot, state = carry
        v_star, state = law.step(MODEL, (Measurement(e, e_dot, 0.0), STILL), state, T)
        # stiffness and weight as the law assumes them, so that the mechanics are a double integrator
        acceleration = 2 * MODEL.k_z / MODEL.m * e + MODEL.a * v_star - MODEL.g + q(k * T)
        after = e + T * e_dot + T**2 / 2 * acceleration, e_dot + T * acceleration, state
        return after, (e, e_dot)

    first = law.begin_sampled(MODEL, (Measurement(e, e_dot, 0.0), STILL), T)
    start = jnp.asarray(e), jnp.asarray(e_dot), first
    return jax.jit(lambda x: jax.lax.scan(sample, x, jnp.arange(samples)))(start)[1]


def samples(count=50):
    """Random z, z_dot, r, r_dot, r_ddot and x."""
    scale = np.array([3e-3, 0.05, 2.5e-3, 0.03, 0.4, 0.5])
    return np.random.default_rng(3).uniform(-1, 1, (count, 6)) * scale


# --- integral sliding mode ---


@pytest.mark.parametrize("sampled", [False, True])
def test_an_integral_sliding_mode_begins_on_its_manifold(sampled):
    law, reference = position.UtkinSlidingMode(), Sine(2.5e-3, 2.0)
    inputs = Measurement(1e-4, 0.02, 0.01), Reference(0.0, 2.5e-3 * 4 * np.pi, 0.0)
    s = inputs[0].z_dot - inputs[1].r_dot + law.k_d * inputs[0].z
    if sampled:  # from the first estimate that the law is given, predicted or not
        T = 1e-4
        first = law.begin_sampled(MODEL, inputs, T)
        v_star, after = law.step(MODEL, inputs, first, T)
        assert float(after) == pytest.approx(-s + T * law.k_p * inputs[0].z, rel=1e-12)
        free, _ = dataclasses.replace(law, k=2e-30).step(MODEL, inputs, first, T)
        assert v_star == free  # the sign of s = 0 adds nothing
        return
    scenario = Scenario(reference=reference, initial=Initial(*inputs[0]))
    state = ClosedLoop(Cascade(position=law), scenario).realised().start()
    assert float(state.control.position) == pytest.approx(-s, rel=1e-12)


# --- terminal sliding mode ---


def test_the_terminal_manifold_is_driven_by_the_sign_only():
    law = position.TerminalSlidingMode()
    for z, z_dot, r, r_dot, r_ddot, _ in samples():
        y = (z_dot - r_dot) / (law.c * law.l)
        if abs(y) < 0.3:  # the root is smoothed: 1 - (1 + 0.01^2/y^2)^(-1/4) is 3e-4 at 0.3
            continue
        inputs = Measurement(z, z_dot, 0.0), Reference(r, r_dot, r_ddot)
        v_star, _ = law(MODEL, inputs, ())
        e_ddot = 2 * MODEL.k_z / MODEL.m * z + MODEL.a * v_star - MODEL.g - r_ddot
        error = lambda e, e_dot: law.sigma(Measurement(e, e_dot, 0.0), STILL)  # noqa: E731
        sigma, sigma_dot = jax.jvp(error, (z - r, z_dot - r_dot), (z_dot - r_dot, e_ddot))
        np.testing.assert_allclose(law.sigma(*inputs), sigma, rtol=1e-12)
        np.testing.assert_allclose(sigma, law.c * (z - r + law.l * np.sign(y) * abs(y) ** 1.5), rtol=1e-12)
        robust = -1.5 * abs(y) ** 0.5 * law.k * smooth_sign(sigma, law.p)
        np.testing.assert_allclose(sigma_dot, robust, atol=3e-4 * law.c * abs(z_dot - r_dot) + 1e-12)


def test_a_terminal_sliding_mode_ends_in_the_finite_time_of_its_manifold():
    law, e_0, T = position.TerminalSlidingMode(c=100.0, l=5e-4, k=50.0, p=None), 4e-4, 1e-6
    e, _ = motion_of(law, e_0, -law.c * law.l * (e_0 / law.l) ** (2 / 3), lambda t: 10.0 * jnp.cos(200 * t), T, 32_000)
    e, roots = np.asarray(e), (e_0 / law.l) ** (1 / 3)
    for share in (0.5, 0.1, 0.01):  # of l: the times at which the error is this small
        wanted = 3 * (roots - share ** (1 / 3)) / law.c
        # the implicit sign keeps sigma within 3/2 T q: 0.3 % of the time at an error of 0.01 l
        assert np.argmax(e < share * law.l) * T == pytest.approx(wanted, rel=5e-3)
    # a decay at the rate c leaves 4 % of the error at that time
    ended = round(3 * roots / law.c / T)
    assert np.max(np.abs(e[ended:])) < 1e-3 * e_0


@pytest.mark.slow
@pytest.mark.parametrize("name", [thorough("bearing"), "rig"])
def test_the_default_gains_of_a_terminal_manifold_reach_zone_a(name):
    raw = tomllib.loads(template(name))
    raw["controller"]["position"] = {"kind": "terminal-sliding-mode"}
    case = case_from({key: table for key, table in raw.items() if key != "tune"})
    system = linearise(case.cascade, case.scenario, case.clock)
    f = np.geomspace(1.0, 2000.0, 2000)  # a grid finer than any resonance of a loop in zone A
    assert system.stable
    assert np.max(np.abs(system.sensitivity(f))) < case.zones.zone_a
