"""The report of the tuner if facts are absent, and the answer if a description fails."""

import dataclasses
import itertools
import json
import re
import tomllib

import numpy as np
import pytest
from bowl import World, case_file, instead_of_engines
from matplotlib.figure import Figure
from test_tuning_outcome import losing

import tuning.command
import tuning.report.folder
import tuning.rounds
from ambjax.results import outputs
from ambjax.text.web_page import render_page
from tuning.__main__ import main
from tuning.report import document as report
from tuning.report import judging, pictures
from tuning.report.outcome import outcome_of, verdict
from tuning.report.sensitivity_table import UNSTABLE
from tuning.report.sensitivity_table import line as sensitivity_line

# --- one member's peak of |S| --------------------------------------------------------------------------------------

UNKNOWN = "it cannot be linearised: no equilibrium"
# The linear peak of a member: known, unstable, not computed. Its injection: none (continuous time), known, lost.
LINEAR = {
    "2": {"linear": 2.0, "frequency_hz": 300.0, "zone": "A", "why": ""},
    "unstable": {"linear": None, "frequency_hz": None, "zone": "D", "why": UNSTABLE},
    "unknown": {"linear": None, "frequency_hz": None, "zone": None, "why": UNKNOWN},
}


def injection(peak=None, low=None, high=None, saturated=None, zone=None, lost=0, repetitions=2):
    row = {"peak": peak, "low": low, "high": high, "at_hz": peak and 400.0, "saturated": saturated}
    return row | {"injected_zone": zone, "repetitions": repetitions, "lost": lost}


INJECTED = {
    "none": injection(repetitions=0),
    "1.5": injection(1.5, 1.4, 1.6, 0.0, "A"),
    "3.5": injection(3.5, None, None, 0.1, "B"),
    "one of two lost": injection(1.5, None, None, 0.0, "D", lost=1),
    "all lost": injection(zone="D", lost=2),
}
# What the report says, by linear peak, injection, and whether only injections decide.
SAID = {
    ("2", "none", False): "at most 2 (at 300 Hz) over the worst members: zone A",
    ("2", "1.5", False): "at most 2 (at 300 Hz) over the worst members: zone A",
    ("2", "3.5", False): "at most 3.5 (at 400 Hz) over the worst members: zone B",
    ("2", "1.5", True): "at most 1.5 (at 400 Hz)",
    ("unstable", "none", False): f"no peak of |S| for member 7: {UNSTABLE}: zone D",
    ("unknown", "none", False): f"no peak of |S| for member 7: {UNKNOWN}.",
    ("unstable", "3.5", True): "at most 3.5 (at 400 Hz)",
}


def peak_of(linear, injected):
    return {"member": 7} | LINEAR[linear] | INJECTED[injected]


def sensitivities():
    """Every combination of a linear and an injected peak, alone and beside a member whose peak is known."""
    known = {"member": 3} | LINEAR["2"] | INJECTED["1.5"]
    for linear, injected, decides in itertools.product(LINEAR, INJECTED, (False, True)):
        if decides and injected == "none":
            continue  # no injection decides in continuous time
        one, continuous = peak_of(linear, injected), injected == "none"
        beside = known | INJECTED["none"] if continuous else known
        for members in ([one], [one, beside], [beside, one]):
            yield {
                "members": members,
                "injected": not continuous,
                "decides": decides,
                "tried": decides,
                "zones": [3.0, 4.0, 5.0],
            }


@pytest.mark.parametrize("kind", SAID)
def test_the_printed_peak_is_the_one_that_counts(kind):
    linear, injected, decides = kind
    found = {"members": [peak_of(linear, injected)], "decides": decides}
    assert SAID[kind] in sensitivity_line(found)


# --- every combination of facts ------------------------------------------------------------------------------------


def tuned(world, folder, *flags, **tune):
    """Run the tuner on a Bowl from shell to files. Return its exit code and its output folder."""
    path, out = case_file(folder, **tune)
    with pytest.MonkeyPatch.context() as patch:
        instead_of_engines(patch, world)
        patch.setattr(tuning.rounds, "MOST_ROUNDS", 1)
        return main([str(path), "--out", str(out), "--force", *flags]), out


