"""An error in a description of a result costs this description, with one line on stderr, and never the result."""

import json
import pathlib

import numpy as np
import pytest
from test_end_to_end import CASES, COMMANDS, SAMPLED
from texts import write

from ambjax.__main__ import main
from ambjax.commands import outputs

pytestmark = pytest.mark.usefixtures("elsewhere")


def broken(*_, **__):
    raise TypeError("'>' not supported between instances of 'NoneType' and 'NoneType'")


# For each description: the command, the function that makes it, and the file that is then missing ('': printed text).
FAILING = {
    "overview": ("simulate", "ambjax.pictures.overview.overview", "overview.png"),
    "fan": ("ensemble", "ambjax.pictures.fans.fan", "fan.png"),
    "histograms": ("ensemble", "ambjax.pictures.histograms.histograms", "histograms.png"),
    "tornado": ("ensemble", "ambjax.pictures.tornado.tornado", "tornado.png"),
    "summary": ("ensemble", "ambjax.commands.study_report._summary", "summary.json"),
    "table of an ensemble": ("ensemble", "ambjax.commands.study_report.study_tables", ""),
    "map": ("map", "ambjax.pictures.heatmaps.maps", "map.png"),
    "table of a map": ("map", "ambjax.commands.map._text", ""),
    "frequency": ("sensitivity", "ambjax.pictures.frequency.sensitivity_picture", "sensitivity.png"),
    "table of the sensitivity": ("sensitivity", "ambjax.commands.sensitivity.text_of", ""),
    "comparison": ("compare", "ambjax.pictures.comparison.comparison", "compare.png"),
    "page of a comparison": ("compare", "ambjax.commands.compare.render_page", "compare.html"),
    "table of a comparison": ("compare", "ambjax.commands.compare.comparison_table", ""),
}


@pytest.mark.parametrize("name", FAILING)
def test_an_error_in_a_description_costs_only_that_description(name, monkeypatch, capsys):
    command, function, missing = FAILING[name]
    monkeypatch.setattr(outputs, "STRICT", False)
    monkeypatch.setattr(function, broken)
    for file, text in zip(("first.toml", "second.toml"), CASES["bearing"], strict=True):
        write(text, file)
    words, names = COMMANDS[command]
    words = [word for word in words if word != "--tune"]
    assert main([*words, "--out", "out"]) == 0
    out, err = capsys.readouterr()
    (line,) = (line for line in err.splitlines() if " is left out: " in line)
    assert "TypeError: '>' not supported" in line
    assert "test_descriptions.py, line" in line
    assert "report it" in line
    results = {name for name in names if not name.startswith("tuned-")}
    assert {path.name for path in pathlib.Path("out").iterdir()} >= results - {missing}
    if missing:
        assert not pathlib.Path("out", missing).exists()
        assert missing not in out
    for path in pathlib.Path("out").glob("*.json"):
        json.loads(path.read_text())


def test_a_verification_that_ends_with_an_error_is_not_a_proof(monkeypatch, capsys):
    monkeypatch.setattr(outputs, "STRICT", False)
    monkeypatch.setattr("ambjax.codegen.verify.verify", broken)
    monkeypatch.setattr("ambjax.codegen.verify.COUNT", 10)
    write(CASES["bearing"][0], "first.toml")
    assert main([*SAMPLED["export"][0], "--out", "out"]) == 1
    out, err = capsys.readouterr()
    assert "the verification is left out: TypeError" in err
    assert "Some checks FAIL." in out
    assert json.loads(pathlib.Path("out/verify.json").read_text())["ok"] is False
    assert pathlib.Path("out/first.c").stat().st_size > 0


def test_an_ensemble_without_a_survivor_has_a_report(capsys):
    """The paper's printed gains lose every member. No quantity then explains the error of the survivors."""
    write(CASES["paper"][0], "first.toml")
    assert main([*COMMANDS["ensemble"][0], "--out", "out"]) == 1
    assert " is left out: " not in capsys.readouterr().err
    assert {path.name for path in pathlib.Path("out").iterdir()} >= set(COMMANDS["ensemble"][1])
    assert json.loads(pathlib.Path("out/summary.json").read_text())["survivors"] == 0


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_error_that_concerns_the_result_too_is_raised(error, monkeypatch):
    monkeypatch.setattr(outputs, "STRICT", False)

    def fail():
        raise error

    with pytest.raises(type(error)):
        outputs.described("a picture", fail)


def test_a_result_of_a_description_is_returned_and_errors_for_users_are_no_defects(monkeypatch, capsys):
    monkeypatch.setattr(outputs, "STRICT", False)
    assert outputs.described("a number", lambda: 3) == 3

    def refuse():
        raise ValueError("tune.front = 9: it must be at most 5")

    assert outputs.described("the front", refuse) is None
    assert capsys.readouterr().err == "the front is left out: tune.front = 9: it must be at most 5.\n"
    assert np.isfinite(outputs.described("an array", lambda: np.ones(2))).all()
