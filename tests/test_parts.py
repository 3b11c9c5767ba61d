"""Reverse mode through a rollout in parts: its memory, and when the tuner uses it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import RK4, Cascade, Clock, Scenario, Sensor, Sine, current, inversion, position, rollout
from ambjax.simulation.folds import Rms
from ambjax.simulation.parts import part_length, rolled_in_parts
from ambjax.simulation.rollout import prepare
from tuning.problem import cheaper_mode


@pytest.mark.parametrize(("samples", "length"), [(100, 10), (20_000, 125), (240, 15), (17, 1), (1, 1)])
def test_a_part_is_the_largest_divisor_up_to_the_square_root(samples, length):
    assert part_length(samples) == length


SCENARIO = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(0.0))


def in_parts_or_not(samples, in_parts):
    """Return the mean square of e_z as a function of the logarithm of c, in a rollout in parts or not."""
    clock = Clock(samples, 1e-4, RK4(1))

    def loss(log):
        cascade = Cascade(
            position=position.SlidingMode(17.0 * jnp.exp(log), 25.0),
            inversion=inversion.Adaptive(1e9, 25e-6),
            current=current.SlidingMode(152.0),
        )
        fold = Rms("e_z")
        if in_parts:
            return rolled_in_parts(*prepare(cascade, SCENARIO, clock), fold).measured ** 2
        return rollout(cascade, SCENARIO, clock, fold=fold, every=0).measured ** 2

    return loss


@pytest.mark.slow
def test_the_memory_of_a_rollout_in_parts_grows_with_the_square_root_of_its_samples():
    """Four times as many samples need four times the memory in one piece, and twice the memory in parts."""

    def compiled(samples, in_parts):
        loss = in_parts_or_not(samples, in_parts)
        return jax.jit(jax.value_and_grad(loss)).lower(0.0).compile()

    found = {(n, parts): compiled(n, parts) for n in (10_000, 40_000) for parts in (True, False)}
    size = {key: one.memory_analysis().temp_size_in_bytes for key, one in found.items()}
    # a part of the memory does not depend on the samples
    assert size[40_000, True] < 2.1 * size[10_000, True]
    assert size[40_000, False] > 3.5 * size[10_000, False]
    assert size[10_000, True] < size[10_000, False] / 10
    values = np.array([found[10_000, parts](0.0) for parts in (True, False)])
    # the same operations, fused differently
    np.testing.assert_allclose(values[0], values[1], rtol=1e-9)


@pytest.mark.parametrize(("outcomes", "most"), [(1, 8), (2, 12), (3, 16)])
def test_the_mode_with_fewer_plain_rollouts_is_used(outcomes, most):
    """Forward mode takes 1 + m plain rollouts for m gains, reverse mode 5 and 4 for each outcome."""
    assert cheaper_mode(most, outcomes) == "forward"
    assert cheaper_mode(most + 1, outcomes) == "reverse"
