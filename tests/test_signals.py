"""Signals and their derivatives: against formulas by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, Scenario, rollout
from ambjax.laws import inversion
from ambjax.signals import BandNoise, Chirp, Constant, Pulse, Sine, SmoothStep, Step, Sum
from ambjax.solvers import RK4
from ambjax.world.recorded import LINES
from ambjax.world.waveforms import reference_at

T = np.array([0.0, 0.013, 0.1, 0.2501, 0.77, 3.0])
W = 2 * np.pi * 2.0

# name: signal, r, r_dot, r_ddot by hand, all smooth at the instants T
BY_HAND = {
    "constant": (Constant(3.0), lambda t: 3.0 + 0 * t, lambda t: 0 * t, lambda t: 0 * t),
    "step": (Step(2.0, 0.2), lambda t: 2.0 * (t >= 0.2), lambda t: 0 * t, lambda t: 0 * t),
    "pulse": (Pulse(2.0, 0.05, 0.2), lambda t: 2.0 * ((t >= 0.05) & (t < 0.2)), lambda t: 0 * t, lambda t: 0 * t),
    "sine": (
        Sine(1.5, 2.0, 0.3),
        lambda t: 1.5 * np.sin(W * t + 0.3),
        lambda t: 1.5 * W * np.cos(W * t + 0.3),
        lambda t: -1.5 * W**2 * np.sin(W * t + 0.3),
    ),
    "smoothstep": (
        SmoothStep(2.0, 0.0, 0.8),
        lambda t: 2 * np.where(t >= 0.8, 1, 10 * (t / 0.8) ** 3 - 15 * (t / 0.8) ** 4 + 6 * (t / 0.8) ** 5),
        lambda t: 2 / 0.8 * np.where(t >= 0.8, 0, 30 * (t / 0.8) ** 2 * (1 - t / 0.8) ** 2),
        lambda t: 2 / 0.8**2 * np.where(t >= 0.8, 0, 60 * (t / 0.8) * (1 - t / 0.8) * (1 - 2 * t / 0.8)),
    ),
    "sum": (
        Sum((Sine(1.5, 2.0), Constant(1.0))),
        lambda t: 1.5 * np.sin(W * t) + 1,
        lambda t: 1.5 * W * np.cos(W * t),
        lambda t: -1.5 * W**2 * np.sin(W * t),
    ),
}
CHIRP = Chirp(1.0, 2.0, 5.0, 0.5)


@pytest.mark.parametrize("name", BY_HAND)
def test_value_and_two_derivatives_by_hand(name):
    signal, *expected = BY_HAND[name]
    found = jax.vmap(lambda t: reference_at(signal, t))(T)
    for got, formula in zip(found[:3], expected, strict=True):
        # rounding of a few operations; absolute where a sine passes through zero
        np.testing.assert_allclose(got, formula(T), rtol=1e-12, atol=1e-11)


def test_jumps_are_right_continuous_and_add_nothing_to_derivatives():
    step, pulse, ulp = Step(2.0, 0.2), Pulse(3.0, 0.2, 0.3), np.spacing(0.3)
    assert step(0.2) == 2
    assert step(0.2 - ulp) == 0
    assert [float(pulse(t)) for t in (0.2 - ulp, 0.2, 0.3 - ulp, 0.3)] == [0, 3, 3, 0]
    for signal, t in ((step, 0.2), (pulse, 0.2), (pulse, 0.3)):
        _, r_dot, r_ddot, _ = reference_at(signal, t)
        assert r_dot == r_ddot == 0
    assert Step(2.0)(0.0) == 2


@pytest.mark.parametrize("end", [0.1, 0.35])
def test_smoothstep_is_twice_continuously_differentiable_at_its_ends(end):
    step = SmoothStep(2.0, 0.1, 0.25)
    h = np.array([1e-3, 1e-4, 1e-5, 1e-6])
    inwards = 1 if end == 0.1 else -1
    inside, outside = (jax.vmap(lambda t: reference_at(step, t))(end + s * h) for s in (inwards, -inwards))
    level = 0.0 if end == 0.1 else 2.0
    np.testing.assert_array_equal(outside[:3], np.stack([np.full(4, level), np.zeros(4), np.zeros(4)]))
    # from inside, with s = h/duration: r - level = 10 A s^3, r_dot = 30 A s^2/d, r_ddot = 60 A s/d^2, all to O(s)
    s = h / 0.25
    assert np.all(np.abs(inside.r - level) <= 2 * 10 * s**3 + 1e-15)
    assert np.all(np.abs(inside.r_dot) <= 2 * 30 * s**2 / 0.25 + 1e-12)
    assert np.all(np.abs(inside.r_ddot) <= 2 * 60 * s / 0.25**2 + 1e-10)


def test_a_chirp_sweeps_between_two_frequencies_and_then_keeps_the_second():
    # frequency = phase rate / 2 pi, read off r and r_dot: for a sine of phase p, r_dot = p_dot cos p
    t = np.linspace(0.001, 0.9, 500)
    r, r_dot, *_ = jax.vmap(lambda t: reference_at(CHIRP, t))(t)
    clear = np.abs(r) < 0.9
    frequency = (np.abs(r_dot) / (2 * np.pi))[clear] / np.sqrt(1 - r[clear] ** 2)
    np.testing.assert_allclose(frequency, (2 + np.minimum(t, 0.5) / 0.5 * 3)[clear], rtol=1e-11)


# --- band-limited noise ---

NOISE = BandNoise(0.5, 20.0, 60.0)


def members(count, signal=NOISE, slot="q_z", seed=0):
    """Realisations of a scenario's signal, leaves [count]."""
    scenario = Scenario(**{slot: signal}, seed=seed)
    return jax.vmap(lambda m: getattr(dataclasses.replace(scenario, member=m).realised(), slot))(jnp.arange(count))


