"""Machines against their speed: response to unbalance, critical speeds, and modes, against closed forms."""

import dataclasses
import json
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from machine_cases import MACHINES, MUNICH, Pid
from scipy.linalg import block_diag
from texts import refusal

from ambjax import save_controller
from ambjax.__main__ import main
from ambjax.cases.machine_case import machine_from, read_machine
from ambjax.cases.rotor_drawing import in_pairs
from ambjax.cases.template_text import template
from ambjax.commands import campbell
from ambjax.commands.machine_commands import once_per_revolution
from ambjax.commands.sensitivity_report import injection_text
from ambjax.linear import rotor_modes
from ambjax.linear.injection import Injection
from ambjax.linear.linear_machine import machine_sensitivity, turning_machines
from ambjax.linear.rotor_modes import modes_of, springs_critical
from ambjax.linear.unbalance_response import UnbalanceResponse, critical_speeds, separation, unbalance_response
from ambjax.pictures.machine_pictures import machine_sensitivity_picture
from ambjax.pictures.run_up_picture import last_turn, waterfall
from ambjax.pictures.scales import save
from ambjax.results.runs import simulate_machine

MASS, I_T, I_P, HALF = 3.0, 0.1, 0.04, 0.25
K_I, K_S = 50.0, 1e5


@pytest.fixture(scope="module")
def rigid(tmp_path_factory):
    """A rigid rotor on two equal bearings, in continuous time; its unbalance beside the centre of mass."""
    return machine_of(tmp_path_factory.mktemp("rigid"), Pid)


def machine_of(folder, controller):
    save_controller(folder / "pid.npz", controller)
    raw = MUNICH | {
        "rotor": {"kind": "rigid", "m": MASS, "I_t": I_T, "I_p": I_P, "gravity": [0.0] * 3},
        "bearing": [{"name": n, "kind": "radial", "at": at} for n, at in (("left", -HALF), ("right", HALF))],
        "unbalance": [{"at": 0.1, "amount": 10.0, "phase": 30.0}],
    }
    return machine_from(raw, "rigid", "", folder)


def test_an_unstable_machine_has_no_peaks_no_zones_and_no_verdict_by_api(tmp_path):
    """A stiffness of 1000 A/m times K_I is half of the negative one of the magnets."""

    class Weak(Pid):
        D = np.array([[1000.0 + 5.0 * Pid.w]])

    weak = machine_of(tmp_path, Weak)
    found = machine_sensitivity(weak.machine, weak.axes, weak.clock.sample_period, 6000.0, weak.zones)
    assert not found.stable
    assert once_per_revolution(found) == [([], [])] * len(weak.axes)
    response = unbalance_response(weak.machine, weak.clock.sample_period, 100.0)
    assert np.isnan(response.sensors).all()
    text = campbell.unbalance_text(weak, response, critical_speeds(response, (50.0, 90.0)), (50.0, 90.0))
    assert "not judged by A1" in text
    assert "um" not in text
    save(machine_sensitivity_picture([found], (3.0, 4.0, 5.0), "x"), tmp_path / "S.png")
    assert campbell.ranges(np.arange(5.0), np.array([True, False, True, True, True])) == "0, 2 to 4"


@pytest.mark.parametrize("way", [1, -1])
def test_the_unbalance_response_of_a_rigid_rotor_is_the_closed_form(rigid, way):
    found = unbalance_response(rigid.machine, rigid.clock.sample_period, way * 9000.0)
    W = way * found.speeds[1:] * np.pi / 30
    stiffness = 2 * (K_I * (5000 + 1500 / (1j * W) + 5j * W) - K_S)  # of both bearings
    force = 1e-5 * W**2 * np.exp(1j * np.pi / 6)
    x = force / (stiffness - MASS * W**2)
    tilt = 0.1 * force / (stiffness * HALF**2 - (I_T - I_P) * W**2)  # forward whirl
    for axis, place in ((0, -HALF), (2, HALF)):
        # the amplifier of 1 MHz delays the current by 1.6e-7 s
        np.testing.assert_allclose(found.magnets[1:, axis], x + place * tilt, rtol=1e-3)
        # y follows x by a quarter of a turn
        np.testing.assert_allclose(found.sensors[1:, axis + 1], -1j * (x + place * tilt), rtol=1e-3)
    current = -(stiffness / 2 + K_S) / K_I * found.magnets[1:, 0]
    np.testing.assert_allclose(found.current[1:, 0], current, rtol=1e-3)


