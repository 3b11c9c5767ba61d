"""The limit on the rms current of a coil: against recorded currents, and in a search."""

import math
import tomllib

import numpy as np
import pytest
from texts import SMALL_SEARCH, case_and_tune, problem_from

from ambjax import rollout
from ambjax.simulation.folds import Named
from tuning.judge.evaluate import judge
from tuning.problem.config import seeds
from tuning.problem.limits import measures
from tuning.problem.quantities import LimitContext
from tuning.rounds import rounds

# A rotor of 1.64 kg between coils with a bias of 1 A is moved by 0.1 mm. Then a load acts on it.
CASE = """
[plant]
kind = "two-coil"
m = 1.64
k_z = 0.0
mu_0 = 1.2566e-6
n = 208.0
A = 2.68e-4
s_0 = 5e-4
i_0 = 1.0
R = 1.0
[controller]
position = { c = 2500.0, k = 9.0, p = 500.0 }
inversion = { gamma = 7e11, p = 1e-8 }
current = { k_i = 1100.0, p = 50.0 }
[disturbance.q_z]
kind = "step"
amplitude = -20.0
start = 0.005
[processor]
[sensor]
std = 1e-7
[actuator]
u_max = 48.0
[initial]
z = 1e-4
[clock]
duration = 0.02
sample_period = 5e-5
[run]
settle = 0.001
"""
CASE += SMALL_SEARCH
CASE += """
gains = ["controller.position.c"]
bounds.controller.position.c = [100.0, 10000.0]
members = 4
validation = 8
held_out = 8
"""


def measured(case):
    """Return the rms current of a coil as the search computes it, and the recorded signals."""
    context = LimitContext(case.settle, float(case.clock.duration), float(case.scenario.touchdown), 45e-6)
    outcome = rollout(case.cascade, case.scenario, case.clock, fold=Named(measures(["rms_coil_A"], (), context)))
    return outcome.metrics["rms_coil_A"], outcome.trajectory.rows


@pytest.mark.parametrize("kind", ["lumped", "two-coil"])
@pytest.mark.parametrize(("load", "k", "lost"), [(0.0, 60.0, False), (30.0, 60.0, False), (40.0, 9.0, True)])
def test_the_rms_current_is_that_of_the_coil_that_carries_more(kind, load, k, lost):
    """The currents count until the rotor is lost."""
    document = tomllib.loads(CASE) | {"disturbance": {"q_z": {"kind": "constant", "value": load}}}
    document["plant"]["kind"] = kind
    document["controller"]["position"]["k"] = k
    found, rows = measured(case_and_tune(document)[0])
    alive, i = np.asarray(rows.alive), np.asarray(rows.i)
    late = alive & (np.asarray(rows.t) >= 0.001)
    assert lost != alive.all()
    coils = (1.0 + i, 1.0 - i) if kind == "lumped" else (np.asarray(rows.i_1), np.asarray(rows.i_2))
    upper, lower = (math.sqrt(np.mean(one[late] ** 2)) for one in coils)
    assert (upper > 1.1 * lower) == (load == 0.0)
    assert (lower > 1.1 * upper) == (load != 0.0)
    assert float(found) == pytest.approx(max(upper, lower), rel=1e-12)


@pytest.mark.slow
def test_a_search_keeps_the_rms_current_of_a_coil_within_its_limit(tmp_path):
    problem = problem_from(
        CASE, limits={"sensitivity": math.inf, "rms_u_V": math.inf, "rms_coil_A": 1.66, "margin": 0.005}
    )
    members, found = problem.objective.members(1, 2), {}
    # the derivative of the search, by central differences
    x, step = problem.objective.space.encode(np.array([2000.0])), 1e-5
    (_, slopes, _), *sides = (
        problem.engine.gradient((x + h)[None], members, problem.goal.weights) for h in (0.0, step, -step)
    )
    np.testing.assert_allclose(slopes[0, :, 1, 0], (sides[0][0] - sides[1][0])[0, :, 1] / (2 * step), rtol=1e-5)
    # the optimum without the limit exceeds it
    for name, one in (("with", problem), ("without", problem.limited(()))):
        folder = tmp_path / name
        folder.mkdir()
        answer = rounds(one, one.tune.space.values(one.case.cascade), folder, {}, False)
        found[name] = judge(one, answer.x, seeds(one.tune.budget)[2], 8)
    (limit,) = problem.limits
    assert limit.reached(found["with"]) <= 1.66 < 1.01 * 1.66 < limit.reached(found["without"])
    errors = {name: columns["settled_rms_error_m"].mean() for name, columns in found.items()}
    assert errors["without"] < errors["with"] < 1.1 * errors["without"]
