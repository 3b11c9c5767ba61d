"""The limits of each coil against closed forms, in a loop, and in the numbers that follow from them."""

import dataclasses
import functools
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import RIG

from ambjax import Scenario, rollout
from ambjax.actuators import Amplifier
from ambjax.cases.forces import forces
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.codegen.block import numbers_of
from ambjax.commands.check_text import machine
from ambjax.simulation.integrate import Begin, InitialValueProblem
from ambjax.solvers import RK4
from ambjax.world.amplifier import CoilLimits, difference
from ambjax.world.magnet import Iron
from ambjax.world.plant import TwoCoil
from ambjax.world.sensor import Measurement

STILL = TwoCoil(**RIG)
L = float(STILL.L)
STEP, STEPS = 1e-5, 300
IRON = Iron(saturation=1.2, leakage=1.1, eddy=5e-5)


def world(plant=STILL, **limits):
    return Scenario(plant=plant, amplifier=Amplifier(coil=CoilLimits(**limits)))


def at(plant, i_1, i_2, z=0.0, z_dot=0.0):
    """The state with these currents of the coils (A)."""
    start = plant.start(Measurement(*map(jnp.asarray, (z, z_dot, 0.0))))
    return start._replace(i_1=jnp.asarray(i_1), i_2=jnp.asarray(i_2))


@functools.partial(jax.jit, static_argnames=("steps", "clamped"))
def driven(scenario, u, state, steps=STEPS, clamped=True):
    """The state after `steps` steps of STEP (s) under a constant u (V). A clamped rotor does not move.

    Each coil of a clamped rotor is a resistance and a constant inductance.
    """
    plant = scenario.plant

    def rates(u, x):
        moving = plant.rates(x, scenario.applied(u, x))
        return moving._replace(z=0.0 * x.z, z_dot=0.0 * x.z) if clamped else moving

    problem = InitialValueProblem(lambda _: u, rates, plant.scale(), lambda _: jnp.asarray(0))
    return RK4(steps).advance(problem, Begin(0.0, state, ()), steps * STEP).state


def free(i, volt, time):
    """Current (A) of a coil after `time` (s) under a constant voltage (V)."""
    return volt / STILL.R + (i - volt / STILL.R) * np.exp(-STILL.R * time / L)


def test_the_voltage_of_each_coil_is_within_its_limit():
    scenario = world(u_max=40.0)
    for u in (-100.0, -39.0, -10.0, 0.0, 37.4, 38.0, 41.0, 60.0):
        got = scenario.applied(jnp.asarray(u), at(STILL, 2.5, 2.5))
        volts = np.clip([2.5 + u, 2.5 - u], -40.0, 40.0)
        assert [2.5 + got.upper, 2.5 - got.lower] == pytest.approx(volts, abs=1e-13)  # a unit in the last place of 40
        assert float(difference(got)) == pytest.approx((volts[0] - volts[1]) / 2, abs=1e-13)
        if abs(u) < 37.5:
            assert got.upper == got.lower == u
    after = driven(scenario, 60.0, at(STILL, 2.5, 2.5))
    # RK4 with R h/L = 1.4e-3
    assert [after.i_1, after.i_2] == pytest.approx([free(2.5, v, STEPS * STEP) for v in (40.0, -40.0)], rel=1e-12)


@pytest.mark.parametrize("iron", [None, IRON], ids=["ideal", "iron"])
@pytest.mark.parametrize("side", [1, -1], ids=["upper", "lower"])
def test_a_coil_at_its_limit_keeps_its_current_while_the_rotor_moves(side, iron):
    plant = TwoCoil(**RIG, iron=iron)
    scenario = world(plant, i_max=4.0, unidirectional=True)
    # One coil is at its limit and the other at 0 A; slightly beyond, so that rounding does not release them.
    high, low = 4.0 + 1e-6, -1e-6
    state = at(plant, *((high, low) if side > 0 else (low, high)), z=1e-4, z_dot=0.2)
    for u, kept in ((60.0, True), (-30.0, False)):
        voltages = scenario.applied(jnp.asarray(side * u), state, 3.0)
        rates = plant.rates(state, voltages, 0.0, 3.0)
        unlimited = plant.rates(state, side * u, 0.0, 3.0)
        scale = abs(float(unlimited.i_1))  # about 1e4 A/s; rounding of the quotient that gives the kept voltage
        for coil in ("i_1", "i_2"):
            expected = 0.0 if kept else float(getattr(unlimited, coil))
            assert float(getattr(rates, coil)) == pytest.approx(expected, abs=1e-11 * scale)
    after = driven(scenario, side * 60.0, state, 10, clamped=False)
    assert [float(i) for i in after[2:4]] == pytest.approx([float(i) for i in state[2:4]], abs=1e-11)
    assert abs(float(after.z - state.z)) > 1e-5


