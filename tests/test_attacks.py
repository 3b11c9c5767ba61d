"""Hostile case files, arguments, folders and streams: one line states the error, and no partial result is written."""

import dataclasses
import errno
import importlib
import io
import math
import os
import pathlib
import pkgutil
import sys
import tomllib

import numpy as np
import pytest
from texts import refusal, write
from tomlkit import dumps

import ambjax
import tuning
from ambjax.__main__ import main
from ambjax.cases.reader import read_case
from ambjax.cases.template_text import template
from ambjax.cases.tune_table import Budget
from ambjax.cases.warned import idealised, reversal, warnings_of
from ambjax.commands import simulate
from ambjax.control.processor import Processor
from ambjax.numerics.declared import within
from ambjax.results.outputs import files
from ambjax.simulation.clock import Clock
from ambjax.world.amplifier import Amplifier
from ambjax.world.plant import Plant, TwoCoil
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Sensor
from ambjax.world.waveforms import Chirp, Pulse, Sine, SmoothStep, Step
from tuning.__main__ import main as tune
from tuning.problem.config import read_tune, settings
from tuning.problem.loss import Loss
from tuning.report.folder import tuned

SHORT = "[clock]\nduration = 0.01\n"


pytestmark = pytest.mark.usefixtures("elsewhere")


SINE = '[reference]\nkind = "sine"\nfrequency = 2.0\n'
SUM = '[reference]\nkind = "sum"\nterms = ['

# What is wrong, the file, and what the message must contain.
HOSTILE = {
    "nested 2,000 deep": ("a = " + "[" * 2000 + "]" * 2000, ["nested deeper"]),
    "tables nested 400 deep": (".".join("a" * 400) + " = 1", ["nested deeper"]),
    "400 digits": ("[plant]\nm = " + "9" * 400, ["plant.m", "digits", "from 1e-06 to 1e+06 (kg)"]),
    "5,000 digits": ("[plant]\nm = " + "9" * 5000, ["thousands of digits"]),
    "seed of 5,000 digits": ("[run]\nseed = 0x" + "f" * 5000, ["run.seed", "digits", "4294967295"]),
    "gap of an underflow": ("[plant]\ns_0 = 1e-110", ["plant.s_0 = 1e-110", "from 1e-06 to 1 (m)"]),
    "steps for years": ('[clock]\ndt = 1e-14\nmethod = "rodas3"', ["clock.dt", "2e+14 steps", '"auto"']),
    "settle": ("[run]\nsettle = nan", ["run.settle = nan"]),
    "percentage of an overflow": ("[spread]\nplant.k_z = { percent = 1e308 }", ["spread.plant.k_z", "inf"]),
    "key of two lines": ('"a\\nb" = 1', ["a\\nb = 1", "unknown key"]),
    "endless key": ('[plant]\n"' + "m" * 5000 + '" = 1', ["plant.mmm", "..."]),
    "sum of a thousand": (SUM + '{ kind = "constant" }, ' * 1000 + "]", ["reference.terms", "1 to 100"]),
    "11 MB": ("# " + "x" * 11_000_000, ["10,000,000 bytes"]),
    # beyond the clearance
    "a sine": (SINE + "amplitude = 20e-3", ["reference reaches 0.02 m", "0.0045 m", "SI"]),
    "a sum": (
        SUM + '{ kind = "step", amplitude = 3e-3 }, { kind = "sine", amplitude = 3e-3, frequency = 7 }]',
        ["reaches 0.006 m"],
    ),
    "noise": ("reference = { kind = 'band-noise', std = 3e-3, f_low = 1, f_high = 99 }", ["reference reaches"]),
    "spread": (SINE + "amplitude = 4e-3\n[spread]\nreference.amplitude = { percent = 20 }", ["spread", "0.0048 m"]),
    "gap narrowed": (SINE + "amplitude = 4e-3\n[spread]\nplant.s_0 = { percent = 20 }", ["spread", "0.0036 m"]),
    "clearance": (SINE + "amplitude = 4e-3\n[run]\nclearance = 3e-3", ["0.003 m", "run.clearance"]),
}


