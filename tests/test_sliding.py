"""The sliding step: comparison with accurate references, its order, and its derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough

from ambjax import Cascade, Clock, Initial, Scenario, rollout
from ambjax.ensemble import run_ensemble
from ambjax.laws import current, inversion, observer, position
from ambjax.sensors import Sensor
from ambjax.signals import Pulse, Sine
from ambjax.simulation.folds import Rms
from ambjax.solvers import AdaptiveRodas3, Rodas3, Slide

TRACKING = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.01, 0.02), u_max=200.0)


def cascade(c, k, gamma, k_i, p=25.0, **more):
    return Cascade(
        position=position.SlidingMode(c, k, 25.0),
        inversion=inversion.Adaptive(gamma, p),
        current=current.SlidingMode(k_i, 25.0),
        **more,
    )


OBSERVED = cascade(551.0, 108.0, 2.9e5, 367.0, observer=observer.Complementary(1.0, 0.0))
NOISY = {
    "direct": (cascade(2190.0, 37.0, 1.66e6, 238.0), Sensor(1e-6, 1e-4, 1e-4), 200.0),
    "behind an observer": (OBSERVED, Sensor(3.1623e-4), 200.0),
    "fast current loop": (cascade(181.0, 202.0, 1.3e6, 3800.0), Sensor(1e-5, 1e-4, 1e-4), 500.0),
}


@pytest.mark.parametrize(
    "case", [pytest.param(x, marks=pytest.mark.slow if x == "direct" else pytest.mark.thorough) for x in NOISY]
)
def test_stiff_gains_under_held_noise_agree_with_error_control(case):
    gains, sensor, u_max = NOISY[case]
    scenario = dataclasses.replace(TRACKING, sensor=sensor, u_max=u_max, member=np.arange(32))
    fold = Rms("e_z", 0.01)
    found = [
        np.sqrt(np.mean(run_ensemble(gains, scenario, Clock(400, 1e-4, method), fold=fold).metrics ** 2))
        for method in (AdaptiveRodas3(1e-6), Slide(4))
    ]
    # measured 1 % and less, and a third of that over four times the horizon
    assert found[1] == pytest.approx(found[0], rel=0.03)


@pytest.mark.slow
def test_the_slow_motion_is_of_second_order():
    gains = cascade(60.0, 1.0, 1e8, 20.0, p=1.0)
    scenario = Scenario(reference=Sine(1e-3, 10.0), initial=Initial(1e-4), u_max=1e9)
    motions = [
        rollout(gains, scenario, Clock(100, 1e-3, method), record_every=1).trajectory.rows.z
        for method in (AdaptiveRodas3(1e-9), Slide(2), Slide(4), Slide(8))
    ]
    errors = [float(np.abs(z - motions[0]).max()) for z in motions[1:]]
    order = np.polyfit(np.log([2, 4, 8]), -np.log(errors), 1)[0]
    assert order > 1.6, (order, errors)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "mode"), [(Slide(2), jax.jacfwd), *(thorough(Rodas3(12), f) for f in (jax.jacfwd, jax.grad))]
)
def test_values_and_derivatives_are_finite_over_six_decades_of_gains(method, mode):
    """From 1 mm off the origin, most of these gains lose the rotor.

    The steps of `Rodas3` are coarse for the stiffest: the derivative of the computed map grows to 1e149, and is finite.
    """
    gains = np.array([17.0, 25.0, 7.5e4, 152.0]) * 10 ** np.random.default_rng(0).uniform(-3, 3, (200, 4))
    scenario = dataclasses.replace(TRACKING, initial=Initial(1e-3))

    def loss(gains):
        out = rollout(cascade(*gains), scenario, Clock(100, 1e-4, method), fold=Rms("e_z"), record_every=0)
        return out.metrics, (out.metrics, out.trajectory.lost_at)

    slope, (value, lost_at) = jax.jit(jax.vmap(mode(loss, has_aux=True)))(jnp.asarray(gains))
    assert np.mean(np.isfinite(lost_at)) > 0.5
    assert np.all(np.isfinite(value))
    assert np.all(np.isfinite(slope))
