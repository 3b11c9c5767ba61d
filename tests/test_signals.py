"""Signals and their derivatives: against formulas by hand, and against finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Chirp, Constant, Pulse, Sine, SmoothStep, Step, Sum
from ambjax.signals import reference_at

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
EVERY = {name: row[0] for name, row in BY_HAND.items()} | {"chirp": CHIRP}
ALL = pytest.mark.parametrize("signal", EVERY.values(), ids=EVERY.keys())


@pytest.mark.parametrize("name", BY_HAND)
def test_value_and_two_derivatives_by_hand(name):
    signal, *expected = BY_HAND[name]
    found = jax.vmap(lambda t: reference_at(signal, t))(T)
    for got, formula in zip(found[:3], expected, strict=True):
        # rounding of a few operations; absolute where a sine passes through zero
        np.testing.assert_allclose(got, formula(T), rtol=1e-12, atol=1e-11)


@ALL
def test_derivatives_equal_central_differences(signal):
    # instants in the inside of every piece; h = 1e-4: truncation w^2 h^2 / 6 = 2e-5 at 5 Hz, rounding eps / h^2 = 2e-8
    t, h = np.array([0.011, 0.12, 0.31, 0.47, 0.93]), 1e-4
    at = jax.jit(jax.vmap(lambda t: reference_at(signal, t)))
    before, here, after = at(t - h), at(t), at(t + h)
    pairs = zip(before[:3], after[:3], strict=True)
    slope, curve, jerk = ((b - a) / (2 * h) for a, b in pairs)
    _, first, second, third = 3e-5 * np.max(np.abs(np.stack(here)), axis=1)
    np.testing.assert_allclose(here.r_dot, slope, rtol=2e-5, atol=first + 1e-10)
    np.testing.assert_allclose(here.r_ddot, curve, rtol=2e-5, atol=second + 1e-8)
    np.testing.assert_allclose(here.r_dddot, jerk, rtol=2e-5, atol=third + 1e-6)


@ALL
def test_signals_are_pytrees_of_their_numbers_and_jit_vmap_grad_work(signal):
    leaves, tree = jax.tree.flatten(signal)
    assert jax.tree.unflatten(tree, leaves) == signal
    assert all(isinstance(x, float) for x in leaves)
    # one rounding apart: XLA may fuse a product into a sum
    np.testing.assert_allclose(jax.jit(lambda s, t: s(t))(signal, T), signal(T), rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(jax.vmap(signal)(T), signal(T), rtol=1e-14, atol=1e-14)
    gradient = jax.grad(lambda s: s(0.21))(signal)
    assert all(np.isfinite(x) for x in jax.tree.leaves(gradient))
    assert np.shape(signal(0.1)) == ()


@ALL
def test_linear_in_the_amplitude(signal):
    if not hasattr(signal, "amplitude"):
        return  # Constant has a value and Sum has terms: nothing to scale
    scaled = dataclasses.replace(signal, amplitude=3 * signal.amplitude)
    np.testing.assert_allclose(scaled(T), 3 * signal(T), rtol=1e-14, atol=1e-15)


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


def test_sum_is_linear_and_nests():
    a, b = Sine(1.0, 3.0), SmoothStep(2.0, 0.0, 0.5)
    whole = jax.vmap(lambda t: reference_at(Sum((a, Sum((b, a)))), t))(T)
    part_a, part_b = (jax.vmap(lambda t, s=s: reference_at(s, t))(T) for s in (a, b))
    for total, x, y in zip(whole, part_a, part_b, strict=True):
        np.testing.assert_allclose(total, 2 * x + y, rtol=1e-13, atol=1e-12)
    np.testing.assert_array_equal(Sum(())(T), 0 * T)


def test_chirp_sweeps_from_one_frequency_to_the_other_and_stays():
    # frequency = phase rate / 2 pi, read off r and r_dot: for a sine of phase p, r_dot = p_dot cos p
    t = np.linspace(0.001, 0.9, 500)
    r, r_dot, *_ = jax.vmap(lambda t: reference_at(CHIRP, t))(t)
    clear = np.abs(r) < 0.9
    frequency = (np.abs(r_dot) / (2 * np.pi))[clear] / np.sqrt(1 - r[clear] ** 2)
    np.testing.assert_allclose(frequency, (2 + np.minimum(t, 0.5) / 0.5 * 3)[clear], rtol=1e-11)


def test_reference_of_a_traced_or_integer_time():
    # the rollout's time is traced; a person at the prompt types 1
    np.testing.assert_allclose(jax.jit(lambda t: reference_at(Sine(1.0, 0.3), t).r)(1), np.sin(0.6 * np.pi), rtol=1e-14)
    assert reference_at(Sine(1.0, 0.3), 1).r_dot.dtype == jnp.result_type(float)