def facts_of(world, folder, *flags, **tune):
    """Return the facts of such a run."""
    found, examined = [], judging.examined
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning.command, "examined", lambda *args: found.append(examined(*args)) or found[0])
        patch.setattr(tuning.report.folder, "_pictures", lambda *_: None)
        tuned(world, folder, *flags, **tune)
    return found[0]


@pytest.fixture(scope="module")
def facts(tmp_path_factory):
    """The facts of a run in which all members are held, with a front."""
    return facts_of(World(), tmp_path_factory.mktemp("held"), "--pareto")


@pytest.fixture(scope="module")
def all_lost(tmp_path_factory):
    """The facts of a run in which no held-out member is held, before or after."""
    return facts_of(losing(*range(6)), tmp_path_factory.mktemp("lost"), "--pareto")


@pytest.fixture(scope="module")
def unjudged(tmp_path_factory):
    """The facts of a run without held-out members."""
    return facts_of(World(), tmp_path_factory.mktemp("none"), held_out=0)


# Facts that may be absent, and their values then.
ABSENT = {
    "conditions": [], "advice_on_conditions": [], "step_error": None,
    "worst_step_error": None, "worst_member": None, "front": None,
    "sensitivity": None, "stability": None,
}  # fmt: skip


def check_report(facts):
    """Render the report of these facts: nothing raises an error, and no text shows that a fact is absent."""
    text = report.report_markdown(facts)
    assert len(re.findall(r"^- \*\*", text.partition("\n## ")[0], re.MULTILINE)) == 5
    assert not re.search(r"\bNone\b|\bnan\b", text)
    json.dumps(outputs.plain(facts.table), allow_nan=False)
    return text


def judged_again(facts):
    """Return the facts with the outcome and the verdict that follow from them."""
    outcome = outcome_of(facts, 0)
    facts = dataclasses.replace(facts, outcome=outcome.facts())
    return dataclasses.replace(facts, verdict=verdict(facts))


@pytest.mark.slow
def test_the_report_is_complete_for_every_combination_of_ensembles(facts, all_lost, unjudged):
    """Held or lost, before and after; not judged; not verified; no front."""
    ends = {"held": facts, "lost": all_lost, "none": unjudged}
    for before, after in itertools.product(ends, ends):
        if (before == "none") != (after == "none"):
            continue  # both are judged, or none
        mixed = dataclasses.replace(ends[after], before=ends[before].before)
        for refuted, front in itertools.product(("", "accurate steps lose 1 of 4 members"), (facts.front, None)):
            check_report(judged_again(dataclasses.replace(mixed, refuted=refuted, front=front)))


@pytest.mark.slow
def test_the_report_is_complete_for_each_kind_of_peak(facts):
    for found in (None, *sensitivities()):
        text = check_report(dataclasses.replace(facts, sensitivity=found))
        assert ("## Sensitivity" in text) == (found is not None)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["facts", "all_lost", "unjudged"])
def test_the_report_is_complete_without_any_of_the_facts_that_may_be_absent(which, request):
    whole = request.getfixturevalue(which)
    lacking = [{name: value} for name, value in ABSENT.items()]
    gains = [row | {"sensitivity_percent": None, "sensitivity_lost": 0} for row in whole.gains]
    for change in [*lacking, ABSENT | {"gains": gains}]:
        check_report(judged_again(dataclasses.replace(whole, **change)))


def test_a_page_without_pictures_says_so(facts):
    shown = render_page(report.report_markdown(facts), {}, "t")
    assert shown.count("The picture is missing") == 5
    assert "<img" not in shown


# --- a description fails -------------------------------------------------------------------------------------------

