"""Runs of `ambjax ensemble`: on processes, on a cluster, interrupted, killed, resumed; and refused input."""

import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from matplotlib.figure import Figure
from profiles import examples, thorough
from texts import refusal, write

from ambjax.__main__ import main
from ambjax.commands import ensemble, study_report
from ambjax.pictures import ensembles

CASE = """
[controller.inversion]
gamma = 1e9
p = 25e-6

[reference]
kind = "sine"
amplitude = 2.5e-3
frequency = 2.0

[sensor]
std = 1e-7
std_z_dot = 1e-7

[clock]
duration = {duration}
sample_period = 1e-4
dt = 5e-5

[spread]
plant.m = {{ percent = 10 }}
initial.z = {{ normal = 1e-6 }}
"""
TINY = CASE.format(duration="2e-3")
# A tenth of a second and two calls of the compiled program for each chunk, so that something can happen in the middle
# of a run. The last one is no whole chunk.
LONGER, MEMBERS, CHUNK, CHUNKS = CASE.format(duration="0.05"), 1000, 96, 11
RUN = ["ensemble", "case.toml", "--members", str(MEMBERS), "--chunk", str(CHUNK), "--seed", "3"]


pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes longer than these ensemble."""
    monkeypatch.setattr(study_report, "_pictures", lambda *_: None)


# Ctrl-C is heard even if the tests run in the background of a shell, which has its children ignore it.
LISTENING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from ambjax.__main__ import main
sys.exit(main())
"""


def begin(out, *flags):
    """Start a study in a separate process group."""
    argv = [sys.executable, "-c", LISTENING, *RUN, "--out", out, *flags]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(argv, text=True, start_new_session=True, **pipes)


def wait_for(condition, running, patience=120.0):
    """Wait until the condition holds; fail if the process ends first."""
    end = time.monotonic() + patience
    while not condition():
        assert running.poll() is None, running.stderr.read()
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)


def finished_chunks(out):
    return len(list(pathlib.Path(out, "chunks").glob("*.npz")))


def group_ends(group, patience=20.0):
    """Return whether no process of the group is left."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def result(out):
    return pathlib.Path(out, "members.npz").read_bytes()


@pytest.mark.thorough
def test_a_cluster_gives_the_same_file_if_a_worker_is_killed(no_pictures):
    distributed = pytest.importorskip("distributed")
    write(LONGER)
    assert main([*RUN, "--out", "here"]) == 0
    several = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with distributed.LocalCluster(**several) as cluster:
        running = begin("there", "--cluster", cluster.scheduler_address)
        wait_for(lambda: finished_chunks("there") >= 2, running)
        assert finished_chunks("there") < CHUNKS - 4
        os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
        err = running.communicate(timeout=240)[1]
    assert running.returncode == 0, err
    assert result("here") == result("there")


# --- interruptions ---


@pytest.mark.slow
@pytest.mark.parametrize("flags", [pytest.param([], id="here"), thorough(["--processes", "2"], id="processes")])
def test_ctrl_c_keeps_the_finished_chunks_and_prints_the_command_to_resume(flags):
    write(LONGER)
    many = 100_000  # so that no machine is done before it is interrupted
    running = begin("out", *flags, "--members", str(many))
    wait_for(lambda: finished_chunks("out") >= 12, running)  # by then every worker has started
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does: the whole group hears it
    err = running.communicate(timeout=120)[1]
    assert running.returncode == 130
    assert group_ends(running.pid)
    kept = finished_chunks("out")
    assert 2 <= kept < many // CHUNK
    said = [line for line in err.splitlines() if line.startswith("ambjax: ")]
    again = "To continue, repeat the command with --out out --resume."
    assert said == [f"ambjax: interrupted: {CHUNK * kept} of {many} members are kept. {again}"]
    assert "Traceback" not in err
    for path in pathlib.Path("out", "chunks").glob("*.npz"):
        with np.load(path) as chunk:
            assert np.isfinite(chunk["rms_error_m"]).all()


@pytest.mark.parametrize("program", ["ambjax", "tuning"])
@pytest.mark.parametrize("calls", [100, 20_000])
def test_ctrl_c_before_the_first_chunk_gives_one_line_and_exit_code_130(program, calls):
    """For example during the import of JAX, which raises an error of its own."""
    write(LONGER)
    argv = ["case.toml", "--out", "out"] if program == "tuning" else [*RUN, "--out", "out"]
    code = EARLY.format(calls=calls, module=f"{program}.__main__")
    done = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    name = {"ambjax": "ambjax", "tuning": "ambjax-tune"}[program]
    assert done.stderr == f"{name}: interrupted.\n"
    assert not pathlib.Path("out").exists()


# The signal comes at a given call of a Python function after listening began: no clock is involved.
EARLY = """
import importlib, os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)
main = importlib.import_module("{module}").main
calls = 0

