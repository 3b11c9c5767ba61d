"""Tuning of whole machines: derivatives, gains of one bearing, and the command."""

import dataclasses
import re
import tomllib
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from texts import refusal
from tomlkit import dumps

import tuning
from ambjax.cases.machine_case import machine_from, read_any
from ambjax.cases.table import Table
from ambjax.cases.template_text import template
from ambjax.commands.machine_commands import outside_lines
from ambjax.linear.linear_machine import machine_sensitivity, turning_machines
from ambjax.results.machine_study import MachineStudy
from ambjax.results.operating import sensitivity
from tuning.__main__ import main
from tuning.machines.machine_gains import MachineSpace, lqg_space, machine_space
from tuning.machines.machine_peaks import Peaks, Value
from tuning.machines.machine_search import Settings, minimise, save, saved, searched
from tuning.machines.machine_tuning import judged
from tuning.problem.space import Gain, Space

PARTS = {"position": {"kind": "pid"}, "inversion": {"kind": "linearised"}, "current": {"kind": "pi"}}
GAINS = ["controller.position.k_d", "bearing.left.controller.position.k_p", "bearing.right.controller.position.k_p"]


# the equilibrium of this law depends on its gains
SLIDING = ["controller.position.c_int", *(f"bearing.{one}.controller.position.k" for one in ("left", "right"))]


def raw_case(**tune):
    raw = tomllib.loads(template("machine"))
    raw["controller"] |= PARTS
    return raw | {"tune": tune}


def quick_case(**tune):
    """The case without observer and prediction, which compiles faster; its sensors measure the velocity."""
    raw = raw_case(**tune) | {"sensor": {}}
    raw["processor"] |= {"predict": False}
    del raw["controller"]["observer"]
    return raw


def space_of(raw):
    case = machine_from(raw)
    return case, machine_space(Table(raw).table("tune"), case, raw)


@pytest.fixture(scope="module")
def peaks():
    raw = quick_case(gains=SLIDING)
    raw["controller"]["position"] = {"kind": "integral-sliding-mode"}
    case, space = space_of(raw)
    return case, space, Peaks(case, space)


@pytest.mark.slow  # compiles the loop and its derivatives
@pytest.mark.parametrize("integral", [0.3, -45.0])  # almost without it, a pole is at 0 and |S| is largest at 0 Hz
def test_the_peak_is_that_of_the_sensitivity(peaks, integral):
    case, space, found = peaks
    x = space.space.encode(space.values(case)) + np.array([integral, -0.2, 0.1])
    machine = space.decode(jnp.asarray(x), case.machine)
    points = [machine_sensitivity(machine, case.axes, case.clock.sample_period, v, case.zones) for v in case.speeds]
    worst = max(point.worst.S.height for point in points)
    assert np.exp(found.peak(x).f) == pytest.approx(worst, rel=1e-3)
    growth = max(np.max(np.real(point.poles)) for point in points)
    assert found.stability(x).f == pytest.approx(growth, rel=1e-3, abs=1e-6)
    S = [np.diagonal(point.system.response([v / 60])[0]) for point, v in zip(points, case.speeds, strict=True) if v]
    assert found.turning(x) == pytest.approx(np.max(np.abs(S)), rel=1e-9)


@pytest.mark.thorough  # compiles the loop and its derivatives
def test_the_search_designs_the_notches_for_its_gains():
    """Poles and peak are those of the machine that is read with the gains, and so are the derivatives."""
    raw: dict[str, Any] = quick_case(gains=["controller.position.k_d"]) | {"sensitivity": {"speeds": [6000.0]}}
    raw["controller"] |= {"notch": {"kind": "displacement-free", "rate": 20.0}}
    raw["bearing"][2]["controller"] = {"notch": {"kind": "none"}}
    case, space = space_of(raw)
    found, k_d = Peaks(case, space), 1.6 * space.values(case)[0]
    pid = {"position": PARTS["position"] | {"k_d": float(k_d)}}
    same = machine_from(raw | {"controller": raw["controller"] | pid})
    point = machine_sensitivity(same.machine, same.axes, same.clock.sample_period, 6000.0, same.zones)
    x, h = space.space.encode([k_d]), 1e-5
    assert found.stability(x).f == pytest.approx(np.max(np.real(point.poles)), rel=1e-4)
    assert np.exp(found.peak(x).f) == pytest.approx(point.worst.S.height, rel=1e-3)
    for function in (found.stability, found.peak):
        step = (function(x + h).f - function(x - h).f) / (2 * h)
        assert function(x).gradient == pytest.approx(step, rel=0.02)


