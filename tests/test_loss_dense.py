"""The tuner's loss and limits against those of an independent, densely integrated solution (tests/dense.py)."""

import dataclasses
import functools

import pytest
from dense import costs, metrics
from oracle import World
from test_oracle import Case, adaptive, current, in_ambjax, noise_of, pulse, sine, smc

from ambjax import Clock, rollout
from ambjax.sensors import Sensor
from ambjax.simulation.folds import Named
from ambjax.solvers import AdaptiveRodas3
from tuning.problem.limits import measures
from tuning.problem.loss import Loss
from tuning.problem.quantities import LimitContext

PERIOD, S_0, U = 1e-4, 5e-3, 200.0
LOOPS = {
    "noisy": (  # at the limit of the supply
        World(position=smc(140.5, 1158.0), inversion=adaptive(1.869e7), current=current(92.3), u_max=U,
              reference=sine(5e-4), initial=(1e-4, 5e-3, 0.0), q_v=pulse(1.0, 0.002, 0.003)),
        (1e-6, 1e-4, 1e-4), 60, 1.8e-4, 8e-5,
    ),
    "smooth": (World(position=smc(300.0, 25.0), inversion=adaptive(1e9, 25e-6), initial=(2e-4, 0.02, 0.0)),
               (0.0, 0.0, 0.0), 200, 3e-4, 5e-5),
}  # fmt: skip

# Motions bend by less than 30 m/s^2 (22 at most are seen): an extreme between two samples is missed by no more
# than BEND, a crossing of the band, at more than 0.01 m/s, by BEND over that.
BEND = 30 * PERIOD**2 / 8
# Relative, else: u's integrals by the trapezoidal rule over adaptive steps miss 5e-4 of rms u; of chatter, a difference
# of neighbours, 2.4e-3 of the squares was seen. What is of z is as good as z, to the 16th power.
TOLERANCES = {"effort": 2e-3, "chatter": 0.01, "chatter_V_per_s": 0.01, "peak": 1e-4, "clearance": 1e-3}


def both(name):
    """Return the quantities from the folds and from the dense solution.

    The stop is so near that the clearance term is not 0.
    """
    world, std, samples, near, band = LOOPS[name]
    case, settle = Case("", world, samples=samples), samples // 3 * PERIOD
    cascade, scenario, _ = in_ambjax(case)
    if any(std):
        scenario = dataclasses.replace(scenario, sensor=Sensor(*std))
    clock = Clock(samples, PERIOD, AdaptiveRodas3())
    context = LimitContext(settle, float(clock.duration), float(scenario.touchdown), band)
    folds = measures(("chatter_V_per_s", "settling_s", "overshoot_m"), (), context)
    fold = Named({"loss": Loss(settle, 0.0, S_0, U, near), "limits": Named(folds)})
    found = rollout(cascade, scenario, clock, fold=fold, record_every=0).metrics
    ours = {key: float(value) for part in found.values() for key, value in part.items()}
    numbers = functools.partial(costs, s_0=S_0, u_scale=U, near=near, band=band)
    return ours, metrics(world, samples, PERIOD, settle, noise_of(case, scenario), numbers=numbers)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_costs_and_limits_agree_with_a_dense_solution(name):
    ours, theirs = both(name)
    assert min(theirs.values()) > 0  # or nothing was compared
    for key, value in theirs.items():
        print(f"{key}: {ours[key]:.8g} {value:.8g}")
        most = {"settling_s": BEND / 0.01, "overshoot_m": BEND}.get(key) or TOLERANCES[key] * value
        assert ours[key] == pytest.approx(value, rel=0, abs=most), key