def test_a_scan_that_ends_below_an_operating_speed_is_not_judged(rigid):
    found = unbalance_response(rigid.machine, rigid.clock.sample_period, 4000.0)
    text = campbell.unbalance_text(rigid, found, [], (3000.0, 6000.0))
    assert text.endswith("unbalance at 3000 to 6000 rpm: not judged by A1, because the scan ends at 4000 rpm")
    assert "limit A1" in campbell.unbalance_text(rigid, found, [], (3000.0, 4000.0))


@pytest.mark.parametrize("to", ["inf", "nan", "1e9", "0"])
def test_an_end_of_the_scan_that_is_no_speed_is_refused(tmp_path, capsys, to):
    (tmp_path / "case.toml").write_text(template("machine"))
    said = refusal(capsys, "campbell", tmp_path / "case.toml", "--to", to, "--out", tmp_path / "c")
    assert said.endswith("it must be above 0 rpm and at most 1e+07 rpm.\n")


@pytest.mark.thorough
def test_the_scan_has_the_direction_of_the_speeds(tmp_path, capsys, rigid):
    with pytest.raises(ValueError, match="3000, -6000 rpm, have both signs"):
        campbell.direction(dataclasses.replace(rigid, speeds=(3000.0, -6000.0)))
    path = tmp_path / "back.toml"
    path.write_text(template("machine").replace("= 6000.0", "= -6000.0").replace("[0.0, 6000.0, 12000.0]", "[-6000.0]"))
    assert main(["campbell", str(path), "--out", str(tmp_path / "c")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("0 to -7800 rpm: stable")
    assert "unbalance at -6000 rpm: " in text
    found = json.loads((tmp_path / "c" / "campbell.json").read_text())
    assert found["speeds_rpm"][-1] == found["unbalance"]["speeds_rpm"][-1] == pytest.approx(-7800.0)


@pytest.mark.slow
def test_the_unbalance_response_is_that_of_the_simulation_at_constant_speed():
    raw = tomllib.loads(template("machine")) | {"load": [], "sensor": {"velocity": False}, "run": {"settle": 0.0}}
    raw |= {"unbalance": [{"at": 0.05, "amount": 2.0}], "clock": raw["clock"] | {"duration": 0.1}}
    case = machine_from(raw, "machine")
    run, found = simulate_machine(case), unbalance_response(case.machine, 5e-5, 6000.0)
    t = run.signals["t"]
    last = t >= 0.08  # whole turns; the slowest radial transient has decayed to 3e-4
    turning = np.exp(-2j * np.pi * 100.0 * t[last])[:, None]
    for name, ours in (("z", found.magnets), ("i", found.current), ("u", found.command)):
        simulated = 2 * np.mean(run.signals[name][last, :4] * turning, 0)
        # the run is not linear: the magnets, and the boundary layer of the law
        np.testing.assert_allclose(simulated, ours[-1, :4], rtol=0.01)


@pytest.mark.parametrize("damping", [0.01, 0.05, 1e-14])
def test_the_amplification_factor_of_one_mode_is_that_of_its_damping(damping):
    near = 1 + max(4 * damping, 1e-3) * np.linspace(-1, 1, 33)
    speeds = 3000 * np.unique(np.concatenate([np.linspace(0, 2, 121), near]))
    r = speeds / 3000
    response = (1e-6 * r**2 / (1 - r**2 + 2j * damping * r))[:, None]
    found = UnbalanceResponse(speeds, response, response, response, response)
    (one,) = critical_speeds(found, (6000.0, 8000.0))
    assert one.speed == pytest.approx(3000, rel=3 * damping**2)
    undamped = damping < 1e-9  # within rounding errors
    assert one.amplification == (np.inf if undamped else pytest.approx(1 / (2 * damping), rel=0.02))
    assert one.peak_to_peak == (np.inf if undamped else pytest.approx(1e-6 / damping, rel=0.02))
    case = SimpleNamespace(axes=("x",), speeds=(6000.0,))
    assert ("undamped" in campbell.unbalance_text(case, found, [one], (6000.0, 6000.0))) == undamped
    assert one.present == pytest.approx(50, abs=1)


def test_separation_margins_of_api_684():
    # AF 5: 17 (1 - 1/3.5) below, 10 more above; at most 16 and 26; none below AF 2.5
    assert separation(900.0, 5.0, (1000.0, 2000.0)) == pytest.approx((12.142857, 10.0))
    assert separation(2400.0, 5.0, (1000.0, 2000.0)) == pytest.approx((22.142857, 20.0))
    assert separation(1500.0, 50.0, (1000.0, 2000.0)) == (26.0, 0.0)
    assert separation(900.0, 50.0, (1000.0, 2000.0))[0] == 16.0
    assert separation(900.0, 2.4, (1000.0, 2000.0))[0] is None


def test_critical_speeds_of_a_rigid_rotor_on_springs(rigid):
    k = np.array([1e4, 1e6])
    found = np.array(springs_critical(rigid.machine.rotor, k))
    expected = np.sort([np.sqrt(2 * k / MASS), np.sqrt(2 * k * HALF**2 / (I_T - I_P))], 0).T * 30 / np.pi
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    centre = dataclasses.replace(rigid.machine.rotor, at_magnets=np.eye(2, 5))  # it does not hold the tilt
    np.testing.assert_allclose(springs_critical(centre, k)[0], np.sqrt(k[0] / MASS) * 30 / np.pi, rtol=1e-12)
    assert (in_pairs(rigid), in_pairs(machine_from(MACHINES["one"]))) == (True, False)


@pytest.mark.parametrize("way", [1, -1])
def test_modes_have_the_names_and_directions_of_the_motion(rigid, way):
    (still, turning) = turning_machines(rigid.machine, rigid.clock.sample_period, (0.0, way * 9000.0))
    slow = modes_of(still, rigid.machine.rotor)
    assert [mode.name for mode in slow] == ["translation"] * 2 + ["tilt"] * 2
    stiffness, damping = 2 * (K_I * 5000 - K_S), 2 * K_I * 5
    assert slow[0].damping == pytest.approx(damping / 2 / np.sqrt(stiffness * MASS), rel=5e-3)
    tilts = [mode for mode in modes_of(turning, rigid.machine.rotor) if mode.name == "tilt"]
    assert [mode.whirl for mode in tilts] == ["backward", "forward"]  # nutation is forward, and faster
    # an oscillation of a law at 4 kHz that moves the rotor is no mode of the rotor
    one, wave = still.system, [[-8e3, 25e3], [-25e3, -8e3]]
    A, B = block_diag(one.A, wave), np.vstack([one.B, np.ones((2, one.B.shape[1]))])
    A[5, -1] = 1e3  # m/s^2
    wide = one._replace(A=A, B=B, C=np.pad(one.C, [(0, 0), (0, 2)]), sizes=np.append(one.sizes, [1.0, 1.0]))
    found = modes_of(still._replace(system=wide), rigid.machine.rotor)
    assert [mode.label for mode in found] == [*(mode.label for mode in slow), "controller"]
    # the vectors of a double pole at rest are any of its plane, such as two circles
    circle = np.array([1.0, -1j, 0.0, 0.0, 0.0])
    found = [rotor_modes._described(circle, np.ones(5), speed)[1] for speed in (way, 0)]
    assert found == ["forward" if way > 0 else "backward", "planar"]


def test_the_waterfall_of_a_sweep_follows_its_frequency():
    t = np.arange(0, 2.0, 1e-3)
    speed = 60 * (10 + 40 * t)  # rpm: 10 to 90 Hz
    speeds, frequency, amplitude = waterfall(2e-6 * np.sin(2 * np.pi * (10 * t + 20 * t**2)), speed, 1e-3)
    highest = frequency[np.argmax(amplitude, 1)]
    # a window covers 1/12 of the sweep, 7 Hz, and lowers the peak of the spectrum
    np.testing.assert_allclose(highest, speeds / 60, atol=2.0)
    assert 0.6e-6 < amplitude.max() < 2e-6


def test_the_text_of_an_injection_gives_the_zone_of_its_peak(rigid):
    system = machine_sensitivity(rigid.machine, rigid.axes, rigid.clock.sample_period, 0.0, rigid.zones).system
    one = np.ones(1)
    measured = Injection(10 * one, one, one, one, 3.5, 3.5, 3.5, 10.0, 0, 1, 1e-6, 0.0)
    assert "at 10 Hz, zone B (the linear peak: zone A), an end" in injection_text(system, measured, rigid.zones, "A")
    assert "at 10 Hz, zone B, an end" in injection_text(system, measured, rigid.zones, "B")
    assert "zone" not in injection_text(system, measured, None)


def test_an_orbit_is_one_turn_also_where_the_speed_passes_0():
    t = np.linspace(0, 2.0, 2001)
    turns = 10 * (2 * t - t**2)  # 1200 rpm to -1200 rpm
    assert last_turn(turns, 1000) == slice(1000 - 317, 1001)  # sqrt(1/10) s
    assert last_turn(turns, 2000) == slice(1948, 2001)  # 10 (t - 1)^2 = 9 at 1.94868 s
    assert last_turn(turns, 10) == slice(0, 11)


@pytest.mark.thorough
def test_the_commands_write_what_an_engineer_looks_at(tmp_path, capsys):
    path, turning = tmp_path / "up.toml", "speed = 600.0\nacceleration = 60000.0"
    text = template("machine").replace("speed = 6000.0", turning).replace("duration = 0.2", "duration = 0.05")
    path.write_text(text.replace("settle = 0.05", "settle = 0.02"))
    assert main(["simulate", str(path), "--out", str(tmp_path / "run")]) == 0
    assert (tmp_path / "run" / "runup.png").stat().st_size > 10_000
    assert main(["campbell", str(path), "--out", str(tmp_path / "c")]) == 0
    assert {file.name for file in (tmp_path / "c").iterdir()} == set(campbell.WRITTEN)
    found = json.loads((tmp_path / "c" / "campbell.json").read_text())
    # by the closed form of the command's own definition: A1 at the highest speed of the case
    assert found["unbalance"]["a1_limit_m"] == pytest.approx(25.4e-6)
    springs, rotor = found["undamped_critical_speeds"], read_machine(path).machine.rotor
    for own, expected in zip(springs["speeds_rpm"], springs_critical(rotor, springs["stiffness_N_per_m"]), strict=True):
        np.testing.assert_allclose(own, expected)
    capsys.readouterr()
    assert main(["check", str(path), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["clearance_used"] == max(axis["clearance_used"] for axis in checked["axes"].values())
    turning = [fact for facts in checked["running_speed"].values() for fact in facts]
    assert len(turning) == len(checked["axes"]) * sum(speed != "0" for speed in checked["stable"])
    assert all(0 < fact["S"] <= checked["peak"] for fact in turning)
    assert checked["peak"] == max(axis["peak"] for axis in checked["axes"].values())
    weight = 2.3 * 9.81
    case = read_machine(path)
    largest = [float(one.scenario.largest_force) for one in case.cases]
    shares = [axis["force_carried"] * most for axis, most in zip(checked["axes"].values(), largest, strict=True)]
    assert sum(shares) == pytest.approx(weight)
    assert all(axis["force_reserve"] <= 1 - axis["force_carried"] for axis in checked["axes"].values())


def test_the_margins_of_an_axis_follow_from_its_sensitivity(rigid):
    found = machine_sensitivity(rigid.machine, rigid.axes, rigid.clock.sample_period, 9000.0, rigid.zones)
    f = np.geomspace(1.0, 1e4, 20_001)
    for k, axis in enumerate(found.axes):
        L = 1 / np.asarray(found.system.response(f))[:, k, k] - 1
        crossing = np.flatnonzero(np.diff(np.sign(np.abs(L) - 1)))
        phases = np.abs(np.abs(np.angle(L[crossing], deg=True)) - 180)
        assert axis.margins.pm == pytest.approx(phases.min(), abs=0.05)  # a step of f is 0.05 %
