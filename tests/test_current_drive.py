"""The amplifier that controls the current (`actuator.mode = "current"`) against closed forms, also in loops."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, Initial, Processor, Scenario, rollout, signals
from ambjax.cases.reader import case_from
from ambjax.codegen.controller import controller_of
from ambjax.control import current, inversion, observer, position
from ambjax.linear import injected, linearise, loop_matrices
from ambjax.plants import Plant
from ambjax.simulation.integrate import FixedSteps
from ambjax.simulation.sliding import Slide, slides
from ambjax.simulation.system import system_of
from ambjax.solvers import AdaptiveCashKarp, AdaptiveRodas3, with_method
from ambjax.world.amplifier import CurrentAmplifier
from ambjax.world.plant import TwoCoil
from ambjax.world.sensor import Measurement
from tuning.problem.tuning_problem import method_for

# a magnet of 2.4 kg and 0.5 mm, as a data sheet gives it
NUMBERS = {"m": 2.4, "k_z": -2e4, "mu_0": 1.2566e-6, "n": 300.0, "A": 2e-4, "s_0": 5e-4, "i_0": 2.0, "R": 1.0}
PLANTS = {"lumped": Plant(**NUMBERS), "two-coil": TwoCoil(**NUMBERS)}
MODEL, HZ, PERIOD = PLANTS["lumped"], 800.0, 6.25e-5
W = 2 * np.pi * HZ
EACH = pytest.mark.parametrize("kind", PLANTS)


def cascade(bandwidth=HZ, **more):
    law = {"position": position.StateFeedback().designed(MODEL, None), "inversion": inversion.Linearised()}
    return Cascade(current=current.AmplifierCurrent(bandwidth), **law | {"model": MODEL} | more)


def world(kind="lumped", i_max=None, **more):
    return Scenario(plant=PLANTS[kind], amplifier=CurrentAmplifier(HZ, i_max), **more)


@EACH
def test_the_current_follows_the_command_with_one_pole(kind):
    """i' = w (c - i) in every state, with motion and a disturbance; if the voltage is limited, i' is that of u_max."""
    random, plant = np.random.default_rng(1), PLANTS[kind]
    free, weak = world(kind), world(kind, u_max=5.0)
    for z, z_dot, i, c, q in random.uniform(-1, 1, (20, 5)) * [3e-4, 0.1, 1.5, 1.5, 1e3]:
        x = plant.start(Measurement(*map(jnp.asarray, (z, z_dot, i))))
        u = free.coil_voltage(jnp.asarray(c), x, q)
        # rounding, relative to the rates of single terms
        np.testing.assert_allclose(plant.measurement(plant.rates(x, u, 0.3, q)).i, W * (c - i), rtol=0, atol=1e-8 * W)
        assert float(weak.coil_voltage(jnp.asarray(c), x, q)) == np.clip(float(u), -5.0, 5.0)


@pytest.mark.slow
def test_the_poles_in_continuous_time_are_those_of_the_textbook():
    """State feedback of z, z_dot and the integral of z, with i' = w (i_star - i).

    The matrix is written explicitly, without the package.
    """
    law = cascade().position
    k_p, k_d, k_int, k_aw = (float(getattr(law, name)) for name in ("k_p", "k_d", "k_int", "k_aw"))
    a = (MODEL.k_s + 2 * MODEL.k_z) / MODEL.m
    A = [[0, 1, 0, 0], [a, 0, MODEL.k_i / MODEL.m, 0], [-W * k_p, -W * k_d, -W, -W],
         [k_int - k_aw * k_p, -k_aw * k_d, -k_aw, -k_aw]]  # fmt: skip
    plant = dataclasses.replace(MODEL, g=0.0)
    scenario = dataclasses.replace(world(), plant=plant)
    system, found = loop_matrices(cascade(model=plant), scenario, PERIOD, 0.0)
    assert found
    got, want = (np.sort_complex(np.linalg.eigvals(np.asarray(x))) for x in (system.A, A))
    # rounding of the derivatives and of the eigenvalues, whose condition is below 1e3 here
    np.testing.assert_allclose(got, want, rtol=1e-9)
    assert np.all(want.real < 0)


def sampled(**more):
    return cascade(observer=observer.Kalman(w=1700.0), processor=Processor(1.0, guard=None), **more)


@EACH
def test_a_held_command_is_followed_exactly_between_samples(kind):
    """With one sample of delay, i_{n+1} = c_{n-1} + (i_n - c_{n-1}) exp(-w T), and i_ref of a row is c_{n-1}."""
    outcome = rollout(sampled(), world(kind, initial=Initial(5e-5)), Clock(160, PERIOD), record_every=1)
    rows = outcome.trajectory.rows
    assert np.isinf(outcome.trajectory.lost_at)
    i, c = np.asarray(rows.i), np.asarray(rows.i_ref)
    decay = np.exp(-W * PERIOD)
    # RK4 in two substeps of w h = 0.16; the currents are about 1 A
    np.testing.assert_allclose(i[2:], c[1:-1] + (i[1:-1] - c[1:-1]) * decay, rtol=0, atol=2e-6)
    assert np.ptp(i) > 0.1
    # the voltage of a row is the one that acts: the current begins to follow c_{n-1}
    plant = world(kind).plant
    state = plant.start(Measurement(rows.z, rows.z_dot, rows.i))
    state = state._replace(i_1=rows.i_1, i_2=rows.i_2) if kind == "two-coil" else state
    rate = np.asarray(plant.measurement(plant.rates(state, rows.u)).i)
    np.testing.assert_allclose(rate[1:], W * (c - i)[1:], rtol=0, atol=1e-9 * W)
    assert np.all(np.abs(rows.u) <= rows.u_peak)


def test_the_command_is_limited():
    def largest(i_max):
        outcome = rollout(sampled(), world(i_max=i_max, initial=Initial(5e-5)), Clock(160, PERIOD), record_every=1)
        return np.max(np.abs(np.asarray(outcome.trajectory.rows.i)))

    assert largest(None) > 0.3
    assert 0.19 < largest(0.2) <= 0.2 + 1e-9


@pytest.mark.slow
def test_the_injected_sensitivity_is_the_linear_one():
    clock, scenario = Clock(1600, PERIOD), world("two-coil")
    linear = linearise(sampled(), scenario, clock)
    found = injected(sampled(), scenario, clock, np.array([20.0, 100.0, 200.0, 400.0, 1000.0]), amplitude=2e-8)
    # small signals: what is left is the integration error of RK4 and rounding
    np.testing.assert_allclose(found.S, linear.sensitivity(found.frequency), rtol=2e-3)
    np.testing.assert_allclose(found.KS, linear.response(found.frequency)[:, 2, 0], rtol=2e-3)


def test_the_export_commands_a_current():
    controller = controller_of(sampled(), 1.5, PERIOD)
    found = {x.name: x for x in controller.numbers()}
    assert controller.outputs["u"][0] == "A"
    assert (found["limits.u_max"].unit, found["limits.u_max"].value) == ("A", 1.5)


CURRENT = {"mode": "current", "bandwidth": 1e3}
CASE = {"plant": {"R": 1.0}, "clock": {"duration": 0.01, "sample_period": 1e-4}}


def read(actuator, **more):
    return case_from(CASE | {"actuator": actuator} | more)


def test_a_case_file_gives_the_amplifier_and_its_nominal_bandwidth():
    case = read(CURRENT | {"i_max": 0.2})
    assert case.scenario.amplifier == CurrentAmplifier(1e3, 0.2)
    assert case.cascade.current == current.AmplifierCurrent(1e3)
    given = read(CURRENT, controller={"current": {"bandwidth": 300.0}})
    assert given.cascade.current == current.AmplifierCurrent(300.0)


@pytest.mark.parametrize(
    ("actuator", "laws", "words"),
    [
        ({"mode": "current"}, {}, r"actuator\.bandwidth is missing"),
        (CURRENT | {"slew": 1e5}, {}, r"actuator\.slew: an amplifier with mode = \"current\""),
        ({"mode": "torque"}, {}, r"actuator\.mode"),
        (CURRENT, {"kind": "pi"}, r"ProportionalIntegral commands a voltage\. Leave out"),
        ({"u_max": 5.0}, {"kind": "amplifier"}, r"AmplifierCurrent commands a current\. Leave out"),
    ],
)
def test_a_law_and_an_amplifier_with_different_commands_are_refused_in_one_line(actuator, laws, words):
    with pytest.raises(ValueError, match=words):
        read(actuator, controller={"current": laws} if laws else {})


def test_in_continuous_time_steps_have_a_fixed_number_and_end_at_jumps():
    load = world(q_z=signals.Step(1.0, PERIOD / 2))
    clock = with_method(Clock(10, PERIOD), cascade(), load)
    assert isinstance(clock.method, FixedSteps)
    assert system_of(cascade(), load, clock).problem(None).edges.most == 1
    for method in (AdaptiveRodas3(), AdaptiveCashKarp()):
        with pytest.raises(ValueError, match=r"controls the current requires fixed steps.*dt = 'auto'"):
            rollout(cascade(), load, Clock(10, PERIOD, method))


@pytest.mark.parametrize(
    ("tables", "sliding"), [({}, True), ({"actuator": CURRENT}, False), ({"run": {"stop_stiffness": 1e8}}, False)]
)
def test_the_sliding_step_is_for_a_voltage_drive_without_a_stop(tables, sliding):
    # of these cases, `ambjax tune` takes sliding steps only for the first
    case = case_from(tables)
    assert isinstance(method_for(case, 3, 1), Slide) == sliding
    assert slides(case.cascade, case.scenario) == sliding
    if sliding:
        assert isinstance(case_from(tables | {"clock": {"method": "sliding"}}).clock.method, Slide)
    else:
        with pytest.raises(ValueError, match=r'clock.method = "sliding": it (needs|does not)'):
            case_from(tables | {"clock": {"method": "sliding"}})
