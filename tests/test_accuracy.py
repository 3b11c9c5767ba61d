"""The accuracy that the README promises for continuous time: 1e-8 m, for every structure, sensor and limit."""

import tomllib

import numpy as np
import pytest
from structures import drawn, solution

import ambjax as amb
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.simulation.method import EXPLICIT, slopes


def error_of(case):
    """Largest distance of z from SciPy's solution, m, and largest |u| at a sample, V; None if the rotor is lost."""
    trajectory = amb.rollout(case.cascade, case.scenario, case.clock).trajectory
    if trajectory.lost_why:
        return None, None
    stiff = max(slopes(case.cascade, case.scenario).values()) * float(case.clock.sample_period) > 2 * EXPLICIT
    z = solution(case, *(("Radau", 1e-9) if stiff else ()))
    return np.abs(trajectory.rows.z - z).max(), np.abs(trajectory.rows.u).max()


def rig(sensor, u_max):
    raw = tomllib.loads(template("rig"))
    raw = {key: raw[key] for key in ("plant", "clock", "run")}
    notched = {"kind": "chain", "w_1": 5650.0, "width_1": 0.3, "depth_1": 0.1, "w_z": 3000.0, "w_p": 9000.0}
    inner = {"inversion": {"kind": "linearised"}, "current": {"kind": "dead-beat", "w": 8000.0}}
    raw["controller"] = {"observer": {"kind": "direct"}, "position": notched, **inner}
    raw |= {"initial": {"z": 3e-5}, "actuator": {"u_max": u_max}}
    raw |= {} if sensor is None else {"sensor": sensor}
    raw["clock"]["duration"], raw["run"]["settle"] = 5e-3, 2e-3
    return case_from(raw)


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [{"std": 5e-7}, None], ids=["noise", "no sensor"])
def test_the_limit_of_the_supply_and_a_table_of_the_sensor_do_not_cost_accuracy(sensor):
    """With one RK4 step per sample, the kinks at the limit cost 2.2e-6 m here, and the filters 8.7e-8 m."""
    case = rig(sensor, 24.0)
    error, u = error_of(case)
    assert u == 24.0  # the voltage reaches its limit, and leaves it
    assert error <= 1e-8
    free = rig(sensor, 1e4)
    error, u = error_of(free)
    assert u < 1e4
    assert error <= 1e-8
    assert (case.clock.method == rig({}, 24.0).clock.method) == (sensor is None)


# Each of these draws is held; together they contain a limit that is reached with and without noise, a jump inside a
# sample, iron, two coils, a stiff loop and a loop of one DOP853 step.
@pytest.mark.slow
@pytest.mark.parametrize("seed", [102, 105, 107])
def test_a_random_structure_is_accurate(seed):
    error, _ = error_of(case_from(drawn(seed, 60)))
    assert error <= 1e-8


@pytest.mark.slow
def test_fixed_steps_under_noise_are_accurate_for_analytic_laws_and_only_chosen_for_them():
    """One step of DOP853 per sample; the roots of a differentiator, by contrast, cost 1e-7 m with such steps."""
    raw = drawn(102, 60) | {"sensor": {"std": 5e-7}, "initial": {"z": 1e-5}}
    raw = {key: value for key, value in raw.items() if key not in ("actuator", "disturbance", "reference")}
    raw["controller"] |= {"position": {"kind": "pid"}, "inversion": {"kind": "closed-form"}}
    case = case_from(raw)
    assert case.clock.method == amb.solvers.DOP853(1)
    assert error_of(case)[0] <= 1e-10
    raw["controller"]["observer"] = {"kind": "ired-2"}
    assert not isinstance(case_from(raw).clock.method, amb.solvers.DOP853)