@pytest.mark.parametrize("wrong", HOSTILE)
def test_hostile_files_are_refused_in_one_line(wrong):
    text, wanted = HOSTILE[wrong]
    with pytest.raises(ValueError, match=r"^case\.toml: ") as refused:
        read_case(write(text))
    message = str(refused.value)
    assert message.isprintable()
    assert len(message) < 1000
    for part in wanted:
        assert part in message


@pytest.mark.slow
def test_a_metric_that_is_not_a_number_is_refused(capsys, monkeypatch):
    done = simulate._simulated(read_case(write(SHORT)), None, None)
    for name, value in (("rms_error_m", math.nan), ("lost_at_s", math.nan), ("rms_u_V", math.inf)):
        broken = dataclasses.replace(done, metrics=done.metrics | {name: value})
        monkeypatch.setattr(simulate, "_simulated", lambda *_, run=broken: run)
        assert main(["simulate", "case.toml", "--out", "broken"]) == 2
        assert f"case.toml: {name}: not finite in this run" in capsys.readouterr().err
        assert not pathlib.Path("broken/metrics.json").exists()


def records():
    """Return every record with numbers, except distributions, whose ranges are those of the spread numbers."""
    for package in (ambjax, tuning):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                kinds = vars(importlib.import_module(module.name)).values()
                own = [kind for kind in kinds if isinstance(kind, type) and kind.__module__ == module.name]
                yield from (kind for kind in own if dataclasses.is_dataclass(kind) and not hasattr(kind, "quantile"))


def test_every_number_has_a_lower_and_an_upper_bound():
    found = [(kind, field) for kind in records() for field in dataclasses.fields(kind) if field.metadata.get("leaf")]
    assert {Plant, TwoCoil, Amplifier, Sensor, Processor, Clock, Scenario, Step, Loss} < {kind for kind, _ in found}
    for kind, field in found:
        low = field.metadata["above"] if field.metadata["at_least"] is None else field.metadata["at_least"]
        high = field.metadata["at_most"]
        assert None not in (low, high), f"{kind.__name__}.{field.name}"
        assert -math.inf < low < high < math.inf, f"{kind.__name__}.{field.name}"
        assert within(field.metadata, high)
        assert not within(field.metadata, np.nextafter(high, np.inf))
        assert not within(field.metadata, np.nextafter(low, -np.inf))
        assert within(field.metadata, math.inf) is field.metadata["infinite"]
        assert not within(field.metadata, math.nan)
        assert not within(field.metadata, -math.inf)


# --- references ---

NEAR = {
    "sine": SINE + "amplitude = 4.4e-3",
    "sine that never gets there": SINE + "amplitude = 20e-3\n[clock]\nduration = 0.01",
    "step after the end": '[reference]\nkind = "step"\namplitude = 5e-3\nstart = 3.0',
    # the sum of its terms' bounds is 8 mm, and it never leaves 4
    "steps up and down": SUM + '{ kind = "step", amplitude = 4e-3 }, '
    '{ kind = "step", amplitude = -4e-3, start = 0.5 }, { kind = "step", amplitude = 4e-3, start = 0.7 }]',
}


@pytest.mark.parametrize("case", NEAR)
def test_a_reference_within_the_clearance_is_accepted(case):
    read_case(write(NEAR[case]))


SPANS = [
    Step(2.0, 0.3), Step(-2.0, -1.0), Step(2.0, 5.0),
    Pulse(3.0, 0.2, 0.4), Pulse(-3.0, -1.0, 0.4), Pulse(3.0, 1.5, 2.0),
    Sine(2.0, 0.1), Sine(-2.0, 0.3, 1.0), Sine(2.0, 0.2, 4.0), Sine(1.0, 3.0),
    SmoothStep(-2.0, 0.5, 2.0), SmoothStep(2.0, -0.5, 2.0),
    Chirp(2.0, 0.1, 0.3, 0.5), Chirp(-2.0, 0.5, 0.0, 3.0),
]  # fmt: skip


