"""Other numbers in the same structure are neither traced nor compiled again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, Scenario, rollout
from ambjax.laws import inversion, position
from ambjax.plants import Plant
from ambjax.sensors import Sensor
from ambjax.signals import Pulse, Sine
from ambjax.solvers import AdaptiveRodas3, Slide

NOISY = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.8, 1.3), sensor=Sensor(1e-6, 1e-4, 1e-4))
SHORT = Clock(203, 1e-4, AdaptiveRodas3())


class Counting(position.SlidingMode):
    """The sliding-mode law, counting how often it is traced."""

    traces = 0

    def __call__(self, model, inputs, state):
        Counting.traces += 1
        return super().__call__(model, inputs, state)


jax.tree_util.register_dataclass(Counting)


def variations():
    """The same structure with other numbers, and the same numbers in other types."""
    law, world = Counting(), NOISY
    other = Scenario(Plant(m=0.6, g=9.8), Sine(1e-3, 1.0), q_v=Pulse(2.0, 0.7, 1.2), sensor=Sensor(2e-6), u_max=100.0)
    yield "plant, signals and limit", law, inversion.Adaptive(), other
    yield "gains", Counting(c=20.0, k=26.0, p=20.0), inversion.Adaptive(gamma=8e4), world
    yield "seed", law, inversion.Adaptive(), dataclasses.replace(world, seed=5, member=2)
    yield "NumPy", Counting(np.float64(20.0), np.float32(25.0), np.asarray(25.0)), inversion.Adaptive(), world
    yield "JAX", Counting(jnp.asarray(20.0), jnp.float32(25.0), 25.0), inversion.Adaptive(), world
    yield "integer gains", Counting(c=20, k=26, p=20), inversion.Adaptive(), world
    yield "integer limit", law, inversion.Adaptive(), dataclasses.replace(world, u_max=200)
    yield "integer amplitude", law, inversion.Adaptive(), dataclasses.replace(world, q_v=Pulse(1, 0.8, 1.3))
    yield "unsigned seed", law, inversion.Adaptive(), dataclasses.replace(world, seed=np.uint32(4))
    yield "JAX seed", law, inversion.Adaptive(), dataclasses.replace(world, seed=jnp.asarray(5), member=np.int64(2))


def compiled(caplog, *case):
    """Kernels that a rollout compiles."""
    with jax.log_compiles(), caplog.at_level("WARNING"):
        rollout(*case, record_every=0)
    # the name of a rollout on the fast path, and without it
    return [said for said in caplog.messages if said.startswith(("Compiling jit(marked)", "Compiling jit(run)"))]


@pytest.fixture(scope="module")
def warm():
    """One rollout with the counting law, compiled."""
    return rollout(Cascade(position=Counting()), NOISY, SHORT, record_every=0)


@pytest.mark.parametrize("what", list(variations()), ids=lambda x: x[0])
def test_other_numbers_never_recompile(what, warm, caplog):
    _, law, invert, scenario = what
    before = Counting.traces
    assert not compiled(caplog, Cascade(position=law, inversion=invert), scenario, SHORT)
    assert Counting.traces == before


def test_a_change_of_structure_recompiles(caplog):
    """This shows that the other tests of this module can detect a compilation."""
    before = Counting.traces
    assert compiled(caplog, Cascade(position=Counting()), NOISY, Clock(3, 1e-4, Slide(1)))
    assert Counting.traces > before
