"""The memory of reverse mode through a rollout in parts."""

import jax
import jax.numpy as jnp
import pytest

from ambjax import Cascade, Clock, Scenario
from ambjax.laws import current, inversion, position
from ambjax.sensors import Sensor
from ambjax.signals import Sine
from ambjax.simulation.folds import Rms
from ambjax.simulation.rollout import prepare, rolled_in_parts
from ambjax.solvers import RK4


def gradient_in_parts(samples):
    """Return the compiled gradient of the mean square of e_z in a rollout in parts, with respect to log c."""
    scenario, clock = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(0.0)), Clock(samples, 1e-4, RK4(1))

    def loss(log):
        cascade = Cascade(
            position=position.SlidingMode(17.0 * jnp.exp(log), 25.0),
            inversion=inversion.Adaptive(1e9, 25e-6),
            current=current.SlidingMode(152.0),
        )
        return rolled_in_parts(*prepare(cascade, scenario, clock), Rms("e_z")).metrics ** 2

    return jax.jit(jax.value_and_grad(loss)).lower(0.0).compile()


@pytest.mark.thorough
def test_the_memory_of_a_rollout_in_parts_grows_with_the_square_root_of_its_samples():
    """Four times as many samples need at most twice the memory: twice as many parts of twice as many samples."""
    sizes = [gradient_in_parts(n).memory_analysis().temp_size_in_bytes for n in (10_000, 40_000)]
    # a part of the memory does not depend on the samples
    assert sizes[1] < 2.1 * sizes[0]
