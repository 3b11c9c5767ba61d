"""Controllers of a whole machine: in rigid-body coordinates."""

import copy
import tomllib

import numpy as np
import pytest

from ambjax.cases.machine_case import machine_from
from ambjax.cases.template_text import template
from ambjax.results.machine_run import simulate_machine

MACHINE = tomllib.loads(template("machine"))
# With l^2 = I_t/m at both ends, a force at one end does not move the other. All motions then have the same plant.
UNCOUPLED = {
    "rotor": {"kind": "rigid", "m": 3.0, "I_t": 0.12, "I_p": 0.0, "gravity": [3.0, -9.0, 2.0]},
    "bearing": [
        {"name": "left", "kind": "radial", "at": -0.2},
        {"name": "right", "kind": "radial", "at": 0.2},
        {"name": "thrust", "kind": "axial"},
    ],
    "plant": {"mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "i_0": 2.5, "R": 1.0},
    "controller": {"observer": {"kind": "kalman"}, "position": {"kind": "pid"}, "inversion": {"kind": "closed-form"},
                   "current": {"kind": "pi"}},
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


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [{}, {"dropouts": {"rate": 300.0, "duration": 1e-4, "value": "nan"}}])
def test_rigid_body_coordinates_equal_the_axes_if_the_motions_have_the_same_plant(sensor):
    """Default gains of each coordinate, from its own nominal plant; a supply that limits; a guard that replaces."""
    raw = UNCOUPLED | {"sensor": UNCOUPLED["sensor"] | sensor}
    axes, rigid = signals(raw), signals(changed(raw, coordinates="rigid-body"))
    assert np.any(axes["refused"]) == bool(sensor)
    assert not np.isfinite(axes["lost_at"])
    for name in ("z", "i", "u"):
        np.testing.assert_allclose(rigid[name], axes[name], rtol=0, atol=1e-9 * np.abs(axes[name]).max())


@pytest.mark.slow
def test_rigid_body_coordinates_in_continuous_time_equal_the_axes():
    raw = copy.deepcopy(UNCOUPLED)
    del raw["processor"]
    raw["clock"] = {"duration": 0.004, "sample_period": 1e-5}
    axes, rigid = signals(raw), signals(changed(raw, coordinates="rigid-body"))
    for name in ("z", "i", "u"):
        np.testing.assert_allclose(rigid[name], axes[name], rtol=0, atol=1e-9 * np.abs(axes[name]).max())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"coordinates": "modal"}, "controller.coordinates = .*must be one of"),
        ({"tilt": {"position": {"k_p": 1.0}}}, r'controller\.tilt is for coordinates = "rigid-body"'),
        ({"coordinates": "rigid-body", "tilt": {"current": {}}}, r"controller\.tilt\.current"),
        ({"coordinates": "rigid-body", "tilt": {"position": {"kind": "pid"}}}, "same kind in all coordinates"),
    ],
)
def test_bad_keys_are_refused_in_one_line(change, said):
    with pytest.raises(ValueError, match=said) as refused:
        machine_from(changed(MACHINE, **change))
    assert "\n" not in str(refused.value)


def test_a_bearing_has_no_position_law_of_its_own_in_rigid_body_coordinates():
    raw = changed(MACHINE, coordinates="rigid-body")
    raw["bearing"][0]["controller"] = {"position": {"c": 300.0}}
    with pytest.raises(ValueError, match=r"bearing\[0\]\.controller\.position: in rigid-body coordinates"):
        machine_from(raw)
