"""A replayed member equals that of the ensemble, bit by bit; printed commands are valid.

The loops have converters and signs without a layer: a difference in the last bit grows until two runs have nothing in
common. So a replay in other arithmetic, even if that is as exact, is another run.
"""

import dataclasses
import json
import pathlib
import re
import shlex
import sys

import numpy as np
import pytest
from texts import write

from ambjax.__main__ import main, parser
from ambjax.cases.reader import read_case
from ambjax.cases.template_text import template
from ambjax.commands import study_report
from ambjax.ensemble import replay as replaying
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.study import Study
from ambjax.ensemble.worker import CALL, chunk
from ambjax.simulation.metrics import Metrics
from tuning.__main__ import parser as tuner

# 16 kHz, converters of 14 bits, a Kalman observer, signs without a layer, a plant off by up to 10 %.
CHANGES = {
    "duration = 0.3 ": "duration = 0.08 ",
    "sample_period = 5e-5": "sample_period = 6.25e-5",
    "settle = 0.05": "settle = 0.02",
    "bits = 12": "bits = 14",
    "start = 0.1 ": "start = 0.04 ",
    "stop = 0.2 ": "stop = 0.06 ",
    "initial.z = { uniform = [-1e-4, 1e-4] }": "plant.R = { percent = 10 }",
}


def changed(text, changes):
    for old, new in changes.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


CASE = changed(template("rig"), CHANGES)
SEED, MEMBERS = 3, 66
pytestmark = pytest.mark.usefixtures("elsewhere")


def study_of(text, members=MEMBERS):
    case = read_case(write(text))
    return Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, SEED, members)


def no_pictures(patch):
    """Drawing takes longer than these runs."""
    patch.setattr(study_report, "_pictures", lambda *_: None)
    patch.setattr("ambjax.commands.simulate.drawn", lambda *_: None)