def count(frame, event, argument):
    global calls
    calls += event == "call"
    if calls == {calls}:
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGINT)

class Listener(threading.Thread):
    def start(self):
        super().start()
        sys.setprofile(count)

threading.Thread = Listener
sys.exit(main())
"""


@pytest.mark.thorough
def test_a_study_killed_at_any_instant_and_resumed_on_other_processes_gives_the_same_file(capsys, monkeypatch):
    write(LONGER)
    with monkeypatch.context() as hasty:
        hasty.setattr(study_report, "_pictures", lambda *_: None)
        assert main([*RUN, "--out", "whole"]) == 0
    # a fan is another program; tests/test_descriptions.py draws one
    monkeypatch.setattr(study_report, "_bands", lambda *_: ())
    monkeypatch.setattr(ensembles, "fan", Figure)
    dice, early = random.Random(3), 0
    count = examples(1, 10)
    for n in range(count):
        out, places = f"cut-{n}", [[], ["--processes", "2"]]
        running = begin(out, *places[n % 2])
        after = dice.randrange(CHUNKS)
        wait_for(lambda out=out, after=after: finished_chunks(out) >= after or done(out), running)
        time.sleep(dice.uniform(0, 0.2))
        os.kill(running.pid, signal.SIGKILL)
        running.communicate()
        assert group_ends(running.pid), "a worker process outlives its parent"
        early += not done(out)
        resume = ["--resume"] if pathlib.Path(out, "study.json").exists() else []
        assert main([*RUN, "--out", out, *places[1 - n % 2], *resume]) == 0
        assert result(out) == result("whole")
        assert not pathlib.Path(out, "chunks").exists()
        written = capsys.readouterr().out.splitlines()[-1]
        assert written == f"written: {out}/members.npz, summary.json, fan.png, histograms.png, tornado.png"
        for path in written.removeprefix(f"written: {out}/").split(", "):
            assert pathlib.Path(out, path).stat().st_size > 0
    assert early >= count / 2, "the runs were over before they could be killed"


def done(out):
    return pathlib.Path(out, "members.npz").exists()


@pytest.mark.slow
def test_a_finished_study_is_not_run_again(no_pictures, monkeypatch, capsys):
    write(TINY)
    argv = ["ensemble", "case.toml", "--members", "5", "--out", "out", "--json"]
    assert main(argv) == 0
    first, members = capsys.readouterr().out, result("out")
    pathlib.Path("out", "chunks").mkdir()  # as a kill in the last moment leaves it
    monkeypatch.setattr(ensemble, "_compute", None)
    assert main([*argv, "--resume"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(first)
    assert result("out") == members
    assert not pathlib.Path("out", "chunks").exists()


# --- the sliding step ---

# A sign so hard that explicit steps would have to be a nanosecond long.
HARD = TINY.replace("gamma = 1e9\np = 25e-6", "gamma = 3.5e5\np = 25.0").replace("2e-3", "2e-2")


@pytest.mark.thorough
def test_the_error_of_the_sliding_step_is_measured_and_printed(no_pictures, capsys):
    write(HARD.replace("dt = 5e-5", 'method = "sliding"'))
    assert main(["ensemble", "case.toml", "--members", "20", "--seed", "3", "--out", "out", "--json"]) == 0
    out, err = capsys.readouterr()
    error = json.loads(out)["sliding_step_error"]
    assert error["members"] == 16
    assert error["lost_by_one"] == 0
    write(HARD.replace("dt = 5e-5", 'method = "adaptive"'))
    assert main(["ensemble", "case.toml", "--members", "20", "--seed", "3", "--out", "accurate"]) == 0
    with np.load("out/members.npz") as ours, np.load("accurate/members.npz") as theirs:
        for name in ensemble.COMPARED:
            off = np.abs(ours[name] / theirs[name] - 1)[:16].max()
            assert error[name] == pytest.approx(off, rel=1e-9)  # the same numbers, divided otherwise
            assert f"{name} off by {100 * off:.2g} %" in err
    assert "sliding step against adaptive steps, 16 members: " in err


def test_the_sliding_step_needs_its_inversion_law(capsys):
    text = HARD.replace("dt = 5e-5", 'method = "sliding"')
    text = text.replace("gamma = 3.5e5\np = 25.0", 'kind = "closed-form"')
    err = refused(["ensemble", write(text), "--members", "3"], capsys)
    assert 'clock.method = "sliding": it needs controller.inversion.kind = "adaptive"' in err


# --- bad input ---

LATIN = 'design = "latin-hypercube"\n'
# What is wrong: arguments after the case, what is added to it, what the message must contain.
BAD = {
    "no members": ("ensemble --members 0", "", ["--members 0", "from 1 to 2,147,483,648"]),
    "beyond disk": ("ensemble --members 2147483648", "", ["--members 2147483648", "GB free", "members fit"]),
    "chunk 0": ("ensemble --members 9 --chunk 0", "", ["--chunk 0", "at least 1"]),
    "negative seed": ("ensemble --members 9 --seed -1", "", ["--seed -1", "from 0 to 4294967295"]),
    "resume what": ("ensemble --members 9 --resume", "", ["--resume", "--out DIR"]),
    "resume nothing": ("ensemble --members 9 --resume --out new", "", ["--resume", "no study in new", "--out"]),
    "out a file": ("ensemble --members 9 --out case.toml", "", ["--out case.toml", "cannot write"]),
    "spread simulated": ("simulate", "plant.k_z = { percent = -5 }\n", ["spread.plant.k_z", "-5"]),
    "seed without member": ("simulate --seed 3", "", ["--seed and --members need --member"]),
    "member -1": ("simulate --member -1", "", ["--member -1", "from 0 to 2147483647"]),
    "member N": ("simulate --member 9 --members 9", "", ["--member 9", "from 0 to 8"]),
    "member of none": ("simulate --member 0 --members 0", "", ["--members 0", "from 1"]),
    "member of a hypercube": ("simulate --member 3", LATIN, ["--member", "add --members N", "hypercube"]),
    "member's seed": ("simulate --member 3 --seed -1", "", ["--seed -1", "from 0"]),
}


def refused(argv, capsys):
    """Return the line of a refusal, after a check that nothing is written."""
    before = sorted(pathlib.Path().rglob("*"))
    err = refusal(capsys, *argv)
    assert sorted(pathlib.Path().rglob("*")) == before, "something was written"
    return err


@pytest.mark.parametrize("wrong", BAD)
def test_bad_input_is_refused_in_one_line(wrong, capsys):
    line, more, wanted = BAD[wrong]
    command, *flags = line.split()
    err = refused([command, write(TINY + more), *flags], capsys)
    for part in wanted:
        assert part in err


ON_A_CLUSTER = ["ensemble", "case.toml", "--members", "9", "--out", "new", "--cluster"]


def test_a_missing_package_for_clusters_is_reported_in_one_line(monkeypatch, capsys):
    write(TINY)
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install 'ambjax[cluster]'" in refused([*ON_A_CLUSTER, "tcp://127.0.0.1:9"], capsys)


@pytest.mark.slow  # the slow tests run with the optional packages installed
def test_a_cluster_that_does_not_answer_is_reported_in_one_line(monkeypatch, capsys):
    pytest.importorskip("distributed")
    write(TINY)
    monkeypatch.setattr(ensemble, "PATIENCE", "0.5s")
    assert "--cluster tcp://127.0.0.1:9: no scheduler answers there" in refused(
        [*ON_A_CLUSTER, "tcp://127.0.0.1:9"], capsys
    )
    assert "--cluster nonsense://x: " in refused([*ON_A_CLUSTER, "nonsense://x"], capsys)


@pytest.mark.slow
def test_another_study_in_the_folder_is_refused_and_not_changed(no_pictures, capsys):
    write(TINY)
    argv = ["ensemble", "case.toml", "--members", "9", "--out", "out"]
    assert main(argv) == 0
    capsys.readouterr()
    assert "--out out: it already holds a study. Add --resume" in refused(argv, capsys)
    assert "another study: seed is " in refused([*argv, "--seed", "5", "--resume"], capsys)
    for text in ("3", "[1]"):  # tests/test_damage.py has other damage, tests/test_ensemble.py other differences
        write(text, "out/study.json")
        assert "study.json: cannot be read" in refused([*argv, "--resume"], capsys)
    pathlib.Path("out/study.json").unlink()
    assert "it holds results, but no study.json" in refused(argv, capsys)
