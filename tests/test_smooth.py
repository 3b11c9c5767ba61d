"""Smooth replacements of signs and roots: limits, slopes at 0, and finite derivatives there."""

import jax
import numpy as np
import pytest

from ambjax.compiler.fast_path import one_kernel
from ambjax.numerics import smooth

EPS = np.finfo(float).eps
P = [0.1, 25.0, 1e4]


@pytest.mark.parametrize("function", [smooth.smooth_sign, smooth.smooth_root])
@pytest.mark.parametrize("p", P)
def test_a_smooth_function_is_odd_and_converges_to_its_limit(function, p):
    x = np.array([1e3, 1e6, 1e9]) / p
    if function is smooth.smooth_sign:
        # 1 - S = 2/(pi p x) + O((p x)^-3): a relative 1e-6 at p x = 1e3; the rest is the cancellation in 1 - S
        np.testing.assert_allclose(1 - function(x, p), smooth.TWO_OVER_PI / (p * x), rtol=1e-6, atol=2 * EPS)
    else:  # relative distance 1/(4 (p x)^2) <= 2.5e-7
        np.testing.assert_allclose(function(x, p), np.sqrt(x), rtol=3e-7)
    np.testing.assert_array_equal(function(-x, p), -function(x, p))
    assert function(0.0, p) == 0


@pytest.mark.parametrize("x", [-1e300, -1.0, -1e-300, 0.0, 1e-300, 1.0, 1e300])
def test_values_and_both_derivatives_are_finite_everywhere(x):
    # 1e300 only for the sign: x^2 of the root overflows there, 145 orders beyond any velocity
    cases = [lambda x: smooth.smooth_sign(x, 25.0), smooth.safe_sqrt, lambda x: smooth.away_from_zero(x, 1e-3)]
    cases += [lambda x: smooth.smooth_root(x, 25.0)] if abs(x) < 1e150 else []
    for f in cases:
        first, second = jax.grad(f), jax.grad(jax.grad(f))
        # safe_sqrt'' at 1e-300 is 1e450: its first derivative is what is promised
        derivatives = [first(x)] if f is smooth.safe_sqrt else [first(x), second(x)]
        assert np.all(np.isfinite([f(x), *derivatives]))


# Around 0, around the points where the argument is folded, and far out.
RATIOS = np.concatenate([np.logspace(-30, 18, 3001), 1 + np.linspace(-1e-3, 1e-3, 2000)])
TURNS = np.concatenate([np.linspace(-3, 3, 4801), np.logspace(-15, 5, 3000), np.arange(-9, 9) / 8 + 1e-9])
DTYPES = [np.float64, np.float32]


def wide(function):
    """Compile a function as in an ensemble: one kernel with 61 lanes, so that the last vector is not full."""
    kernel = one_kernel(lambda *blocks: jax.lax.map(lambda x: jax.vmap(function)(*x), blocks))

    def run(*args):
        padded = [np.pad(x, (0, -x.size % 61), constant_values=1).reshape(-1, 61) for x in args]
        return np.asarray(kernel(*padded)).reshape(-1)[: args[0].size]

    return run


def exact_turns(x):
    """sin and cos of 2 pi x, in long double from an exactly reduced angle."""
    y = np.asarray(x, np.longdouble)
    y = 8 * np.arctan(np.longdouble(1)) * (y - np.round(y))
    return np.sin(y), np.cos(y)


@pytest.mark.parametrize("dtype", DTYPES)
def test_arctan_per_agrees_with_numpy(dtype):
    x = np.concatenate([-RATIOS, RATIOS, [0.0]]).astype(dtype)
    per = np.linspace(0.5, 7, x.size).astype(dtype)
    expected = np.arctan(x.astype(np.longdouble)) / per.astype(np.longdouble)
    # the approximation's own 2e-15 (9 eps) in float64, a few roundings in float32
    np.testing.assert_allclose(wide(smooth.arctan_per)(x, per), expected, rtol=10 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
def test_refined_reciprocal_is_one_over_x_to_the_last_bit_but_one(dtype):
    """Over the whole range, and near 1, where rounding of either operand has the largest effect."""
    eps = np.finfo(dtype).eps
    near = 1 + np.linspace(-50, 50, 101) * eps
    x = np.concatenate([np.geomspace(1e-37, 1e37, 9973), near]).astype(dtype)
    x = np.concatenate([x, -x])
    np.testing.assert_allclose(wide(smooth.refined_reciprocal)(x), 1 / x.astype(np.longdouble), rtol=2 * eps)
    # far beyond it, what is as good as 0: a trial state on its way out of the model's range
    assert np.all(wide(smooth.refined_reciprocal)(np.full(8, np.sqrt(np.finfo(dtype).max))) < 1e-18)


@pytest.mark.parametrize("dtype", DTYPES)
def test_sine_and_cosine_of_turns_agree_with_numpy(dtype):
    x = TURNS.astype(dtype)
    sin, cos = exact_turns(x)
    # relative where the sine is small, too: the reduced angle is exact; its polynomial rounds a few times.
    # At half turns long double's pi leaves the reference 1e-19 beside 0.
    eps = np.finfo(dtype).eps
    np.testing.assert_allclose(wide(smooth.sine)(x), sin, rtol=4 * eps, atol=1e-18)
    np.testing.assert_allclose(wide(smooth.cosine)(x), cos, rtol=4 * eps, atol=2 * eps)
