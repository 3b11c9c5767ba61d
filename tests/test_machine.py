"""Whole machines: several axes on one rotor, against one axis, closed forms and published figures."""

import copy
import dataclasses
import json
import re
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machine_cases import MUNICH, Pid
from scipy.linalg import eig
from texts import refusal

from ambjax.__main__ import main
from ambjax.cases.machine_case import machine_from, read_machine
from ambjax.cases.reader import case_from, read_case
from ambjax.cases.rotor_numbers import varied_rotor
from ambjax.cases.template_text import template
from ambjax.commands import machine_commands
from ambjax.commands.reading import read_any_with_warnings
from ambjax.compiler.short_compilation import precision
from ambjax.linear import linearise
from ambjax.linear.linear_machine import machine_sensitivity
from ambjax.numerics.records import canonical
from ambjax.page.rotor_motion import motion_of
from ambjax.pictures.machine_pictures import machine_figure
from ambjax.results.runs import simulate, simulate_machine
from ambjax.simulation.folds import PerAxis, Rms
from ambjax.simulation.rollout import run
from ambjax.world.shaft import Section, shaft_model

MACHINE = tomllib.loads(template("machine"))
FLEXIBLE = tomllib.loads(template("machine-flexible"))
RADIAL, PUSH, DRIVE = MACHINE["bearing"][:2], {"kind": "constant", "value": 1.0}, {"mode": "current", "bandwidth": 1e3}
VERTICAL = MACHINE["rotor"] | {"gravity": [0.0, 0.0, -9.81]}


def changed(raw, **tables):
    """A copy of a raw case with other tables."""
    return copy.deepcopy(raw) | tables


def short(raw, samples=200, **tables):
    """The case, simulated for a few samples."""
    period = raw["clock"]["sample_period"]
    return changed(raw, **({"clock": raw["clock"] | {"duration": samples * period}, "run": {"settle": 0.0}} | tables))


def first(**keys):
    """The tables of the bearings, of which the first one has other keys."""
    return {"bearing": [MACHINE["bearing"][0] | keys, *MACHINE["bearing"][1:]]}


@pytest.fixture(scope="module")
def machine():
    # without noise: each axis of a machine has a random key of its own
    return machine_from(short(MACHINE, sensor={"velocity": False}), "machine")


@pytest.fixture(scope="module")
def held(machine):
    return simulate_machine(machine)


def test_an_uncoupled_axis_equals_the_case_of_one_axis(machine, held):
    # The thrust axis is coupled to no other one. Its case has the same mass and no weight.
    one = machine.cases[-1]
    assert machine.axes[-1] == "thrust.z"
    alone = simulate(dataclasses.replace(one, clock=machine.clock))
    for name in ("z", "i", "u", "i_ref", "z_measured"):
        ours, theirs = held.signals[name][:, -1], np.asarray(getattr(alone.trajectory.rows, name))
        # rounding: the machine multiplies the acceleration by the mass and divides by it again
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11 * np.abs(theirs).max())
    for name in ("max_abs_u_V", "rms_error_m", "copper_loss_W"):
        assert held.metrics["axes"]["thrust.z"][name] == pytest.approx(alone.metrics[name], rel=1e-9)


@pytest.mark.thorough
def test_the_sensitivity_of_a_machine_with_an_axial_bearing_alone_is_that_of_one_axis():
    """The coordinates across the shaft, which nothing holds, count neither as unstable nor in the peak."""
    tables = {key: MACHINE[key] for key in ("plant", "controller", "processor", "actuator", "clock")}
    tables |= {"sensor": {"velocity": False}}
    machine = machine_from(tables | {"rotor": VERTICAL, "bearing": MACHINE["bearing"][2:]})
    one = case_from(tables | {"plant": MACHINE["plant"] | {"m": 2.3, "g": 9.81, "k_z": 0.0}})
    period = machine.clock.sample_period
    found = machine_sensitivity(machine.machine, machine.axes, period, 6000.0, machine.zones)
    f = np.geomspace(1, 9000, 50)
    alone = linearise(one.cascade, one.scenario, one.clock).sensitivity(f)
    assert found.stable
    np.testing.assert_allclose(np.asarray(found.system.response(f))[:, 0, 0], alone, rtol=1e-7)