def test_band_noise_has_the_autocovariance_of_its_band():
    # std^2 times the mean of cos(2 pi f tau) over the band, at any instant: stationary
    lags = np.array([0.0, 2e-3, 6e-3, 1.25e-2, 3e-2, 0.2])
    f_low, f_high = NOISE.f_low, NOISE.f_high
    safe = np.maximum(lags, 1e-12)
    mean = (np.sin(2 * np.pi * f_high * safe) - np.sin(2 * np.pi * f_low * safe)) / (f_high - f_low)
    mean /= 2 * np.pi * safe
    for start in (0.0, 0.7, 31.0):
        x = np.asarray(jax.vmap(lambda s, start=start: s(start + lags))(members(20_000)))
        found = np.mean(x[:, :1] * x, axis=0)
        # five standard errors: a product of Gaussians has variance of at most 2 std^4, so 5 sqrt(2/20000) std^2
        np.testing.assert_allclose(found, NOISE.std**2 * mean, rtol=0, atol=0.05 * NOISE.std**2)
        assert np.all(np.abs(np.mean(x, axis=0)) < 5 * NOISE.std / 20_000**0.5)


def test_band_noise_depends_on_seed_member_and_path():
    batch = members(4)
    for m in range(4):
        alone = Scenario(q_z=NOISE, member=m).realised().q_z
        for x, y in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(x, y if np.ndim(y) == 0 else y[m], rtol=1e-15)
    both = Scenario(q_z=NOISE, q_i=Sum((NOISE, Constant(1.0), NOISE)), reference=Sine(1.0, 2.0)).realised()
    lines = [both.q_z, both.q_i.terms[0], both.q_i.terms[2], members(1, seed=1)]
    phases = np.stack([np.ravel(x.phases) for x in lines])
    assert np.unique(phases).size == phases.size
    assert both.reference == Sine(1.0, 2.0)
    assert both.q_i.terms[1] == Constant(1.0)
    # what is drawn in one place does not depend on the others
    np.testing.assert_array_equal(lines[0].phases, batch.phases[0])
    assert Scenario().realised() == Scenario()


def test_band_noise_has_its_derivatives():
    lines = Scenario(q_z=NOISE, member=3).realised().q_z
    w, size = 2 * np.pi * np.asarray(lines.frequencies), NOISE.std * (2 / LINES) ** 0.5
    found = jax.vmap(lambda t: reference_at(lines, t))(T)
    angle = np.multiply.outer(T, w) + np.asarray(lines.phases)
    formulas = (np.sin(angle), w * np.cos(angle), -(w**2) * np.sin(angle), -(w**3) * np.cos(angle))
    for got, formula in zip(found, formulas, strict=True):
        # sums of 32 terms, angles of up to 1e3 rad rounded to 1e-13
        np.testing.assert_allclose(got, size * formula.sum(axis=1), rtol=1e-10, atol=1e-12 * np.max(np.abs(formula)))
    assert jax.grad(lambda std: Scenario(q_z=BandNoise(std, 1.0, 2.0)).realised().q_z(0.3))(0.5) != 0


SMOOTH = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))


@pytest.mark.slow
def test_a_rollout_uses_the_band_noise_of_its_member():
    scenario = Scenario(q_z=BandNoise(0.05, 20.0, 60.0), q_i=BandNoise(0.5, 5.0, 9.0), seed=4, member=2)
    rows = rollout(SMOOTH, scenario, Clock(50, 1e-4, RK4(2))).trajectory.rows
    drawn = scenario.realised()
    # the row is taken a few roundings after its instant, so that it is behind a jump
    np.testing.assert_allclose(rows.q_z, drawn.q_z(rows.t), rtol=0, atol=1e-13)
    np.testing.assert_allclose(rows.q_i, drawn.q_i(rows.t), rtol=0, atol=1e-13)
    batch = jax.vmap(lambda m: rollout(SMOOTH, dataclasses.replace(scenario, member=m), Clock(50, 1e-4, RK4(2))))(
        jnp.arange(4)
    )
    np.testing.assert_allclose(batch.trajectory.rows.q_z[2], rows.q_z, rtol=1e-13, atol=1e-14)
    assert np.all(np.std(batch.trajectory.rows.q_z, axis=0) > 0)
