"""`ambjax sensitivity`: numbers against the analysis, the picture against its data, and messages for bad input."""

import json
import tomllib
import types

import numpy as np
import pytest
from texts import refusal

from ambjax.__main__ import main
from ambjax.cases.reader import case_from, read_case
from ambjax.cases.template_text import template
from ambjax.commands import check_text
from ambjax.commands.comparison_loop import loop_of_axis
from ambjax.commands.sensitivity_report import UNSTABLE, WITHOUT, _measured_numbers, text_of
from ambjax.linear import MemberPeaks, Stability, StateSpace, Zones, analyse, linearise
from ambjax.linear.state_space import CommandPath
from ambjax.pictures.frequency import frequency_figure
from ambjax.results import operating
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import rollout
from ambjax.world.sensor import Measurement

CASE = """
[reference]
kind = "sine"
amplitude = 1e-3
frequency = 2.0
[sensitivity]
f_high = 500.0
"""
SPREAD = """
[controller.position]
k = 5.0
[spread]
plant.m = { choices = [0.588, 1.5] }
"""
KEYS = {"peak", "frequency_hz", "zone", "t_peak", "ks_peak", "gain_margin", "phase_margin_deg", "delay_margin_s"}


def answered(tmp_path, capsys, text, *flags):
    path = tmp_path / "case.toml"
    path.write_text(text)
    code = main(["sensitivity", str(path), "--out", str(tmp_path / "out"), "--force", *flags])
    return code, *capsys.readouterr(), path


def checked(tmp_path, capsys, text):
    """Return the exit code and the summary of `check`."""
    path = tmp_path / "case.toml"
    path.write_text(text)
    return main(["check", str(path), "--json"]), json.loads(capsys.readouterr().out)


def test_the_summary_agrees_with_the_analysis(tmp_path, capsys):
    code, out, _, path = answered(tmp_path, capsys, CASE, "--json")
    summary = json.loads(out)
    assert code == 0
    assert {*KEYS, "disk_margin"} <= set(summary)
    case = read_case(path)
    for r, row in zip((0.0, 1e-3, -1e-3), summary["points"], strict=True):
        one = analyse(linearise(case.cascade, case.scenario, case.clock, r), 0.588, 1e-4, case.zones)
        found = [one.S.height, one.S.frequency, one.T.height, one.margins.pm, one.margins.dm]
        assert [row[k] for k in ("peak", "frequency_hz", "t_peak", "phase_margin_deg", "disk_margin")] == found
        assert row["reference_m"] == pytest.approx(r, rel=1e-3)
        assert row["zone"] == "D"
    assert summary["peak"] == summary["points"][0]["peak"]
    at = summary["margins"]
    for key in ("delay_margin_s", "phase_margin_deg", "disk_margin"):
        assert summary[key] == min(at["reading"][key], at["command"][key])
    assert summary["gain_margin_low"] == max(at[place]["gain_margin_low"] for place in ("reading", "command"))
    assert at[at["delay_at"]]["delay_margin_s"] == summary["delay_margin_s"]
    assert at["reading"]["delay_margin_s"] != at["command"]["delay_margin_s"]
    assert summary["at_band_edge"] is False
    written = json.loads((tmp_path / "out" / "sensitivity.json").read_text())
    assert written == {key: value for key, value in summary.items() if key != "out"}
    assert (tmp_path / "out" / "sensitivity.png").stat().st_size > 20_000


@pytest.mark.slow
def test_a_member_without_an_equilibrium_is_reported_as_the_worst(tmp_path, capsys):
    """A rotor of 1.5 kg needs 6 m/s^2 more than the model, and k gives 5 m/s^2. The exit code is 1."""
    code, out, _, _ = answered(tmp_path, capsys, SPREAD, "--members", "8", "--seed", "1")
    assert code == 1
    counted = next(line for line in out.splitlines() if line.startswith("Of 8 members"))
    stable = int(counted.split()[5])
    assert 0 < stable < 8
    assert "0 are in zone A" in counted