def test_the_orbits_of_a_rotor_that_is_lost_before_it_settles_end_at_the_loss(machine, held):
    lost = held.signals | {"lost_at": np.asarray(0.004), "lost_why": np.asarray("touched down")}
    figure = machine_figure(dataclasses.replace(machine, settle=0.005), lost, "m")
    (orbit,) = figure.axes[-1].lines
    assert figure.get_suptitle() == f"m: {lost['lost_why']}"
    np.testing.assert_allclose(orbit.get_xdata(), 1e6 * held.signals["z"][:81, 2])  # 5e-5 s a sample


def test_the_page_of_the_motion_shows_the_displacements_of_the_axes(machine, held):
    shown = motion_of(machine, held.signals)
    kept = np.searchsorted(held.signals["t"], np.array(shown["t"]) - 1e-9)
    for at, axis in ((-0.139, 0), (0.241, 2)):
        row = shown["along"][int(np.argmin(np.abs(np.array(shown["at"]) - at)))]
        for k, motion in enumerate((shown["x"], shown["y"])):
            z = held.signals["z"][kept, axis + k]
            np.testing.assert_allclose(np.array(motion) @ row, z, rtol=0, atol=1e-4 * np.abs(z).max())


def test_a_slender_uniform_shaft_has_the_frequencies_of_the_beam():
    """A uniform free beam: k l of the first three modes; Euler-Bernoulli, valid for a slender shaft."""
    length, d, E, rho = 1.0, 2e-3, 2.1e11, 7850.0
    model = shaft_model([Section(0.0, length, d, 0.0, E, rho, 0.3)], [], np.linspace(0, length, 61), 3)
    area, I = np.pi / 4 * d**2, np.pi / 64 * d**4
    kl = np.array([4.730040745, 7.853204624, 10.99560784])
    # shear and rotary inertia lower the third mode by 4e-5 at this slenderness
    expected = (kl / length) ** 2 * np.sqrt(E * I / (rho * area)) / (2 * np.pi)
    np.testing.assert_allclose(model.frequencies, expected, rtol=1e-4)
    assert float(model.m) == pytest.approx(rho * area * length)
    assert float(model.I_t) == pytest.approx(rho * area * length**3 / 12 + rho * I * length)
    assert abs(float(model.shapes[0, 0])) == pytest.approx(2 / np.sqrt(float(model.m)), rel=1e-4)  # at the end


MBTR_SHAPES = {"left": [-0.4587, -0.0004, 0.1728, 0.136, -0.2031], "right": [-0.4649, 0.0419, 0.088, -0.1208, -0.0117]}


def test_the_rotor_of_the_munich_rig_from_its_geometry():
    """Mass, inertia, free frequencies and shapes: published model of the TUM rig (AMrotor), 4 to 6 digits."""
    with precision("float"):  # the precision of a user who does not set float64
        rotor = machine_from(short(changed(FLEXIBLE, rotor=FLEXIBLE["rotor"] | {"modes": 5}))).machine.rotor
    np.testing.assert_allclose(np.diag(rotor.M)[[0, 3]], [3.273, 0.12542], rtol=1e-4)
    assert rotor.G[3, 4] == pytest.approx(3.643e-3, rel=1e-4)
    Hz = np.sqrt(np.diag(rotor.K)[5::2]) / (2 * np.pi)
    np.testing.assert_allclose(Hz, [22.38, 105.57, 176.53, 212.87, 607.4], rtol=1e-4)
    for k, name in ((0, "left"), (2, "right")):
        # the sign of a shape is arbitrary, and the table has four digits
        np.testing.assert_allclose(abs(rotor.at_magnets[k, 5::2]), np.abs(MBTR_SHAPES[name]), atol=2e-4)