def commands(text):
    """Return the commands of ambjax in a text: between backticks or quotes, or after a colon to the end of the line."""
    found = re.findall(r"`(ambjax [^`\n]*)`|'(ambjax [^'\n]*)'|: (ambjax [^\n]+)$", text, re.M)
    return [next(filter(None, one)) for one in found]


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Folder, printed text, columns and summary of an ensemble of a case whose file name contains a space."""
    folder = tmp_path_factory.mktemp("printed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder.parent / "cache"))
        no_pictures(patch)
        write(CASE, "my case.toml")
        words = ["ensemble", "my case.toml", "--members", str(MEMBERS), "--seed", str(SEED), "--out", "out"]
        with pathlib.Path("said").open("w") as said:
            patch.setattr(sys, "stdout", said)
            assert main(words) == 0
        with np.load("out/members.npz") as file:
            columns = dict(file)
        summary = json.loads(pathlib.Path("out/summary.json").read_text())
        return folder, pathlib.Path("said").read_text(), columns, summary


@pytest.mark.slow
def test_the_printed_command_replays_the_worst_member(printed, monkeypatch, capsys):
    folder, said, columns, summary = printed
    monkeypatch.chdir(folder)
    no_pictures(monkeypatch)
    monkeypatch.setattr(replaying, "SEGMENT", 300)  # four stretches, the last of which the run does not fill
    (line,) = commands(said)
    assert line == summary["worst"][0]["replay"]
    program, *argv = shlex.split(line)
    assert program == "ambjax"
    assert main([*argv, "--json", "--out", "alone"]) == 0
    answer = capsys.readouterr()
    assert "trajectory.npz" not in answer.err  # no deviation to report
    metrics = json.loads(answer.out)
    worst = summary["worst"][0]["index"]
    assert metrics["settled_max_abs_error_m"] == summary["metrics"]["settled_max_abs_error_m"]["max"]
    shared = [name for name in columns if name in metrics]
    assert len(shared) > 12
    for name in shared:
        value = columns[name][worst]
        assert metrics[name] == (value if np.isfinite(value) else None), name
    # the written trajectory is that of the metrics; sums of squares in another order: a unit in the last place a sample
    with np.load("alone/trajectory.npz") as rows:
        error, late = rows["z"] - rows["r"], rows["t"] >= 0.02
    assert np.sqrt(np.mean(error**2)) == pytest.approx(metrics["rms_error_m"], rel=1e-12)
    assert np.sqrt(np.mean(error[late] ** 2)) == pytest.approx(metrics["settled_rms_error_m"], rel=1e-12)
    assert metrics["trajectory_deviation"] <= len(error) * np.finfo(float).eps


@pytest.mark.slow
def test_results_of_a_chaotic_loop_do_not_depend_on_the_division_of_the_ensemble(printed):
    _, _, columns, _ = printed
    study = study_of(CASE)
    few = np.arange(40, 60)
    for found in (
        chunk(study, 40, 60, 20),  # other lanes, other companions
        chunk(study, 40, 60, 7, threads=2),
        chunk(dataclasses.replace(study, members=1000), 40, 60, 64),
    ):
        for name, column in found.items():
            np.testing.assert_array_equal(column, columns[name][few], err_msg=name)
    cascade, scenario = study.batch(few)
    nudged = dataclasses.replace(scenario.plant, m=np.nextafter(scenario.plant.m, np.inf))
    fold = Metrics.of(study.settle, scenario)
    near = run_ensemble(cascade, dataclasses.replace(scenario, plant=nudged), study.clock, fold=fold, call=CALL).metrics
    ratio = near["settled_max_abs_error_m"] / columns["settled_max_abs_error_m"][few]
    # from 1e-16 of the mass to per cents of the error: what is equal above is equal for a reason
    assert np.median(np.abs(ratio - 1)) > 1e-3


# --- commands in messages and files ---

LOST = """
[clock]
duration = 0.02
[controller.inversion]
gamma = 1000.0
[reference]
kind = "sine"
amplitude = 2.5e-3
frequency = 2.0
"""
# Words that print commands, their exit code, and the printed commands; None: those that a text of many lines contains.
PRINTED = {
    "a rotor is lost": (
        ["simulate", "my case.toml", "--out", "lost"],
        1,
        {"check 'my case.toml'", "tune 'my case.toml'"},
    ),
    "a condition fails": (["check", "my case.toml"], 1, {"tune 'my case.toml'"}),
    "an option lacks": (["ensemble", "my case.toml"], 2, {"ensemble --help"}),
    "no case file": (["check", "no.toml"], 2, {"template"}),
    "the list of templates": (["template"], 0, None),
    "a template": (["template", "rig"], 0, None),
    "an export": (["export", "my case.toml", "--out", "c"], 0, None),
}


@pytest.mark.parametrize(
    "what",
    [pytest.param(x, marks=pytest.mark.slow if x in ("a rotor is lost", "a condition fails") else ()) for x in PRINTED],
)
def test_printed_commands_are_valid(what, monkeypatch, capsys):
    """The only part that some of them lack is the name of the case."""
    no_pictures(monkeypatch)
    words, code, expected = PRINTED[what]
    write("{", "no.toml")
    write(CASE if what == "an export" else LOST, "my case.toml")
    assert ended(lambda: main(words)) == code
    answer = capsys.readouterr()
    text = answer.out + answer.err + "".join(path.read_text() for path in pathlib.Path("c").glob("README.md"))
    found = {line.removeprefix("ambjax ") for line in commands(text)}
    assert {line for line in found if "CASE" not in line} == expected if expected else found
    for line in found:
        command, *rest = (word for word in shlex.split(line) if word != "CASE.toml")
        given = command == "template" or any(word == "--help" or word.endswith(".toml") for word in rest)
        argv = [*([] if command == "tune" else [command]), *([] if given else ["case.toml"]), *rest]
        parse = (tuner() if command == "tune" else parser()).parse_args
        assert ended(lambda parse=parse, argv=argv: parse(argv) and 0) == 0, line


def ended(call):
    """Return the exit code of a command, also if it raises one."""
    try:
        return call()
    except SystemExit as end:
        return end.code or 0


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("[clock]\nduration = 0.05\n", "ambjax simulate 'my case.toml'"),
        (
            changed(CASE, {"[spread]\n": '[spread]\ndesign = "latin-hypercube"\n'}),
            "ambjax simulate 'my case.toml' --member 2 --seed 3 --members 66",
        ),
    ],
    ids=["no noise and no spread", "latin hypercube"],
)
def test_a_replay_needs_no_member_without_noise_and_the_size_of_a_latin_hypercube(text, command):
    assert study_of(text).command("my case.toml", 2) == command
