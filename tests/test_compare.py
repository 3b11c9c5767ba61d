"""`ambjax compare`: its numbers are those of the study and of the linear analysis, of the same members in all cases."""

import dataclasses
import json

import numpy as np
import pytest
from texts import refusal

from ambjax.__main__ import main
from ambjax.cases.reader import read_case
from ambjax.codegen.controller import controller_of
from ambjax.codegen.trace import trace
from ambjax.commands import compare
from ambjax.commands.comparison_loop import ComparedLoop
from ambjax.commands.comparison_report import Compared, Quantity, _marked
from ambjax.ensemble.study import Study
from ambjax.host import extensions
from ambjax.linear import analyse, linearise
from ambjax.pictures.frequency import comparison_figure
from ambjax.results.case_export import guarded_for

# A smooth loop on a processor, 0.2 s of it.
CASE = """
[controller.position]
c = {c}
k = 63.0
p = 5.0
[controller.inversion]
gamma = 2e6
p = 1e-3
[controller.current]
k_i = 600.0
p = 20.0
[processor]
delay = 0.0
guard = false
[sensor]
std = 1e-6
std_z_dot = 1e-4
[clock]
duration = 0.05
[run]
settle = 0.02
[spread]
plant.m = {{ percent = 10 }}
initial.z = {{ uniform = [-1e-4, 1e-4] }}
"""
MEMBERS = 6


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cases")
    (folder / "soft.toml").write_text(CASE.format(c=150.0))
    (folder / "stiff.toml").write_text(CASE.format(c=200.0))
    (folder / "loose.toml").write_text(CASE.format(c=200.0).replace("k = 63.0", "k = 0.01"))
    return folder


@pytest.fixture(scope="module")
def run(cases):
    """Return a function that compares cases of the folder: exit code and summary."""

    def compared(*names, flags=()):
        out = cases / "-".join(names)
        paths = [str(cases / f"{name}.toml") for name in names]
        code = main(["compare", *paths, "--members", str(MEMBERS), "--out", str(out), "--force", *flags])
        return code, json.loads((out / "compare.json").read_text()), out

    return compared


@pytest.fixture(scope="module")
def two(run):
    return run("soft", "stiff")


@pytest.mark.slow
def test_the_numbers_are_those_of_the_study_and_of_the_analysis(two, cases):
    code, summary, out = two
    soft, stiff = summary["cases"]
    errors = [check_row(row, read_case(cases / f"{row['case']}.toml"), c) for row, c in ((soft, 150.0), (stiff, 200.0))]
    assert soft["better_than_first"] is None
    assert stiff["better_than_first"] == np.sum(errors[1] < errors[0]) == MEMBERS
    assert code == 0
    assert summary["differences"] == []
    html = (out / "compare.html").read_text()
    assert html.count("data:image/png;base64,") == 1
    assert f"<strong>{stiff['rms_error_median_m']:.4g}</strong>" in html
    assert '<td class="short">settled rms error, median</td>' in html


def test_only_a_number_that_is_printed_as_better_is_bold():
    cells = [_marked(Quantity("peak", "", ""), {"cases": [{"peak": x}, {"peak": 1.69404}]}) for x in (1.69401, 1.6)]
    assert cells == [["1.694", "1.694"], ["**1.6**", "1.694"]]


def check_row(row, case, c):
    """Check the row of a case whose position law has the gain c. Return the error of each member."""
    study = Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, 0, MEMBERS)
    columns = study.columns(0, MEMBERS, call=MEMBERS)  # the same members in the same call: equal to the last digit
    assert row["lost"] == row["stalled"] == 0
    assert row["rms_error_median_m"] == np.median(columns["settled_rms_error_m"])
    assert row["rms_error_worst_m"] == np.max(columns["settled_rms_error_m"])
    assert row["rms_u_V"] == pytest.approx(np.sqrt(np.mean(columns["settled_rms_u_V"] ** 2)), rel=1e-14)
    assert row["chatter_V_per_s"] == pytest.approx(np.mean(columns["chatter_V"]) / 0.03, rel=1e-14)
    assert row["clearance_used"] == np.max(columns["settled_clearance_used"])
    assert row["clearance_zone"] == "A"
    loop = analyse(linearise(case.cascade, case.scenario, case.clock), 0.588, 1e-4)
    assert row["peak"] == loop.S.height
    assert row["disk_margin"] == loop.margins.dm
    assert row["zone"] == loop.zone
    assert row["unstable"] == 0
    assert row["worst_peak"] > loop.S.height
    controller = controller_of(guarded_for(case), case.scenario.u_max, 1e-4)
    assert row["flops"] == trace(controller, "float").flops()
    assert row["laws"]["position"] == {"kind": "SlidingMode", "c": c, "k": 63.0, "p": 5.0}
    return columns["settled_rms_error_m"]


