"""Whole machines against an independent program, written from the equations alone (machine_oracle)."""

import tomllib

import machine_oracle
import numpy as np
import pytest
import tomlkit
from machine_cases import MACHINES

from ambjax.cases.machine_case import machine_from
from ambjax.linear.linear_machine import machine_sensitivity
from ambjax.results.machine_run import simulate_machine

# The fast tests take the machines with the most features.
FAST = ("bending", "coordinates")
NAMES = [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in MACHINES]


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_agrees_with_the_independent_program(name):
    raw = tomllib.loads(tomlkit.dumps(MACHINES[name]))
    ours = simulate_machine(machine_from(raw, name)).signals
    theirs = machine_oracle.simulate(MACHINES[name])
    assert list(ours["axes"]) == list(theirs.axes)
    assert not np.isfinite(ours["lost_at"])
    for signal, size in (("z", 1e-9), ("q", 1e-9), ("i", 1e-6)):
        # steps of different length: RK4's error is below 1e-11 m and 1e-7 A here
        np.testing.assert_allclose(ours[signal], getattr(theirs, signal), rtol=0, atol=size, err_msg=signal)


@pytest.mark.parametrize("name", NAMES)
def test_the_sensitivity_agrees_with_the_independent_program(name):
    case = machine_from(tomllib.loads(tomlkit.dumps(MACHINES[name])), name)
    ours = machine_sensitivity(case.machine, case.axes, case.clock.sample_period, case.speeds[0], case.zones)
    theirs = machine_oracle.sensitivity(MACHINES[name])
    assert ours.stable
    assert theirs.stable
    np.testing.assert_allclose([axis.S.height for axis in ours.axes], [peak for peak, _ in theirs.peaks], rtol=1e-5)
    assert ours.sigma.height == pytest.approx(theirs.sigma_max[0], rel=1e-5)
