"""run_on_gpu against the rollout, in Pallas's interpreter; lowering of its kernel for CUDA, without a GPU."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough

from ambjax import Cascade, Clock, Initial, Metrics, Scenario
from ambjax.compiler.fast_path import block_length
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble, run_on_gpu
from ambjax.laws import inversion, observer, position
from ambjax.sensors import Sensor
from ambjax.signals import Constant, Pulse, Recorded, Samples, Sine
from ambjax.simulation.folds import Named, Peak, Variation
from ambjax.solvers import RK4, AdaptiveRodas3
from ambjax.world.recorded import BandNoise

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
    found = run_on_gpu(CASCADE, SCENARIO, CLOCK, fold=fold, block=32, interpret=True)
    expected = run_ensemble(CASCADE, SCENARIO, CLOCK, fold=fold, threads=1)
    assert 0 < int(jnp.isfinite(expected.trajectory.lost_at).sum()) < MEMBERS
    for ours, theirs in zip(*map(jax.tree.leaves, (found, expected)), strict=True):
        assert ours.shape == (MEMBERS,)
        # one and the same arithmetic; only the compiler's contraction of a*b + c may differ
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=0)


RECORDED = Recorded(Samples(np.array([0.0, 1.0]), np.array([0.0, 1e-5])))
OTHERS = Cascade(
    observer=observer.Complementary(np.linspace(1.0, 10.0, MEMBERS)),
    position=position.SuperTwisting(),
    inversion=inversion.ClosedForm(),
)
# Without random signals, members share the reference, so the kernel computes its sine with scalars.
SHARED = dataclasses.replace(SCENARIO, q_z=Constant(0.0), q_v=Pulse(1.0, 1e-4, 2e-4), sensor=None)
KERNELS = [(CASCADE, True, SCENARIO), thorough(OTHERS, False, SCENARIO), (CASCADE, False, SHARED)]


@pytest.mark.slow
@pytest.mark.parametrize(("laws", "x64", "scenario"), KERNELS, ids=("paper", "others", "shared"))
def test_the_kernel_compiles_for_a_gpu(laws, x64, scenario, monkeypatch):
    # Lowering for CUDA needs no GPU. A primitive that Triton lacks raises here.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.enable_x64(x64):
        run = jax.jit(lambda z: run_on_gpu(laws, dataclasses.replace(scenario, initial=z), CLOCK, fold=Metrics(2e-4)))
        lowered = run.trace(scenario.initial).lower(lowering_platforms=("cuda",)).as_text()
    assert lowered.count("custom_call @__gpu$xla.gpu.triton") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clock": Clock(6, 1e-4, AdaptiveRodas3())}, "RK4 only"),
        ({"block": 48}, "block = 48: it must be a power of two"),
        ({"scenario": dataclasses.replace(SCENARIO, seed=np.arange(5))}, "leaves: 5 and 37"),
        ({"scenario": Scenario(), "cascade": Cascade(), "clock": Clock(6, 1e-4, RK4(50))}, "leaves: none"),
        ({"clock": Clock(0, 1e-4, RK4(1))}, "clock.samples = 0"),
        ({}, "run_on_gpu needs a GPU, and JAX runs on this backend: cpu. Use run_ensemble."),
        ({"scenario": dataclasses.replace(SCENARIO, reference=RECORDED), "interpret": True}, "a recorded signal"),
        ({"cascade": Cascade(processor=Processor()), "interpret": True}, "cascades in continuous time only"),
    ],
)
def test_bad_input_is_refused(change, message):
    arguments = {"cascade": CASCADE, "scenario": SCENARIO, "clock": CLOCK, "fold": Peak("e_z")} | change
    with pytest.raises(ValueError, match=message):
        run_on_gpu(**arguments)


@pytest.mark.slow
def test_without_the_triton_back_end_the_ordinary_ensemble_runs(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax.experimental.pallas.triton", None)
    with pytest.warns(UserWarning, match="run_ensemble simulates the members instead"):
        found = run_on_gpu(CASCADE, SCENARIO, CLOCK, fold=Peak("e_z"), interpret=True)
    expected = run_ensemble(CASCADE, SCENARIO, CLOCK, fold=Peak("e_z"), threads=1)
    assert all(map(np.array_equal, jax.tree.leaves(found), jax.tree.leaves(expected)))


def test_little_of_the_blocks_is_padding():
    for members in range(1, 3000):
        block = block_length(members)
        blocks = -(-members // block)
        assert block % 16 == 0
        assert blocks * block - members < (16 * blocks if blocks > 1 else max(members, 16))
