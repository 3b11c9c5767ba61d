"""Signs on a processor: residuals of their equations, their derivatives, their limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples

from ambjax.numerics.relax import _twisted, relax, share, twist

DECADES = st.floats(-9, 9).map(lambda x: 10.0**x)
SIDES = st.sampled_from([-1.0, 1.0])


def sign(x, p):
    return 2 / np.pi * np.arctan(p * x)


def root(x, p):
    return x / (x * x + 1 / p**2) ** 0.25


# Rounding of the three terms: 10 units in the last place of the largest.
@given(DECADES, SIDES, DECADES, DECADES)
@settings(max_examples=500, deadline=None)
def test_relax_solves_its_equation_to_rounding(size, side, h, p):
    w = side * size
    y = float(relax(w, h, p))
    assert abs(y + h * sign(y, p) - w) <= 10 * np.finfo(float).eps * size
    assert np.sign(y) == side
    assert abs(y) <= size * (1 + 1e-15)


@pytest.mark.slow
@given(DECADES, SIDES, DECADES, DECADES, DECADES)
@settings(max_examples=examples(100, 300), deadline=None)
def test_twist_solves_its_equation_to_rounding(size, side, a, b, p):
    x = side * size
    y = float(_twisted(*(jnp.asarray(number) for number in (x, a, b, p))))
    assert abs(y + a * root(y, p) + b * sign(y, p) - x) <= 10 * np.finfo(float).eps * size
    np.testing.assert_allclose(twist(x, a, b, p), (root(y, p), sign(y, p)), rtol=1e-14)


def test_the_implicit_relay_is_the_limit_of_a_steep_sign():
    w, h = jnp.linspace(-3.0, 3.0, 601), 1.0
    steep, hard = relax(w, h, 1e9), relax(w, h, None)
    np.testing.assert_allclose(hard, np.sign(w) * np.maximum(np.abs(w) - h, 0), atol=0)
    # near |w| = h the smoothed sign is 1 up to 2/(pi p y): y is off by sqrt(2 h/(pi p)) at most
    np.testing.assert_allclose(steep, hard, atol=np.sqrt(2 * h / (np.pi * 1e9)) * 1.01)
    np.testing.assert_allclose(share(w, h, 1e9), np.clip(w / h, -1, 1), atol=3e-5)
    np.testing.assert_array_equal(share(w, h, None), np.clip(w / h, -1, 1))


def test_the_hard_twist_is_the_published_controller():
    """The two cases are those that R. Seeber and B. Andritsch print, with x, v, T, k_1, k_2."""
    rng = np.random.default_rng(1)
    for x, v, T, k_1, k_2 in zip(*np.exp(rng.normal(size=(5, 200))), strict=True):
        x = x * rng.choice([-1, 1])
        if abs(x) <= k_2 * T**2:
            after, u = v - x / T, v - 2 * x / T
        else:
            over = abs(x) - k_2 * T**2
            r = 2 * over / (T * k_1 + np.sqrt(T**2 * k_1**2 + 4 * over))
            after = v - k_2 * T * np.sign(x)
            u = -k_1 * r * np.sign(x) + 2 * after - v
        above, turned = twist(x, T * k_1, T**2 * k_2, None)
        ours = v - T * k_2 * turned
        np.testing.assert_allclose([ours, 2 * ours - v - k_1 * above], [after, u], rtol=1e-13, atol=1e-13)


# Central differences with steps of 1e-6: their own error is 1e-9 or so of the value, more where the sign turns.
@pytest.mark.slow
@pytest.mark.parametrize(
    "function", [share, lambda w, h, p: twist(w, h, 0.3 * h, p)[0], lambda w, h, p: relax(w, h, p)]
)
def test_derivatives_are_those_of_the_equation(function):
    rng = np.random.default_rng(2)
    function, reverse = jax.jit(function), jax.jit(jax.grad(function, (0, 1, 2)))
    for point in np.exp(rng.normal(size=(30, 3))):
        slope = reverse(*point)
        for n in range(3):
            step = 1e-6 * np.eye(3)[n] * point
            difference = (function(*(point + step)) - function(*(point - step))) / (2e-6 * point[n])
            np.testing.assert_allclose(slope[n], difference, rtol=2e-7, atol=1e-9)
    forward = jax.jacfwd(function, (0, 1, 2))(*point)
    np.testing.assert_allclose(forward, slope, rtol=1e-12)
