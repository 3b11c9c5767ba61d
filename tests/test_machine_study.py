"""Ensembles of whole machines: each member is a machine of its own."""

import argparse
import copy
import dataclasses
import json
import math
import pickle
import tomllib
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from texts import refusal
from tomlkit import dumps

from ambjax.__main__ import main
from ambjax.cases.machine_case import machine_from, read_any
from ambjax.cases.rotor_numbers import rotor_places, varied_rotor
from ambjax.cases.template_text import template
from ambjax.commands import comparison_tuning
from ambjax.ensemble import worker
from ambjax.ensemble.study import PERIOD
from ambjax.ensemble.worker import chunk
from ambjax.host.extensions import NothingToTuneError
from ambjax.linear import Stability, machine_sensitivity
from ambjax.results import machine_study
from ambjax.results.case_map import study_and_axes, survival_map
from ambjax.results.runs import simulate_machine
from ambjax.results.spread_runs import study_of

MACHINE = tomllib.loads(template("machine"))
# Spread of the shapes of a flexible rotor.
FACTOR = "rotor.modes.0.scale"
SHAPES = {
    "rotor": {"modes": {"0": {"scale": {"percent": 20}}}},
    "bearing": {"left": {"modes": {"0": {"percent": 10}}}, "right": {"sensor_modes": {"1": {"uniform": [-0.1, 0.3]}}}},
}
SPREAD = {
    "plant": {"A": {"percent": 10}},
    "bearing": {"left": {"plant": {"A": {"percent": 1}}, "x": {"plant": {"R": {"uniform": [0.9, 1.1]}}}}},
    "rotor": {"m": {"percent": 5}, "speed": {"uniform": [0.0, 12000.0]}},
    "unbalance": {"0": {"amount": {"percent": 50}}},
    "processor": {"delay": {"uniform": [0.5, 1.0]}},
}


def case(spread, **tables):
    clock = {"duration": 1e-3, "sample_period": 5e-5}
    raw = copy.deepcopy(MACHINE) | {"spread": spread, "clock": clock, "run": {"settle": 0.0}} | tables
    return machine_from(raw, "machine")


def flexible(spread, shapes=(([0.5, 0.4], [0.4, 0.2]),) * 2, load=0.7, **tables):
    """The case of the template with two bending modes, whose bearings have these shapes."""
    raw = copy.deepcopy(MACHINE)
    rotor = raw["rotor"] | {"kind": "modal", "modes": [{"frequency": 80.0, "damping": 0.01}, {"frequency": 300.0}]}
    for bearing, (magnet, sensor) in zip(raw["bearing"], shapes, strict=False):
        bearing |= {"modes": magnet, "sensor_modes": sensor, "angle": 20.0}
    for one in (*raw["unbalance"], *raw["load"]):
        one["modes"] = [load, 0.1]
    return case(spread, rotor=rotor, **{key: raw[key] for key in ("bearing", "unbalance", "load")}, **tables)


def test_draws():
    study = study_of(case(SPREAD), 3, 1000)
    drawn = study.drawn(np.arange(1000))
    areas = {name: drawn[f"bearing.{name}.plant.A"] for name in study.case.axes}
    # the magnet of each axis varies alone; a bearing replaces the common distribution
    for name, x in areas.items():
        spread = np.abs(x / 7.6e-5 - 1).max()
        assert spread == pytest.approx(0.01 if name.startswith("left") else 0.1, rel=0.05)
    assert abs(np.corrcoef(areas["right.x"], areas["right.y"])[0, 1]) < 0.1
    assert "bearing.left.x.plant.R" in drawn
    assert "bearing.left.y.plant.R" not in drawn
    # the processor is common to all axes
    assert [path for path in drawn if path.endswith("delay")] == ["processor.delay"]


@pytest.mark.slow  # compiles the linear loop
def test_numbers_of_the_notches():
    notch = {"kind": "displacement-free", "rate": 20.0}
    laws = MACHINE["controller"] | {"notch": notch}
    rate = {"controller": {"notch": {"rate": {"percent": 10}, "max_speed": {"uniform": [6e3, 9e3]}}}}
    left = {"bearing": {"left": {"controller": {"notch": {"rate": {"uniform": [40.0, 50.0]}}}}}}
    study = study_of(case(rate | left, controller=laws), 0, 50)
    rates = {name: study.drawn(np.arange(50))[f"bearing.{name}.controller.notch.rate"] for name in study.case.axes}
    assert {name: (15 < x.min() < x.max() < 25) for name, x in rates.items() if not name.startswith("left")} == {
        "right.x": True, "right.y": True, "thrust.z": True
    }  # fmt: skip
    assert min(rates["left.x"].min(), rates["left.y"].min()) > 40
    member = study.member(7)
    assert float(member.cases[3].cascade.notch.rate) == rates["right.y"][7]
    with pytest.raises(ValueError, match=r"spread.controller.notch.rate.*no such number"):
        case(rate)


