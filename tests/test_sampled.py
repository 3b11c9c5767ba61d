"""The loop on a processor against an independent simulator of it, which shares no code: the same world solved twice."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from sampled_oracle import World, simulate
from test_oracle import adaptive, current, pulse, sine, smc, smoothstep, twisting

import ambjax as amb
from ambjax.control.processor import Processor

KINDS = {
    "observer": {"direct": amb.observer.Direct, "complementary": amb.observer.Complementary},
    "position": {"sliding-mode": amb.position.SlidingMode, "super-twisting": amb.position.SuperTwisting},
    "inversion": {"adaptive": amb.inversion.Adaptive},
    "current": {"sliding-mode": amb.current.SlidingMode, "pi": amb.current.ProportionalIntegral},
}
SIGNALS = {"constant": amb.Constant, "sine": amb.Sine, "smoothstep": amb.SmoothStep, "pulse": amb.Pulse}
INF = math.inf


@dataclass(frozen=True)
class Case:
    name: str
    world: World
    samples: int = 2000
    std: tuple = (0.0, 0.0, 0.0)


def hard(c=200.0, k=25.0, gamma=2e6, k_i=2000.0):
    """Laws with the sign itself, with gains that hold the rotor at 10 kHz."""
    return {"position": smc(c, k, INF), "inversion": adaptive(gamma, INF), "current": current(k_i, INF)}


def soft(gamma=2e5):
    return {"inversion": adaptive(gamma)}


TRACKING = {"reference": sine(), "q_v": pulse(1.0, 0.1, 0.15)}
# Stepped explicitly, a sign turns over from sample to sample where its slope times the period is above 2: chaos, in
# which two programs part whatever they agree on. So these run fast, and are softer.
EXPLICIT = {
    "reference": sine(),
    "q_v": pulse(1.0, 0.02, 0.04),
    "inversion": adaptive(7.5e4, 2.0),
    "discretisation": "explicit",
    "period": 1e-5,
}
NOISE = (1e-6, 1e-4, 1e-4)
SLOW = ("complementary", {"l": 5.0})
PI = ("pi", {"k_p": 3e5, "k_int": 1e8, "k_aw": 200.0})
WRONG = {"m": 0.65, "R": 45.0, "n": 1400.0}
CASES = [
    Case("repaired, delay 1", World(**TRACKING)),
    Case("repaired, not predicted", World(**TRACKING, predict=False)),
    Case("repaired, no delay", World(**TRACKING, delay=0.0)),
    Case("half a sample", World(**TRACKING, delay=0.5, **soft())),
    Case("one and a half", World(**TRACKING, delay=1.5, **soft())),
    Case("two samples", World(**TRACKING, delay=2.0, **soft())),
    Case("explicit", World(**EXPLICIT), 6000),
    Case("explicit, half a sample", World(**EXPLICIT, delay=0.5), 6000),
    Case("explicit, one and a half, not predicted", World(**EXPLICIT, delay=1.5, predict=False), 6000),
    Case("explicit, noise, 100 V", World(**EXPLICIT, u_max=100.0), 6000, std=NOISE),
    Case("the sign itself", World(**TRACKING, **hard())),
    Case("the sign itself, one and a half", World(**TRACKING, delay=1.5, **hard())),
    Case("the sign itself, 20 kHz, 0.3 samples", World(**TRACKING, delay=0.3, period=5e-5, **hard()), 4000),
    Case("the sign itself, noise", World(**TRACKING, u_max=2e3, **hard(k_i=500.0)), std=NOISE),
    Case("wrong model", World(**TRACKING, model=WRONG, **soft())),
    Case("supply of 70 V", World(**TRACKING, u_max=70.0, **soft())),
    Case("observer under noise", World(**TRACKING, observer=SLOW, u_max=200.0, **soft()), std=(3e-6, 0.0, 1e-4)),
    Case("current pulse, off centre", World(q_i=pulse(1.0, 0.05, 0.1), initial=(2e-5, 0.0, 0.0), **soft())),
    Case("PI", World(current=PI, u_max=300.0, reference=smoothstep(1e-3, 0.02, 0.1), **soft())),
    Case("super-twisting, the sign itself", World(**TRACKING, position=twisting(k_1=10.0, p=INF), **soft())),
    Case("super-twisting, explicit", World(**EXPLICIT, position=twisting()), 6000),
]


def record_of(kinds, given, *more):
    kind, numbers = given
    return kinds[kind](*more, **numbers)


def loop_of(world, samples, std):
    """The same world in the package's words."""
    laws = {stage: record_of(kinds, getattr(world, stage)) for stage, kinds in KINDS.items()}
    plant, model = amb.Plant(**world.plant), amb.Plant(**(world.plant | world.model))
    processor = Processor(world.delay, world.discretisation == "implicit", world.predict)
    signals = {name: record_of(SIGNALS, getattr(world, name)) for name in ("reference", "q_z", "q_v", "q_i")}
    scenario = amb.Scenario(
        plant=plant,
        initial=amb.Initial(*world.initial),
        sensor=amb.Sensor(*std) if any(std) else None,
        u_max=world.u_max,
        seed=5,
        **signals,
    )
    return amb.Cascade(**laws, model=model, processor=processor), scenario, amb.Clock(samples, world.period)


def noise_of(scenario, samples):
    if scenario.sensor is None:
        return None
    words = scenario.words()
    return np.array([scenario.sensor.noise(words, n) for n in range(samples)], float)


# The plant's integration is what differs: DOP853 at 1e-12 against the package's RK4.
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_against_the_independent_simulator(case):
    cascade, scenario, clock = loop_of(case.world, case.samples, case.std)
    rows = amb.rollout(cascade, scenario, clock).trajectory.rows
    run = simulate(case.world, case.samples, noise_of(scenario, case.samples))
    assert np.isinf(run.lost_at), run.lost_at
    assert np.asarray(rows.alive).all()
    np.testing.assert_allclose(rows.z, run.z, rtol=0, atol=1e-10)
    np.testing.assert_allclose(rows.i_ref, run.i_ref, rtol=0, atol=1e-9)
    largest = np.abs(run.u).max()
    np.testing.assert_allclose(rows.u, run.u, rtol=0, atol=1e-6 * largest)
