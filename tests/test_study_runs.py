"""`ambjax ensemble` as it runs: on processes, on a cluster, interrupted, killed, resumed; and what it refuses."""

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

from ambjax import studies
from ambjax.__main__ import main

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

[clock]
duration = {duration}
sample_period = 1e-4
dt = 5e-5

[spread]
plant.m = {{ percent = 10 }}
initial.z = {{ normal = 1e-6 }}
"""
TINY = CASE.format(duration="2e-3")
# Some 0.1 s for each chunk, so that something can happen in the middle of a run; 24 chunks.
LONGER, MEMBERS, CHUNKS = CASE.format(duration="0.2"), 1536, 48
RUN = ["ensemble", "case.toml", "--members", str(MEMBERS), "--chunk", "32", "--seed", "3"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Each test in a folder of its own, with the compilation cache beside it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path.parent / "cache"))


@pytest.fixture
def no_pictures(monkeypatch):
    """Drawing takes longer than these studies."""
    monkeypatch.setattr(studies, "_pictures", lambda *_: None)


def write(text, name="case.toml"):
    pathlib.Path(name).write_text(text, encoding="utf-8")
    return name


# Ctrl-C is heard even if the tests run in the background of a shell, which has its children ignore it.
LISTENING = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from ambjax.__main__ import main
sys.exit(main())
"""


def begin(out, *flags):
    """A study in a process group of its own."""
    argv = [sys.executable, "-c", LISTENING, *RUN, "--out", out, *flags]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(argv, text=True, start_new_session=True, **pipes)


def wait_for(condition, running, patience=120.0):
    """Until the condition holds; fails if the process ends first."""
    end = time.monotonic() + patience
    while not condition():
        assert running.poll() is None, running.stderr.read()
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)


def finished_chunks(out):
    return len(list(pathlib.Path(out, "chunks").glob("*.npz")))


def group_ends(group, patience=20.0):
    """Whether no process of the group is left."""
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


# --- where it runs ---


def test_processes_give_the_same_file(capsys, monkeypatch):
    write(TINY)
    # a chunk is several calls of the compiled program, and the last one is no whole chunk
    argv = ["ensemble", "case.toml", "--members", "200", "--chunk", "128", "--seed", "3"]
    with monkeypatch.context() as hasty:
        hasty.setattr(studies, "_pictures", lambda *_: None)
        assert main([*argv, "--out", "here"]) == 0
    assert main([*argv, "--out", "there", "--processes", "2"]) == 0
    assert result("here") == result("there")
    written = capsys.readouterr().out.splitlines()[-1]
    assert written == "written: there/members.npz, summary.json, fan.png, histograms.png, tornado.png"
    for path in written.removeprefix("written: there/").split(", "):
        assert pathlib.Path("there", path).stat().st_size > 0
    assert not list(pathlib.Path("there").glob("chunks"))


@pytest.mark.slow
def test_a_cluster_gives_the_same_file_though_a_worker_is_killed(no_pictures):
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


@pytest.mark.parametrize("flags", [[], ["--processes", "2"]], ids=["here", "processes"])
def test_ctrl_c_keeps_what_is_finished_and_says_how_to_go_on(flags):
    write(LONGER)
    many = 100_000  # so that no machine is done before it is interrupted
    running = begin("out", *flags, "--members", str(many))
    wait_for(lambda: finished_chunks("out") >= 2, running)
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does: the whole group hears it
    err = running.communicate(timeout=60)[1]
    assert running.returncode == 130
    assert group_ends(running.pid)
    kept = finished_chunks("out")
    assert 2 <= kept < many // 32
    said = [line for line in err.splitlines() if line.startswith("ambjax: ")]
    again = "To go on, give the same command with --out out --resume."
    assert said == [f"ambjax: interrupted: {32 * kept} of {many} members are kept. {again}"]
    assert "Traceback" not in err
    for path in pathlib.Path("out", "chunks").glob("*.npz"):
        with np.load(path) as chunk:
            assert np.isfinite(chunk["rms_error_m"]).all()


