"""`ambjax compare --tune`: tunings that end are kept, whatever happens to the others, and `--resume` continues."""

import argparse
import json
import math
import os
import pathlib
import re
import signal
import time

import pytest
from bowl import World, document, instead_of_engines
from test_own_laws import LAW
from texts import refusal
from tomlkit import dumps

import tuning.command
import tuning.report.folder
from ambjax.__main__ import main
from ambjax.cases.reader import read_case
from ambjax.commands.comparison_tuning import tuned_cases
from ambjax.host.interrupts import exit_on_interrupt

PATHS = ("a.toml", "b.toml", "c.toml")


def write(path, start, **tune):
    """Write a case whose search starts at c = `start`."""
    tables = {"controller": {"position": {"c": start, "k": 30.0}}}
    pathlib.Path(path).write_text(dumps(document(tables, **{"held_out": 0} | tune)))


@pytest.fixture
def world(tmp_path, monkeypatch):
    """Three cases in the current folder, whose tunings take milliseconds. No picture is drawn."""
    monkeypatch.chdir(tmp_path)
    one = World()
    instead_of_engines(monkeypatch, one)
    monkeypatch.setattr(tuning.report.folder, "_pictures", lambda *_: None)
    for path, start in zip(PATHS, (20.0, 40.0, 200.0), strict=True):
        write(path, start)
    return one


def tune(**flags):
    args = argparse.Namespace(cases=PATHS, tune=True, out="out", **{"resume": False, "force": False} | flags)
    with exit_on_interrupt("ambjax"):
        return tuned_cases([read_case(path) for path in PATHS], pathlib.Path("out"), args)


def position(case):
    return float(case.cascade.position.c)


def written():
    """Return the time of the last change of each tuned.toml by case."""
    return {path.parent.name[-1]: path.stat().st_mtime_ns for path in pathlib.Path("out").glob("*/tuned.toml")}


def test_a_case_that_cannot_be_tuned_does_not_cost_the_others(world):
    write("b.toml", 40.0, bounds={"controller": {"position": {"c": [50.0, 1000.0]}}})
    with pytest.raises(ValueError, match=r"1 of 3 .* b\.toml: controller\.position\.c = 40: .* --out out --resume"):
        tune()
    before = written()
    assert set(before) == {"a", "c"}
    write("b.toml", 40.0)
    with pytest.raises(ValueError, match=r"tuned-a, tuned-c.*--resume"):
        tune()
    world.calls.clear()
    found = tune(resume=True)
    after = written()
    assert before.items() < after.items()
    assert [position(case) for case in found] == pytest.approx([100.0] * 3, rel=0.01)  # `World.best`
    assert [case.name for case in found] == ["a", "b", "c"]
    assert world.calls
    world.calls.clear()
    assert [position(case) for case in tune(resume=True)] == [position(case) for case in found]
    assert written() == after
    assert not world.calls
    tune(force=True)
    assert min(written().values()) > max(after.values())


@pytest.mark.parametrize("change", ["settings", "case", "answer"])
def test_what_has_changed_is_not_reused(world, change):
    found, before = tune(), written()
    if change == "answer":
        path = pathlib.Path("out/tuned-b/tuned.toml")
        path.write_text(path.read_text().replace(f"c = {position(found[1])!r}", "c = 123.0"))
        assert position(read_case(path)) == 123.0
        assert [position(case) for case in tune(resume=True)] == [position(case) for case in found]
        return
    for path, start in zip(PATHS, (20.0, 40.0, 200.0), strict=True):
        members = {"members": 5} if change == "settings" and path == "a.toml" else {}
        write(path, 41.0 if (change, path) == ("case", "b.toml") else start, **members)
    count, key = (3, "tune.members is 4") if change == "settings" else (1, "c is 40.0")
    with pytest.raises(ValueError, match=rf"{count} of 3 .*{key} in the file"):
        tune(resume=True)
    assert written() == before


def test_a_case_without_gains_is_taken_as_it_is(world, capsys):
    own = re.sub(r"damp: .*", "", re.sub(r"spring: .*", 'demand = "voltage"', LAW))
    pathlib.Path("own.py").write_text(own.replace("self.spring", "1e4").replace("self.damp", "400.0"))
    stages = {"position": "own.py:PD", "inversion": "linearised", "current": "open-loop"}
    laws = {stage: {"kind": kind} for stage, kind in stages.items()}
    raw = {name: table for name, table in document().items() if name != "tune"}
    pathlib.Path("b.toml").write_text(dumps(raw | {"controller": laws}))
    write("c.toml", 200.0, gains=[], bounds={})
    found = tune()
    assert [case.cascade for case in found[1:]] == [read_case(path).cascade for path in PATHS[1:]]
    assert position(found[0]) == pytest.approx(100.0, rel=0.01)
    assert capsys.readouterr().err.count("no gains to tune") == 2
    assert set(written()) == {"a"}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--resume"], "Add --tune"),
        (["--tune", "--resume"], "Give it as --out"),
        (["--tune", "--resume", "--out", "none"], "--out none does not exist"),
    ],
)
def test_resume_needs_the_folder_of_a_comparison(world, capsys, flags, message):
    assert message in refusal(capsys, "compare", "a.toml", "b.toml", *flags)
    assert not pathlib.Path("out").exists()


@pytest.fixture
def interruptible():
    """SIGINT arrives, also if the tests run in the background of a shell that ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.thorough
@pytest.mark.usefixtures("interruptible")
def test_a_comparison_interrupted_and_resumed_is_the_uninterrupted_one(world, capsys):
    """Ctrl-C arrives in the search of the second case."""
    compare = ["compare", "a.toml", "b.toml", "--tune", "--members", "2", "--json"]
    assert main([*compare, "--out", "whole"]) in (0, 1)
    printed, err = capsys.readouterr()
    assert "tune.limits" in err
    laws = [case["laws"]["position"]["c"] for case in json.loads(printed)["cases"]]  # and nothing else there
    assert laws == pytest.approx([100.0] * 2, rel=0.01)  # `World.best`
    begun, stop = [], True

    def limit(seed, number, stressed, accurate):
        if stop and pathlib.Path("cut/tuned-b/checkpoints/round-1.npz").exists() and not begun:
            begun.append(True)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.5)
        return math.inf

    world.limit = limit
    assert main([*compare, "--out", "cut"]) == 130
    assert "--out cut --resume" in capsys.readouterr().err
    stop, before = False, pathlib.Path("cut/tuned-a/tuned.toml").stat().st_mtime_ns
    assert main([*compare, "--out", "cut", "--resume"]) in (0, 1)
    whole, again = (json.loads(pathlib.Path(out, "compare.json").read_text()) for out in ("whole", "cut"))
    assert again == whole
    assert pathlib.Path("cut/tuned-a/tuned.toml").stat().st_mtime_ns == before