def test_a_worker_process_receives_a_machine_in_double_precision(monkeypatch):
    study = study_of(case(SPREAD), 3, 8)
    sent = pickle.dumps(study)
    monkeypatch.delenv("JAX_ENABLE_X64", raising=False)
    monkeypatch.setattr(worker, "chunk", lambda study, *_, **__: study)
    jax.config.update("jax_enable_x64", False)
    try:
        found = worker.work(sent, 0, 8, 8)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert found.fingerprint() == study.fingerprint()
    assert {path: list(x) for path, x in found.drawn(np.arange(8)).items()} == {
        path: list(x) for path, x in study.drawn(np.arange(8)).items()
    }


def test_numbers_of_the_rotor():
    rotor = flexible({}, base=[{"direction": [2.0, 0.0, 0.0], "kind": "constant", "value": 1.0}]).machine.rotor
    values = {"rotor.m": 3.0, "rotor.I_t": 0.07, "rotor.I_p": 1e-3, "rotor.modes.1.frequency": 250.0}
    values |= {"rotor.modes.0.damping": 0.02, "unbalance.0.amount": 7.0, "load.0.start": 0.2, "rotor.speed": 10.0}
    values |= {"base.0.value": 5.0, "bearing.left.modes.0": 0.6, "bearing.right.sensor_modes.1": -0.3}
    axes = ("left.x", "left.y", "right.x", "right.y", "thrust.z")
    other = varied_rotor(rotor, values, axes)
    nominal, found = rotor_places(rotor, axes), rotor_places(other, axes)
    for path, place in found.items():
        assert float(np.asarray(place.value)) == pytest.approx(values.get(path, float(np.asarray(nominal[path].value))))
    # the weight follows the mass; a free bending mode has the given frequency and damping
    assert np.asarray(other.gravity)[1] == pytest.approx(-9.81 * 3.0)
    still = dataclasses.replace(other, speed=0.0)  # no unbalance
    np.testing.assert_allclose(still.forces(0.0)[:3], [-5.0 * 3.0, -9.81 * 3.0, 0.0], rtol=1e-12)
    thin = varied_rotor(varied_rotor(rotor, {"rotor.I_p": 0.0}), {"rotor.I_p": 2e-3})
    assert (thin.G[3, 4], thin.G[4, 3]) == (2e-3, -2e-3)
    k = other.K[7, 7] / other.M[7, 7]
    assert np.sqrt(k) == pytest.approx(2 * np.pi * 250)
    assert other.D[5, 5] == pytest.approx(2 * 0.02 * 2 * np.pi * 80)


def test_shapes_of_modes():
    """A member is the machine whose bearings, unbalances and loads are given with its shapes."""
    study = study_of(flexible(SHAPES), 3, 4)
    drawn = {path: x[1] for path, x in study.drawn(np.arange(4)).items()}
    assert len(drawn) == 3
    left, sensor, factor = (drawn[path] for path in ("bearing.left.modes.0", "bearing.right.sensor_modes.1", FACTOR))
    shapes = ([left * factor, 0.4], [0.4 * factor, 0.2]), ([0.5 * factor, 0.4], [0.4 * factor, sensor])
    expected = flexible({}, shapes, 0.7 * factor).machine.rotor
    found = study.member(1).machine.rotor
    for one in jax.tree.leaves(jax.tree.map(lambda a, b: np.max(np.abs(a - b)), found, expected)):
        assert one < 1e-12
    assert abs(left - 0.5) < 0.05
    assert left != 0.5


