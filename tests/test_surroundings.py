"""The environment does not affect a run: streams, links, other runs, a matplotlibrc, a missing home folder."""

import errno
import io
import os
import pathlib
import sys
import warnings

import jax
import matplotlib
import platformdirs
import pytest
from texts import refusal, write
from tqdm import tqdm

from ambjax.__main__ import main, parser, run_command
from ambjax.commands import simulate
from ambjax.ensemble import worker
from ambjax.host.command_line import open_streams
from ambjax.host.lock import LOCK, locked
from ambjax.host.sealed import write_whole
from ambjax.pictures import ensembles
from ambjax.pictures.scales import save
from ambjax.results import outputs
from tuning.__main__ import main as tune

SHORT = "[clock]\nduration = 0.01\n"

pytestmark = pytest.mark.usefixtures("elsewhere")


class Stuck(io.StringIO):
    """A stream that refuses every write."""

    def __init__(self, number):
        super().__init__()
        self.number = number

    def write(self, text):
        raise OSError(self.number, os.strerror(self.number))


@pytest.mark.parametrize(("number", "code"), [(None, 1), (errno.EPIPE, 1), (errno.ENOSPC, 2)])
@pytest.mark.parametrize("flags", [[], ["--json"]])
def test_the_exit_code_does_not_change_if_the_reader_closes_stdout(number, code, flags, monkeypatch, capsys):
    if number is not None:
        monkeypatch.setattr(sys, "stdout", Stuck(number))

    def run(args):
        print("no")
        return 1, {}

    assert run_command(parser(), ["template", *flags], run) == code
    assert ("No space left" in capsys.readouterr().err) == (code == 2)


@pytest.mark.parametrize(("number", "code"), [(errno.EPIPE, 0), (errno.ENOSPC, 2)])
@pytest.mark.parametrize("flag", ["--version", "--help"])
def test_help_and_version_with_a_failing_stdout(number, code, flag, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdout", Stuck(number))
    assert main([flag]) == code
    assert capsys.readouterr().err.count("\n") == (code == 2)


def test_a_failing_stderr_does_not_stop_the_command(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Stuck(errno.ENOSPC))
    monkeypatch.setattr(simulate, "tqdm", lambda **options: tqdm(**options | {"delay": 0, "mininterval": 0}))
    assert main(["simulate", write(SHORT), "--out", "there"]) == 0
    # without a speed there is no run-up
    assert {p.name for p in pathlib.Path("there").iterdir()} == {*simulate.WRITTEN} - {"runup.png"}


def test_characters_that_the_encoding_lacks_are_escaped(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", stream)
    open_streams()
    outputs.written(pathlib.Path("\u03a9\n"), "a")
    stream.flush()
    assert stream.buffer.getvalue() == b"written: \\u03a9\\n/a\n"


@pytest.mark.parametrize("said", ["out of memory\nmore", ""])
def test_an_error_of_the_device_is_reported_in_one_line(said, capsys):
    def run(args):
        raise RuntimeError(said)

    assert run_command(parser(), ["template"], run) == 2
    assert capsys.readouterr().err == f"ambjax: {said[:13] or 'RuntimeError'}\n"


def test_a_folder_accepts_one_run_at_a_time():
    here = pathlib.Path()
    with locked(here):
        with pytest.raises(ValueError, match="another run is using this directory"), locked(here):
            pass
        assert os.path.lexists(LOCK)
    assert not os.path.lexists(LOCK)
    pathlib.Path(LOCK).touch()  # as a kill leaves it
    with locked(here):
        pass
    assert os.listdir() == []  # noqa: PTH208


def test_two_runs_without_a_given_folder_use_two_folders(monkeypatch):
    meant = iter([pathlib.Path("out/a"), pathlib.Path("out/a"), pathlib.Path("out/a-2")])  # both see that a is free
    monkeypatch.setattr(outputs, "target", lambda *_: next(meant))
    assert [outputs.directory(None, "a").name for _ in range(2)] == ["a", "a-2"]


def test_a_search_in_a_folder_in_use_is_refused_and_changes_nothing(capsys):
    pathlib.Path("out/checkpoints").mkdir(parents=True)
    pathlib.Path("out/checkpoints/round-1.npz").touch()
    with locked(pathlib.Path("out")):
        said = refusal(capsys, write(SHORT), "--out", "out", program=tune)
    assert "--out out: another run is using this directory" in said
    assert pathlib.Path("out/checkpoints/round-1.npz").exists()


@pytest.mark.parametrize("name", simulate.WRITTEN)
def test_a_folder_in_place_of_a_file_is_refused_before_the_computation(name, monkeypatch, capsys):
    monkeypatch.setattr(simulate, "simulate", None)
    pathlib.Path("out", name).mkdir(parents=True)
    said = refusal(capsys, "simulate", write(SHORT), "--out", "out")
    assert f"--out out: {name} exists and is a folder. Move it, or choose" in said


def test_nothing_is_written_through_a_link():
    inside = pathlib.Path("inside")
    inside.mkdir()
    for name in ("study.json.part", ".ambjax-write-test"):
        (inside / name).symlink_to("../victim")
    outputs.make(inside)
    write_whole(inside / "study.json", lambda file: file.write(b"{}"))
    assert not pathlib.Path("victim").exists()
    assert len(list(inside.iterdir())) == 3


def test_names_that_the_system_refuses_are_reported_in_one_line(capsys):
    pathlib.Path("loop").symlink_to("loop")
    long = write(SHORT, chr(0x10400) * 62 + ".toml")
    for argv in (["simulate", write(SHORT), "--out", "loop"], ["simulate", long]):
        said = refusal(capsys, *argv)
        assert said.startswith("ambjax: --out ")
        assert "cannot write there" in said


def test_no_home_folder_and_a_full_cache_cause_no_error_and_no_message(monkeypatch):
    def homeless(*_):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setattr(platformdirs, "user_cache_dir", homeless)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        worker.configure_jax()
        for act in ("reading", "writing"):
            warnings.warn(f"Error {act} persistent compilation cache entry for 'jit_f': OSError: full", stacklevel=1)


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unknown backend\nmore")])
def test_a_missing_device_is_reported_in_one_line(error, monkeypatch, capsys):
    def backend():
        raise error

    monkeypatch.setenv("JAX_PLATFORMS", "abacus")
    monkeypatch.setattr(jax, "default_backend", backend)
    assert refusal(capsys, "template").startswith("ambjax: JAX_PLATFORMS=abacus: ")


def test_pictures_do_not_depend_on_a_matplotlibrc():
    bars = [{"path": "plant.m", "share": 0.5, "low": 0.5, "high": 0.5, "rho": 0.5}]
    with matplotlib.rc_context({"text.usetex": True, "font.size": 30, "axes.facecolor": "red"}):
        save(ensembles.tornado(bars, "rms_u_V", "all"), pathlib.Path("theirs.png"))
    save(ensembles.tornado(bars, "rms_u_V", "all"), pathlib.Path("ours.png"))
    assert pathlib.Path("theirs.png").read_bytes() == pathlib.Path("ours.png").read_bytes()
