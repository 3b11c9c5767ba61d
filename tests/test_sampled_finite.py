"""On a processor values and derivatives are numbers whatever the gains: every law, by smoothed signs and by signs."""

import dataclasses
import math

import jax
import numpy as np
import pytest

import ambjax as amb
from ambjax.cases.reader import KINDS
from ambjax.control.base import default_law
from ambjax.control.processor import Processor
from ambjax.simulation.folds import Rms
from tuning.space import Gain, Space, tunable

# Three decades up and down of the law's own gains.
DECADES, POINTS = 3 * math.log(10), 1000
WORLD = amb.Scenario(reference=amb.Sine(2.5e-3, 2.0), sensor=amb.Sensor(1e-6, 1e-4, 1e-4), u_max=200.0, seed=3)
CLOCK = amb.Clock(40, 1e-4, amb.RK4(1))
USUAL = {"observer": "direct", "position": "sliding-mode", "inversion": "adaptive", "current": "sliding-mode"}
LAWS = [USUAL, *(USUAL | {stage: kind} for stage, kinds in KINDS.items() for kind in kinds if USUAL[stage] != kind)]


def cascade_of(laws, smooth):
    """With one sample of delay, predicted; its signs smoothed, or not."""
    made = {stage: default_law(KINDS[stage][kind], amb.Plant()) for stage, kind in laws.items()}
    if not smooth:
        for stage, law in made.items():
            steep = [field.name for field in dataclasses.fields(law) if field.metadata.get("steepness")]
            made[stage] = dataclasses.replace(law, **dict.fromkeys(steep, math.inf))
    return amb.Cascade(**made, processor=Processor()).on_processor()


@pytest.mark.slow
@pytest.mark.parametrize("smooth", [True, False], ids=["smoothed", "signs"])
@pytest.mark.parametrize("laws", LAWS, ids=lambda laws: "-".join(laws.values()))
def test_values_and_derivatives_are_finite_over_six_decades_of_every_gain(laws, smooth):
    cascade = cascade_of(laws, smooth)
    space = Space(tuple(Gain(path) for path in tunable(cascade)))
    assert any(gain.name == "p" for gain in space.gains) == smooth
    start = space.encode(space.values(cascade))

    def loss(x):
        value = amb.rollout(space.decode(x, cascade), WORLD, CLOCK, fold=Rms("e_z"), every=0).measured
        return value, value

    points = start + np.random.default_rng(4).uniform(-DECADES, DECADES, (POINTS, len(space)))
    for mode in (jax.jacfwd, jax.jacrev) if laws is USUAL else (jax.jacfwd,):  # the tuner's, and the other
        slopes, values = jax.jit(jax.vmap(mode(loss, has_aux=True)))(points)
        assert np.isfinite(values).all()
        assert np.isfinite(slopes).all()
        # every gain matters somewhere, but the rate of the dead-beat law, which only its form in continuous time has
        unused = [laws["current"] == "dead-beat" and gain.name == "w" for gain in space.gains]
        np.testing.assert_array_equal(np.abs(slopes).sum(axis=0) == 0, unused)
