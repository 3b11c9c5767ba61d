"""Limits that cannot be broken: which they are, that no run exceeds their bounds, and that the user is told."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from bowl import World, study
from texts import case_and_tune

from ambjax import rollout
from ambjax.extend import canonical
from ambjax.simulation.folds import Named
from ambjax.simulation.metrics import Metrics
from ambjax.world.amplifier import difference
from ambjax.world.plant import Currents
from tuning.problem.limits import bounds_of, measures
from tuning.problem.quantities import KINDS, LimitContext
from tuning.report import limit_table

TWO_COIL = {"plant": {"kind": "two-coil"}, "processor": {"delay": 1.0}}
BASE = {"sensor": {"std": 1e-6}, "clock": {"duration": 0.02, "sample_period": 1e-4}}
SUPPLY = {"actuator": {"u_max": 148.9}}


def left_out(limits, **tables):
    """Return the names of the limits that are left out, and of those that are kept."""
    settings = case_and_tune(BASE | tables | {"tune": {"limits": {"sensitivity": math.inf} | limits}})[1].limits
    return [limit.name for limit, _ in settings.unbreakable], [limit.name for limit in settings.each]


@pytest.mark.parametrize(
    ("name", "most", "tables"),
    [
        ("max_u_V", 148.9, SUPPLY),
        ("rms_u_V", 148.9, SUPPLY),
        ("chatter_V_per_s", 2 * 148.9 / 1e-4, SUPPLY),
        # the largest voltage of all members
        ("max_u_V", 160.0, SUPPLY | {"spread": {"actuator": {"u_max": {"uniform": [120.0, 160.0]}}}}),
        # of each coil, where the supply is stronger
        ("max_u_V", 100.0, TWO_COIL | {"actuator": {"u_max": 148.9, "coil": {"u_max": 100.0}}}),
        # a coil's amplifier that holds the current applies more than the supply gives to the command
        ("max_u_V", 200.0, TWO_COIL | {"actuator": {"u_max": 148.9, "coil": {"u_max": 200.0, "i_max": 5.0}}}),
        # clearance of 4.5 mm, and r within 1 mm
        ("largest_error_m", 5.5e-3, {"reference": {"kind": "sine", "amplitude": 1e-3, "frequency": 100.0}}),
        ("overshoot_m", 4.5e-3, {}),
        # with a stop, the rotor is lost at 0.99 s_0
        ("rms_error_m", 4.95e-3, {"run": {"stop_stiffness": 1e6}}),
    ],
)
def test_a_limit_above_the_largest_possible_value_is_left_out(name, most, tables):
    above, below = (left_out({name: factor * most}, **tables) for factor in (1 + 1e-6, 1 - 1e-6))
    assert above[0] == [name]
    assert name not in above[1]
    assert below[0] == []
    assert name in below[1]


def test_other_limits_are_kept():
    assert left_out({"max_u_V": 148.9}, **SUPPLY)[0] == ["max_u_V"]  # exactly at the supply
    assert left_out({"max_u_V": 1e12})[0] == []  # no supply
    # the supply can be too weak to hold the current at actuator.i_max
    limited = {"actuator": {"u_max": 148.9, "i_max": 1.0}, "processor": {"delay": 1.0}}
    assert left_out({"max_abs_i_A": 1e6, "rms_coil_A": 1e6}, **limited)[0] == []
    assert left_out({"settling_s": 1.0, "complementary": 1e12, "delay_margin_s": 1e-12}, **BASE)[0] == []


@pytest.mark.parametrize(
    ("tables", "names"),
    [
        ({}, ["clearance_used"]),
        ({"run": {"clearance": 4e-3}}, ["clearance_used"]),
        ({"run": {"stop_stiffness": 1e6}}, []),  # the rotor may enter the stop
        # the share is relative to the clearance of the case
        ({"spread": {"plant": {"s_0": {"percent": 10}}}}, []),
    ],
)
def test_a_rotor_uses_more_than_its_clearance_only_with_a_stop_or_a_spread(tables, names):
    assert left_out({"clearance_used": 1.0}, **tables)[0] == names
    assert left_out({"clearance_used": 0.999}, **tables)[0] == []


def test_holding_the_current_of_a_coil_takes_more_than_the_supply():
    """The gap of a coil at its limit opens so fast that the voltage of the motion exceeds that of the supply."""
    actuator = {"u_max": 10.0, "coil": {"u_max": 200.0, "i_max": 2.0}}
    scenario = case_and_tune(BASE | TWO_COIL | {"actuator": actuator})[0].scenario
    applied = scenario.applied(jnp.asarray(10.0), Currents(*map(jnp.asarray, (0.0, -20.0, 2.0, 0.3))))
    assert float(difference(applied)) < -10.0


@pytest.mark.slow
@pytest.mark.parametrize("processor", [{}, {"processor": {"delay": 0.5}}])
def test_no_run_exceeds_the_bounds(processor):
    """Noise and large gains cause a voltage that jumps between its limits."""
    law = {"position": {"c": 1300.0, "k": 11.0}, "inversion": {"gamma": 6e6}, "current": {"k_i": 900.0}}
    shape = {"reference": {"kind": "sine", "amplitude": 1e-3, "frequency": 5.0}, "actuator": {"u_max": 150.0}}
    case = case_and_tune(BASE | shape | processor | {"controller": law})[0]
    bounds = bounds_of(case)
    context = LimitContext(case.settle / 2, float(case.clock.duration), float(case.scenario.touchdown), 45e-6)
    names = [name for name in bounds if KINDS[name].fold is not None]
    fold = Named({"ours": Named(measures(names, (), context)), "theirs": Metrics.of(0.0, case.scenario)})
    found = rollout(case.cascade, case.scenario, case.clock, fold=canonical(fold), record_every=0).metrics
    for name in names:
        exact = KINDS[name].exact
        value = float(found["theirs"][exact] if exact else found["ours"][name])
        assert 0 < value <= bounds[name].most, name
    assert np.isinf(found["theirs"]["lost_at_s"])
    assert float(found["theirs"]["max_abs_u_V"]) == 150.0


def test_the_report_lists_a_limit_that_cannot_be_broken(monkeypatch):
    problem = study(monkeypatch, World(), limits={"max_u_V": 250.0, "rms_u_V": 150.0})
    assert [limit.name for limit in problem.limits] == ["rms_u_V"]
    rows = limit_table.facts(problem, {}, {"members": 0, "held": 0})
    verdicts = [("rms_u_V", "not judged"), ("max_u_V", "cannot be broken"), ("survival", "not judged")]
    assert [(row["name"], row["verdict"]) for row in rows] == verdicts
    text = "\n".join(limit_table.section(rows))
    assert "| `max_u_V` | at most 250 V | - | - | cannot be broken |" in text
    assert "cannot be broken: |u| is at most 200 V (actuator.u_max)" in text