@pytest.mark.parametrize("signal", SPANS, ids=str)
def test_the_span_of_a_signal_contains_exactly_its_values(signal):
    values = np.asarray(signal(np.linspace(0.0, 1.0, 200_001)))
    low, high = signal.span(1.0)
    # the instants are 5e-6 s apart, and no signal here moves faster than 40 1/s: 1e-4 at jumps of none
    np.testing.assert_allclose([low, high], [values.min(), values.max()], atol=1e-4)
    assert low <= values.min() + 1e-12
    assert values.max() - 1e-12 <= high


# --- warnings ---

DOUBTS = {
    "gap in millimetres": ("[plant]\ns_0 = 0.4", "plant.s_0 = 0.4 m", "millimetres"),
    "noise as large as the gap": ("[sensor]\nstd = 5e-3", "sensor.std = 0.005", "100 %"),
    "initial current": ("[initial]\ni = 0.3", "initial.i = 0.3 A", "plant.i_0 = 0.25 A"),
    "weight beyond the bias": ("[plant]\nm = 588.0", "takes 1.741 A", "plant.i_0 = 0.25 A"),
    "supply too weak": ("[actuator]\nu_max = 0.01", "actuator.u_max = 0.01 V", "0.07215 V that hold"),
    "stiffness the wrong way": ("[plant]\nk_z = 754.0", "plant.k_z = 754", "restoring"),
    "milliseconds": ("[sensor]\nstd = 1e-6\n[clock]\nsample_period = 0.1", "clock.sample_period = 0.1 s", "unstable"),
}


@pytest.mark.parametrize("case", DOUBTS)
def test_unlikely_values_cause_one_warning(case):
    text, *wanted = DOUBTS[case]
    found = warnings_of(read_case(write(text)))
    said = [line for line in found if wanted[0] in line]
    assert len(said) == 1, found
    for part in wanted:
        assert part in said[0]


def test_warnings_list_plant_numbers_with_the_paper_s_value():
    given = "m = 0.4\ns_0 = 4e-4\ni_0 = 0.5\nn = 200\nk_z = -100.0\nR = 2.0\n"
    first, *_ = warnings_of(read_case(write(f"[plant]\n{given}")))
    assert first == (
        "[plant] omits numbers, which keep the paper's values: mu_0 = 1.25e-06 N/A^2, A = 0.121 m^2. "
        "Give those that differ."
    )
    first, *_ = warnings_of(read_case(write("[plant]\nkind = 'two-coil'\nA = 0.1\n")))
    assert "n = 1480, s_0 = 0.005 m," in first
    # all of them, all but gravity, or none: nothing is left to the paper unsaid
    for text in (f"[plant]\n{given}mu_0 = 1.257e-6\nA = 4e-4\n", "[plant]\nkind = 'two-coil'\n", ""):
        assert not any("the paper's values" in line for line in warnings_of(read_case(write(text))))


def test_a_warning_names_idealised_parts_of_the_case():
    coils, measured = "plant.kind = 'two-coil'\n", "sensor.velocity = false\ncontroller.observer.kind = 'kalman'\n"
    said = [idealised(read_case(write(text))) for text in ("", coils, measured, coils + measured)]
    assert ["plant.kind" in line for line in said] == [True, False, True, False]
    assert ["sensor.velocity" in line for line in said] == [True, True, False, False]
    assert said[-1] == ""
    # iron does not give the coils two currents
    assert "plant.kind" in idealised(read_case(write("[plant.iron]\nsaturation = 1.2\n")))


