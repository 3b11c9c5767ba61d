"""Controllers of a whole machine: in rigid-body coordinates, linear ones of several outputs, and LQG."""

import copy
import tomllib

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.optimize import brentq

from ambjax.cases.machine_case import machine_from
from ambjax.cases.template_text import template
from ambjax.control.lqg import LinearCoils, RotorModel, design, sampled_model
from ambjax.control.regulator import doubled
from ambjax.linear.linear_machine import machine_sensitivity
from ambjax.results.runs import simulate_machine

MACHINE = tomllib.loads(template("machine"))
# With l^2 = I_t/m at both ends, a force at one end does not move the other. All motions then have the same plant.
UNCOUPLED = {
    "rotor": {"kind": "rigid", "m": 3.0, "I_t": 0.12, "I_p": 0.0, "gravity": [3.0, -9.0, 2.0], "speed": 6000.0},
    "unbalance": [{"at": 0.2, "amount": 20.0}],
    "bearing": [
        {"name": "left", "kind": "radial", "at": -0.2},
        {"name": "right", "kind": "radial", "at": 0.2, "controller": {"notch": {"min_speed": 7000.0}}},
        {"name": "thrust", "kind": "axial"},
    ],
    "plant": {"mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "i_0": 2.5, "R": 1.0},
    "controller": {"observer": {"kind": "kalman"}, "position": {"kind": "pid"}, "inversion": {"kind": "closed-form"},
                   "current": {"kind": "pi"}, "notch": {"kind": "force-free", "rate": 100.0}},
    "sensor": {"velocity": False},
    "processor": {"delay": 1.0},
    "actuator": {"u_max": 20.0},
    "initial": {"q": [2e-5, -3e-5, 1e-5, 1e-4, 5e-5]},
    "clock": {"duration": 0.02, "sample_period": 5e-5},
    "run": {"settle": 0.0},
}  # fmt: skip


def changed(raw, **controller):
    """A copy of a raw case with other keys of [controller]."""
    raw = copy.deepcopy(raw)
    raw["controller"] |= controller
    return raw


def signals(raw):
    return simulate_machine(machine_from(raw)).signals


@pytest.mark.thorough
def test_rigid_body_coordinates_equal_the_axes_if_the_motions_have_the_same_plant():
    """Default gains of each coordinate, from its own nominal plant; a supply that limits; a guard that replaces."""
    dropouts = {"rate": 300.0, "duration": 1e-4, "value": "nan"}
    raw = UNCOUPLED | {"sensor": UNCOUPLED["sensor"] | {"dropouts": dropouts}}
    axes, rigid = signals(raw), signals(changed(raw, coordinates="rigid-body"))
    assert np.any(axes["refused"])
    assert not np.isfinite(axes["lost_at"])
    for name in ("z", "i", "u"):
        np.testing.assert_allclose(rigid[name], axes[name], rtol=0, atol=1e-9 * np.abs(axes[name]).max())


def munich(left, right, modes, **tables):
    """The rig with its real sensors, and an LQG of its own modes, designed for three speeds."""
    raw = tomllib.loads(template("machine-flexible"))
    raw["rotor"] |= {"modes": modes} | tables.get("rotor", {})
    raw["bearing"][0]["sensor_at"], raw["bearing"][1]["sensor_at"] = left, right
    raw["controller"] = {"kind": "lqg", "lqg": {"speeds": [0.0, 3000.0, 6000.0]}}
    return machine_from(raw | {key: value for key, value in tables.items() if key != "rotor"}, "munich")


@pytest.mark.slow
def test_an_lqg_holds_the_munich_rig_with_sensors_beside_its_magnets():
    """|S| in zone A between two speeds of the design. With these sensors, a PID is unstable."""
    case = munich(0.071, 0.665, 6)
    found = machine_sensitivity(case.machine, case.axes, case.clock.sample_period, 1500.0, case.zones)
    assert found.stable
    assert {axis.zone for axis in found.axes} == {"A"}


@pytest.mark.slow
def test_an_lqg_holds_the_munich_rig_in_a_run():
    """Without weight: a shaft that starts unbent is far from its sag. The unbalance moves it by about 10 um."""
    run = simulate_machine(munich(0.155, 0.581, 6, rotor={"gravity": [0.0] * 3}))
    assert not run.lost
    assert run.metrics["settled_max_abs_error_m"] < 2e-5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kind": "lqr"}, "controller.kind = .*must be one of"),
        ({"kind": "lqg", "lqg": {"speeds": [10.0, 0.0]}}, "controller.lqg.speeds = .*ascending order"),
        ({"kind": "lqg", "lqg": {"modes": 3}}, "controller.lqg.modes = 3: the rotor has 0 bending modes"),
        ({"kind": "linear"}, "controller.file is missing"),
        ({"file": "a.npz"}, 'controller.file is for kind = "linear"'),
        ({"tilt": {"position": {"k_p": 1.0}}}, r'controller\.tilt is for coordinates = "rigid-body"'),
        ({"coordinates": "rigid-body", "tilt": {"current": {}}}, r"controller\.tilt\.current"),
        ({"coordinates": "rigid-body", "tilt": {"position": {"kind": "pid"}}}, "same kind in all coordinates"),
        ({"coordinates": "rigid-body", "left": {"position": {"c": 300.0}}},
         r"bearing\[0\]\.controller\.position: in rigid-body coordinates"),
    ],
)  # fmt: skip
def test_bad_keys_are_refused_in_one_line(change, said):
    """`left`: the controller of the first bearing."""
    raw = changed(MACHINE, **{key: value for key, value in change.items() if key != "left"})
    raw["bearing"][0] |= {"controller": change["left"]} if "left" in change else {}
    if "kind" in change:
        raw["controller"] = change
    with pytest.raises(ValueError, match=said) as refused:
        machine_from(raw)
    assert "\n" not in str(refused.value)


