"""`ambjax check` of a machine: its verdict without an equilibrium, and the test with more bending modes."""

import dataclasses
import math
import tomllib
from typing import Any

import jax
import numpy as np
import pytest
from profiles import thorough

from ambjax.__main__ import main
from ambjax.cases.machine_case import read_machine
from ambjax.cases.template_text import template
from ambjax.commands import machine_check
from ambjax.commands.machine_check import LEAST_OFFSET
from ambjax.commands.machine_commands import sensitivity_summary, sensitivity_text
from ambjax.commands.sensitivity_report import signs_note
from ambjax.linear import StateSpace, Zones
from ambjax.linear.linear_machine import TurningMachine, sensitivity_of
from ambjax.linear.machine_stability import machine_stability

FLEXIBLE = tomllib.loads(template("machine-flexible")) | {"sensitivity": {"speeds": [0.0]}}


def with_rotor(**changes):
    return read_machine(FLEXIBLE | {"rotor": FLEXIBLE["rotor"] | changes})


@pytest.mark.thorough
def test_a_lost_rotor_without_an_equilibrium_has_a_verdict(tmp_path, capsys):
    """Each sensor is at an end of the shaft, behind a node of the first bending mode."""
    text = template("machine-flexible").replace("duration = 0.4", "duration = 0.05").replace("settle = 0.2", "")
    for at, end in (("0.113", "0.0"), ("0.623", "0.702")):
        text = text.replace(f"\nat = {at}", f"\nat = {at}\nsensor_at = {end}", 1)
    (tmp_path / "far.toml").write_text(text)
    assert main(["check", str(tmp_path / "far.toml")]) == 1
    run, sensitivity, _, _, *axes = capsys.readouterr().out.splitlines()
    assert run.startswith("run: LOST (touched down")
    assert sensitivity.startswith("sensitivity: no zone and no margins: no equilibrium")
    assert [line.split()[2] for line in axes] == ["D"] * 4


def test_the_check_says_why_there_is_no_test_with_more_modes():
    full = machine_check._spill_over(with_rotor(modes=20))
    assert full == ({}, "the rotor has 20 already, the largest number", False)
    rigid = read_machine(tomllib.loads(template("machine")))
    assert machine_check._spill_over(rigid)[1] == "only a rotor of the kind shaft or of a file has further modes"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "growth", "held"), [("integral-sliding-mode", -125.0, False), thorough("super-twisting", 2519.0, True)]
)
def test_a_run_decides_on_the_stability_of_a_machine_with_set_valued_signs(kind, growth, held):
    """The verdict of the linear machine inside the bands of the signs is wrong in both cases."""
    raw = tomllib.loads(template("machine"))
    laws, clock = raw["controller"] | {"position": {"kind": kind, "p": math.inf}}, raw["clock"] | {"duration": 0.1}
    hard = read_machine(raw | {"controller": laws, "clock": clock, "bearing": raw["bearing"][:2]})
    assert signs_note(hard.cases)
    found = machine_stability(hard.machine, hard.clock, [(0, 6000.0)], np.array([growth]))
    assert found.stable.tolist() == [held]
    assert (found.swing[0] < 1e-8) == held
    smooth = read_machine(raw)
    assert not signs_note(smooth.cases)
    assert machine_stability(smooth.machine, smooth.clock, [(0, 6000.0)], np.array([growth])) is None


@pytest.mark.parametrize(
    ("pole", "run", "linear", "zone"),
    [(0.5, None, True, "A"), (1.5, None, False, "D"), (1.5, True, False, None), (0.5, False, False, "D")],
)
def test_a_machine_has_peaks_if_the_linear_machine_and_its_runs_are_stable(pole, run, linear, zone):
    one = np.eye(1)
    system = StateSpace(pole * one, one, 0.1 * np.ones((3, 1)), np.eye(3)[:, :1], np.ones(1), np.array(1e-3))
    found = sensitivity_of(TurningMachine(system, one, 0.0), ("x",), 0.0, Zones(), run, None if run else 1e-5)
    assert (found.stable, found.linear, found.axes[0].zone) == (linear if run is None else run, linear, zone)
    peaks = [found.sigma, *(peak for axis in found.axes for peak in (axis.S, axis.T, axis.KS))]
    assert {bool(np.isfinite(peak.height)) for peak in peaks} == {linear}
    text = sensitivity_text([found], {}, Zones())
    assert ("there are no peaks" in text) == (not linear)
    assert ("a motion of 1e-05 m does not decay" in text) == (not found.stable)
    assert sensitivity_summary([found], {})["zone"] == zone


