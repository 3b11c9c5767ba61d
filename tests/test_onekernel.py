"""The kernel of a whole rollout against the rollout, in interpret mode; its compilation for a GPU, without a GPU."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import (
    RK4,
    AdaptiveRodas3,
    Cascade,
    Clock,
    Initial,
    Scenario,
    Sensor,
    Sine,
    Standard,
    inversion,
    observer,
    position,
)
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble
from ambjax.ensemble.gpu_kernel import run_whole
from ambjax.simulation.folds import Named, Peak, Variation
from ambjax.world.band_noise import BandNoise

MEMBERS, CLOCK = 37, Clock(5, 1e-4, RK4(2))
CASCADE = Cascade(inversion=inversion.Adaptive(np.linspace(1e8, 1e9, MEMBERS), 25e-6))
SCENARIO = Scenario(
    reference=Sine(2.5e-3, 2.0),
    q_z=BandNoise(1.0, 10.0, 200.0),
    sensor=Sensor(1e-6, 1e-4, 1e-4),
    # the last members start beside the stop, moving towards it, and are lost
    initial=Initial(z=np.linspace(0, 4.49e-3, MEMBERS), z_dot=np.linspace(0, 1.0, MEMBERS)),
    seed=11,
    member=np.arange(1000, 1000 + MEMBERS),
)


@pytest.mark.slow
def test_the_kernel_equals_the_rollout():
    fold = Named({"peak": Peak("e_z", 1e-4, timed=True), "chatter": Variation()})
    found = run_whole(CASCADE, SCENARIO, CLOCK, fold=fold, block=32, interpret=True)
    expected = run_ensemble(CASCADE, SCENARIO, CLOCK, fold=fold, threads=1)
    assert 0 < int(jnp.isfinite(expected.trajectory.lost_at).sum()) < MEMBERS
    for ours, theirs in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        assert ours.shape == (MEMBERS,)
        # one and the same arithmetic; only the compiler's contraction of a*b + c may differ
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=0)


LAWS = {
    "paper": CASCADE,
    "others": Cascade(
        observer=observer.Complementary(np.linspace(1.0, 10.0, MEMBERS)),
        position=position.SuperTwisting(),
        inversion=inversion.ClosedForm(),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(("laws", "x64"), [("paper", True), ("others", False)])
def test_the_kernel_compiles_for_a_gpu(laws, x64, monkeypatch):
    # No GPU is needed to make its program: a primitive that kernels cannot have would raise here. What is done for
    # CPUs alone must be left out, as it is where JAX runs on a GPU.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.enable_x64(x64):
        run = jax.jit(
            lambda z: run_whole(LAWS[laws], dataclasses.replace(SCENARIO, initial=z), CLOCK, fold=Standard(2e-4))
        )
        lowered = run.trace(SCENARIO.initial).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("custom_call @__gpu$xla.gpu.triton") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clock": Clock(6, 1e-4, AdaptiveRodas3())}, "RK4 only"),
        ({"block": 48}, "block = 48: it must be a power of two"),
        ({"scenario": dataclasses.replace(SCENARIO, seed=np.arange(5))}, "leaves: 5 and 37"),
        ({"scenario": Scenario(), "cascade": Cascade(), "clock": Clock(6, 1e-4, RK4(50))}, "leaves: none"),
        ({"clock": Clock(0, 1e-4, RK4(1))}, "clock.samples = 0"),
    ],
)
def test_bad_input_is_refused(change, message):
    arguments = {"cascade": CASCADE, "scenario": SCENARIO, "clock": CLOCK, "fold": Peak("e_z")} | change
    with pytest.raises(ValueError, match=message):
        run_whole(**arguments)


def test_a_processor_is_refused():
    cascade = Cascade(processor=Processor())
    with pytest.raises(ValueError, match="the whole-rollout kernel runs cascades in continuous time only"):
        run_whole(cascade, Scenario(member=np.arange(2)), Clock(10, 1e-4, RK4(2)), fold=None, interpret=True)
