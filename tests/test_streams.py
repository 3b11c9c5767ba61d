"""Independent random streams: of different sensors, and of sensors and keys."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ambjax import Scenario
from ambjax.numerics.gaussian import normals, threefry
from ambjax.sensors import Sensor


def test_the_noise_of_different_sensors_is_independent():
    """There is no correlation of the numbers, of their squares, or of large values."""
    count = 40_000
    drawn = jax.jit(jax.vmap(lambda k: jnp.stack(normals(Scenario(seed=3).words(), k))))(jnp.arange(count))
    for n, function in enumerate((lambda w: w, np.square, lambda w: np.abs(w) > 2, np.sign)):
        value = function(np.asarray(drawn)).astype(float)
        correlation = np.corrcoef(value.T) - np.eye(3)
        # five standard errors, 1/sqrt(count) each; one radius for two numbers would give 1/2 for the squares
        assert np.abs(correlation).max() < 5 / np.sqrt(count), n


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
