"""On a processor, values and derivatives are finite for all gains: every law, with smoothed and set-valued signs."""

import dataclasses
import math

import jax
import numpy as np
import pytest

import ambjax as amb
from ambjax.cases.controller_tables import KINDS as EVERY
from ambjax.control.base import default_law
from ambjax.control.processor import Processor
from ambjax.simulation.folds import Rms
from ambjax.world.amplifier import CurrentAmplifier
from tuning.problem.space import Gain, Space, tunable

# Three decades up and down of the law's own gains.
DECADES, POINTS = 3 * math.log(10), 1000
WORLD = amb.Scenario(
    reference=amb.signals.Sine(2.5e-3, 2.0), sensor=amb.sensors.Sensor(1e-6, 1e-4, 1e-4), u_max=200.0, seed=3
)
CLOCK = amb.Clock(40, 1e-4, amb.solvers.RK4(1))
# Without a law that takes a voltage only: it stands with no other position law.
KINDS = {
    stage: {kind: law for kind, law in kinds.items() if "force" in getattr(law, "accepts", ("force",))}
    for stage, kinds in EVERY.items()
}
DEFAULT_LAWS = {"observer": "direct", "position": "sliding-mode", "inversion": "adaptive", "current": "sliding-mode"}
LAWS = [
    DEFAULT_LAWS,
    *(DEFAULT_LAWS | {stage: kind} for stage, kinds in KINDS.items() for kind in kinds if DEFAULT_LAWS[stage] != kind),
]
# Few loops with every law of every stage: the other laws of the stages, each stage's in turn, until all have been.
OTHERS = {stage: [kind for kind in kinds if kind != DEFAULT_LAWS[stage]] for stage, kinds in KINDS.items()}
MIXED = [{s: kinds[n % len(kinds)] for s, kinds in OTHERS.items()} for n in range(max(map(len, OTHERS.values())))]
CASES = [
    pytest.param(laws, smooth, id=f"{'-'.join(laws.values())}-{'smoothed' if smooth else 'signs'}", marks=marks)
    for marks, cases in (
        (pytest.mark.slow, [(DEFAULT_LAWS, True), *((laws, n % 2 == 1) for n, laws in enumerate(MIXED))]),
        (pytest.mark.thorough, [(laws, smooth) for laws in LAWS for smooth in (True, False)][1:]),
    )
    for laws, smooth in cases
]


def cascade_of(laws, smooth):
    """Return the cascade with one sample of delay and prediction, with smoothed or set-valued signs."""
    made = {stage: default_law(KINDS[stage][kind], amb.plants.Plant()) for stage, kind in laws.items()}
    if not smooth:
        for stage, law in made.items():
            steep = [field.name for field in dataclasses.fields(law) if field.metadata.get("steepness")]
            made[stage] = dataclasses.replace(law, **dict.fromkeys(steep, math.inf))
    return amb.Cascade(**made, processor=Processor()).on_processor()


@pytest.mark.parametrize(("laws", "smooth"), CASES)
def test_values_and_derivatives_are_finite_over_six_decades_of_every_gain(laws, smooth):
    cascade = cascade_of(laws, smooth)
    space = Space(tuple(Gain(path) for path in tunable(cascade)))
    steep = any(gain.name == "p" for gain in space.gains)
    assert steep == smooth or (laws in MIXED and not steep)  # some of these have no sign
    start = space.encode(space.values(cascade))
    amplifier = CurrentAmplifier(1e3) if cascade.current.commands == "current" else None
    world = dataclasses.replace(WORLD, amplifier=amplifier)

    def loss(x):
        value = amb.rollout(space.decode(x, cascade), world, CLOCK, fold=Rms("e_z"), record_every=0).metrics
        return value, value

    points = start + np.random.default_rng(4).uniform(-DECADES, DECADES, (POINTS, len(space)))
    if laws in MIXED:  # along one direction, in which derivatives that are no numbers do not cancel: a short trace
        along = np.random.default_rng(5).normal(size=points.shape)
        both = jax.vmap(lambda x, direction: jax.jvp(loss, (x,), (direction,), has_aux=True)[1:])
        slopes, values = jax.jit(both)(points, along)
        assert np.isfinite(values).all()
        assert np.isfinite(slopes).all()
        return
    mode = jax.jacrev if laws is DEFAULT_LAWS and smooth else jax.jacfwd  # the other, and the tuner's
    slopes, values = jax.jit(jax.vmap(mode(loss, has_aux=True)))(points)
    assert np.isfinite(values).all()
    assert np.isfinite(slopes).all()
    assert np.all(np.abs(slopes).sum(axis=0) > 0)  # every gain matters somewhere
