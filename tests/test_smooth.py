"""Smooth stand-ins: their limits, their slopes at 0, and derivatives that stay finite there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax.smooth import TWO_OVER_PI, away_from_zero, safe_sqrt, smooth_root, smooth_sign

EPS = np.finfo(float).eps
P = [0.1, 25.0, 1e4]


@pytest.mark.parametrize("p", P)
def test_smooth_sign_is_odd_and_tends_to_the_sign_like_two_over_pi_p_x(p):
    x = np.array([1e3, 1e6, 1e9]) / p
    # 1 - S = 2/(pi p x) + O((p x)^-3): a relative 1e-6 at p x = 1e3; the rest is the cancellation in 1 - S
    np.testing.assert_allclose(1 - smooth_sign(x, p), TWO_OVER_PI / (p * x), rtol=1e-6, atol=2 * EPS)
    np.testing.assert_array_equal(smooth_sign(-x, p), -smooth_sign(x, p))
    assert smooth_sign(0.0, p) == 0


@pytest.mark.parametrize("p", P)
def test_smooth_root_is_odd_and_tends_to_the_root(p):
    x = np.array([1e3, 1e6, 1e9]) / p
    # relative distance 1/(4 (p x)^2) <= 2.5e-7
    np.testing.assert_allclose(smooth_root(x, p), np.sqrt(x), rtol=3e-7)
    np.testing.assert_array_equal(smooth_root(-x, p), -smooth_root(x, p))
    assert smooth_root(0.0, p) == 0


@pytest.mark.parametrize(("function", "slope"), [(smooth_sign, lambda p: 2 * p / np.pi), (smooth_root, np.sqrt)])
@pytest.mark.parametrize("p", P)
def test_slope_at_zero_is_the_steepest(function, slope, p):
    derivative = jax.vmap(jax.grad(function), (0, None))
    np.testing.assert_allclose(jax.grad(function)(0.0, p), slope(p), rtol=4 * EPS)
    x = np.concatenate([-np.logspace(-12, 12, 97), np.logspace(-12, 12, 97)]) / p
    assert np.all(derivative(x, p) <= slope(p) * (1 + 4 * EPS))
    assert np.all(derivative(x, p) >= 0)


@pytest.mark.parametrize("x", [-1e300, -1.0, -1e-300, 0.0, 1e-300, 1.0, 1e300])
def test_values_and_both_derivatives_are_finite_everywhere(x):
    # 1e300 only for the sign: x^2 of the root overflows there, 145 orders beyond any velocity
    cases = [lambda x: smooth_sign(x, 25.0), safe_sqrt, lambda x: away_from_zero(x, 1e-3)]
    cases += [lambda x: smooth_root(x, 25.0)] if abs(x) < 1e150 else []
    for f in cases:
        first, second = jax.grad(f), jax.grad(jax.grad(f))
        # safe_sqrt'' at 1e-300 is 1e450: its first derivative is what is promised
        derivatives = [first(x)] if f is safe_sqrt else [first(x), second(x)]
        assert np.all(np.isfinite([f(x), *derivatives]))


def test_safe_sqrt_is_the_root_above_zero_and_flat_below():
    x = np.logspace(-300, 300, 13)
    np.testing.assert_array_equal(safe_sqrt(x), np.sqrt(x))
    np.testing.assert_allclose(jax.vmap(jax.grad(safe_sqrt))(x), 0.5 / np.sqrt(x), rtol=2 * EPS)
    below = jnp.array([0.0, -1e-300, -1.0])
    np.testing.assert_array_equal(safe_sqrt(below), 0.0)
    np.testing.assert_array_equal(jax.vmap(jax.grad(safe_sqrt))(below), 0.0)


def test_away_from_zero_keeps_sign_and_leaves_the_rest_alone():
    x = np.array([-2.0, -0.5, -1e-9, 0.0, 1e-9, 0.5, 2.0])
    np.testing.assert_array_equal(away_from_zero(x, 0.5), [-2.0, -0.5, -0.5, 0.5, 0.5, 0.5, 2.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(away_from_zero), (0, None))(x, 0.5), [1, 1, 0, 0, 0, 1, 1])
    assert np.isfinite(jax.grad(lambda x: 1 / away_from_zero(x, 1e-12))(0.0))