def test_a_file_is_asked_for_as_many_more_modes_as_it_has(monkeypatch):
    """Further modes are damped as the last one of a list."""
    asked = []

    def read(top, folder):
        asked.append((top.raw["rotor"]["modes"], top.raw["rotor"]["damping"]))
        raise ValueError("it has 6")

    monkeypatch.setattr(machine_check, "axes_and_rotor", read)
    case = dataclasses.replace(with_rotor(), text='rotor = { kind = "modal", file = "a.npz", damping = [0.1, 0.2] }')
    assert machine_check._spill_over(case) == ({}, "it has 6", False)
    assert asked == [(10 - k, [0.1] + [0.2] * (5 - k)) for k in range(4)]


def with_notch():
    laws = FLEXIBLE["controller"] | {"notch": {"kind": "displacement-free", "rate": 5.0}}
    return read_machine(FLEXIBLE | {"rotor": FLEXIBLE["rotor"] | {"modes": 1}, "controller": laws})


@pytest.mark.thorough
def test_a_notch_at_rest_grows_by_rounding_errors_only(monkeypatch):
    """At 0 rpm, one of the two states of a notch has a pole at 0."""
    found = machine_check._linear(with_notch())
    assert found.summary["growth_with_more_modes_per_s"] == {"0": 0.0}
    assert found.holds
    monkeypatch.setattr(machine_check, "_spill_over", lambda case: ({"0": 3.0}, "", True))
    found = machine_check._linear(with_notch())
    assert not found.holds
    assert "stability: stable at 0 rpm; with up to 4 more bending modes NOT STABLE" in found.verdict[1]


@pytest.mark.thorough
def test_the_larger_rotor_has_the_notches_of_the_case(monkeypatch):
    """The gain of a notch is that of the designed rotor: the machine in service has no other."""
    case = with_notch()
    taken, machines = machine_check.turning_machines, []
    monkeypatch.setattr(machine_check, "turning_machines", lambda one, *rest: machines.append(one) or taken(one, *rest))
    assert machine_check._spill_over(case)[0]
    assert len(machines[0].rotor.gravity) == len(case.coordinates) + 8
    expected, found = (
        [np.asarray(x) for loop in one.loops() for x in jax.tree.leaves(loop.cascade.notch)]
        for one in (case.machine, machines[0])
    )
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("third", [True, thorough(False)])
def test_integral_actions_on_three_bearings_of_a_rigid_rotor_drift_apart(third, monkeypatch):
    """The least offset is the static gain of the discrete map, which is nearly singular with three bearings."""
    raw: dict[str, Any] = tomllib.loads(template("machine")) | {"sensitivity": {"speeds": [6000.0]}}
    if third:
        raw["bearing"].insert(2, {"name": "middle", "kind": "radial", "at": 0.05})
    case = read_machine(raw)
    linear = machine_check._linear(case)
    assert (linear.holds, linear.summary["stable"]) == (not third, {"6000": True})
    assert ("sensors: NOT BORNE" in "\n".join(linear.verdict)) == third
    monkeypatch.setattr(machine_check, "LEAST_OFFSET", np.inf)
    assert ("drift apart" in machine_check._offset(case, linear.points)[1][0]) == third
    system, c = linear.points[0].system, len(case.axes)
    A, B, C, D = (np.asarray(x) for x in (system.A, system.B, system.C, system.D))
    static = np.abs(C @ np.linalg.solve(np.eye(len(A)) - A, B) + D)[2 * c : 3 * c]
    share = float(case.cases[0].scenario.plant.i_0) / static.max() / (0.9 * 3.81e-4)
    assert (share < LEAST_OFFSET) == third
    # a pole at 1 - 4e-7 loses 7 of 16 digits
    assert linear.summary["sensor_offset_borne"] == pytest.approx(share, rel=1e-5)
