"""The command line: outputs, exit codes, and messages for bad input."""

import dataclasses
import errno
import json
import os
import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest
from texts import refusal, write

from ambjax.__main__ import main, parser
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import case_from, read_case
from ambjax.cases.scenario_tables import SIGNALS
from ambjax.cases.template_text import template
from ambjax.host.command_line import run_command
from ambjax.paper.readings import CLOCK, SETTLE, cascade, scenario

SHORT = "[clock]\nduration = 0.05\n"


pytestmark = pytest.mark.usefixtures("elsewhere")


LOAD, TWICE = "[disturbance.q_z]\n", ["put [[disturbance.q_z]] above each, also the first."]
# What is wrong, the file, what the message must contain: the path, the value or the fix.
BAD = {
    "unknown table": ("[plnat]\nm = 1.0\n", ["plnat", "Did you mean 'plant'"]),
    "unknown key": ("[plant]\nmass = 1.0\n", ["plant.mass", "unknown key", "Keys allowed"]),
    "number for a table": ("plant = 3\n", ["plant = 3", "table"]),
    "NaN": ("[plant]\ng = nan\n", ["plant.g = nan", "finite"]),
    "unknown law": ('[controller.position]\nkind = "lqr"\n', ["position.kind", "sliding-mode", "FILE.py:CLASS"]),
    "gain of another law": ('[controller.current]\nkind = "pi"\nk_i = 1.0\n', ["controller.current.k_i", "k_p"]),
    "signal without kind": ("[reference]\namplitude = 1e-3\n", ["reference.kind is missing"]),
    "signal not whole": ('[reference]\nkind = "sine"\namplitude = 1e-3\n', ["reference.frequency is missing"]),
    "bad term": ('[reference]\nkind = "sum"\nterms = [{ kind = "step" }]\n', ["reference.terms[0].amplitude"]),
    "pulse backwards": (LOAD + "kind = 'pulse'\namplitude = 1.0\nstart = 0.5\nstop = 0.4\n", ["stop", "start = 0.5"]),
    "negative noise": ("[sensor]\nstd = -1e-6\n", ["sensor.std", "from 0"]),
    "z beyond the gap": ("[initial]\nz = 6e-3\n", ["initial.z = 0.006", "0.0045"]),
    "clearance beyond the gap": ("[run]\nclearance = 0.01\n", ["run.clearance", "plant.s_0"]),
    "indivisible duration": ("[clock]\nduration = 1.0\nsample_period = 3e-4\n", ["clock.sample_period", "nearest"]),
    "endless run": ("[clock]\nduration = 1e6\n", ["clock.duration", "samples"]),
    "dt that does not divide": ("[clock]\ndt = 3e-5\n", ["clock.dt = 3e-05", "does not divide", "nearest"]),
    "dt a word": ('[clock]\ndt = "fast"\n', ["clock.dt", "auto"]),
    "unstable dt": ("[clock]\ndt = 1e-5\n", ["clock.dt = 1e-05", "stable only up to", "auto"]),
    "unknown method": ('[clock]\ndt = 1e-6\nmethod = "rk5"\n', ["clock.method", "Did you mean 'rk4'"]),
    "a method without its step": ('[clock]\nmethod = "rk4"\n', ['clock.method = "rk4" needs a step', "clock.dt"]),
    "settle behind the last sample": ("[run]\nsettle = 1.99995\n", ["run.settle = 1.99995", "at most 1.9999 s"]),
    "one sample": ("[clock]\nduration = 1e-4\n", ["clock.duration = 0.0001", "one sample", "at least 2", "Lengthen"]),
    "decimal comma": ("[plant]\nm = 2,4\n", ["line 2", "m = 2,4", "decimal number with a point"]),
    "a key twice": ("[plant]\nm = 1\nm = 2\n", ["line 3", "m = 2", "each key once"]),
    "a table twice": ("[plant]\nm = 1\n[plant]\n", ["[plant]", "each table once"]),
    "period in ms": ("[clock]\nduration = 0.02\nsample_period = 0.0625\n", ["longer than", "milliseconds"]),
    "a grade in N": (
        LOAD + "kind = 'unbalance-grade'\nunit = 'N'\ngrade = 2.5\nservice_speed = 1e3\nspeed = 1e3\n",
        ["disturbance.q_z.kind", "m/s^2", "Omit `unit`"],
    ),
    "not TOML": ("[plant\nm = 1\n", ["not valid TOML", "line 1"]),
    "a second load in double brackets": (LOAD + f"[{LOAD[:-1]}]\n", ["is: [[disturbance.q_z]]. ", *TWICE]),
    "a second load in single brackets": (LOAD + LOAD, TWICE),
}  # fmt: skip