@pytest.mark.slow
def test_a_case_that_loses_members_is_compared_too(run, capsys):
    """The gain k = 0.01 m/s^2 does not hold a rotor whose weight differs by 10 % from that of the model."""
    code, summary, _ = run("stiff", "loose")
    stiff, loose = summary["cases"]
    assert code == 1
    assert 0 < loose["lost"] <= MEMBERS
    assert stiff["lost"] == 0
    assert loose["better_than_first"] == 0
    assert loose["clearance_zone"] == "D"
    assert "members lost" in capsys.readouterr().out


@pytest.mark.slow
def test_differences_other_than_the_laws_are_named(run, cases, capsys):
    (cases / "light.toml").write_text(CASE.format(c=200.0) + "[actuator]\nu_max = 300.0\n")
    code, summary, _ = run("stiff", "light", flags=["--json"])
    out, err = capsys.readouterr()
    assert code == 0
    assert json.loads(out)["differences"] == summary["differences"]
    assert summary["differences"] == ["stiff and light differ in more than the laws: actuator.u_max (inf and 300.0)"]
    assert summary["differences"][0] in err


@pytest.mark.parametrize(
    ("names", "flags", "message"),
    [
        (["soft"], [], "1 case file: give 2 to 8 case files."),
        (["soft"] * 9, [], "9 case files: give 2 to 8 case files."),
        (["soft", "soft"], [], "this file is given 2 times. Give each once."),
        (["soft", "none"], [], "none.toml"),
        (["soft", "stiff"], ["--members", "0"], "--members 0: it must be a whole number from 1"),
        (["soft", "stiff"], ["--seed", "-1"], "--seed -1"),
        (["soft", "spread"], [], "spread.plant.m = { percent = 5 }, and "),
        (["soft", "fixed"], [], "spread.plant.m = none, and"),
    ],
)
def test_bad_input_is_refused_in_one_line(cases, tmp_path, capsys, names, flags, message):
    (cases / "spread.toml").write_text(CASE.format(c=150.0).replace("percent = 10", "percent = 5"))
    (cases / "fixed.toml").write_text(CASE.format(c=150.0).partition("[spread]")[0])
    paths = [str(cases / f"{name}.toml") for name in names]
    assert message in refusal(capsys, "compare", *paths, "--out", tmp_path / "out", *flags)
    assert not (tmp_path / "out").exists()


def test_cases_of_one_name_get_different_names(cases, tmp_path):
    other = tmp_path / "soft.toml"
    other.write_text(CASE.format(c=60.0))
    assert [case.name for case in compare._read([str(cases / "soft.toml"), str(other)])] == ["soft (1)", "soft (2)"]


def test_the_picture_counts_every_member(cases):
    case = read_case(cases / "soft.toml")
    system = linearise(case.cascade, case.scenario, case.clock)
    error, held = np.array([3e-6, 1e-6, 9.0, 2e-6]), np.array([True, True, False, True])
    columns = {"settled_rms_error_m": error, "settled_rms_u_V": np.arange(4.0), "lost_at": np.where(held, np.inf, 0.1)}
    one = Compared(dataclasses.replace(case, name="x"), columns, ComparedLoop({"stable": True}, system=system), None)
    axes = comparison_figure([one], [3.0, 4.0, 5.0], (1.0, 2e3)).axes
    S, shares, KS, points = (ax.get_lines()[0].get_xydata() for ax in axes)
    np.testing.assert_allclose(S[:, 1], np.abs(system.sensitivity(S[:, 0])))
    np.testing.assert_allclose(KS[:, 1], np.abs(system.response(KS[:, 0])[:, 2, 0]))
    np.testing.assert_allclose(shares, [[1.0, 0.25], [2.0, 0.5], [3.0, 0.75]])
    np.testing.assert_allclose(points, [[0.0, 3.0], [1.0, 1.0], [3.0, 2.0]])
    assert axes[1].get_legend().get_texts()[0].get_text() == "x (1 lost)"


def test_a_missing_tuner_is_reported(monkeypatch, capsys):
    monkeypatch.setattr(extensions, "GROUP", "ambjax.none")
    said = refusal(capsys, "tune", "case.toml")
    assert said == "ambjax: tune: this command is not installed. Reinstall ambjax with pip.\n"