def test_campbell_lines_of_the_munich_rig_on_springs():
    """On springs of 3.5e4 N/m at 2000 rpm; AMrotor's published Campbell diagram, read off to about 1 Hz."""
    rotor = machine_from(short(changed(FLEXIBLE, rotor=FLEXIBLE["rotor"] | {"modes": 6}))).machine.rotor
    B, n, W = np.asarray(rotor.at_magnets), len(rotor.gravity), 2000 * np.pi / 30
    K = np.asarray(rotor.K) + 3.5e4 * B.T @ B
    A = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(rotor.M, K), -W * np.linalg.solve(rotor.M, rotor.G)]]
    )
    values, vectors = eig(A)
    lines = {"forward": [], "backward": []}
    for value, vector in zip(values, vectors.T, strict=True):
        if value.imag > 2 * np.pi * 80 and value.imag < 2 * np.pi * 300:
            x, y = (B[k] @ vector[:n] for k in (0, 1))
            # forward: y lags x by 90 degrees
            lines["forward" if np.imag(x * np.conj(y)) > 0 else "backward"].append(value.imag / (2 * np.pi))
    np.testing.assert_allclose(sorted(lines["forward"]), [125.9, 185.9, 234.0], atol=0.1)
    np.testing.assert_allclose(sorted(lines["backward"]), [87.6, 168.0, 196.0], atol=0.1)


def munich(folder, left, right):
    """The rig with its published PID, in continuous time."""
    from ambjax import save_controller

    save_controller(folder / "pid.npz", Pid)
    rotor = {key: value for key, value in FLEXIBLE["rotor"].items() if key not in ("damping", "speed")}
    raw = MUNICH | {
        # damping proportional to the stiffness, 5e-7 s: that of the published figures
        "rotor": rotor | {"modes": 5, "gravity": [0.0] * 3, "damping": [float(np.pi * 5e-7 * f) for f in
                          (22.378, 105.575, 176.527, 212.873, 607.44)]},
        "bearing": [{"name": name, "kind": "radial", "at": at, "sensor_at": sensor} for name, at, sensor in
                    (("left", 0.113, left), ("right", 0.623, right))],
    }  # fmt: skip
    case = machine_from(raw, "munich", "", folder)
    return machine_sensitivity(case.machine, case.axes, case.clock.sample_period, 0.0, case.zones)


def test_the_published_controller_of_the_munich_rig(tmp_path):
    """Poles and peaks from an independent program: real parts and frequencies (Hz) of the slow poles."""
    found = munich(tmp_path, 0.113, 0.623)
    slow = [pole for pole in found.poles if pole.real > -1e3 and pole.imag >= 0]
    ours = sorted({(round(p.real, 2), round(p.imag / (2 * np.pi), 2)) for p in slow if p.imag > 1}, key=lambda p: p[1])
    expected = [(-0.50, 16.72), (-127.45, 59.22), (-128.93, 61.10), (-0.50, 105.59), (-6.04, 176.75), (-5.20, 213.03),
                (-8.91, 607.5)]  # fmt: skip
    # the amplifier of 1 MHz and the pole of the derivative move the damped pair by 3e-4
    np.testing.assert_allclose(ours, expected, rtol=2e-3, atol=0.02)
    # each pair and two real poles, of the integrals, in both planes: 14 + 2 eigenvalues each
    still = [pole for pole in found.poles if abs(pole.imag) < 1 and pole.real > -1e3]
    np.testing.assert_allclose(still, [-0.5] * 4, atol=2e-3)
    assert sum(pole.imag > 1 for pole in slow) == 2 * len(expected)
    peaks = [axis.S.height for axis in found.axes]
    np.testing.assert_allclose(peaks, [5.05, 5.05, 4.85, 4.85], rtol=3e-3)
    assert found.stable
    # the figure depends on the damping of the first mode, which is printed as 0.50 1/s, to 1 %
    assert found.sigma.height == pytest.approx(9.71, rel=1e-2)
    assert found.sigma.frequency == pytest.approx(16.7, rel=2e-3)


def test_real_sensors_beside_the_magnets_make_the_munich_rig_unstable(tmp_path):
    """Rate and frequency of the worst pole from an independent program."""
    found = munich(tmp_path, 0.071, 0.665)
    worst = found.poles[0]
    assert not found.stable
    assert (worst.real, abs(worst.imag) / (2 * np.pi)) == pytest.approx((46, 173), abs=1)
    assert {axis.zone for axis in found.axes} == {"D"}


