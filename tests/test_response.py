"""Settling time and overshoot of motions that are given by formulas."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax.simulation.folds import Ending
from ambjax.simulation.response import Overshoot, Settling

PERIOD, SAMPLES = 1e-3, 3000
T = PERIOD * np.arange(SAMPLES)


class Motion(NamedTuple):
    t: jax.Array
    z: jax.Array
    r: jax.Array


def measured(fold, z, r):
    rows = Motion(jnp.asarray(T), jnp.asarray(z), jnp.asarray(r) + 0.0 * jnp.asarray(z))
    carry, _ = jax.lax.scan(lambda carry, row: (fold.update(carry, row, None), None), fold.init(), rows)
    return fold.result(carry, Ending(*map(jnp.asarray, (0, jnp.inf, jnp.inf, SAMPLES * PERIOD))))


def decay(rate):
    return 1e-3 * jnp.exp(-rate * T)


def test_settling_is_when_the_band_is_entered_for_good():
    # exactly at log(1e-3 / band) / rate; the chord of an exponential is off by at most rate T^2 / 8 there: 6e-7 s
    found = measured(Settling(1e-5), decay(5.0), 0.0)
    assert float(found) == pytest.approx(math.log(100) / 5, abs=6.3e-7)
    # coming back counts
    again = np.where(np.abs(T - 2.0) < 0.1, 2e-5, decay(5.0))
    assert float(measured(Settling(1e-5), again, 0.0)) == pytest.approx(2.1, abs=2 * PERIOD)
    assert float(measured(Settling(1e-2), decay(5.0), 0.0)) == 0.0
    # never: longer than the run, and the longer the farther it is from the band
    assert float(measured(Settling(1e-5), decay(0.0), 0.0)) == pytest.approx(100 * SAMPLES * PERIOD)


def test_the_settling_time_after_a_load_is_that_of_the_recovery():
    """A load deflects a settled rotor at 1 s, and its end at 2 s deflects it the other way, by half as much."""

    def after(start):
        late = np.maximum(T - start, 0.0)
        return np.exp(-5 * late) * np.sin(20 * late)

    z = 1e-3 * (after(1.0) - 0.5 * after(2.0))
    # what is left of the first deflection shifts this by 0.2 ms
    late = np.arange(0, 1, 1e-6)
    last = late[np.abs(0.5 * np.exp(-5 * late) * np.sin(20 * late)) > 1e-1].max()
    assert float(measured(Settling(1e-4), z, 0.0)) == pytest.approx(2 + last, abs=PERIOD)
    assert float(measured(Overshoot(), z, 0.0)) == pytest.approx(np.abs(z).max(), rel=1e-12)


def test_the_derivative_of_the_settling_time_points_to_faster_settling():
    def time(rate):
        return measured(Settling(1e-5), decay(rate), 0.0)

    _, slope = jax.jvp(time, (5.0,), (1.0,))
    # of the chord, a first-order formula in rate T = 5e-3
    assert float(slope) == pytest.approx(-math.log(100) / 25, rel=5e-3)
    _, slope = jax.jvp(time, (0.1,), (1.0,))  # not settled within the run
    assert float(slope) < 0


def test_the_overshoot_of_a_step_is_that_of_the_textbook():
    damping, rate = 0.3, 20.0
    fast = rate * math.sqrt(1 - damping**2)
    z = 1e-3 * (1 - np.exp(-damping * rate * T) * (np.cos(fast * T) + damping * rate / fast * np.sin(fast * T)))
    exact = 1e-3 * math.exp(-math.pi * damping / math.sqrt(1 - damping**2))
    # the peak lies within half a sample of one, where it is lower by (fast T / 2)^2 / 2 of its height above 1
    assert float(measured(Overshoot(), z, 1e-3)) == pytest.approx(exact, rel=1e-3)
    # downwards likewise; a rotor lifted from where it began to r = 0 too
    assert float(measured(Overshoot(), -z, -1e-3)) == pytest.approx(exact, rel=1e-3)
    assert float(measured(Overshoot(), z - 1e-3, 0.0)) == pytest.approx(exact, rel=1e-3)
    assert float(measured(Overshoot(), 1e-3 * np.sin(T), 1e-3 * np.sin(T))) == 0.0