@pytest.mark.slow
def test_killed_at_any_instant_and_resumed_it_is_the_same_file(no_pictures):
    write(LONGER)
    assert main([*RUN, "--out", "whole"]) == 0
    dice, early = random.Random(11), 0
    for n in range(10):
        out, flags = f"cut-{n}", [[], ["--processes", "2"]][n % 2]
        running = begin(out, *flags)
        after = dice.randrange(CHUNKS)
        wait_for(lambda out=out, after=after: finished_chunks(out) >= after or done(out), running)
        time.sleep(dice.uniform(0, 0.2))
        os.kill(running.pid, signal.SIGKILL)
        running.communicate()
        assert group_ends(running.pid), "a worker process outlives its parent"
        early += not done(out)
        resume = ["--resume"] if pathlib.Path(out, "study.json").exists() else []
        assert main([*RUN, "--out", out, *resume]) == 0
        assert result(out) == result("whole")
        assert not pathlib.Path(out, "chunks").exists()
    assert early >= 5, "the runs were over before they could be killed"


def done(out):
    return pathlib.Path(out, "members.npz").exists()


def test_a_finished_study_is_not_run_again(no_pictures, monkeypatch, capsys):
    write(TINY)
    argv = ["ensemble", "case.toml", "--members", "5", "--out", "out", "--json"]
    assert main(argv) == 0
    first, members = capsys.readouterr().out, result("out")
    pathlib.Path("out", "chunks").mkdir()  # as a kill in the last moment leaves it
    monkeypatch.setattr(studies, "_run", None)
    assert main([*argv, "--resume"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(first)
    assert result("out") == members
    assert not pathlib.Path("out", "chunks").exists()


def test_a_member_alone_is_that_row_of_the_study(no_pictures, capsys):
    write(TINY)
    assert main(["ensemble", "case.toml", "--members", "40", "--seed", "8", "--out", "out", "--json"]) == 0
    worst = json.loads(capsys.readouterr().out)["worst"][0]
    command, *argv = worst["replay"].split()
    assert command == "ambjax"
    assert main([*argv, "--json", "--out", "alone"]) == 0
    alone = json.loads(capsys.readouterr().out)
    with np.load("out/members.npz") as study:
        for name in ("max_abs_error_m", "settled_rms_error_m", "rms_u_V"):
            # the same operations, fused otherwise for one member than for many
            assert alone[name] == pytest.approx(study[name][worst["index"]], rel=1e-12)


# --- bad input ---

LATIN = 'design = "latin-hypercube"\n'
# What is wrong: arguments after the case, what is added to it, what the message must contain.
BAD = {
    "no members": ("ensemble --members 0", "", ["--members 0", "from 1 to 2,147,483,648"]),
    "negative members": ("ensemble --members -1", "", ["--members -1", "from 1"]),
    "huge": ("ensemble --members 1099511627776", "", ["--members 1099511627776", "from 1 to 2,147,483,648"]),
    "beyond disk": ("ensemble --members 2147483648", "", ["--members 2147483648", "GB free", "members fit"]),
    "beyond memory": ("ensemble --members 30000000", LATIN, ["latin-hypercube", "30,000,000", "sobol"]),
    "chunk 0": ("ensemble --members 9 --chunk 0", "", ["--chunk 0", "at least 1"]),
    "negative seed": ("ensemble --members 9 --seed -1", "", ["--seed -1", "from 0 to 4294967295"]),
    "large seed": ("ensemble --members 9 --seed 4294967296", "", ["--seed 4294967296", "from 0 to"]),
    "resume what": ("ensemble --members 9 --resume", "", ["--resume", "--out DIR"]),
    "resume nothing": ("ensemble --members 9 --resume --out new", "", ["--resume", "no study in new", "--out"]),
    "no processes": ("ensemble --members 9 --processes 0", "", ["--processes 0", "at least 1"]),
    "out a file": ("ensemble --members 9 --out case.toml", "", ["--out case.toml", "cannot write"]),
    "out below a file": ("ensemble --members 9 --out case.toml/a", "", ["--out case.toml/a", "cannot write"]),
    "resume a file": ("ensemble --members 9 --resume --out case.toml", "", ["no study in case.toml"]),
    "spread of nothing": ("ensemble --members 9", "plant.mass = { percent = 1 }\n", ["plant.mass", "plant.m,"]),
    "negative scale": ("ensemble --members 9", "plant.R = { normal = -1.0 }\n", ["spread.plant.R", "-1"]),
    "per cent of zero": ("ensemble --members 9", "initial.i = { percent = 1 }\n", ["spread.initial.i", "uniform"]),
    "spread simulated": ("simulate", "plant.k_z = { percent = -5 }\n", ["spread.plant.k_z", "-5"]),
    "seed of nobody": ("simulate --seed 3", "", ["--seed and --members belong to --member"]),
    "members of nobody": ("simulate --members 3", "", ["--seed and --members belong to --member"]),
    "member -1": ("simulate --member -1", "", ["--member -1", "from 0 to 2147483647"]),
    "member N": ("simulate --member 9 --members 9", "", ["--member 9", "from 0 to 8"]),
    "member huge": ("simulate --member 1099511627776", "", ["--member 1099511627776", "from 0 to 2147483647"]),
    "member of none": ("simulate --member 0 --members 0", "", ["--members 0", "from 1"]),
    "member of a hypercube": ("simulate --member 3", LATIN, ["--member", "add --members N", "hypercube"]),
    "member's seed": ("simulate --member 3 --seed -1", "", ["--seed -1", "from 0"]),
}


def refused(argv, capsys):
    """The one line of a refusal that writes nothing."""
    before = sorted(pathlib.Path().rglob("*"))
    assert main(argv) == 2, argv
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    assert sorted(pathlib.Path().rglob("*")) == before, "something was written"
    return err


@pytest.mark.parametrize("wrong", BAD)
def test_bad_input_is_one_clear_line(wrong, capsys):
    line, more, wanted = BAD[wrong]
    command, *flags = line.split()
    err = refused([command, write(TINY + more), *flags], capsys)
    for part in wanted:
        assert part in err


def test_an_absent_cluster_is_one_clear_line(monkeypatch, capsys):
    write(TINY)
    argv = ["ensemble", "case.toml", "--members", "9", "--out", "new", "--cluster", "tcp://127.0.0.1:9"]
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "distributed", None)
        assert "pip install 'ambjax[cluster]'" in refused(argv, capsys)
    pytest.importorskip("distributed")
    monkeypatch.setattr(studies, "PATIENCE", "0.5s")
    assert "--cluster tcp://127.0.0.1:9: no scheduler answers there" in refused(argv, capsys)
    assert "--cluster nonsense://x: " in refused([*argv[:-1], "nonsense://x"], capsys)


def test_another_study_is_refused_and_left_alone(no_pictures, capsys):
    write(TINY)
    argv = ["ensemble", "case.toml", "--members", "9", "--out", "out"]
    assert main(argv) == 0
    capsys.readouterr()
    assert "--out out: it holds a study already. Add --resume" in refused(argv, capsys)
    for key, other in (("seed", ["--seed", "5"]), ("members", ["--members", "8"]), ("chunk", ["--chunk", "4"])):
        assert f"another study: {key} is " in refused([*argv, *other, "--resume"], capsys)
    write(TINY.replace("percent = 10", "percent = 9"))
    assert "another study: spread.plant.m is " in refused([*argv, "--resume"], capsys)
    for text in ("{", "3", "[1]"):
        write(text, "out/study.json")
        assert "study.json: cannot be read" in refused([*argv, "--resume"], capsys)
    pathlib.Path("out/study.json").unlink()
    assert "it holds results, but no study.json" in refused(argv, capsys)
