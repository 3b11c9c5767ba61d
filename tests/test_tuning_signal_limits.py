"""Limits on the current of a coil and on motion at the speed of the rotor: their values, and in a search."""

import math
import tomllib

import numpy as np
import pytest
from profiles import thorough
from texts import SMALL_SEARCH, case_and_tune, problem_from

from ambjax import rollout
from ambjax.simulation.folds import Named
from tuning.judge.evaluate import judge
from tuning.problem.config import seeds
from tuning.problem.limits import measures
from tuning.problem.quantities import LimitContext
from tuning.rounds import rounds

# A rotor of 1.64 kg between coils with a bias of 1 A is moved by 0.1 mm. Then a load acts on it.
MOVED = """
disturbance.q_z = { kind = "step", amplitude = -20.0, start = 0.005 }
sensor = { std = 1e-7 }
actuator = { u_max = 48.0 }
initial = { z = 1e-4 }
clock = { duration = 0.02, sample_period = 5e-5 }
run = { settle = 0.001 }
plant = { kind = "two-coil", m = 1.64, k_z = 0, mu_0 = 1.2566e-6, n = 208, A = 2.68e-4, s_0 = 5e-4, i_0 = 1.0, R = 1.0 }
[controller]
position = { c = 2500.0, k = 9.0, p = 500.0 }
inversion = { gamma = 7e11, p = 1e-8 }
current = { k_i = 1100.0, p = 50.0 }
[processor]
"""
MOVED += SMALL_SEARCH
MOVED += """
gains = ["controller.position.c"]
bounds.controller.position.c = [100.0, 10000.0]
members = 4
validation = 8
held_out = 8
"""


# Unbalance at 300 Hz, far above the bandwidth: more damping means less motion and more current.
TURNING = """
rotor = { speed = 18000.0 }
disturbance.q_z = { kind = "unbalance", unbalance = 0.1 }
clock = { duration = 0.04, sample_period = 1e-4 }
run = { settle = 0.02 }
[controller]
position = { kind = "pid", k_p = 1e5, k_d = 800.0 }
inversion = { kind = "closed-form" }
current = { kind = "pi" }
[processor]
"""
TURNING += SMALL_SEARCH
TURNING += """
gains = ["controller.position.k_d"]
bounds.controller.position.k_d = [100.0, 1500.0]
members = 2
validation = 2
held_out = 2
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
    document = tomllib.loads(MOVED) | {"disturbance": {"q_z": {"kind": "constant", "value": load}}}
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


@pytest.mark.parametrize("name", ["z_1x_m", "i_1x_A", "sensitivity_1x"])
def test_a_limit_at_the_speed_needs_a_speed(name):
    limits = {"tune": {"limits": {name: 1.0}}}
    for rotor in ({}, {"rotor": {"speed": 0.0}}):
        with pytest.raises(ValueError, match=rf"^tune\.limits\.{name}: .*rotor\.speed"):
            case_and_tune(limits | rotor)
    case_and_tune(limits | {"rotor": {"speed": 6000.0}})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "names", "gain"), [(MOVED, ["rms_coil_A"], 2000.0), thorough(TURNING, ["i_1x_A", "z_1x_m"], 800.0)]
)
def test_the_derivatives_of_limited_values_agree_with_differences(case, names, gain):
    problem = problem_from(case, limits={"sensitivity": math.inf, "rms_u_V": math.inf} | dict.fromkeys(names, 1e3))
    members, x, step = problem.objective.members(1, 2), problem.objective.space.encode(np.array([gain])), 1e-5
    (_, slopes, _), *sides = (
        problem.engine.gradient((x + h)[None], members, problem.goal.weights) for h in (0.0, step, -step)
    )
    difference = (sides[0][0] - sides[1][0])[0, :, 1:] / (2 * step)
    assert difference.shape[-1] == len(names)
    assert np.all(difference != 0)
    np.testing.assert_allclose(slopes[0, :, 1:, 0], difference, rtol=1e-5)


@pytest.mark.parametrize(
    ("case", "name", "most", "excess", "cost"),
    [
        pytest.param(MOVED, "rms_coil_A", 1.66, 1.01, 1.1, marks=pytest.mark.slow),
        thorough(TURNING, "i_1x_A", 6e-5, 1.1, math.inf),
    ],
)
def test_a_search_keeps_a_current_within_its_limit(tmp_path, case, name, most, excess, cost):
    """The least error needs more current than the limit allows."""
    found = {}
    problem = problem_from(case, limits={"sensitivity": math.inf, "rms_u_V": math.inf, name: most, "margin": 0.005})
    for limited, one in ((True, problem), (False, problem.limited(()))):
        folder = tmp_path / str(limited)
        folder.mkdir()
        answer = rounds(one, one.tune.space.values(one.case.cascade), folder, {}, False)
        found[limited] = judge(one, answer.x, seeds(one.tune.budget)[2], one.tune.budget.held_out)
    (limit,) = problem.limits
    assert limit.reached(found[True]) <= most < excess * most < limit.reached(found[False])
    errors = {limited: columns["settled_rms_error_m"].mean() for limited, columns in found.items()}
    assert errors[False] < errors[True] < cost * errors[False]
