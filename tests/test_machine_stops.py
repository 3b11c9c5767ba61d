"""Stops of a machine at places of their own: where the rotor touches down, and the impact on an elastic stop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machine_cases import OFF

from ambjax.cases.machine_case import machine_from
from ambjax.results.runs import simulate_machine
from ambjax.results.spread_runs import simulate_members
from ambjax.world.scenario import POLE

M, I_T, G = 3.0, 0.1, 9.81
# The magnets are off: a bias of 1 uA, and amplifiers without current.
MAGNET = {"mu_0": 1.2566e-6, "n": 208.0, "A": 2.68e-4, "s_0": 5e-4, "R": 1.0, "i_0": 1e-6}
TILT, STOP, CLEARANCE = 1e-3, -0.3, 4e-4
STOPPED = {"stop_at": STOP, "clearance": CLEARANCE}
BEARINGS = [{"name": name, "kind": "radial", "at": at} for name, at in (("a", -0.2), ("b", 0.2))]


def released(own=(), tilt=TILT, **tables):
    """The machine of a rotor that falls along y, from rest with a tilt beta_x. `own`: keys of the bearing a."""
    load = {"at": 0.0, "direction": [0.0, -1.0, 0.0], "kind": "constant", "value": M * G}
    return machine_from(OFF | {
        "plant": MAGNET,
        "rotor": {"kind": "rigid", "m": M, "I_t": I_T, "I_p": 0.0, "gravity": [0.0] * 3},
        "bearing": [BEARINGS[0] | dict(own), BEARINGS[1]],
        "load": [load],
        "initial": {"q": [0.0, 0.0, 0.0, tilt, 0.0]},
        "clock": {"duration": 0.012, "sample_period": 5e-5, "dt": 5e-5},
    } | tables)  # fmt: skip


def fallen(clearance):
    """The time in which the place of the stop, at rest y = STOP TILT, falls to the clearance."""
    return np.sqrt(2 * (clearance - abs(STOP * TILT)) / G)


def test_a_rotor_is_lost_at_the_place_of_its_stop():
    lowest = CLEARANCE + STOP * TILT  # y - STOP TILT = -CLEARANCE at the stop of a
    highest = 0.9 * MAGNET["s_0"] - 0.2 * TILT  # the other bearing keeps its stop at the magnet
    centred = [bearing | {"stop_at": 0.0} for bearing in BEARINGS]  # a tilt moves the magnets alone
    for case, moves in (
        (released(STOPPED), [(-lowest, -TILT), (-CLEARANCE, 0.0), (highest, -TILT)]),
        (released(bearing=centred), [(0.0, POLE * MAGNET["s_0"] / 0.2)]),
    ):
        machine = case.machine
        state = machine.start()

        def code(q, status=machine.status, state=state):
            return status(state._replace(q=q))

        q = jnp.array([[0.0, y, 0.0, tilt, 0.0] for y, tilt in moves])
        codes = jax.vmap(code)(jnp.concatenate([0.999 * q, 1.001 * q]))
        np.testing.assert_array_equal(codes, np.repeat([0, 1], len(q)))


@pytest.mark.slow  # compiles the run of a machine
def test_a_falling_rotor_touches_down_by_the_place_and_the_clearance_alone():
    for clearance in (CLEARANCE, 4.4e-4):
        run = simulate_machine(released(STOPPED | {"clearance": clearance}, tilt=-TILT))
        signals = run.signals
        assert signals["lost_at"] == pytest.approx(fallen(clearance), rel=1e-9)
        assert float(signals["lost_at"]) < np.sqrt(2 * (0.9 * MAGNET["s_0"] - 0.2 * TILT) / G)  # at the magnet later
        held = signals["t"] < signals["lost_at"]
        y = -G * signals["t"][held] ** 2 / 2 + STOP * TILT
        np.testing.assert_allclose(signals["z_stop"][held, 1], y, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(signals["z_stop"][:, 2:], signals["z"][:, 2:])
        used = run.metrics["axes"]["a.y"]["clearance_used"]
        assert used == pytest.approx(1.0, rel=1e-12)
        assert used == run.metrics["clearance_used"]
        assert run.lost_why.endswith("on the axis a.y")


@pytest.mark.slow  # compiles the rollout of the ensemble
def test_every_member_is_lost_at_its_clearance():
    spread = {"bearing": {"a": {"y": {"run": {"clearance": {"uniform": [3.4e-4, 4.4e-4]}}}}}}
    columns = simulate_members(released(STOPPED, tilt=-TILT, spread=spread), 4, seed=1).columns
    clearances = columns["spread.bearing.a.y.run.clearance"]
    assert np.ptp(clearances) > 0
    np.testing.assert_allclose(columns["lost_at"], fallen(clearances), rtol=1e-9)
    np.testing.assert_allclose(columns["clearance_used"], 1.0, rtol=1e-12)


@pytest.mark.slow  # compiles the run of a machine
def test_an_impact_on_an_elastic_stop_turns_the_velocity_at_the_stop_around():
    """A force of 10 N for 2 ms at the centre; the impulse at the stop is 2 v m_s with 1/m_s = 1/m + l^2/I_t."""
    pulse = {"at": 0.0, "direction": [0.0, -1.0, 0.0], "kind": "pulse", "amplitude": 10.0, "start": 0.0, "stop": 2e-3}
    run = {"settle": 0.0, "stop_stiffness": 1e8}
    own = {"stop_at": STOP, "clearance": 2e-5}
    tables = {"load": [pulse], "run": run, "clock": {"duration": 0.006, "sample_period": 5e-5}, "processor": {}}
    signals = simulate_machine(released(own, tilt=0.0, **tables)).signals
    v = 10.0 * 2e-3 / M
    impulse = 2 * v / (1 / M + STOP**2 / I_T)
    q = signals["q"]
    after = (q[-1] - q[-11]) / (10 * 5e-5)
    np.testing.assert_allclose(after[[1, 3]], [-v + impulse / M, -STOP * impulse / I_T], rtol=1e-3)
    assert signals["lost_why"] == ""