@pytest.mark.parametrize("wrong", BAD)
def test_a_bad_case_file_is_refused_in_one_line(wrong, capsys):
    text, wanted = BAD[wrong]
    path = write(text)
    before = sorted(pathlib.Path().iterdir())
    said = refusal(capsys, "simulate", path)
    assert all(part in said for part in (path, *wanted)), said
    assert sorted(pathlib.Path().iterdir()) == before, "something was written"


def test_bad_files_and_folders(capsys):
    pathlib.Path("binary.toml").write_bytes(b"\xff\xfe\x00")
    pathlib.Path("folder.toml").mkdir()
    write(SHORT)
    write("", "file")
    for argv, words in (
        (["simulate", "missing.toml"], "cannot be read (No such file"),
        (["simulate", "folder.toml"], "cannot be read (Is a directory"),
        (["simulate", "binary.toml"], "not a text file"),
        (["simulate", "case.toml", "--out", "file"], "--out file: cannot write there, because file is a file."),
        (["simulate", "case.toml", "--out", "file/below"], "below: cannot write there, because file is a file."),
        (["reproduce", "--out", "/proc/nowhere"], "cannot write"),
    ):
        assert words in refusal(capsys, *argv)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["simulat"], "page, tune. Did you mean 'simulate'? See 'ambjax --help'.\n"),
        (["levitate"], "'levitate' is not a command. It must be one of reproduce, "),
        (["simulate", "case.toml", "--ouput=x"], ": --ouput=x. Did you mean '--out'? See 'ambjax simulate --help'.\n"),
        (["export", "case.toml", "--to", "x"], "unrecognized arguments: --to x. See 'ambjax export --help'.\n"),
        (["tune", "case.toml", "--iteration", "3"], "arguments: --iteration 3. See 'ambjax tune --help'.\n"),
        (["check", "a.toml", "b.toml"], "b.toml"),
    ],
)
def test_bad_flags(argv, words, capsys):
    assert words in refusal(capsys, *argv)


@pytest.mark.parametrize(
    ("number", "advice"), [(errno.ENOSPC, " Free disk space, or write elsewhere."), (errno.ENOENT, "")]
)
def test_only_an_error_of_writing_is_answered_by_advice_on_the_disk(number, advice, capsys):
    def run(args):
        raise OSError(number, os.strerror(number), "x.csv")

    assert run_command(parser(), ["simulate", "case.toml"], run) == 2
    assert capsys.readouterr().err == f"ambjax: x.csv: {os.strerror(number)}.{advice}\n"