def test_without_unidirectional_a_current_is_limited_in_both_directions():
    state, u = at(STILL, -3.0, 3.0), jnp.asarray(-30.0)
    upper, lower = world(i_max=3.0).applied(u, state)
    assert [upper + 2.5, 2.5 - lower] == pytest.approx([-3.0, 3.0], abs=1e-12)  # R i of each
    assert world(i_max=3.1).applied(u, state) == (u, u)
    assert world(u_max=50.0).applied(u, state) == (u, u)


@pytest.mark.parametrize(("i_max", "unidirectional"), [(4.0, True), (4.0, False), (None, True)])
def test_the_current_reaches_its_limits_and_stays_within_one_step(i_max, unidirectional):
    u, scenario = 40.0, world(i_max=i_max, unidirectional=unidirectional)
    after = driven(scenario, u, at(STILL, 2.5, 2.5))
    least = 0.0 if unidirectional else -4.0
    ends = [free(2.5, 2.5 + u, STEPS * STEP), free(2.5, 2.5 - u, STEPS * STEP)]
    # the largest rise in a step, which begins below the limit
    step = (u + 2.5) / L * STEP
    top, low = min(ends[0], i_max or np.inf), max(ends[1], least)
    assert -1e-12 <= float(after.i_1) - top <= step  # RK4 with R h/L = 7e-4 is exact to rounding
    assert -step <= float(after.i_2) - low <= 1e-12
    per_square = float(STILL.kappa) / 4 / 5e-4**2
    got = float(STILL.m * STILL.a * STILL.signals(after).v)
    assert got == pytest.approx(per_square * (top**2 - low**2), abs=per_square * step * (2 * top + step))
    # longer at the limit: no drift
    longer = driven(scenario, u, at(STILL, 2.5, 2.5), 3 * STEPS)
    if i_max:
        assert float(longer.i_1) == pytest.approx(float(after.i_1), abs=step)
    if unidirectional:
        assert float(longer.i_2) == pytest.approx(float(after.i_2), abs=step)


def read(coil=None, actuator=None, **more):
    raw = tomllib.loads(template("rig"))
    raw["plant"]["kind"] = "two-coil"
    raw["actuator"] = {"u_max": 48.0} | (actuator or {}) | ({} if coil is None else {"coil": coil})
    for name, table in more.items():
        raw[name] = raw.get(name, {}) | table
    return case_from(raw)


@pytest.mark.slow
def test_an_active_limit_acts_in_the_loop_and_an_inactive_one_does_not():
    plain, far = read(), read({"u_max": 1e4, "i_max": 1e3})
    near = read({"u_max": 48.0, "i_max": 2.55, "unidirectional": True})
    clock = dataclasses.replace(plain.clock, samples=30)
    runs = [rollout(case.cascade, case.scenario, clock) for case in (plain, far, near)]
    rows, same, held = (run.trajectory.rows for run in runs)
    # two programs: rounding, which 30 samples of the unstable rotor increase by two decades
    np.testing.assert_allclose(same.i_1, rows.i_1, rtol=1e-11)
    np.testing.assert_allclose(same.z, rows.z, rtol=0, atol=1e-15)
    assert np.max(rows.i_2) > 2.7
    # half of the rise within a substep, as for the limit of |i|
    assert 2.55 < np.max(held.i_2) < 2.55 + 50.5 / L * plain.clock.sample_period / 2
    assert held.u_peak.max() <= 48.0