@pytest.mark.thorough
def test_search_and_verdict_see_peaks_outside_the_band_of_the_case(peaks):
    """The band ends at 20 Hz, below the peaks."""
    case, space, found = peaks
    narrow = dataclasses.replace(case, zones=dataclasses.replace(case.zones, f_high=20.0))
    x = space.space.encode(space.values(case))
    assert Peaks(narrow, space).peak(x).f == pytest.approx(found.peak(x).f, rel=1e-9)
    facts = [judged(one, one, {"sensitivity": 9.0}, 0, 1) for one in (case, narrow)]
    assert facts[0]["sensitivity"]["peak"] == pytest.approx(facts[1]["sensitivity"]["peak"], rel=1e-3)
    (first, *_) = sensitivity(narrow)
    assert len(outside_lines(first, narrow.zones)) == len(narrow.axes)
    assert not outside_lines(sensitivity(case)[0], case.zones)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["peak", "stability"])
def test_derivatives(peaks, name):
    case, space, found = peaks
    function = getattr(found, name)
    x = space.space.encode(space.values(case)) + np.array([0.3, -0.2, 0.1])
    h = 1e-5
    steps = [(function(x + h * e).f - function(x - h * e).f) / (2 * h) for e in np.eye(3)]
    # the frequencies of the grid move with the poles
    np.testing.assert_allclose(function(x).gradient, steps, rtol=0.02, atol=0.02 * np.abs(steps).max())


def test_a_gain_of_a_bearing_belongs_to_its_axes():
    case, space = space_of(raw_case(gains=GAINS))
    axes = {gain.path: [case.axes[k] for k in gain.axes] for gain in space.gains}
    assert axes[GAINS[0]] == list(case.axes)
    assert axes[GAINS[1]] == ["left.x", "left.y"]
    x = space.space.encode([100.0, 2e5, 3e5])
    position = space.decode(jnp.asarray(x), case.machine).axes[0].loop.cascade.position
    np.testing.assert_allclose(position.k_p[:4], [2e5, 2e5, 3e5, 3e5])
    np.testing.assert_allclose(position.k_d, 100.0)
    before = case.machine.axes[0].loop.cascade.position
    assert float(position.k_p[4]) == float(before.k_p[4])


def test_bfgs_finds_the_minimum_of_a_function_that_is_not_smooth():
    # |x - 1| + 8 |y - x^2|: its minimum lies on a curved ridge
    def function(p):
        x, y = p
        a, b = np.sign(x - 1), 8 * np.sign(y - x**2)
        return Value(p, abs(x - 1) + 8 * abs(y - x**2), np.array([a - 2 * x * b, b]))

    found = minimise(function, function(np.array([-0.7, 0.6])), 500, lambda value: False)
    assert found.f < 1e-3


def lqg_case(**tune):
    raw = tomllib.loads(template("machine"))
    raw |= {"controller": {"kind": "lqg"}, "tune": tune, "sensitivity": {"speeds": [6e3]}}
    del raw["bearing"][2]
    case = machine_from(raw)
    return case, lqg_space(Table(raw).table("tune"), case, raw)