@pytest.mark.parametrize(
    ("spread", "words"),
    [
        ({"plant": {"m": {"percent": 1}}}, "rotor.m"),
        ({"initial": {"z": {"percent": 1}}}, "spread.initial"),
        ({"initial": {"q": {"0": {"uniform": [-2e-3, 2e-3]}}}}, r"axis left.x, \|z\| reaches"),
        ({"initial": {"q": {"3": {"normal": 1e-3}}}}, r"axis left.y, \|z\| reaches"),
        ({"bearing": {"top": {"plant": {"A": {"percent": 1}}}}}, "left, right, thrust"),
        ({"bearing": {"thrust": {"x": {"plant": {"A": {"percent": 1}}}}}}, "bearing.thrust.x"),
        ({"bearing": {"left": {"x": 3}}}, "spread.bearing.left.x = 3: it must be a table"),
        ({"rotor": {"kind": {"percent": 1}}}, "spread.rotor.kind"),
        ({"rotor": {"m": {"uniform": [-1.0, 2.0]}}}, "rotor.m"),
        ({"plant": {"B": {"percent": 1}}}, "plant.B"),
        ({"controller": {"current": {"k_p": {"percent": 1}}}}, "current.k_p: one law commands all axes"),
    ],
)
def test_refused(spread, words):
    lqg = {"controller": {"kind": "lqg"}} if "controller" in spread else {}
    with pytest.raises(ValueError, match=words):
        case(spread, **lqg)


AREAS = "\n[spread]\nplant.A = { percent = 10 }\n"
SHORT = [("duration = 0.2", "duration = 1e-3"), ("settle = 0.05", "settle = 0.0")]


@pytest.fixture
def files(tmp_path):
    """Return a function that writes the template with replaced text to a file, and returns its path."""

    def written(name, *changes, end=""):
        text = template("machine")
        for old, new in (*SHORT, *changes):
            assert old in text
            text = text.replace(old, new)
        (tmp_path / name).write_text(text + end)
        return str(tmp_path / name)

    return written


@pytest.mark.slow  # compiles the rollout of the ensemble and that of one machine
def test_members_are_machines(files, tmp_path, capsys):
    path = files("m.toml", end=f"\n{dumps({'spread': SPREAD})}")
    main(["ensemble", path, "--members", "3", "--out", str(tmp_path / "e"), "--json"])
    summary = json.loads(capsys.readouterr().out)
    assert summary["survivors"] == 3
    columns = np.load(tmp_path / "e" / "members.npz")
    assert np.ptp(columns["rms_error_m"]) > 0
    main(["simulate", path, "--member", "2", "--seed", "0", "--out", str(tmp_path / "s"), "--json"])
    alone = json.loads(capsys.readouterr().out)
    for name in ("rms_error_m", "max_abs_i_A", "rms_u_V", "clearance_used"):
        assert alone[name] == pytest.approx(columns[name][2], rel=1e-6), name
    speed = np.load(tmp_path / "s" / "trajectory.npz")["speed_rpm"][0]
    assert speed == pytest.approx(columns["spread.rotor.speed"][2])


@pytest.mark.thorough
def test_compare(files, tmp_path):
    still = ("speeds = [0.0, 6000.0, 12000.0]", "speeds = [0.0]")
    soft = ("[processor]", "c = 150.0\n\n[processor]")
    paths = [files("one.toml", still, end=AREAS), files("two.toml", still, soft, end=AREAS)]
    code = main(["compare", *paths, "--members", "3", "--out", str(tmp_path / "c")])
    summary = json.loads((tmp_path / "c" / "compare.json").read_text())
    for row, one in zip(summary["cases"], map(read_any, paths), strict=True):
        errors = chunk(study_of(one, 0, 3), 0, 3, 3)["settled_rms_error_m"]
        point = machine_sensitivity(one.machine, one.axes, 5e-5, 0.0, one.zones)
        assert row["rms_error_median_m"] == np.median(errors)
        assert {name: own["peak"] for name, own in row["axes"].items()} == {a.name: a.S.height for a in point.axes}
        assert row["worst_at"] == f"{point.worst.name} at 0 rpm"
        for key in ("max_u_V", "max_i_A", "max_error_m"):
            assert row[key] == max(own[key] for own in row["axes"].values())
    assert summary["cases"][0]["peak"] != summary["cases"][1]["peak"]
    assert summary["differences"] == []
    assert code == 0
    assert (tmp_path / "c" / "compare.png").exists()


@pytest.mark.thorough
def test_a_cell_of_a_map_is_a_machine(files):
    x, y = "rotor.speed=6000:30000:2", "initial.q.1=-3e-5:6e-5:2"
    found = survival_map(read_any(files("m.toml")), x, y).map
    other = files("o.toml", ("speed = 6000.0", "speed = 30000.0"), ("q = [2e-5, -3e-5,", "q = [2e-5, 6e-5,"))
    for path, cell in ((files("m.toml"), (0, 0)), (other, (1, 1))):
        alone = simulate_machine(read_any(path)).metrics
        assert found.error[cell] == pytest.approx(alone["settled_max_abs_error_m"], rel=1e-6)
    assert found.survival.min() == 1
    assert found.unstable.max() == 0


