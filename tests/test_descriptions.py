"""An error in a description of a result costs this description, with one line on stderr, and never the result."""

import json
import pathlib

import pytest
from texts import write

from ambjax.__main__ import main
from ambjax.results import outputs

pytestmark = pytest.mark.usefixtures("elsewhere")
# A bearing from a data sheet on a processor, without a velocity sensor.
BEARING = """
plant = { m = 2.4, k_z = 0.0, mu_0 = 1.2566e-6, n = 300.0, A = 2.0e-4, s_0 = 5e-4, i_0 = 2.0, R = 1.0 }
controller.observer = { kind = "kalman" }
controller.position = { kind = "pid", k_p = 2e5 }
controller.inversion = { kind = "linearised" }
controller.current = { kind = "pi" }
processor = { delay = 1.0 }
sensor = { std = 3e-7, std_i = 2e-3, velocity = false, bits = 14 }
actuator = { u_max = 72.0 }
initial = { z = 2e-5 }
clock = { duration = 0.03, sample_period = 6.25e-5 }
run = { settle = 0.015 }
spread = { plant.m = { percent = 10 } }
"""
MAP = ["map", "case.toml", "--x", "plant.m=-10%:10%:2", "--y", "initial.z=1e-5:2e-5:2"]
# For each command: its arguments, and the files that it writes.
COMMANDS = {
    "ensemble": (
        ["ensemble", "case.toml", "--members", "4"],
        ("members.npz", "summary.json", "fan.png", "histograms.png"),
    ),
    "simulate": (["simulate", "case.toml"], ("trajectory.npz", "metrics.json", "overview.png")),
    "map": (MAP, ("map.json", "map.png")),
    "sensitivity": (["sensitivity", "case.toml", "--members", "2"], ("sensitivity.json", "sensitivity.png")),
    "compare": (
        ["compare", "case.toml", "second.toml", "--members", "4"],
        ("compare.json", "compare.html", "compare.png"),
    ),
}


def broken(*_, **__):
    raise TypeError("'>' not supported between instances of 'NoneType' and 'NoneType'")


# For each command: the functions that make its descriptions, with the file that is then missing ('': printed text).
FAILING = {
    "ensemble": {
        "ambjax.pictures.ensembles.fan": "fan.png",
        "ambjax.pictures.ensembles.histogram_figure": "histograms.png",
        "ambjax.pictures.ensembles.tornado": "tornado.png",
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
        "ambjax.pictures.frequency.comparison_figure": "compare.png",
        "ambjax.commands.compare.render_page": "compare.html",
        "ambjax.commands.compare.comparison_table": "",
    },
}
MARKS = {"simulate": (), "ensemble": pytest.mark.thorough, "map": pytest.mark.thorough}


@pytest.mark.parametrize("name", [pytest.param(x, marks=MARKS.get(x, pytest.mark.slow)) for x in FAILING])
def test_an_error_in_a_description_costs_only_that_description(name, monkeypatch, capsys):
    command, missing = name.partition(",")[0], {file for file in FAILING[name].values() if file}
    monkeypatch.setattr(outputs, "STRICT", False)
    for function in FAILING[name]:
        monkeypatch.setattr(function, broken)
    write(BEARING)
    write(BEARING.replace("k_p = 2e5", "k_p = 3e5"), "second.toml")
    words, names = COMMANDS[command]
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
    write(BEARING)
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
