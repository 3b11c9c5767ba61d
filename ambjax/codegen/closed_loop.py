"""Loops with compiled parts (the controller, the plant or both) compared with JAX's own closed loop."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.codegen.c99.machine import Compiled
from ambjax.codegen.controller import controller_of
from ambjax.codegen.interface import OUTPUTS, REFERENCES, STATUS
from ambjax.codegen.loop_step import LoopStep
from ambjax.codegen.plant_step import PlantStep
from ambjax.codegen.trace import in_jax
from ambjax.codegen.twins import Horizon, LoopCase, farthest, horizons, series
from ambjax.control.cascade_state import Command
from ambjax.numerics.records import Scalar, canonical, record, replaced, static
from ambjax.simulation.between import SampledState
from ambjax.simulation.rollout import ExtendedOnProcessor, run
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import sampled_of
from ambjax.simulation.trajectory import Row
from ambjax.world.sensor import Errors

BITS = {name: 1 << k for k, name in enumerate(STATUS)}


class Machines:
    """Compiled controllers with one function `step`, which takes the controller's index, its memory and its inputs.

    A memory is an array: the state, padded with zeros to `room` numbers, and the flag `started`.
    """

    def __init__(self, *machines: Compiled) -> None:
        self.machines = machines
        self.room = max(len(machine.trace.state) for machine in machines)

    def step(self, which: np.ndarray, memory: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Step controller `which`. Return [*memory, bits, *outputs]."""
        machine, memory = self.machines[int(which)], np.asarray(memory)
        count = len(machine.trace.state)
        machine.state["numbers"], machine.state["started"] = memory[:count], int(memory[-1])
        machine.inputs[:] = np.asarray(inputs)
        bits, rest = machine.step(), [0.0] * (self.room - count)
        return np.array([*machine.state["numbers"], *rest, machine.state["started"], bits, *machine.outputs], float)


class CompiledState(NamedTuple):
    """State of the sampled loop, whose own laws do not step, and the memory of the compiled controller."""

    loop: SampledState
    memory: Array


@record
class CompiledLoop(ExtendedOnProcessor):
    """The sampled loop whose laws are the compiled controller `which` of `machines`."""

    loop: Sampled
    which: Scalar = 0.0
    machines: Machines = static(default=None)

    def start(self) -> CompiledState:
        return CompiledState(self.loop.start(), jnp.zeros(self.machines.room + 1))

    def row(self, t: Scalar, state: CompiledState, errors: Errors, alive: Array) -> Row:
        return self.loop.row(t, state.loop, errors, alive)

    def jump(self, t: Scalar, state: CompiledState, errors: Errors) -> CompiledState:
        own, measured = self.loop.read(state.loop, errors)
        processor, size = self.loop.processor, self.machines.room + 1
        shape = jax.ShapeDtypeStruct((size + 1 + len(OUTPUTS),), float)
        given = self.which, state.memory, jnp.stack([*measured, *self.loop.reference(t)])
        found = jax.pure_callback(self.machines.step, shape, *given, vmap_method="sequential")
        bits = found[size].astype(int)
        command = Command(**dict(zip(OUTPUTS, found[size + 1 :], strict=True)), i_ref_dot=jnp.zeros(()))
        faulty = bits & (BITS["invalid"] | BITS["failed"]) != 0
        past, finite = processor.remembered(own.command.u, *own.past), jnp.where(faulty, 0.0, own.finite)
        watch, guard = own.watch, processor.guard
        if watch and guard:  # from `left`, `Sampled.row` finds whether a reading was refused
            watch = watch._replace(left=jnp.where(bits & BITS["refused"], 0.0, jnp.asarray(guard.samples)))
        own = own._replace(command=command, past=past, finite=finite, watch=watch)
        return CompiledState(own, found[:size])


class LoopComparison(NamedTuple):
    """Comparison of two closed loops over the horizon of the twins: one with the compiled C, and JAX's.

    `times`: largest ratio, over the samples, of two distances from JAX's z: that of the compiled loop and that of the
    farthest twin, each the largest so far. NaN if the horizon is too short for a verdict.
    """

    horizon: Horizon
    times: float


# Largest allowed `times`. Correct programs stay below 1 (tests/test_export_verify.py), because every state of a twin is
# changed, whereas a program rounds only in its arithmetic.
TIMES = 2.0
run_jit = jax.jit(run, static_argnames=("record_every",))


def compare(case: LoopCase, machines: dict[str, Compiled]) -> dict[str, LoopComparison]:
    """Compare the loop of a block, compiled in each precision, to JAX's loop. Keys: the precisions."""
    block = next(iter(machines.values())).trace.block
    plant = block.plant if isinstance(block, LoopStep) else block
    held, found, host = isinstance(plant, PlantStep), {}, Machines(*machines.values())
    if isinstance(plant, PlantStep):
        case = case._replace(clock=case.clock.with_method(plant.method))
    given, measured = sampled_of(case.cascade, case.scenario, case.clock), horizons(case, list(machines), held=held)
    count = max(1, *(horizon.samples for horizon in measured.values()))
    clock = replaced(case.clock, samples=count)  # one program for both precisions
    for which, (precision, horizon) in enumerate(measured.items()):
        if held:
            z = _plant_motion(machines[precision], case, count)
        else:
            system = CompiledLoop(given, which=which, machines=host)
            z = np.asarray(run_jit(*canonical((system, clock)), None, record_every=1).trajectory.rows.z)
        found[precision] = LoopComparison(horizon, times_of(z, horizon))
    return found


def times_of(z: np.ndarray, horizon: Horizon) -> float:
    """Return `LoopComparison.times` for z [samples]: inf if z has a NaN or differs where no twin does."""
    n = horizon.samples
    if not horizon.decisive:
        return np.nan
    found, twins = farthest(z[None, :n], horizon.signals["z"][:n]), horizon.parted["z"][:n]
    with np.errstate(all="ignore"):
        times = np.where(found == 0, 0.0, found / twins)
    return float(np.max(np.where(np.isnan(times), np.inf, times)))


def _plant_motion(machine: Compiled, case: LoopCase, count: int) -> np.ndarray:
    """Return the true z (m) of the loop of a compiled plant, with JAX's controller, or of a compiled loop."""
    inputs, trace = series(case.cascade, case.scenario, case.clock, count), machine.trace
    rows = {x.name: inputs.get(x.name, np.zeros(count)) for x in trace.inputs}
    references = np.array([inputs[name] for name in REFERENCES]).T
    z, at = np.empty(count), [x.name for x, _ in trace.outputs].index("z_true")
    memory, step = in_jax(controller_of(case.cascade, case.scenario.u_max, trace.block.period, case.scenario))
    step = jax.jit(step)
    machine.state[()] = np.zeros((), machine.memory)
    for n in range(count):
        machine.inputs[:] = [row[n] for row in rows.values()]
        machine.step()
        z[n] = machine.outputs[at]
        if "u" in rows and n + 1 < count:
            memory, outputs, _ = step(memory, jnp.asarray([*machine.outputs[:3], *references[n]], float))
            rows["u"][n + 1] = outputs.u
    return z