@pytest.mark.slow
def test_a_reference_without_an_equilibrium_is_named_and_the_others_are_analysed(tmp_path, capsys):
    """At r = 1 mm the model misses 68 m/s^2 of the plant's springs, and k gives 25 m/s^2."""
    text = CASE + "[plant]\nk_z = -20000.0\n[controller.model]\nk_z = 0.0\n[controller.position]\nc = 17.0\nk = 25.0\n"
    code, out, _, _ = answered(tmp_path, capsys, text)
    assert code == 1
    lines = out.splitlines()
    for sign in "+-":
        (why,) = [line for line in lines if line.startswith(f"at {sign}reference: ")]
        assert f"no equilibrium at r = {'-' * (sign == '-')}0.001 m" in why
    points = json.loads((tmp_path / "out" / "sensitivity.json").read_text())["points"]
    assert [row["zone"] for row in points] == ["B", None, None]
    assert [row["stable"] for row in points] == [True, None, None]


def test_an_unstable_loop_has_no_peaks_and_no_zone(tmp_path, capsys):
    """A stiffness of 1 N/m holds no rotor: the cause is said in place of figures, by `sensitivity` and `check`."""
    text = '[controller]\nposition = { kind = "pid", k_p = 1.0, k_d = 1.0 }\n[rotor]\nspeed = 6000.0\n'
    code, out, _, path = answered(tmp_path, capsys, text + "[processor]\n[clock]\nduration = 0.01\n")
    assert code == 1
    assert "The nominal loop is not stable" in out
    row = next(line.split() for line in out.splitlines() if line.startswith("nominal"))
    assert row == ["nominal", "unstable", "-", "-", "-", "-"]
    assert not any(word in out for word in ("Zones", "Once per revolution", "stiffness", "|S| peaks"))
    written = json.loads((tmp_path / "out" / "sensitivity.json").read_text())
    numbers = ("peak", "frequency_hz", "t_peak", "ks_peak", "injected_peak", "static_stiffness_N_per_m", "noise_gain")
    assert {written[name] for name in numbers} == {None}
    assert written["running_speed"] == []
    axes = frequency_figure("x", [], [3.0, 4.0, 5.0], (1.0, 500.0)).axes
    assert not any(ax.patches for ax in axes)  # no zones
    summary, lines, _ = check_text.acceptance(read_case(path))
    assert lines == ["Sensitivity: no zone and no margins: the linearised loop is not stable at r = 0."]
    assert not {"peak", "running_speed", "delay_margin_s"} & set(summary)


@pytest.mark.parametrize(
    ("text", "flags", "message"),
    [
        ("[sensitivity]\nzone_a = 4.5\n", [], "sensitivity.zone_a to zone_c = [4.5, 4.0, 5.0]"),
        ("[sensitivity]\nf_low = 3e3\nf_high = 2e3\n", [], "sensitivity.f_low = 3000: it must be below f_high"),
        ("[processor]\n[sensitivity]\nf_high = 6e3\n", [], "at most half the sampling rate, 5000 Hz"),
        ("[sensitivity]\nzone = 3\n", [], "zone_"),
        ("[sensitivity]\namplitude = 0\n", [], "sensitivity.amplitude = 0: it must be a finite number above 0"),
        ("[run]\n", ["--members", "5"], "all members of this case are the same"),
        ("[controller.position]\nk = 5.0\n[controller.model]\nm = 0.1\n", [], "no equilibrium at r = 0 m"),
    ],
)
def test_bad_input_is_refused_in_one_line(tmp_path, capsys, text, flags, message):
    (tmp_path / "case.toml").write_text(text)
    assert message in refusal(capsys, "sensitivity", tmp_path / "case.toml", "--out", tmp_path / "out", *flags)
    assert not (tmp_path / "out").exists()


# The reference and the duration are those of the other tests of `check`, which share a compiled program.
CHECKED = "[reference]\nkind = 'sine'\namplitude = 1e-3\nfrequency = 2.0\n[clock]\nduration = 0.02\n"
CHECKED += "[actuator]\nu_max = 200.0\n"


@pytest.mark.thorough
def test_check_does_not_succeed_without_a_linearisation(tmp_path, capsys, monkeypatch):
    """All conditions hold, the rotor is held, and the verdict on the linear loop is missing."""

    def fails(*args):
        raise ValueError("the cause")

    monkeypatch.setattr(check_text, "linearise", fails)
    code, summary = checked(tmp_path, capsys, CHECKED)
    loop = summary["loop"]
    assert code == 1
    assert (loop["zone"], loop["stable"], loop["why"]) == (None, None, "the cause")
    assert loop["k_s_N_per_m"] > 0