def test_planes_share_the_unbalance_of_a_grade():
    """G 2.5 of 2.3 kg at 6000 rpm: e = 2.5 mm/s / (200 pi/s), so U = m e = 9.15 g mm, half of it in each plane."""
    planes = [{"at": at, "grade": 2.5, "service_speed": 6000.0} for at in (-0.1, 0.2)]
    case = machine_from(changed(MACHINE, unbalance=[*planes, {"at": 0.0, "amount": 3.0}]))
    half = 2.3 * 2.5e-3 / (2 * np.pi * 100.0) / 1e-6 / 2
    np.testing.assert_allclose([one.amount for one in case.machine.rotor.unbalances], [half, half, 3.0], rtol=1e-12)
    # the grade is per mass; an amount that is given itself does not follow the mass
    heavy = varied_rotor(case.machine.rotor, {"unbalance.1.amount": 1.0, "rotor.m": 4.6})
    np.testing.assert_allclose([one.amount for one in heavy.unbalances], [2 * half, 1.0, 3.0], rtol=1e-12)


def test_runout_turns_with_the_rotor():
    """Over one turn, a sensor at rest reads the harmonic, with the angle of the unbalance, later by its own angle."""
    turning = MACHINE["rotor"] | {"speed": 600.0, "acceleration": 6000.0}
    sensor = {"velocity": False, "runout": {"harmonics": [{"amplitude": 1e-6, "number": 2, "phase": 0.3}]}}
    left, right, thrust = MACHINE["bearing"]
    bearings = [left, right | {"angle": 30.0}, thrust]
    case = machine_from(short(MACHINE, rotor=turning, sensor=sensor, bearing=bearings))
    t = np.linspace(0, 0.2, 9)
    angle = 2 * np.pi * (10.0 * t + 100.0 * t * t / 2)
    tilt = np.radians(30.0)
    for name, one, own in zip(case.axes, case.cases, [0.0, np.pi / 2, tilt, tilt + np.pi / 2, 0.0], strict=True):
        runout = one.scenario.turning().sensors.runout
        assert runout is not None
        expected = 1e-6 * np.sin(2 * (angle - own) + 0.3)
        np.testing.assert_allclose([float(runout(x)) for x in t], expected, atol=1e-18, err_msg=name)