@pytest.mark.thorough
def test_a_diagonal_controller_of_a_file_equals_one_controller_on_each_axis(tmp_path):
    """K = 2e4 (1 + s/500)/(1 + s/5e3) A/m, continuous; the states start at the reading."""
    raw = UNCOUPLED | {"processor": {"delay": 1.0, "predict": False}, "sensor": {}}
    A, B, C, D = -5e3, 1.0, -9 * 2e4 * 5e3, 10 * 2e4
    np.savez(tmp_path / "one.npz", A=A, B=B, C=C, D=D)
    np.savez(tmp_path / "all.npz", **{name: x * np.eye(5) for name, x in zip("ABCD", (A, B, C, D), strict=True)})
    one = {"position": {"kind": "linear", "file": "one.npz"}, "current": {"kind": "pi"}}
    one["inversion"] = {"kind": "linearised"}
    alone, whole = (
        simulate_machine(machine_from(raw | {"controller": controller}, "case", "", tmp_path)).signals
        for controller in (one, {"kind": "linear", "file": "all.npz"})
    )
    assert not np.isfinite(alone["lost_at"])
    for name in ("z", "i", "u"):
        np.testing.assert_allclose(whole[name], alone[name], rtol=0, atol=1e-9 * np.abs(alone[name]).max())


def test_the_riccati_equation_is_solved_as_by_scipy():
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(9, 9)) / 2, rng.normal(size=(9, 3))  # some poles are outside the unit circle
    Q, R = np.diag(rng.uniform(0.1, 1, 9)), np.diag([1.0, 2.0, 3.0])
    np.testing.assert_allclose(doubled(A, B, Q, R), solve_discrete_are(A, B, Q, R), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.5, 2.0])
def test_the_loop_of_an_lqg_has_the_poles_of_its_feedback_and_of_its_filter(delay):
    """Separation: each pole of the loop belongs to one of them, so that all are stable; a load leaves no offset."""
    rotor = RotorModel(
        M=np.diag([3.0, 0.12, 1.0]), D=np.diag([0.0, 0.0, 6.0]), K=np.diag([0.0, 0.0, 600.0**2]),
        B=np.array([[1.0, -0.2, -0.4], [1.0, 0.25, 0.5]]), C=np.array([[1.0, -0.25, -0.6], [1.0, 0.3, 0.7]]),
        constant=np.array([0.0, 0.0, 5.0]),
    )  # fmt: skip
    coils = LinearCoils(*(np.full(2, x) for x in (1e5, 50.0, 1.0, 0.01, 0.0)))
    weights = {"error": 1e-5, "current": 0.2, "noise": 2e-7, "force": 80.0, "drift": 1e4, "bending": 0.3}
    T = 1e-4
    law, plant = design(rotor, coils, weights, 250.0, T, delay), sampled_model(rotor, coils, T, delay)
    signs = np.diag([-1.0, -1.0, 1.0, 1.0]) @ plant.H
    loop = np.block([[plant.F + plant.G @ law.D @ signs, plant.G @ law.C], [law.B @ signs, law.A]])
    poles, n = np.linalg.eigvals(loop), len(plant.F)
    assert np.abs(poles).max() < 1 - 1e-5
    # an error of the estimate moves as without feedback: its poles are those of A - G C, with G the effect of u
    filter_poles = np.linalg.eigvals(law.A + law.B @ np.zeros((4, n + 2)) - law.E @ law.C)
    for pole in filter_poles:
        assert np.abs(poles - pole).min() < 1e-6
    load = np.concatenate([plant.f + plant.pushed @ [20.0, -10.0] + plant.G @ law.b, law.a])
    rest = np.linalg.solve(np.eye(len(loop)) - loop, load)
    assert np.abs(rotor.B @ rest[:3]).max() < 1e-12  # the magnets are centred, and the shaft is bent
    assert abs(rest[2]) > 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("controller", [{}, {"coordinates": "rigid-body"}])
def test_a_start_at_rest_has_no_bump(controller):
    """Off centre, where the currents hold the rotor at the reference: the first voltage stays, R i of each axis."""
    r, raw = 2e-5, tomllib.loads(template("machine"))
    raw |= {
        "controller": {"observer": {"kind": "kalman"}, "position": {"kind": "pid"},
                       "inversion": {"kind": "closed-form"}, "current": {"kind": "dead-beat"}} | controller,
        "sensor": {"velocity": False, "bandwidth": 3000.0}, "processor": {"delay": 0.0},
        "reference": {"kind": "constant", "value": r}, "load": [], "unbalance": [],
        "initial": {"q": [r, r, r, 0.0, 0.0]}, "clock": {"duration": 0.005, "sample_period": 5e-5},
        "run": {"settle": 0.0},
    }  # fmt: skip
    plants = [one.scenario.plant for one in machine_from(raw).cases]
    held = [brentq(lambda i, p=p: float(p.a * p.v(r, i) - p.g), -1.4, 1.4, xtol=1e-15) for p in plants]
    raw["initial"]["i"] = held
    signals = simulate_machine(machine_from(raw)).signals
    np.testing.assert_allclose(signals["u"], np.broadcast_to(held, signals["u"].shape), rtol=0, atol=1e-12)  # 1 ohm
    np.testing.assert_allclose(signals["z"], r, rtol=0, atol=1e-16)
