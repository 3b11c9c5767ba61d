"""Gradients of a rollout three ways: forward = reverse = finite differences."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough

from ambjax import Cascade, Clock, Initial, Metrics, Processor, Scenario, rollout, with_gains
from ambjax.actuators import Amplifier
from ambjax.laws import current, inversion, position
from ambjax.sensors import Sensor
from ambjax.signals import Pulse, Sine
from ambjax.simulation.folds import Rms
from ambjax.solvers import RK4, Rodas3

TRACKING = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.01, 0.03), sensor=Sensor(0.0))
NOISE = np.array([0.0, 1e-6])
REPAIRED = np.array([17.0, 25.0, 7.5e4, 152.0])
SMOOTH = np.array([17.0, 25.0, 1e9, 152.0])


def run(gains, p, std, clock):
    """Mean square of e_z/s_0, and the status, of the cascade with gains (c, k, gamma, k_i)."""
    c, k, gamma, k_i = gains
    cascade = Cascade(
        position=position.SlidingMode(c, k), inversion=inversion.Adaptive(gamma, p), current=current.SlidingMode(k_i)
    )
    scenario = dataclasses.replace(TRACKING, sensor=Sensor(std))
    out = rollout(cascade, scenario, clock, fold=Rms("e_z"), record_every=0)
    return (out.metrics / 5e-3) ** 2, out.trajectory


def derivatives(nominal, p, clock):
    """Compiled reverse and forward derivatives in the logarithms of the gains, over a batch of (log gains, std)."""

    def loss(log, std, nominal):
        return run(nominal * jnp.exp(log), p, std, clock)[0]

    # not one_kernel: reverse mode takes minutes to compile that way, and runs for seconds here
    reverse = jax.jit(jax.vmap(jax.value_and_grad(loss), (0, 0, None)))
    forward = jax.jit(jax.vmap(jax.jacfwd(loss), (0, 0, None)))
    return lambda *batch: reverse(*batch, nominal), lambda *batch: forward(*batch, nominal)


# Relative steps of the differences, gain by gain. The smooth loop is smooth on the scale of 1 %. The repaired loop
# is rough below it: each corner of its arctan (width 1/(p gamma) = 0.5 us) is crossed in one step, so the computed
# loss ripples as gamma moves corners across steps. k_i acts through noise only, 1e-8 of the loss: large steps.
CASES = {
    "smooth": (SMOOTH, 25e-6, RK4(2), [1e-2, 1e-2, 1e-2, 1e-2]),
    "repaired": (REPAIRED, 25.0, Rodas3(20), [1e-5, 1e-5, 1e-5, 1e-2]),
}


@pytest.fixture(scope="module", params=["smooth", thorough("repaired")])
def three_ways(request):
    """Reverse, forward and Richardson-extrapolated central differences, without and with noise: arrays [2, 4]."""
    nominal, p, method, steps = CASES[request.param]
    reverse, forward = derivatives(nominal, p, Clock(500, 1e-4, method))
    points = [np.zeros(4)]
    for j, h in enumerate(steps):
        points += [s * h * np.eye(4)[j] for s in (1, -1, 0.5, -0.5)]
    batch = np.repeat(points, 2, axis=0), np.tile(NOISE, len(points))
    value, by_reverse = (np.asarray(x).reshape(len(points), 2, -1) for x in reverse(*batch))
    by_forward = np.asarray(forward(*batch)).reshape(len(points), 2, 4)
    up, down, half_up, half_down = (value[1 + s :: 4, :, 0].T for s in range(4))
    whole, half = (up - down) / (2 * np.array(steps)), (half_up - half_down) / np.array(steps)
    return by_reverse, by_forward, (4 * half - whole) / 3


@pytest.mark.slow
def test_forward_equals_reverse(three_ways):
    by_reverse, by_forward, _ = three_ways
    size = np.max(np.abs(by_reverse), axis=-1, keepdims=True)
    # the same chain of 1,000 (10,000) steps multiplied from either end
    assert np.all(np.abs(by_forward - by_reverse) <= 1e-10 * np.abs(by_reverse) + 1e-14 * size)


@pytest.mark.slow
def test_derivatives_equal_differences(three_ways):
    by_reverse, _, differences = three_ways
    quiet, noisy = by_reverse[0]
    # h^4 truncation and eps/h rounding after one Richardson step, both measured below 1e-7
    np.testing.assert_allclose(differences[1], noisy, rtol=1e-6)
    np.testing.assert_allclose(differences[0][:3], quiet[:3], rtol=1e-6)
    # without noise i = i_ref from the start, Eq. (10), so k_i has no effect: zero, to rounding
    assert abs(quiet[3]) < 1e-12 * np.max(np.abs(quiet))
    assert abs(differences[0][3]) < 1e-9 * np.max(np.abs(quiet))


# --- the fast path ---

IN_A_PROCESS_OF_ITS_OWN = """
import jax, numpy as np
from ambjax import *
from ambjax.laws import *
from ambjax.solvers import *
from ambjax.compiler import fast_path
from ambjax.compiler.fast_path import one_kernel
from ambjax.numerics.records import canonical
from ambjax.simulation.folds import Rms