@pytest.mark.slow
def test_a_machine_is_differentiable_and_an_ensemble_has_one_entry_per_member():
    # without observer, prediction and guard: compiles faster
    tables = {"controller": {"position": MACHINE["controller"]["position"]}, "sensor": {}}
    tables |= {"processor": MACHINE["processor"] | {"predict": False, "guard": False}}
    machine = machine_from(short(MACHINE, 20, **tables), "machine")
    fold = PerAxis(jax.tree.map(lambda *x: np.stack(x), *[canonical(Rms("z"))] * 5))
    whole, clock, fold = canonical((machine.machine, machine.clock, fold))
    whole, clock, fold = jax.tree.map(jnp.asarray, (whole, clock, fold))

    @jax.jit
    def displacement(amount):
        one = dataclasses.replace(whole.rotor.unbalances[0], amount=amount)
        moved = dataclasses.replace(whole, rotor=dataclasses.replace(whole.rotor, unbalances=(one,)))
        return run(moved, clock, fold, record_every=0).metrics[0]

    at, h = 20.0, 1e-2
    value, forward = map(float, jax.jvp(displacement, (at,), (1.0,)))
    (low, middle, high), slopes = jax.vmap(jax.value_and_grad(displacement))(jnp.array([at - h, at, at + h]))
    assert forward == pytest.approx(float(slopes[1]), rel=1e-9)
    assert forward == pytest.approx(float(high - low) / (2 * h), rel=1e-5)  # rounding/h and h^2
    assert float(middle) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(x, marks=pytest.mark.slow if x == "machine" else pytest.mark.thorough)
        for x in ("machine", "machine-flexible", "machine-ufu")
    ],
)
def test_the_templates_are_held_and_in_zone_a_or_b(name, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(machine_commands, "_injections", lambda *_: {})  # tests/test_machine_agreement.py
    monkeypatch.setattr(machine_commands, "drawn", lambda *_: None)  # drawing takes longer than the run
    path = tmp_path / f"{name}.toml"
    path.write_text(template(name))
    assert main(["simulate", str(path), "--out", str(tmp_path / "run"), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["lost"] is False
    with np.load(tmp_path / "run" / "trajectory.npz") as arrays:
        assert arrays["z"].shape == (len(arrays["t"]), len(arrays["axes"]))
        assert arrays["q"].shape == (len(arrays["t"]), len(arrays["coordinates"]))
    worst = max(one["settled_max_abs_error_m"] for one in metrics["axes"].values())
    assert metrics["settled_max_abs_error_m"] == worst
    assert main(["sensitivity", str(path), "--out", str(tmp_path / "s"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {axis["zone"] for speed in found["speeds"] for axis in speed["axes"]} <= {"A", "B"}
    assert found["peak"] == max(axis["peak"] for speed in found["speeds"] for axis in speed["axes"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rotor": {"kind": "rigid"}}, r"rotor\.m is missing"),
        ({"rotor": FLEXIBLE["rotor"] | {"discs": [{"at": 0, "m": 1, "I_t": 1, "I_p": 3}]}}, "I_p = 3: .*at most 2 I_t"),
        (first(at=0.2409), r"left\.y: rotor\.gravity and these places: of the share of this axis, g = "),
        ({"plant": MACHINE["plant"] | {"mass": 2.0}}, r"plant\.mass = 2\.0: unknown key\. Did you mean 'rotor\.m'"),
        (first(plant={"m": 2.0}), r"^bearing\[0\]\.plant\.m = 2\.0: the rotor gives it"),
        (first(plant={"A": -1.0}), r"left\.x: bearing\[0\]\.plant\.A = -1: it must be"),
        (first(stop=0.1), r"bearing\[0\]\.stop = 0\.1: unknown key\. Did you mean 'stop_at'"),
        (first(clearance=4e-4), r"left\.x: bearing\[0\]\.clearance = 0\.0004 m: it must be less than the gap"),
        (first(stop_at=-5.0), r"left\.y: initial\.q: at this axis z = .* touch its stop at the start"),
        ({"spread": {"bearing": {"left": {"clearance": {"uniform": [0.0, 1.0]}}}}}, r"\.bearing\.left\.clearance ="),
        ({"loads": []}, r"loads = \[\]: unknown key\. Did you mean 'load'"),
        ({"bearing": MACHINE["bearing"][:1]}, "determine .* of the .* rigid motions"),
        ({"bearing": MACHINE["bearing"][2:]}, "no axis holds x, y, .*or leave out the weight"),
        ({"bearing": RADIAL, "load": [PUSH | {"direction": [0, 0, 1]}]}, "no axis holds z.*, load"),
        ({"bearing": [{"kind": "radial", "at": 0.0}], "rotor": VERTICAL}, "no axis holds z, beta_x, beta_y"),
        (first(axes=["z"]), r"bearing\[0\]\.axes = \[.z.\]: it must be"),
        (first(axes=["x"]), "determine 4 of the 5 rigid motions"),
        ({"bearing": [one | {"axes": ["y"]} for one in RADIAL], "unbalance": []}, r"no axis holds beta_y\."),
        ({"bearing": []}, r"\[\[bearing\]\] is missing"),
        ({"clock": MACHINE["clock"] | {"dt": 1e-6, "method": "rodas3"}}, r"clock\.method = .rodas3.*Give 'rk4'"),
        ({"bearing": [MACHINE["bearing"][0]] * 2}, r"bearing\[1\]\.name = .*needs a name of its own"),
        ({"bearing": [MACHINE["bearing"][0] | {"name": "top.a"}]}, r"bearing\[0\]\.name = .top\.a.: .*without dots"),
        ({"bearing": [*MACHINE["bearing"][:2], {"kind": "axial", "angle": 45.0}]}, r"bearing\[2\]\.angle.*along the"),
        ({"base": [PUSH | {"direction": [0, 0, 0]}]}, r"base\[0\]\.direction.*not be zero"),
        ({"load": [{"direction": [1, 0, 0], "kind": "unbalance", "unbalance": 1.0}]}, r"load\[0\].*as \[\[unbalance"),
        ({"plant": MACHINE["plant"] | {"n": 20.0}}, "must carry .* N, and its magnet gives at most"),
        ({"disturbance": {"q_z": {"kind": "constant"}}}, r"\[disturbance\].*Use \[\[load\]\] or \[\[base"),
        ({"initial": {"q": [0.0, 0.0]}}, r"initial\.q has 2 numbers: it must have 5"),
        ({"sensitivity": {"speeds": [0.0, 9e3, 0]}}, r"sensitivity\.speeds = .*: 0 rpm is given more than once"),
        ({"rotor": FLEXIBLE["rotor"] | {"m": 3.0}}, r"rotor\.m = 3\.0: it follows from the geometry"),
        ({"rotor": MACHINE["rotor"] | {"kind": "modal"}}, r"rotor\.modes is missing: give \[\[rotor\.modes"),
        ({"unbalance": [{"amount": 1.0, "grade": 2.5}]}, r"unbalance\[0\]\.grade: give amount, or grade .*not both"),
        ({"controller": {"kind": "pid"}}, r"controller\.kind = .pid.: it is a law of each axis.*position\.kind"),
        ({"controller": {"kind": "linear", "output": "voltage"}, "actuator": DRIVE}, "output = .voltage.: ampl"),
        ({"controller": {"kind": "lqg"}, "processor": {"predict": True}}, r"processor\.predict = true"),
        ({"controller": {"position": {"kind": "pdi"}}}, "axis left.x: controller.position.kind"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, said):
    with pytest.raises(ValueError, match=said) as refused:
        machine_from(changed(MACHINE, **change))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("name", "advice"), [("load", "put [[load]] above each"), ("run", "table once.")])
def test_a_table_given_twice_is_refused_in_one_line(name, advice, tmp_path):
    path = tmp_path / "twice.toml"
    path.write_text(f"{template('machine')}\n[{name}]\n[{name}]\n".replace("[[load]]", "[load]"))
    with pytest.raises(ValueError, match="not valid TOML") as refused:
        read_machine(path)
    assert advice in str(refused.value)
    assert "disturbance" not in str(refused.value)


def test_an_order_that_the_samples_do_not_resolve_causes_a_warning(tmp_path, capsys):
    path = tmp_path / "fast.toml"
    path.write_text(template("machine").replace("speed = 6000.0", "speed = 400000.0"))
    said = "rotor.speed: 2 times the speed is 1.333e[+]04 Hz, not below half the sampling rate"
    for given in (path, tomllib.loads(path.read_text())):
        with pytest.warns(UserWarning, match=said):  # once, not for each axis: another warning is an error
            read_machine(given)
    read_any_with_warnings(path)
    assert len(re.findall(said, capsys.readouterr().err)) == 1


def test_one_axis_and_a_machine_are_not_confused(tmp_path, capsys):
    whole, alone = tmp_path / "whole.toml", tmp_path / "alone.toml"
    whole.write_text(template("machine"))
    alone.write_text(template("bearing"))
    with pytest.raises(ValueError, match="whole machine, and this takes one axis"):
        read_case(whole)
    with pytest.raises(ValueError, match="so it is a case of one axis"):
        read_machine(alone)
    with pytest.raises(ValueError, match="so it is a case of one axis"):
        read_machine(tomllib.loads(alone.read_text()))
    with pytest.raises(ValueError, match=r"path = 3: it must be the path of a file.*, or a dict of tables"):
        read_machine(3)
    tables = tomllib.loads(whole.read_text())
    read = read_machine(tables)
    assert tomllib.loads(read.text) == tables
    jax.tree.map(np.testing.assert_array_equal, read.machine, read_machine(whole).machine)
    for words, said in (
        (["campbell", str(alone)], "ambjax sensitivity"),
        (["simulate", str(whole), "--from", "0"], "ambjax: --from: a machine"),
        (["simulate", str(whole), "--to", "0.1"], "ambjax: --to: a machine"),
    ):
        assert said in refusal(capsys, *words)
    assert case_from(tomllib.loads(alone.read_text())).scenario.plant.m == 2.4
