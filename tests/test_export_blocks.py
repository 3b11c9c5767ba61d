"""The plant and the loop as blocks: their steps are the simulator's, and what cannot be exported is refused."""

import dataclasses
import functools
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_export import compiled, failed

from ambjax import Clock, rollout
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.codegen.c99.source import Origin
from ambjax.codegen.fmi.archive import run_block
from ambjax.codegen.loop_step import WHAT, block_of
from ambjax.codegen.trace import arguments
from ambjax.codegen.twins import LoopCase, series
from ambjax.codegen.verify import draft, verify
from ambjax.control.processor import Processor
from ambjax.sensors import Sensor
from ambjax.signals import Constant, Pulse, Sine
from ambjax.simulation.integrate import FixedSteps
from ambjax.simulation.rosenbrock import AdaptiveRodas3
from ambjax.simulation.trajectory import TOUCHED
from ambjax.solvers import RK4
from ambjax.world.amplifier import Amplifier
from ambjax.world.faults import Dropouts, Outliers
from ambjax.world.plant import TwoCoil
from ambjax.world.rotation import Runout


def rig(**more):
    """The laboratory bearing: Kalman filter, set-valued signs, low-pass, converter, current limit."""
    case = case_from(tomllib.loads(template("rig")))
    scenario = dataclasses.replace(case.scenario, **more)
    return case.cascade, scenario, Clock(400, case.clock.sample_period)


RIG = rig()
CASES = {
    "rig": RIG,
    "two coils": rig(
        plant=TwoCoil(**{f.name: getattr(RIG[1].plant, f.name) for f in dataclasses.fields(TwoCoil)}),
        amplifier=Amplifier(bandwidth=5e3, slew=2e6, dead_band=0.1),
    ),
    "3.4 samples late": (dataclasses.replace(RIG[0], processor=Processor(3.4)), *RIG[1:]),
}


@functools.cache
def blocks(name):
    return {what: block_of(what, *CASES[name]) for what in WHAT}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_the_steps_of_the_loop_equal_the_simulator(name):
    cascade, scenario, clock = CASES[name]
    block, count = blocks(name)["loop"], 100
    x = series(cascade, scenario, clock, count)
    outputs, bits = run_block(block, np.array([x[port] for port in block.inputs]).T)
    rows = rollout(cascade, scenario, clock.with_method(block.plant.method)).trajectory.rows
    found = dict(zip(block.outputs, outputs.T, strict=True))
    # 100 samples of hard signs, in which rounding (1e-20 m) grows by a few decades (ambjax/codegen/twins.py)
    np.testing.assert_allclose(found["z_true"], rows.z[:count], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found["z"], rows.z_measured[:count], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found["u"], rows.u[:count], rtol=0, atol=1e-6)
    assert np.ptp(rows.z[:count]) > 1e-6
    assert not np.any(bits & ~1)  # nothing but a voltage at its limit


@functools.cache
def stepping(sensor=None):
    """Return the plant of the rig, or of the rig with another sensor, and its compiled step."""
    block = blocks("rig")["plant"] if sensor is None else block_of("plant", *rig(sensor=sensor))
    parameters, memory, inputs, period = arguments(block)
    read = frozenset(block.inputs)
    return jax.jit(lambda p, memory, x: block.step(p, memory, x, period, read)), parameters, memory, inputs


def plant_step(machine=None, sensor=None, **inputs):
    """One step of the plant after the first one: memory before, first outputs and status, result of the step."""
    step, parameters, memory, ports = stepping(sensor)
    parameters = dataclasses.replace(parameters, **{k: jnp.asarray(x) for k, x in (machine or {}).items()})
    memory, *first = step(parameters, memory, ports)
    return memory, first, step(parameters, memory, ports._replace(**{k: jnp.asarray(x) for k, x in inputs.items()}))


def test_a_rotor_beyond_the_clearance_is_lost_and_frozen():
    _, (_, first), (after, outputs, status) = plant_step({"clearance": 1e-5}, u=10.0)
    assert (first.touched, status.touched, status.diverged) == (True, True, False)
    assert outputs.z_true == 5e-5  # as it began
    assert after.lost == TOUCHED


@pytest.mark.parametrize("name", ["u", "q_z", "w_z"])
def test_an_input_that_is_not_finite_is_reported_and_replaced_by_0(name):
    _, _, (_, outputs, status) = plant_step(**{name: np.nan})
    _, _, (_, plain, fine) = plant_step(**{name: 0.0})
    assert (status.invalid, fine.invalid) == (True, False)
    assert outputs == plain
    assert plant_step({"delay": 3.0})[2][2].invalid


def test_a_disturbance_acts_in_the_step_that_integrates_its_sample():
    cascade, scenario, clock = rig(q_z=Pulse(2.0, 3 * 5e-5, 5 * 5e-5), q_i=Constant(7.0), reference=Sine(1e-5, 50.0))
    x = series(cascade, scenario, clock, 8)
    np.testing.assert_array_equal(x["q_z"], [0, 0, 0, 0, 2, 2, 0, 0])
    np.testing.assert_array_equal(x["q_i"], 7.0)
    ahead = float(cascade.processor.delay)  # the laws see a prediction, and the reference of its instant
    np.testing.assert_allclose(x["r"], 1e-5 * np.sin(2 * np.pi * 50 * 5e-5 * (np.arange(8) + ahead)), atol=1e-15)


@pytest.mark.parametrize(
    "part", [{"outliers": Outliers(at=1e-3)}, {"dropouts": Dropouts(at=1e-3)}, {"runout": Runout()}]
)
def test_parts_that_an_exported_plant_lacks_are_refused_in_one_line(part):
    case = rig(sensor=Sensor(**part))
    for what in ("plant", "loop"):
        with pytest.raises(ValueError, match=rf"sensor\.{next(iter(part))}: the exported plant") as error:
            block_of(what, *case)
        assert "\n" not in str(error.value)
    assert block_of("controller", *case).noun == "controller"


def test_a_plant_needs_a_processor_and_fixed_steps():
    cascade, scenario, clock = RIG
    with pytest.raises(ValueError, match=r"\[processor\] is missing"):
        block_of("plant", dataclasses.replace(cascade, processor=None), scenario, clock.with_method(RK4(1)))
    # a case whose method is adaptive gets the simulator's choice among those with fixed steps
    assert isinstance(block_of("plant", cascade, scenario, clock.with_method(AdaptiveRodas3(1e-6))).method, FixedSteps)


@pytest.mark.thorough
@compiled
@pytest.mark.parametrize("what", ["plant", "loop"])
@pytest.mark.parametrize("name", CASES)
def test_the_c_of_each_block_passes_all_checks(what, name):
    cascade, scenario, clock = CASES[name]
    block = blocks(name)[what]
    one = draft(block, "double", "amb", Origin("test", "0" * 64, block.described()), 2000)
    checks = verify({"double": one}, LoopCase(cascade, scenario, clock, 0.0))
    assert len(checks) == 10
    assert not failed(checks)
    # the points are no formality: the rotor is levitated, lost, and an input is not finite, at some of each
    bits = one.steps["one step"][1].bits
    counts = {bit: np.sum(bits & (1 << k) > 0) for k, bit in enumerate(block.bits)}
    assert all(counts[bit] > 5 for bit in ("touched", "diverged", "invalid"))
    assert np.sum(bits == 0) > 200