@pytest.mark.parametrize("kind", ["lumped", "two-coil"])
def test_the_numbers_of_the_machine_contain_its_iron(kind):
    """Difference quotients of the acceleration and of the current's rate."""
    rig = tomllib.loads(template("rig"))
    rig["plant"] |= {"kind": kind, "iron": {"saturation": 0.7, "leakage": 1.1}}
    case = case_from(rig)
    plant, facts = case.scenario.plant, {fact.key: fact.value for fact in check_text.machine(case)}

    def rates(z=0.0, i=0.0, u=0.0):
        return plant.measurement(plant.rates(plant.start(Measurement(z, 0.0, i)), u))

    def slope(x, h):
        return float(plant.m * (rates(**{x: h}).z_dot - rates(**{x: -h}).z_dot) / (2 * h))

    assert facts["k_s_N_per_m"] == pytest.approx(slope("z", 1e-8), rel=1e-5)
    assert facts["unstable_pole_per_s"] == pytest.approx((facts["k_s_N_per_m"] / plant.m) ** 0.5)
    assert facts["k_i_N_per_A"] == pytest.approx(slope("i", 1e-5), rel=1e-5)
    assert facts["current_slew_A_per_s"] == pytest.approx(float(rates(u=48.0).i), rel=1e-9)
    assert facts["bias_flux_T"] == pytest.approx(float(plant.flux_density(plant.start(Measurement(0.0, 0.0, 0.0)))))


@pytest.mark.parametrize(
    ("pole", "held", "zone", "words"),
    [(0.5, True, "A", ""), (0.5, False, "D", UNSTABLE), (1.5, True, None, WITHOUT), (1.5, False, "D", UNSTABLE)],
)
def test_a_run_decides_on_a_loop_with_set_valued_signs(monkeypatch, pole, held, zone, words):
    case, one = case_from(tomllib.loads(template("rig"))), np.eye(1)
    path = CommandPath(0.0 * one, one[0], np.array(1.0))
    system = StateSpace(
        pole * one, 0.1 * np.ones((1, 3)), np.ones((6, 1)), np.eye(6)[:, :3], np.ones(1), np.array(1e-3), path
    )
    found = Stability(*(np.array([x]) for x in (held, np.nan, not held, 0.0, 0.0, False)), 1.0, 1.0)
    monkeypatch.setattr(operating.linear, "linearise", lambda *_: system)
    monkeypatch.setattr(operating.linear, "stability_of", lambda *_: found)
    point = operating.operating_point(case, "nominal", 0.0)
    assert (point.stable, point.zone) == (held, zone)
    assert np.isfinite(point.analysis.S.height) == (zone == "A")
    assert words in text_of(case, [point], None, None)
    assert loop_of_axis(point, None).numbers["stable"] == held
    assert loop_of_axis(point, None).numbers["zone"] == zone


@pytest.mark.slow
def test_check_begins_with_the_numbers_of_the_machine(tmp_path, capsys):
    """By hand for the plant of Table 1: kappa = mu_0 n^2 A, k_s = kappa i_0^2/s_0^3, k_i = kappa i_0/s_0^2."""
    loop = checked(tmp_path, capsys, CHECKED)[1]["loop"]
    kappa = 1.25e-6 * 1480**2 * 0.121
    expected = {
        "k_s_N_per_m": kappa * 0.25**2 / 5e-3**3,
        "k_i_N_per_A": kappa * 0.25 / 5e-3**2,
        "unstable_pole_per_s": (kappa * 0.25**2 / 5e-3**3 / 0.588) ** 0.5,
        "force_reserve": kappa * 0.25**2 / 5e-3**2 / (0.588 * 9.81),
        "bias_flux_T": 1.25e-6 * 1480 * 0.25 / 0.01,
        "current_slew_A_per_s": 200 / (kappa / 0.01),
    }
    assert {key: loop[key] for key in expected} == pytest.approx(expected, rel=1e-12)
    assert loop["zone"] == "D"
    assert loop["converter_step_m"] is None
    assert loop["delay_margin_s"] == min(loop["margins"][at]["delay_margin_s"] for at in ("reading", "command"))
    main(["check", str(tmp_path / "case.toml"), "--full"])
    shown = capsys.readouterr().out
    assert shown.startswith("The check passes.")
    assert "Eq. (14a)" in shown