def test_axes_of_a_map(files, monkeypatch):
    path = files("m.toml", end=AREAS)
    study, x, y = study_and_axes(read_any(path), "plant.A=-10%:10%:2", "rotor.speed=0:4e6:2", 2, None)
    # one value for all axes, which replaces the spread; the steps resolve the fastest rotor
    assert study.parts(x.path) == tuple(f"bearing.{axis}.plant.A" for axis in study.case.axes)
    assert len(study.parts("bearing.left.plant.A")) == 2
    assert study.parts(y.path) == ("rotor.speed",)
    assert study.clock.method.substeps > study_of(read_any(path), None, 2).clock.method.substeps
    halved = study.at(PERIOD, 2.5e-5)
    assert halved.clock.samples == 2 * study.clock.samples
    assert study.rereads("processor.delay")
    assert not study.rereads("controller.position.c")
    for one, count in (("controller.model.A", 5), ("bearing.left.controller.model.A", 2)):
        assert study.rereads(one)
        gains, own = ([case.cascade.position.c for case in of.case.cases] for of in (study, study.at(one, 9e-5)))
        assert np.not_equal(gains, own).sum() == count
    tested = []  # all speeds, but only that of the cell if they vary
    monkeypatch.setattr(machine_study, "turning_machines", lambda *x: tested.append(x[2]) or [])
    for values in ({}, {"rotor.speed": np.array([9e3])}):
        study.stable(values, np.arange(1))
    assert tested == [{0.0, 6000.0, 12000.0}, {9000.0}]
    runs = Stability(
        *np.array([[True, False, True], [math.nan] * 3, [0, 1, 0], [1.0, 3.0, 2.0], [2.0] * 3, [0] * 3]), 1.0, 2.0
    )
    monkeypatch.setattr(machine_study, "growth_of", lambda system: -1.0)
    monkeypatch.setattr(machine_study, "turning_machines", lambda *x: [SimpleNamespace(system=None)] * 3)
    for found, words in (
        (None, "The linearised loops of all 1"),
        (runs._replace(stable=runs.stable > 0), "amplitude 3 m"),
    ):
        monkeypatch.setattr(machine_study, "machine_stability", lambda *_, found=found: found)
        assert words in study.findings(np.arange(1)).words()
    for bad, words in (("plant.m=1:2", "Spread rotor.m"), ("rotor.speed=-1e9:0", "rotor.speed must be")):
        with pytest.raises(ValueError, match=words):
            study_and_axes(read_any(path), bad, "initial.q.0=0:1e-5", 1, None)


def test_tuned_machines_are_compared(files, tmp_path, monkeypatch):
    """The tuner is replaced: it writes its answer, or finds nothing to tune."""
    paths = [files("one.toml"), files("two.toml")]

    def tune(words, program, nested):
        if "two" in words[0]:
            raise NothingToTuneError
        (folder := tmp_path / "tuned-one").mkdir()
        files("tuned-one/tuned.toml", ("[processor]", "c = 321.0\n\n[processor]"))
        assert words == [paths[0], "--settings-of", paths[0], "--out", str(folder)]

    monkeypatch.setattr(comparison_tuning, "extension", lambda name: {"tune": tune}[name])
    cases = [read_any(path) for path in paths]
    options = argparse.Namespace(cases=paths, out=str(tmp_path), resume=False, force=False)
    one, two = comparison_tuning.tuned_cases(cases, tmp_path, options)
    assert (one.name, one.folder) == ("one", tmp_path)
    assert float(one.cases[0].cascade.position.c) == 321.0
    assert two is cases[1]


def test_compare_refuses(files, tmp_path, capsys):
    machine, axis = files("m.toml"), tmp_path / "axis.toml"
    axis.write_text(template("rig"))
    other = files("n.toml", end="\n[spread]\nplant.A = { percent = 1 }\n")
    for argv, words in (
        ([machine, str(axis)], "Compare cases of one kind"),
        ([machine, other, "--page"], "--page: a machine"),
        ([machine, other], "Give both cases the same [spread]"),
    ):
        assert words in refusal(capsys, "compare", *argv, "--out", tmp_path / "no")
