"""A table of speeds over time, of one axis and of a machine."""

import numpy as np
import pytest
import scipy.integrate
from machine_cases import MACHINES

from ambjax.cases.machine_case import machine_from
from ambjax.cases.reader import case_from

TIMES, RPM = [0.01, 0.5, 1.5], [600.0, 6000.0, -3000.0]
UNBALANCE = [{"at": 0.05, "amount": 50.0, "phase": 20.0}]


def machine(**rotor):
    raw = MACHINES["rigid"]
    return machine_from(raw | {"rotor": raw["rotor"] | rotor, "unbalance": UNBALANCE}, "machine")


def test_the_angle_is_the_integral_of_the_speed():
    rotor = case_from({"rotor": {"speed": {"times": TIMES, "rpm": RPM}}}, "case").scenario.rotor
    for t in (0.005, 0.3, 1.0, 2.5):
        corners = [x for x in TIMES if x < t]
        turns = scipy.integrate.quad(lambda x: np.interp(x, TIMES, RPM) / 60, 0.0, t, points=corners or None)[0]
        np.testing.assert_allclose(rotor.turns(t), turns, rtol=1e-9)
        np.testing.assert_allclose(rotor.rpm(t), np.interp(t, TIMES, RPM), rtol=1e-9)
    assert sorted(map(float, rotor.edges())) == TIMES
    assert rotor.fastest(2.5) == pytest.approx(2 * np.pi * 100)


def test_the_unbalance_force_is_the_second_derivative_of_the_turning_mass():
    rotor, h = machine(speed={"times": TIMES, "rpm": RPM}).machine.rotor, 1e-5
    assert [float(t) for t in rotor.edges()] == TIMES

    def place(t):
        angle = 2 * np.pi * float(rotor.rotation.turns(t)) + np.radians(20.0)
        return 50e-6 * np.array([np.cos(angle), np.sin(angle)])

    for t in (0.005, 0.3, 1.0, 2.5):
        force = -(place(t + h) - 2 * place(t) + place(t - h)) / h**2
        np.testing.assert_allclose((rotor.forces(t) - rotor.gravity)[:2], force, rtol=1e-4, atol=1e-3)


def test_the_speeds_of_the_sensitivity_are_first_last_and_largest():
    speed = {"times": [0.0, 0.01, 0.02], "rpm": [0.0, 6000.0, 3000.0]}
    assert machine(speed=speed).speeds == pytest.approx((0.0, 3000.0, 6000.0))


def listed(speeds):
    return machine_from(MACHINES["rigid"] | {"sensitivity": {"speeds": speeds}}, "machine").speeds


def test_a_range_of_speeds_is_a_list_of_them():
    assert listed("-3000:6000:4") == listed([-3000.0, 0.0, 3000.0, 6000.0])


@pytest.mark.parametrize("speeds", [[], "", "0:6000", "6:0:3", "0:6000:1", "0:6:2.5", "0:inf:3", "0:1:101", 6000.0])
def test_a_wrong_range_of_speeds_is_refused(speeds):
    with pytest.raises(ValueError, match=r"sensitivity\.speeds = .*LOW:HIGH:COUNT"):
        listed(speeds)
    with pytest.raises(ValueError, match=r"sensitivity\.speeds\[0\] = -1e\+09"):
        listed("-1e9:0:3")


@pytest.mark.parametrize("read", [machine_from, case_from])
def test_a_table_has_no_rate_that_varies(read):
    raw = MACHINES["rigid"] if read is machine_from else {"rotor": {}}
    turning = raw["rotor"] | {"speed": {"times": TIMES, "rpm": RPM}}
    spread = {"rotor": {"acceleration": {"uniform": [0.0, 1.0]}}}
    with pytest.raises(ValueError, match=r"spread.rotor.acceleration.*The table rotor.speed gives it"):
        read(raw | {"rotor": turning, "spread": spread})
    shifted = read(raw | {"rotor": turning, "spread": {"rotor": {"speed": {"uniform": [0.0, 9.0]}}}})
    assert shifted.spread.paths == ("rotor.speed",)


@pytest.mark.parametrize("times", [[0.0], [0.0, 0.0], [1.0, 0.5], [0.0, 1.0, 2.0]])
def test_times_must_ascend_with_one_rpm_each(times):
    with pytest.raises(ValueError, match="ascending"):
        case_from({"rotor": {"speed": {"times": times, "rpm": [0.0, 1.0]}}}, "case")
