"""A while loop in both modes of differentiation, against the same loop in Python floats."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax.numerics.reversible import KEPT, while_loop


def grown(a, b):
    """Return a sum whose number of terms depends on the values: about 190 for a = 1.5, 60 for a = 1.4."""

    def step(carry):
        return carry[0] * jnp.sin(a) + b, carry[1] + 1

    return while_loop(lambda carry: (carry[0] < 100 * b) & (carry[1] < 200), step, (2 * a, 0))[0] * b


def in_python(a, b):
    x, n = 2 * a, 0
    while x < 100 * b and n < 200:
        x, n = x * jnp.sin(a) + b, n + 1
    return x * b, n


@pytest.mark.parametrize("a", [1.5, 70.0, 200.0])  # more steps than are stored, and two loops without a step
def test_both_modes_agree_with_an_unrolled_loop(a):
    value, steps = in_python(a, 0.7)
    assert steps > 2 * KEPT or steps == 0
    expected = jax.grad(lambda *x: in_python(*x)[0], (0, 1))(a, 0.7)
    for f in (grown, jax.jit(grown)):
        assert f(a, 0.7) == pytest.approx(float(value), rel=1e-12)
        np.testing.assert_allclose(jax.grad(f, (0, 1))(a, 0.7), expected, rtol=1e-10)
        np.testing.assert_allclose(jax.jacfwd(f, (0, 1))(a, 0.7), expected, rtol=1e-10)


@pytest.mark.slow
def test_batches_and_second_derivatives():
    a = jnp.array([1.5, 1.4, 0.3])  # different numbers of steps
    expected = [float(jax.grad(lambda x: in_python(x, 0.7)[0])(float(x))) for x in a]
    np.testing.assert_allclose(jax.vmap(lambda x: jax.grad(grown)(x, 0.7))(a), expected, rtol=1e-10)
    np.testing.assert_allclose(jax.grad(lambda x: jax.vmap(lambda y: grown(y, 0.7))(x).sum())(a), expected, rtol=1e-10)
    forward = jax.jacfwd(jax.jacfwd(grown, (0, 1)), (0, 1))(1.4, 0.7)
    np.testing.assert_allclose(jax.hessian(grown, (0, 1))(1.4, 0.7), forward, rtol=1e-9)
    np.testing.assert_allclose(jax.jacrev(jax.jacfwd(grown, (0, 1)), (0, 1))(1.4, 0.7), forward, rtol=1e-9)