PROCESSOR = """
controller.position = { c = 200.0, k = 63.0, p = 5.0 }
controller.inversion = { gamma = 2e6, p = 1e-3 }
controller.current = { k_i = 600.0, p = 20.0 }
[processor]
[sensitivity]
f_low = 20.0
"""


def test_the_measured_members_are_counted_by_zone():
    """A peak at the limit of zone A is in zone B. A lost rotor is the worst member and has no peak."""
    held = MemberPeaks(np.array([2.9, 3.0, 2.5]), np.full(3, 40.0), np.zeros(3, bool))
    assert _measured_numbers(held, Zones()) == {
        "injected_zone_a": 2,
        "injected_lost": 0,
        "injected_worst_member": 1,
        "injected_worst_peak": 3.0,
        "injected_worst_frequency_hz": 40.0,
    }
    lost = MemberPeaks(np.array([2.9, np.inf, 2.5]), np.full(3, 40.0), np.array([False, True, False]))
    assert _measured_numbers(lost, Zones())["injected_worst_peak"] is None


def test_the_picture_shows_the_response_and_the_injected_points(tmp_path):
    """A phase that differs by whole turns from that of the curve is drawn on the curve."""
    path = tmp_path / "case.toml"
    path.write_text(CASE)
    case = read_case(path)
    system = linearise(case.cascade, case.scenario, case.clock)
    f = np.array([10.0, 50.0, 200.0])
    H = system.response(f)
    measured = types.SimpleNamespace(frequency=f, S=H[:, 0, 0], T=H[:, 0, 0] - 1, KS=H[:, 2, 0])
    loop = operating.operating_point(case, "nominal", 0.0)
    axes = frequency_figure("x", [loop], [3.0, 4.0, 5.0], (1.0, 500.0), measured).axes
    lines = [(ax.get_ylabel(), line) for ax in axes for line in ax.get_lines()]
    curves = {ax.get_ylabel(): ax.get_lines()[0].get_xydata() for ax in axes}
    points = {label: line.get_xydata() for label, line in lines if line.get_label() == "injected"}
    assert "dynamic stiffness, N/m" not in points
    assert curves["|S|"][[0, -1], 0] == pytest.approx([1.0, 500.0])

    def expected(f):
        H = system.response(f)
        S, L = H[:, 0, 0], 1 / H[:, 0, 0] - 1
        shown = {"|S|": np.abs(S), "|T|": np.abs(S - 1), "|KS|, V/m": np.abs(H[:, 2, 0])}
        return shown | {"dynamic stiffness, N/m": 0.588 / np.abs(H[:, 3, 2]), "imaginary part of L": L.imag}, L.real

    for found, at in ((curves, curves["|S|"][:, 0]), (points, f)):
        shown, real = expected(at)
        for label in shown.keys() & found.keys():
            assert found[label][:, 1] == pytest.approx(shown[label]), label
        assert found["imaginary part of L"][:, 0] == pytest.approx(real)
    # the curve has 1200 points: between two of them its phase is linear to 0.01 degrees
    phase = np.interp(f, *curves["phase of L, degrees"].T)
    assert points["phase of L, degrees"][:, 1] == pytest.approx(phase, abs=0.01)


@pytest.mark.thorough
def test_check_gives_the_zone_of_the_clearance(tmp_path, capsys):
    """The reference moves the rotor by 1 mm of 4.5 mm, which is 22 %: above clearance_b, below clearance_c."""
    limits = "clearance_a = 0.1\nclearance_b = 0.2\n"
    found = checked(tmp_path, capsys, f"{CASE}{limits}[clock]\nduration = 0.4\n[run]\nsettle = 0.3\n")[1]
    case = read_case(tmp_path / "case.toml")
    fold = Metrics.of(case.settle, case.scenario)
    used = rollout(case.cascade, case.scenario, case.clock, fold=fold, record_every=0).metrics["settled_clearance_used"]
    assert found["clearance_used"] == pytest.approx(float(used), rel=1e-3)  # extremes of other steps
    assert found["clearance_used"] == pytest.approx(1 / 4.5, rel=0.03)  # the error of tracking
    assert found["clearance_zone"] == "C"