@pytest.mark.parametrize("name", ["tracking", "regulation"])
def test_the_papers_cases_have_no_warnings(name):
    sensor = f"\n[sensor]\nstd = {math.sqrt(1e-7)}\n"
    said = warnings_of(read_case(write(template(name) + sensor)))  # its text names no error of the velocity
    assert [line.split(":")[0] for line in said] == ["sensor.std_z_dot = 0 m/s"]
    assert warnings_of(read_case(write(template(name) + sensor + "std_z_dot = 1e-4\n"))) == []


@pytest.mark.thorough
def test_a_current_above_the_bias_causes_one_warning(capsys):
    for i, count in ((0.26, 1), (0.24, 0)):
        main(["simulate", write(SHORT + f"[initial]\ni = {i}\n"), "--out", f"{i}", "--json"])
        assert capsys.readouterr().err.count("|i| reaches 0.26 A, above the bias plant.i_0 = 0.25 A") == count
    still = write("[clock]\nduration = 0.001\n[initial]\ni = 0.26\n", "still.toml")
    main(["ensemble", still, "--members", "2", "--out", "study", "--json"])  # of members that are held
    assert capsys.readouterr().err.count("|i| reaches 0.26 A") == 1
    # of two coils i is half a difference
    coils = read_case(write(SHORT + "[processor]\n[plant]\nkind = 'two-coil'\n"))
    assert not list(reversal(coils, 0.26))


# --- names ---


def test_special_characters_of_a_file_name_are_removed_or_escaped(capsys):
    name = "a\n\x7f<b>|$x$&.toml"
    case = read_case(write(SHORT, name))
    assert case.name == "a_b_x_"
    assert "a\\n\\x7f<b>|$x$&.toml" in refusal(capsys, "simulate", write("[plant]\nm = 0", name))
    assert read_case(write(SHORT, "x" * 200 + ".toml")).name == "x" * 80
    assert read_case(write(SHORT, "\n.toml")).name == "_"


def test_the_byte_order_mark_of_an_editor_is_ignored(tmp_path):
    path = tmp_path / "marked.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SHORT.encode())
    assert read_case(path).clock == read_case(write(SHORT, tmp_path / "plain.toml")).clock


@pytest.mark.parametrize("code", [0, 9, 10, 13, 31, 0x7F, 0x85, 0x2028, 0xDCFF])
def test_control_characters_are_escaped_in_the_written_toml(code):
    text = f"a{chr(code)}b"
    written = tuned("a = 1 # kept", {"b": 2.0}, text, f"first{text}\nsecond")
    assert tomllib.loads(written.encode("utf-8").decode("utf-8")) == {"a": 1, "b": 2.0}


# --- arguments ---

MAP = ["map", "case.toml", "--y", "initial.z=-1e-4:1e-4:3", "--x"]
ARGUMENTS = {
    "no name for a folder": (["simulate", "case.toml", "--out", ""], ["--out", "empty"]),
    "a folder of 300 characters": (["simulate", "case.toml", "--out", "x" * 300], ["--out xxx", "too long"]),
    "member of nothing": (["simulate", "case.toml", "--member", "3"], ["--member", "[spread]"]),
    "a million processes": (["ensemble", "case.toml", "--members", "9", "--processes", "1000000"], ["1 to 1024"]),
    "seed": (["ensemble", "case.toml", "--members", "9", "--seed", "9" * 30], ["--seed", "4294967295"]),
    "count of 1e12": ([*MAP, "plant.m=0.5:0.6:1000000000000"], ["--x", "2 to 1,000,000"]),
    "beyond a field's range": ([*MAP, "plant.m=-1:1:3"], ["--x", "from 1e-06 to 1e+06 (kg)"]),
    "period that takes years": ([*MAP, "clock.sample_period=1e-9:1e-4:3"], ["--x", "2e+09 samples", "Raise LOW"]),
    "period beyond the run": ([*MAP, "clock.sample_period=1e-4:5:3"], ["reaches 5 s", "clock.duration is 2 s"]),
}