def test_force_and_voltage_reserves_follow_from_the_limits():
    def facts(case):
        return {fact.key: fact.value for fact in machine(case)}

    k_i, weight = float(read().scenario.plant.k_i), 1.64 * 9.81
    # L di/dt is half the difference of the voltages: at 48 V, 2.5 V + 48 V and 2.5 V - 48 V within the limit of a coil
    for coil, i, volt, reserve in (
        (None, 2.5, 48.0, None),
        ({"i_max": 3.5}, 1.0, 48.0, None),
        ({"i_max": 9.0, "u_max": 48.0}, 2.5, (48.0 + 45.5) / 2, 45.5),
        ({"u_max": 30.0, "unidirectional": True}, 2.5, 30.0, 27.5),
    ):
        case = read(coil)
        found = facts(case)
        assert forces(case).largest == pytest.approx(k_i * i, rel=1e-12)
        assert found["force_reserve"] == pytest.approx(k_i * i / weight, rel=1e-12)
        assert found["current_slew_A_per_s"] == pytest.approx(volt / L, rel=1e-12)
        assert found["coil_voltage_reserve_V"] == reserve
        assert float(case.scenario.voltage_limit) == min(48.0, reserve or 48.0)


def test_the_limits_can_be_spread_and_are_parameters_of_the_exported_plant():
    case = read({"u_max": 48.0, "i_max": 4.0}, spread={"actuator.coil.u_max": {"percent": 10}})
    assert "actuator.coil.u_max" in case.spread.paths
    names = [number.name for number in numbers_of(case.scenario.amplifier, "actuator.")]
    assert names == ["actuator.coil.u_max", "actuator.coil.i_max"]


@pytest.mark.parametrize(
    ("coil", "more", "words"),
    [
        ({"i_max": 4.0}, {"plant": {"kind": "lumped"}}, r'actuator\.coil: Plant has one current.*kind = "two-coil"'),
        ({"i_max": 4.0}, {"actuator": {"i_max": 2.0}}, r"actuator\.i_max: .*actuator\.coil\.i_max = plant\.i_0 \+ i_"),
        ({"i_max": 2.5}, {}, r"actuator\.coil\.i_max = 2\.5 A: .* plant\.i_0 = 2\.5 A"),
        ({"u_max": 1e-3}, {}, r"actuator\.coil\.u_max = 0\.001 V: .* R i_0"),
        ({"i_min": 0.0}, {}, r"actuator\.coil\.i_min = 0\.0: unknown key\. Did you mean 'i_max'"),
        ({"unidirectional": 1}, {}, r"actuator\.coil\.unidirectional = 1: it must be true or false"),
        ({"unidirectional": True}, {"initial": {"i": -2.6}}, r"initial\.i = -2\.6 A: .* at most 2\.5 A"),
        ({"i_max": 3.0}, {"spread": {"plant.i_0": {"percent": 30}}}, r"i_max can be as small as 3 A.*reaches 3\.25 A"),
        ({"u_max": 9.0}, {"spread": {"actuator.coil.u_max": {"percent": 90}}}, r"u_max can be as small as 0\.9 V"),
        (4.0, {}, r"actuator\.coil = 4\.0: it must be a table"),
    ],
)
def test_limits_that_contradict_the_case_are_refused_in_one_line(coil, more, words):
    with pytest.raises(ValueError, match=words) as error:
        read(coil, **more)
    assert "\n" not in str(error.value)


def test_coil_limits_need_a_processor_and_a_voltage():
    laws = {"plant": {"kind": "two-coil"}, "sensor": {}}
    with pytest.raises(ValueError, match=r"actuator\.coil is for a controller on a processor"):
        case_from(laws | {"actuator": {"coil": {"i_max": 1.0}}})
    with pytest.raises(ValueError, match=r"actuator\.coil: an amplifier with mode = \"current\" has no such"):
        case_from(laws | {"actuator": {"mode": "current", "bandwidth": 1e3, "coil": {"i_max": 1.0}}})