def loss(cascade):
    # squared: the cotangent of the rollout is no constant
    return rollout(cascade, Scenario(), Clock(20, 1e-4, Euler(1)), fold=Rms("e_z"), record_every=0).metrics ** 2

smooth = canonical(Cascade(inversion=inversion.Adaptive(1e9, 25e-6)))
transforms = [
    jax.jit(jax.value_and_grad(loss)),
    one_kernel(jax.value_and_grad(loss)),
    one_kernel(lambda x: jax.jvp(loss, (x,), (x,))),
]
fast = [jax.tree.leaves(f(smooth)) for f in transforms]
fast_path.options = lambda: None
for f, leaves in zip(transforms, fast):
    # the same operations, fused differently
    np.testing.assert_allclose(leaves, jax.tree.leaves(f(smooth)), rtol=1e-11, atol=1e-28)
"""


@pytest.mark.slow
def test_the_fast_path_is_differentiable():
    # reverse mode through a marked call aborts XLA, and would take pytest with it
    command = [sys.executable, "-c", IN_A_PROCESS_OF_ITS_OWN]
    done = subprocess.run(command, env=os.environ | {"JAX_ENABLE_X64": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:500]


# --- steps whose lengths depend on a number ---

SAMPLED = Cascade(processor=Processor(1.0, guard=None))
DRIVEN = Scenario(initial=Initial(1e-4), u_max=200.0)
# A load that begins inside a sample (s), which a sensor with a low-pass divides there; an amplifier whose ramps, which
# depend on the gain c, end inside samples; a delay that is not a whole number of samples. The metrics are smooth over
# 0.4 % of each number.
LENGTHS = {
    "start": (1.13e-3, lambda x: (SAMPLED, dataclasses.replace(DRIVEN, q_z=Pulse(3.0, x, 1.0), sensor=LAG))),
    "ramp": (
        17.0,
        lambda x: (with_gains(SAMPLED, {"controller.position.c": x}), dataclasses.replace(DRIVEN, amplifier=SLEW)),
    ),
    "delay": (1.3, lambda x: (with_gains(BETWEEN, {"processor.delay": x}), DRIVEN)),
}
LAG, SLEW, BETWEEN = Sensor(bandwidth=2e3), Amplifier(slew=3e5), SAMPLED.on_processor(1.0, 2.0, between=True)


@pytest.mark.thorough
@pytest.mark.parametrize("name", LENGTHS)
def test_the_derivatives_of_integrals_contain_the_lengths_of_the_steps(name):
    x, world = LENGTHS[name]

    def integrals(x):
        cascade, scenario = world(x)
        fold = Metrics.of(5e-4, scenario)
        found = rollout(cascade.on_processor(), scenario, Clock(40, 1e-4, RK4(4)), fold=fold, record_every=0).metrics
        return jnp.stack([found[name] for name in ("settled_rms_u_V", "rms_u_V", "settled_rms_error_m")])

    h = 1e-3 * x
    low, high, lowest, highest = jax.jit(jax.vmap(integrals))(x + h * np.array([-1.0, 1.0, -2.0, 2.0]))
    differences = (8 * (high - low) - (highest - lowest)) / (12 * h)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(integrals))(x), differences, rtol=1e-5)