NAMES = {
    "tuned.toml", "history.npz", "report.json", "report.md", "report.html", "before.png", "after.png", "spectrum.png",
    "convergence.png", "front.png",
}  # fmt: skip
# Descriptions that fail in one run, and the files that are then missing. Functions of the tuner by module and name.
FAILING = [
    {
        "tuning.report.outcome.prices": set(),
        "tuning.report.document.SECTIONS": set(),
        "tuning.report.judging._conditions": set(),
        "tuning.judge.evaluate.JudgedMembers.worst": set(),
        "tuning.report.judging.changed_gains": set(),
        "tuning.report.outcome.verdict": set(),
        "tuning.report.outcome.remedies": set(),
        "tuning.report.pictures.front": {"front.png"},
    },
    {
        "tuning.report.folder.nominal": {"before.png", "after.png", "spectrum.png"},
        "tuning.report.folder.render_page": {"report.html"},
        "tuning.report.judging.front_table.facts": {"front.png"},
    },
]


def broken(*_, **__):
    raise TypeError("'>' not supported between instances of 'NoneType' and 'NoneType'")


DRAWN = ("nominal", "spectrum", "convergence", "front")


@pytest.fixture
def lenient(monkeypatch):
    """An error in a description does not end the command. Nothing is drawn: that takes most of the time."""
    monkeypatch.setattr(outputs, "STRICT", False)
    monkeypatch.setattr("tuning.report.folder.nominal", lambda *_: object())
    for name in DRAWN:
        monkeypatch.setattr(pictures, name, lambda *_: Figure(figsize=(1, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("failing", FAILING, ids=["descriptions", "files"])
def test_errors_in_descriptions_cost_only_those_descriptions(failing, lenient, monkeypatch, tmp_path, capsys):
    for name in failing:
        if name.endswith("SECTIONS"):
            monkeypatch.setitem(report.SECTIONS, "the gains", broken)
        else:
            monkeypatch.setattr(name, broken)
    code, out = tuned(World(), tmp_path, "--pareto")
    assert code == 0
    names = {path.name for path in out.iterdir() if path.is_file() and "V.toml" not in path.name}
    assert names - {f"tuned_{x}" for x in names} == NAMES - set().union(*failing.values())
    lines = {line for line in capsys.readouterr().err.splitlines() if " is left out: " in line}
    assert len(lines) == len(failing) + ("tuning.report.folder.nominal" in failing)  # the runs before and after
    for line in lines:
        assert "TypeError: '>' not supported" in line
        assert "test_tuning_absent.py, line" in line
        assert "report it" in line
    gains = tomllib.loads((out / "tuned.toml").read_text())["controller"]["position"]
    assert gains["c"] == pytest.approx(100, rel=0.01)  # `World.best`
    assert json.loads((out / "report.json").read_text())["outcome"]["good"]


def test_the_answer_is_kept_if_it_cannot_be_judged(lenient, monkeypatch, tmp_path, capsys):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(judging, "judge", broken)
        code, out = tuned(World(), tmp_path)
    assert code == 1
    assert sorted(path.name for path in out.iterdir() if path.is_file()) == ["history.npz", "tuned.toml"]
    text = (out / "tuned.toml").read_text()
    assert tuning.command.NOT_JUDGED in text
    gains = tomllib.loads(text)["controller"]["position"]
    assert gains["c"] == pytest.approx(100, rel=0.01)  # `World.best`
    assert "--resume" in capsys.readouterr().err
    # the same search is judged later
    with pytest.MonkeyPatch.context() as patch:
        instead_of_engines(patch, World())
        assert main([str(tmp_path / "case.toml"), "--out", str(out), "--resume"]) == 0
    assert tomllib.loads((out / "tuned.toml").read_text())["controller"]["position"] == gains
    assert {path.name for path in out.iterdir() if path.is_file()} == NAMES - {"front.png"}


def test_the_answer_is_kept_if_the_front_fails(lenient, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tuning.rounds, "trace_front", broken)
    code, out = tuned(World(), tmp_path, objective="knee")
    assert code == 0
    assert "the front of error against voltage is left out: TypeError" in capsys.readouterr().err
    gains = tomllib.loads((out / "tuned.toml").read_text())["controller"]["position"]
    np.testing.assert_allclose([gains["c"], gains["k"]], [100, 60], rtol=0.01)  # `World.best`
