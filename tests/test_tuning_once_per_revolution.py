"""Limits at the speed of the rotor: their derivatives, in a search, and without a speed."""

import math

import numpy as np
import pytest
from texts import SMALL_SEARCH, case_and_tune, problem_from

from tuning.judge.evaluate import judge
from tuning.problem.config import seeds
from tuning.rounds import rounds

# Unbalance at 300 Hz, far above the bandwidth: more damping means less motion and more current.
CASE = """
[rotor]
speed = 18000.0
[controller]
position = { kind = "pid", k_p = 1e5, k_d = 800.0 }
inversion = { kind = "closed-form" }
current = { kind = "pi" }
[disturbance.q_z]
kind = "unbalance"
unbalance = 0.1
[processor]
[clock]
duration = 0.04
sample_period = 1e-4
[run]
settle = 0.02
"""
CASE += SMALL_SEARCH
CASE += """
gains = ["controller.position.k_d"]
bounds.controller.position.k_d = [100.0, 1500.0]
members = 2
validation = 2
held_out = 2
"""


@pytest.mark.parametrize("name", ["z_1x_m", "i_1x_A", "sensitivity_1x"])
def test_a_limit_at_the_speed_needs_a_speed(name):
    limits = {"tune": {"limits": {name: 1.0}}}
    for rotor in ({}, {"rotor": {"speed": 0.0}}):
        with pytest.raises(ValueError, match=rf"^tune\.limits\.{name}: .*rotor\.speed"):
            case_and_tune(limits | rotor)
    case_and_tune(limits | {"rotor": {"speed": 6000.0}})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["i_1x_A", "z_1x_m"])
def test_the_derivative_of_an_amplitude_agrees_with_differences(name):
    problem = problem_from(CASE, limits={"sensitivity": math.inf, name: 1e3})
    members, x, step = problem.objective.members(1, 2), problem.objective.space.encode(np.array([800.0])), 1e-5
    (_, slopes, _), *sides = (
        problem.engine.gradient((x + h)[None], members, problem.goal.weights) for h in (0.0, step, -step)
    )
    difference = (sides[0][0] - sides[1][0])[0, :, 1] / (2 * step)
    assert np.all(difference != 0)
    np.testing.assert_allclose(slopes[0, :, 1, 0], difference, rtol=1e-5)


@pytest.mark.slow
def test_a_search_keeps_the_current_at_the_speed_within_its_limit(tmp_path):
    """The least error needs more current at the speed than the limit allows."""
    most, found = 6e-5, {}
    problem = problem_from(CASE, limits={"sensitivity": math.inf, "i_1x_A": most})
    for name, one in (("with", problem), ("without", problem.limited(()))):
        folder = tmp_path / name
        folder.mkdir()
        answer = rounds(one, one.tune.space.values(one.case.cascade), folder, {}, False)
        found[name] = judge(one, answer.x, seeds(one.tune.budget)[2], 2)
    (limit,) = problem.limits
    assert limit.reached(found["with"]) <= most < 1.1 * most < limit.reached(found["without"])
    errors = {name: columns["settled_rms_error_m"].mean() for name, columns in found.items()}
    assert errors["without"] < errors["with"]