def test_a_warning_of_a_library_does_not_reach_stderr():
    """In another process, because pytest turns warnings into errors; -W prints them for developers."""
    code = """
import argparse, sys
import numpy as np
from ambjax.host.command_line import run_command
def run(args):
    np.log(np.zeros(1))
    return 0, None
sys.exit(run_command(argparse.ArgumentParser(), [], run))
"""
    for options, words in (([], ""), (["-W", "default"], "divide by zero")):
        done = subprocess.run([sys.executable, *options, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout == ""
        assert (words in done.stderr) if words else (done.stderr == "")


def test_without_a_command_the_help_lists_the_first_commands(capsys):
    assert main([]) == 0
    listed = re.findall(r"^  ambjax (\w+)", capsys.readouterr().out, re.MULTILINE)
    assert listed == ["template", "simulate", "check", "tune", "export", "page"]


def test_ambjax_finds_the_tuner_in_its_own_package(capsys):
    assert refusal(capsys, "tune", "nowhere.toml").startswith("ambjax tune: nowhere.toml: cannot be read")


@pytest.mark.parametrize("name", ["tracking", "regulation"])
def test_template_is_the_paper(name):
    case = read_case(write(template(name)))
    wanted = scenario(name, "repaired")
    assert case.cascade == cascade("repaired")
    assert (case.clock.samples, case.clock.sample_period, case.settle) == (CLOCK.samples, CLOCK.sample_period, SETTLE)
    t = np.linspace(0, 2, 41)
    assert np.allclose(case.scenario.reference(t), wanted.reference(t), rtol=0, atol=0)
    assert np.allclose(case.scenario.acceleration(t), wanted.acceleration(t), rtol=0, atol=0)


def test_empty_file_gives_the_documented_defaults():
    case = case_from({})
    assert case.cascade == cascade("repaired")
    assert case.scenario.sensor is None
    assert np.isinf(case.scenario.u_max)
    assert (case.clock.samples, case.clock.sample_period) == (20_000, 1e-4)


def test_every_kind_can_be_given_in_a_case_file():
    np.savez("k.npz", A=-1.0, B=1.0, C=1.0, D=1.0)
    for stage, kinds in KINDS.items():
        for kind, law in kinds.items():
            table = {"kind": kind} | ({"file": "k.npz"} if kind == "linear" else {})
            if kind == "open-loop":
                continue  # for a linear controller whose output is a voltage: tests/test_linear_controller.py
            drive = {"actuator": {"mode": "current", "bandwidth": 1e3}} if kind == "amplifier" else {}
            assert isinstance(getattr(case_from({"controller": {stage: table}} | drive).cascade, stage), law)
    numbers = dict.fromkeys(["amplitude", "start", "frequency", "std", "f_low", "unbalance", "grade"], 1e-3)
    numbers |= dict.fromkeys(["stop", "duration", "frequency_end", "f_high", "service_speed"], 1.0)
    for kind, signal in SIGNALS.items():
        names = {field.name for field in dataclasses.fields(signal)}
        special = {"sum": {"terms": [{"kind": "constant"}]}, "table": {"file": write("0,0\n1,1e-3\n", "table.csv")}}
        table = {"kind": kind} | special.get(kind, {k: v for k, v in numbers.items() if k in names})
        if hasattr(signal, "unit"):
            slot = {"N": "q_f", "m/s^2": "q_z"}[signal.unit]
            made = getattr(case_from({"rotor": {"speed": 60.0}, "disturbance": {"q_z": table}}).scenario, slot)
        else:
            made = case_from({"reference": table}).scenario.reference
        assert isinstance(made, signal)


def test_simulate_writes_what_is_documented(capsys):
    path = write(SHORT)
    assert main(["simulate", path, "--out", "there"]) == 0
    with np.load("there/trajectory.npz") as data:
        names = {"t", "z", "z_dot", "i", "i_ref", "u", "v", "v_star", "v_tilde", "sigma", "r", "q_z", "q_i"}
        for name in names | {"z_measured"}:
            assert data[name].shape == (500,)
            assert data[name].dtype == np.float64
            assert np.isfinite(data[name]).all()
        assert np.isinf(data["lost_at"])
        assert str(data["lost_why"]) == ""
        e = data["z"] - data["r"]
    metrics = json.loads(pathlib.Path("there/metrics.json").read_text())
    assert metrics["max_abs_error_m"] == np.abs(e).max()
    assert metrics["lost"] is False
    assert metrics["lost_at_s"] is None
    wanted = {"rms_error_m", "settled_max_abs_error_m", "max_abs_u_V", "rms_u_V", "max_abs_i_A"}
    assert wanted <= set(metrics)
    assert pathlib.Path("there/overview.png").read_bytes().startswith(b"\x89PNG")
    assert "written: there/" in capsys.readouterr().out


def test_files_of_an_earlier_run_are_overwritten_only_with_force(capsys):
    pathlib.Path("out").mkdir()
    pathlib.Path("out/metrics.json").write_text("old")
    said = r"it has metrics.json of an earlier run. Choose another .* with --force"
    assert re.search(said, refusal(capsys, "simulate", write(SHORT), "--out", "out"))
    assert pathlib.Path("out/metrics.json").read_text() == "old"


@pytest.mark.slow
def test_check_exits_with_0_if_the_conditions_hold_and_1_otherwise(capsys):
    sine = SHORT.replace("0.05", "0.02") + '[reference]\nkind = "sine"\namplitude = 2.5e-3\nfrequency = 2.0\n'
    assert main(["check", write(sine), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["holds"] is True
    no = write(sine + "[controller.inversion]\ngamma = 1000.0\n[initial]\ni = 0.3\n")
    assert main(["check", no, "--json"]) == 1
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert err.count("initial.i = 0.3 A") == 1  # a doubt is printed once, and stops nothing
    assert "simulating 0.0" in err  # progress
    assert no in err
    along = next(c for c in summary["conditions"] if "along the run" in c["requires"])
    assert along["gain"] == 1000
    assert along["against"] >= 6.3e4  # |dv/dz z_dot| alone, 2.0e6 * 0.0314, on the printed reference
    assert along["holds"] is False