@pytest.mark.parametrize("what", ARGUMENTS)
def test_impossible_arguments_are_refused_in_one_line(what, capsys):
    argv, wanted = ARGUMENTS[what]
    write("[clock]\nduration = 2.0\n")
    said = refusal(capsys, *argv)
    assert all(part in said for part in wanted), said
    assert sorted(os.listdir()) == ["case.toml"]  # noqa: PTH208 (names alone)


def test_a_finished_study_is_not_mixed_with_a_simulation(capsys):
    path = write(SHORT + "[sensor]\nstd = 1e-9\n")
    for kept in ("study.json", "members.npz"):
        folder = pathlib.Path(kept.partition(".")[0])
        folder.mkdir()
        (folder / kept).write_text("{}")
        for argv in (["simulate", path], ["map", path, "--x", "plant.m=0.5:0.6:2", "--y", "plant.g=9:10:2"]):
            assert "study of an ensemble" in refusal(capsys, *argv, "--out", folder)
        assert [p.name for p in folder.iterdir()] == [kept]


# --- disks and streams ---


def test_all_files_are_written_or_none(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "a").write_text("old")

    def fail():
        with files(out) as part:
            (part / "a").write_text("new")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(ValueError, match="No space left"):
        fail()
    assert [p.name for p in out.iterdir()] == ["a"]
    assert (out / "a").read_text() == "old"
    with files(out) as part:
        (part / "a").write_text("new")
        (part / "b").mkdir()
        (part / "b" / "c").write_text("below")
    assert sorted(str(p.relative_to(out)) for p in out.rglob("*")) == ["a", "b", "b/c"]
    assert (out / "a").read_text() == "new"


def test_a_full_disk_is_reported_when_stdout_is_flushed(monkeypatch, capsys):
    def flush():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    stream = io.StringIO()
    monkeypatch.setattr(stream, "flush", flush)
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["template"]) == 2
    assert "cannot write to stdout: No space left on device" in capsys.readouterr().err


# --- the template and [tune] ---


def uncommented(name):
    """Return the template's table [tune] with all lines uncommented, as parsed by tomllib."""
    head, _, tail = template(name).partition("# [tune]")
    lines = ("[tune]" + tail).splitlines()
    return tomllib.loads(head + "\n".join(line.removeprefix("# ") for line in lines))


@pytest.mark.parametrize("name", ["tracking", "regulation"])
def test_the_template_lists_every_key_of_tune_with_its_default(name):
    document = uncommented(name)
    table, nothing = document["tune"], {"nothing": 1}
    within = {name: {name: nothing} for name in ("weights", "limits")}
    for keys, wrong in ((table, nothing), *((table[name], one) for name, one in within.items())):
        with pytest.raises(ValueError, match="Keys allowed here") as refused:
            read_tune(write(dumps({"tune": wrong})))
        assert set(keys) == set(str(refused.value).partition("Keys allowed here: ")[2].rstrip(".").split(", "))
    assert {field.name for field in dataclasses.fields(Budget)} <= set(table)
    # these are examples, and say so; all else is what is left out
    for example in ("gains", "bounds", "risk", "alpha", "limits"):
        del table[example]
    ours, left_out = (settings(read_tune(write(dumps(one)))[1]) for one in (document, document | {"tune": {}}))
    assert ours == left_out


def test_the_error_of_the_tuner_names_the_case_file(capsys):
    outside = 'gains = ["controller.position.c"]\nbounds.controller.position.c = [100.0, 200.0]\n'
    for text, said in (
        ('"a\\nb" = 1\n', "tune.a\\nb = 1: unknown key"),
        # what is found only once the problem is made
        (outside, "controller.position.c = 17: it must lie between tune.bounds"),
    ):
        line = refusal(capsys, write(f"[tune]\n{text}"), program=tune)
        assert line.startswith(f"ambjax-tune: case.toml: {said}")
