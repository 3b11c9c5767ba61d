"""An error in a description of a result costs this description, with one line on stderr, and never the result."""

import json
import pathlib

import pytest
from test_end_to_end import CASES, COMMANDS
from texts import write

from ambjax.__main__ import main
from ambjax.results import outputs

pytestmark = pytest.mark.usefixtures("elsewhere")
COMPARE = ["compare", "case.toml", "second.toml", "--members", "4"]
EVERY = COMMANDS | {
    "simulate": (["simulate", "case.toml"], ("trajectory.npz", "metrics.json", "overview.png")),
    "compare": (COMPARE, ("compare.json", "compare.html", "compare.png")),
}


def broken(*_, **__):
    raise TypeError("'>' not supported between instances of 'NoneType' and 'NoneType'")


# For each command: the functions that make its descriptions, with the file that is then missing ('': printed text).
FAILING = {
    "ensemble": {
        "ambjax.pictures.fans.fan": "fan.png",
        "ambjax.pictures.histograms.histogram_figure": "histograms.png",
        "ambjax.pictures.tornado.tornado": "tornado.png",
        "ambjax.commands.study_report.study_tables": "",
    },
    "ensemble, summary": {"ambjax.commands.study_report._summary": "summary.json"},
    "simulate": {"ambjax.pictures.overview.overview_figure": "overview.png"},
    "map": {"ambjax.pictures.heatmaps.map_figure": "map.png", "ambjax.commands.map._text": ""},
    "sensitivity": {
        "ambjax.pictures.frequency.frequency_figure": "sensitivity.png",
        "ambjax.commands.sensitivity.text_of": "",
    },
    "compare": {
        "ambjax.pictures.comparison.comparison_figure": "compare.png",
        "ambjax.commands.compare.render_page": "compare.html",
        "ambjax.commands.compare.comparison_table": "",
    },
}


@pytest.mark.parametrize("name", [x if x == "simulate" else pytest.param(x, marks=pytest.mark.slow) for x in FAILING])
def test_an_error_in_a_description_costs_only_that_description(name, monkeypatch, capsys):
    command, missing = name.partition(",")[0], {file for file in FAILING[name].values() if file}
    monkeypatch.setattr(outputs, "STRICT", False)
    for function in FAILING[name]:
        monkeypatch.setattr(function, broken)
    write(CASES["bearing"])
    write(CASES["bearing"].replace("k_p = 2e5", "k_p = 3e5"), "second.toml")
    words, names = EVERY[command]
    assert main([*words, "--out", "out"]) == 0
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if " is left out: " in line]
    assert len(lines) == len(FAILING[name])
    for part in ("TypeError: '>' not supported", "test_descriptions.py, line", "report it"):
        assert all(part in line for line in lines)
    written = {path.name for path in pathlib.Path("out").iterdir()}
    assert set(names) - missing <= written
    assert not written & missing
    assert not any(file in out for file in missing)
    for path in pathlib.Path("out").glob("*.json"):
        json.loads(path.read_text())


@pytest.mark.slow
def test_a_verification_that_ends_with_an_error_is_not_a_proof(monkeypatch, capsys):
    monkeypatch.setattr(outputs, "STRICT", False)
    monkeypatch.setattr("ambjax.codegen.verify.verify", broken)
    monkeypatch.setattr("ambjax.codegen.verify.COUNT", 10)
    write(CASES["bearing"])
    assert main(["export", "case.toml", "--verify", "--out", "out"]) == 1
    out, err = capsys.readouterr()
    assert "the verification is left out: TypeError" in err
    assert "Some checks FAIL." in out
    assert json.loads(pathlib.Path("out/verify.json").read_text())["ok"] is False
    assert pathlib.Path("out/amb_case.c").stat().st_size > 0


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_error_that_concerns_the_result_too_is_raised(error, monkeypatch):
    monkeypatch.setattr(outputs, "STRICT", False)

    def fail():
        raise error

    with pytest.raises(type(error)):
        outputs.described("a picture", fail)