def test_the_weights_of_an_lqg_begin_at_those_of_the_case():
    case, space = lqg_case(bounds={"controller": {"lqg": {"error": [1e-9, 1e-3]}}})
    x = space.space.encode(space.values(case))
    assert len(x) == 5  # bending included, although the rotor is rigid
    law = space.decode(x, case.machine).law
    for name in ("A", "B", "C", "D", "start"):
        np.testing.assert_allclose(getattr(law, name), getattr(case.machine.law, name), rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_peak_and_derivatives_of_an_lqg():
    case, space = lqg_case(gains=[f"controller.lqg.{name}" for name in ("error", "noise")])
    found, x = Peaks(case, space), space.space.encode(space.values(case)) + np.array([0.5, 0.3])
    machine, h = space.decode(x, case.machine), 1e-4
    points = [machine_sensitivity(machine, case.axes, case.clock.sample_period, v, case.zones) for v in case.speeds]
    assert np.exp(found.peak(x).f) == pytest.approx(max(point.worst.S.height for point in points), rel=1e-3)
    steps = [(found.peak(x + h * e).f - found.peak(x - h * e).f) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(found.peak(x).gradient, steps, rtol=0.02, atol=0.02 * np.abs(steps).max())


class Parabola:
    """A machine with one gain g: it is stable for g < e^3, and log |S| is least at g = e^2."""

    def stability(self, x):
        return Value(x, x[0] - 3, np.ones(1))

    def stable(self, value):
        return value.f <= 0

    def peak(self, x):
        return Value(x, (x[0] - 2) ** 2, 2 * (x - 2)) if x[0] < 3 else Value(x, np.inf, np.zeros(1))


@pytest.mark.parametrize(("lost_above", "expected"), [(4.0, 2.0), (1.0, 1.0), (-9.0, 2.0)])
def test_no_member_is_lost_for_a_lower_peak(lost_above, expected):
    settings = Settings(MachineSpace(Space((Gain("controller.position.k"),)), ()), {}, 1.0, 0, 3, 100, 2)
    lost = lambda x: 2 * int(x[0] > lost_above)  # noqa: E731
    found = searched(Parabola(), settings, np.ones(1), lost, lambda words: None).answer
    assert found.x[0] == pytest.approx(expected, abs=0.01)
    assert found.x[0] <= max(lost_above, expected)


def test_a_search_killed_after_any_start_ends_as_the_uninterrupted_one(tmp_path):
    settings = Settings(MachineSpace(Space((Gain("controller.position.k"),)), ()), {}, 1.0, 0, 4, 2, 2)
    after, path, facts = [], tmp_path / "round-1.npz", {"case": 1}

    def search(before, save):
        return searched(Parabola(), settings, np.ones(1), lambda x: int(x[0] > 1.5), print, before, save)[:4]

    whole = search(None, after.append)
    assert [now.number for now in after] == [1, 2, 3, 4]
    assert len({now.best.f for now in after}) > 1  # later starts change the result
    for now in after:
        save(path, facts, now)
        again = search(saved(path, facts, print), lambda now: None)
        assert (again[1].x, again[1].f, again[2], again[3].f) == (whole[1].x, whole[1].f, whole[2], whole[3].f)
    with pytest.raises(ValueError, match="belongs to another search: case is 1"):
        saved(path, {"case": 2}, print)
    path.write_bytes(path.read_bytes()[:-40])
    assert saved(path, facts, print) is None  # damaged: the search begins again


@pytest.mark.parametrize(
    ("tune", "words"),
    [
        ({"gains": ["controller.position.k_q"]}, "k_q"),
        ({"gains": ["bearing.top.controller.position.k_p"]}, "bearing.top"),
        ({"gains": ["controller.position.k_p", "bearing.left.controller.position.k_p"]}, "both"),
        ({"gains": []}, "empty"),
    ],
)
def test_refused_gains(tune, words):
    with pytest.raises(ValueError, match=words):
        space_of(raw_case(**tune))
    with pytest.raises(ValueError, match="k_p"):
        lqg_case(gains=["controller.lqg.k_p"])


@pytest.mark.parametrize("options", [["--resume"], ["--pareto"]])
def test_refused_options(tmp_path, capsys, options):
    path = tmp_path / "m.toml"
    path.write_text(template("machine"))
    assert options[0] in refusal(capsys, path, *options, program=main)


@pytest.mark.slow  # compiles no other peaks than the tests above
def test_command(tmp_path, capsys):
    budget = {"starts": 1, "iterations": 1, "held_out": 2, "limits": {"sensitivity": 2.5}}
    raw = quick_case(gains=SLIDING, **budget) | {"run": {"settle": 0.0}}
    raw["controller"]["position"] = {"kind": "integral-sliding-mode"}
    raw["clock"]["duration"] = 2e-3
    path = tmp_path / "m.toml"
    path.write_text(dumps(raw))

    heard = []

    def killed(event):
        heard.append(event.text)
        if "start 1 of 1" in event.text:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        tuning.tune(path, tmp_path / "t", listen=killed)
    with pytest.raises(ValueError, match="search that has not ended"):
        tuning.tune(path, tmp_path / "t")
    found = tuning.tune(path, tmp_path / "t", resume=True)
    assert "start 1 of 1" not in capsys.readouterr().err  # it is not searched again
    # an ended search is not repeated
    assert tuning.tune(path, tmp_path / "t", resume=True).report["gains"] == found.report["gains"]
    before, after = found.report["before"], found.report["sensitivity"]
    assert after["peak"] < before["peak"]
    # although the default of a gain depends on whether k is given
    assert float(re.findall(r"best peak ([\d.]+)", heard[-1])[-1]) == pytest.approx(after["peak"], rel=1e-3)
    # the file is the answer, with the gains of each bearing in its table
    again = read_any(tmp_path / "t" / "tuned.toml")
    assert max(point.worst.S.height for point in sensitivity(again)) == pytest.approx(after["peak"], rel=1e-6)
    raw = tomllib.loads((tmp_path / "t" / "tuned.toml").read_text())
    assert raw["bearing"][0]["controller"]["position"]["k"] == pytest.approx(found.report["gains"][1]["after"])
    assert found.good == (after["peak"] <= 2.5)
    # 5 kN: all members are lost, so that no limit of theirs is met
    load = raw["load"][0] | {"amplitude": 5e3, "start": 0.0}
    pushed = machine_from(raw | {"load": [load], "sensitivity": {"speeds": [0.0]}})
    facts = judged(pushed, pushed, {"max_u_V": 1e6}, 0, 2)
    assert (facts["outcome"]["held"], facts["limits"][0]["holds"]) == (0, False)
    assert "all limits met" not in facts["verdict"]
    # two turns in the run: each limit at the speed holds or breaks by itself
    fast = {"rotor": raw["rotor"] | {"speed": 60000.0}, "sensitivity": {"speeds": [12000.0]}}
    turning = machine_from(raw | fast)
    one = {"z_1x_m": 1.0, "i_1x_A": 9.0, "sensitivity_1x": 99.0}
    values = judged(turning, turning, one, 0, 2)["metrics"]
    (point,) = turning_machines(turning.machine, 5e-5, turning.speeds)
    S = np.diagonal(point.system.response([12000.0 / 60])[0, :5, :5])
    assert values["sensitivity_1x"] == pytest.approx(np.max(np.abs(S)), rel=1e-9)
    found = judged(turning, turning, {name: 0.999 * values[name] for name in one} | {"max_u_V": 1e6}, 0, 2)
    assert [row["holds"] for row in found["limits"]] == [False, False, False, True]
    assert min(row["value"] for row in found["limits"]) > 0
    assert all(name in found["verdict"] for name in one)


@pytest.mark.slow
def test_members_that_are_held_but_not_stable_refute_the_answer():
    """Delays of up to 8 samples without prediction: the motion grows, too slowly to reach a stop within 2 ms."""
    raw = quick_case() | {"run": {"settle": 1e-3}, "spread": {"processor": {"delay": {"uniform": [0.5, 8.0]}}}}
    raw = {name: table for name, table in raw.items() if name != "load"} | {"sensitivity": {"speeds": [6000.0]}}
    raw["clock"] |= {"duration": 2e-3}
    case = machine_from(raw)
    facts = judged(case, case, {"sensitivity": 3.0}, 0, 6)
    stable = MachineStudy(case, 0, 6).stable(MachineStudy(case, 0, 6).drawn(np.arange(6)), np.arange(6))
    assert 0 < np.sum(~stable) == facts["outcome"]["stability"]["unstable"]
    assert (facts["outcome"]["held"], facts["outcome"]["good"]) == (6, False)
    assert "not stable" in facts["verdict"]
    assert "all limits met" not in facts["verdict"]
