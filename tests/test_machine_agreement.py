"""Whole machines against an independent program (machine_oracle), and their injected sensitivity against the linear."""

import dataclasses
import json
import tomllib

import machine_oracle
import numpy as np
import pytest
import tomlkit
from machine_cases import MACHINES
from profiles import thorough

from ambjax.__main__ import main
from ambjax.cases.machine_case import machine_from
from ambjax.cases.template_text import template
from ambjax.linear import Zones, machine_injected, machine_sensitivity
from ambjax.results.runs import simulate_machine

# The fast test takes a machine with many features.
FAST = "bending"
NAMES = [name if name == FAST else pytest.param(name, marks=pytest.mark.slow) for name in MACHINES]


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


@pytest.mark.slow
# the laws of "five", in another arrangement, are those of the others
@pytest.mark.parametrize("name", ["gyroscopic", "run-up", "bending", "one", thorough("coordinates")])
def test_the_sensitivity_agrees_with_the_independent_program(name):
    case = machine_from(tomllib.loads(tomlkit.dumps(MACHINES[name])), name)
    ours = machine_sensitivity(case.machine, case.axes, case.clock.sample_period, case.speeds[0], case.zones)
    theirs = machine_oracle.sensitivity(MACHINES[name])
    assert ours.stable
    assert theirs.stable
    np.testing.assert_allclose([axis.S.height for axis in ours.axes], [peak for peak, _ in theirs.peaks], rtol=1e-5)
    assert ours.sigma.height == pytest.approx(theirs.sigma_max[0], rel=1e-5)


SPEED = 9000.0


@pytest.mark.slow
def test_the_injected_sensitivity_of_every_axis_is_the_linear_one():
    """At all lines, within 1 % of the largest |S|: one period of 50 ms does not settle the integrals further.

    The amplitude of 1e-7 m is 2e-4 of the gap, and the nonlinear terms are of this size.
    """
    case = machine_from(MACHINES["coordinates"])
    zones, clock = Zones(f_low=20.0, f_high=2000.0, amplitude=1e-7), dataclasses.replace(case.clock, samples=1000)
    linear = machine_sensitivity(case.machine, case.axes, clock.sample_period, SPEED, zones)
    (found,) = machine_injected(case.machine, clock, zones, [SPEED], [[axis.S.frequency for axis in linear.axes]])
    assert len(found) == len(case.axes)
    for k, (one, axis) in enumerate(zip(found, linear.axes, strict=True)):
        expected = np.asarray(linear.system.response(one.frequency))
        assert np.abs(one.S - expected[:, k, k]).max() < 0.01 * axis.S.height
        assert np.abs(one.KS - expected[:, len(found) + k, k]).max() < 0.01 * axis.KS.height
        assert one.peak == pytest.approx(axis.S.height, rel=0.01)


@pytest.mark.thorough
def test_the_command_reports_the_injected_beside_the_linear_peak(tmp_path, capsys):
    text = template("machine").replace("std = 2e-7", "std = 1e-9")
    text = text.replace("[sensitivity]", "[sensitivity]\nf_low = 50.0")
    path = tmp_path / "m.toml"
    path.write_text(text)
    assert main(["sensitivity", str(path), "--out", str(tmp_path / "s"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["injected_peak"] == pytest.approx(summary["injected_linear_there"], rel=0.05)
    assert tomllib.loads(text)["sensitivity"]["speeds"] == [own["speed_rpm"] for own in summary["speeds"]]
    for own in summary["speeds"]:
        measured = [axis["injected_peak"] for axis in own["axes"]]
        if own["speed_rpm"] == summary["speed_rpm"]:
            assert summary["injected_peak"] in measured
        else:  # only the speed with the largest peak is measured
            assert measured == 5 * [None]
