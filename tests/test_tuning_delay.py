"""The test of the limit on the delay margin: an additional delay in the simulation against the linear margin."""

import math

import numpy as np
import pytest
from texts import case_and_tune

from ambjax.linear import linearise, margins_of
from tuning.judge.evaluate import JudgedMembers
from tuning.judge.peaks import DELAY_MARGIN, DelayTest, delay_test, not_simulated
from tuning.problem.limits import PREFIX
from tuning.problem.tuning_problem import problem_of
from tuning.report import judging, limit_table

PERIOD = 6e-4
# a current amplifier on a slow processor: the linear delay margin is 0.68 of a sample
CASE = {
    "plant": {"m": 2.4, "k_z": 0.0, "mu_0": 1.2566e-6, "n": 300.0, "A": 2e-4, "s_0": 5e-4, "i_0": 2.0, "R": 1.0},
    "controller": {
        "observer": {"kind": "kalman", "w": 1700.0},
        "position": {"kind": "state-feedback"},
        "inversion": {"kind": "linearised"},
    },
    "processor": {"delay": 0.5},
    "actuator": {"mode": "current", "bandwidth": 1500.0},
    "sensor": {"std": 3e-7, "velocity": False},
    "initial": {"z": 2e-5},
    "clock": {"duration": 0.3, "sample_period": PERIOD},
}


def problem(limit, **more):
    return problem_of(*case_and_tune(CASE | more | {"tune": {"limits": {DELAY_MARGIN: limit}, "members": 4}}))


def test_laws_without_a_condition_of_theorem_1_have_no_table_of_conditions():
    made = problem(1e-4)
    assert judging._conditions(made, made.tune.space.encode(made.tune.space.values(made.case.cascade))) == {
        "conditions": [], "advice_on_conditions": [],
    }  # fmt: skip


@pytest.mark.thorough
def test_an_additional_delay_of_several_samples_is_simulated():
    """The margin at the command is 5 to 8 samples of this period."""
    period = 1e-4
    clock = {"duration": 0.3, "sample_period": period}
    case = problem(1e-4, clock=clock).case
    margin = margins_of(linearise(case.cascade, case.scenario, case.clock)).command.delay
    assert 5 * period < margin < 8 * period
    columns = {f"loss.{PREFIX}{DELAY_MARGIN}": np.ones(2), "lost_at_s": np.full(2, math.inf)}
    found = []
    for share in (0.9, 1.1):
        made = problem(share * margin, clock=clock)
        x = made.tune.space.encode(made.tune.space.values(case.cascade))
        found.append(delay_test(JudgedMembers(made, x, 1, columns)))
    assert found == [DelayTest(2, 0, 0), DelayTest(2, 0, 2)]


def test_a_lost_member_breaks_the_limit():
    row = {"name": DELAY_MARGIN, "what": "delay margin", "held": True, "verdict": limit_table.HELD}
    assert limit_table._tested(row, None, "") == row
    kept = limit_table._tested(row, DelayTest(16, 0, 0), "")
    assert kept["verdict"] == limit_table.HELD
    assert "0 of 16" in kept["what"]
    for test in (DelayTest(16, 1, 0), DelayTest(16, 0, 1)):
        broken = limit_table._tested(row, test, "")
        assert (broken["verdict"], broken["price"]) == (limit_table.BROKEN, None)
    # a delay that is not simulated: the report says why
    late = {share: problem(share * PERIOD) for share in (9.4, 9.6)}
    limits = {share: next(x for x in one.limits if x.name == DELAY_MARGIN) for share, one in late.items()}
    reason = not_simulated(late[9.6], limits[9.6])
    assert reason == "the total delay of 10.1 samples exceeds the 10 samples that can be simulated"
    assert not_simulated(late[9.4], limits[9.4]) == ""
    said = limit_table._tested(row, None, "", reason)
    assert said["held"]
    assert reason in said["what"]
    other = row | {"name": "sensitivity"}
    assert limit_table._tested(other, None, "", reason) == other
    assert limit_table._tested(other, DelayTest(16, 1, 0), "") == other
