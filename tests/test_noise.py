"""Sensor noise is Gaussian, held, independent, and the same for a member in every computation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from ambjax import Scenario
from ambjax.numerics.gaussian import normals, threefry
from ambjax.sensors import Sensor

NOISY = Scenario(sensor=Sensor(1e-6, 1e-4, 1e-4))


def test_the_random_words_are_those_of_jax_random():
    """Threefry is implemented here, because kernels on accelerators cannot call jax.random.

    The comparison uses fold_in.
    """
    scenario = dataclasses.replace(NOISY, seed=5, member=2**31 + 9)
    for number in (0, 1, 77, 2**32 - 1):
        expected = jax.random.key_data(jax.random.fold_in(scenario.key(), np.uint32(number)))
        np.testing.assert_array_equal(jnp.stack(threefry(scenario.words(), (0, np.uint32(number)))), expected)


@pytest.mark.parametrize("x64", [True, False])
def test_the_normal_numbers_have_a_normal_distribution(x64):
    """The Kolmogorov-Smirnov test, the tail beyond 4, and no correlation of numbers, squares, large values, samples."""
    with jax.enable_x64(x64):
        drawn = jax.jit(jax.vmap(lambda k: normals(Scenario(seed=1).words(), k)))(jnp.arange(400_000))
        for w in map(np.asarray, drawn):
            assert w.dtype == (np.float64 if x64 else np.float32)
            # one in 1,000 fails by chance, and the seed is fixed
            assert stats.kstest(w.astype(float), "norm").pvalue > 1e-3
            # 25 expected; Poisson's five standard deviations
            assert 0 < np.sum(np.abs(w) > 4) < 51
            assert abs(np.mean(w[1:] * w[:-1])) < 5 / 400_000**0.5  # five standard errors
    np.testing.assert_array_equal(NOISY.sensor.scaled((1.0, 2.0, 4.0)), (1e-6, 2e-4, 4e-4))
    drawn = np.asarray(drawn)[:, :40_000]
    for function in (lambda w: w, np.square, lambda w: np.abs(w) > 2, np.sign):
        correlation = np.corrcoef(function(drawn).astype(float)) - np.eye(3)
        # five standard errors, 1/sqrt(40,000) each; one radius for two numbers would give 1/2 for the squares
        assert np.abs(correlation).max() < 5 / 200


def test_member_k_draws_the_same_noise_alone_and_in_a_batch():
    def noise(member, seed):
        scenario = dataclasses.replace(NOISY, seed=seed, member=member)
        return jax.vmap(lambda k: scenario.sensor.noise(scenario.words(), k))(jnp.arange(50))

    alone, batch = jax.jit(noise), jax.jit(jax.vmap(noise, (0, None)))(jnp.arange(5), 7)
    for m in range(5):
        for x, y in zip(alone(m, 7), batch, strict=True):
            np.testing.assert_array_equal(x, y[m])
    rows = np.asarray(batch.z)
    assert len(set(rows.ravel())) == rows.size
    assert np.max(np.abs(np.corrcoef(rows) - np.eye(5))) < 0.7  # 5/sqrt(50)
    # another seed draws other noise for the same member
    assert not np.any(np.asarray(alone(0, 8).z) == rows[0])


def test_noise_and_keys_use_different_random_words():
    """fold_in(key, n) gives two words from which signals and designs draw.

    The noise of sample n does not use these words.
    """
    scenario = dataclasses.replace(Scenario(sensor=Sensor(1.0, 1.0, 1.0)), seed=9, member=4)

    def words(n):
        return jnp.stack(threefry(scenario.words(), (0, n))).astype(float)

    a, b = np.asarray(jax.vmap(words)(jnp.arange(200))).T
    radius, turn = np.sqrt(-2 * np.log((a + 0.5) / 2**32)), 2 * np.pi * b / 2**32
    own = np.asarray(jax.vmap(lambda n: jnp.stack(scenario.sensor.noise(scenario.words(), n)))(jnp.arange(200)))
    for made in (radius * np.cos(turn), radius * np.sin(turn)):
        assert np.abs(own - made[:, None]).min() > 1e-9  # 600 numbers of order 1; equal ones agree to 1e-15
