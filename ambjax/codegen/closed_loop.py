"""Loops with compiled parts (the controller, the plant or both) compared with JAX's own closed loop."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.codegen.c99.machine import Compiled
from ambjax.codegen.controller import Controller, controller_of
from ambjax.codegen.interface import OUTPUTS, Status
from ambjax.codegen.loop_step import LoopStep
from ambjax.codegen.plant_step import PlantStep
from ambjax.codegen.trace import in_jax
from ambjax.codegen.twins import Horizon, LoopCase, farthest, horizons, series
from ambjax.control.cascade_state import Command
from ambjax.numerics.records import Scalar, canonical, record, static
from ambjax.simulation.between import SampledState
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import begin, segment
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import sampled_of
from ambjax.world.sensor import Errors

FAULTS = [1 << k for k, name in enumerate(Status._fields) if name in ("invalid", "failed")]
(REFUSED,) = (1 << k for k, name in enumerate(Status._fields) if name == "refused")


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


@record
class CompiledLoop(Sampled):
    """The sampled loop whose laws are the compiled controller `which` of `machines`."""

    which: Scalar = 0.0
    machines: Machines = static(default=None)

    def start(self) -> SampledState:
        return super().start()._replace(control=jnp.zeros(self.machines.room + 1))

    def jump(self, t: Scalar, state: SampledState, errors: Errors) -> SampledState:
        state, measured = self.read(state, errors)
        processor, size = self.processor, self.machines.room + 1
        shape = jax.ShapeDtypeStruct((size + 1 + len(OUTPUTS),), float)
        given = self.which, state.control, jnp.stack([*measured, *self.reference(t)])
        found = jax.pure_callback(self.machines.step, shape, *given, vmap_method="sequential")
        bits = found[size].astype(int)
        command = Command(**dict(zip(OUTPUTS, found[size + 1 :], strict=True)), i_ref_dot=jnp.zeros(()))
        faulty = bits & sum(FAULTS) != 0
        past, finite = processor.remembered(state.command.u, *state.past), jnp.where(faulty, 0.0, state.finite)
        watch, guard = state.watch, processor.guard
        if watch and guard:  # from `left`, `Sampled.row` finds whether a reading was refused
            watch = watch._replace(left=jnp.where(bits & REFUSED, 0.0, jnp.asarray(guard.samples)))
        return state._replace(control=found[:size], command=command, past=past, finite=finite, watch=watch)


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
# Samples per call, until the horizon is reached.
BLOCK = 1000
begin_jit, segment_jit = jax.jit(begin), jax.jit(segment, static_argnames=("count", "record_every"))


def compare_loops(case: LoopCase, machines: dict[str, Compiled]) -> dict[str, LoopComparison]:
    """Compare the loop of each compiled controller to JAX's loop. Returns one comparison for each precision."""
    given = sampled_of(case.cascade, case.scenario, case.clock)
    host, found = Machines(*machines.values()), {}
    for which, (precision, horizon) in enumerate(horizons(case, list(machines)).items()):
        looped = CompiledLoop(**vars(given), which=which, machines=host)
        z = _displacement(looped, case.clock, horizon.samples)
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


def _displacement(system: CompiledLoop, clock: Clock, count: int) -> np.ndarray:
    """Return z of a loop over at least its first `count` samples, m."""
    system, clock = canonical((system, clock))
    progress, rows, block = begin_jit(system, clock, None), [], min(BLOCK, clock.samples)
    for first in range(0, max(count, 1), block):
        progress, row = segment_jit(system, clock, None, progress, first, count=block, record_every=1)
        rows.append(np.asarray(row.z))
    return np.concatenate(rows)


# Function that returns the controller's voltage (V) for readings and reference, [7], and stores the controller's state.
Law = Callable[[np.ndarray], float]


def compare_blocks(case: LoopCase, machines: dict[str, Compiled]) -> dict[str, LoopComparison]:
    """Compare the loop of each compiled plant, or each compiled loop, to JAX's loop. Keys: the precisions."""
    block = next(iter(machines.values())).trace.block
    plant = block.plant if isinstance(block, LoopStep) else block
    assert isinstance(plant, PlantStep)
    case = case._replace(clock=case.clock.with_method(plant.method))
    controller = controller_of(case.cascade, case.scenario.u_max, plant.period, case.scenario)
    found = {}
    for precision, horizon in horizons(case, list(machines), held=True).items():
        inputs = series(case.cascade, case.scenario, case.clock, max(horizon.samples, 1))
        machine = machines[precision]
        z = looped(machine, inputs, None if block.noun == "loop" else law_of(controller))
        found[precision] = LoopComparison(horizon, times_of(z, horizon))
    return found


def looped(machine: Compiled, inputs: dict[str, np.ndarray], law: Law | None) -> np.ndarray:
    """Return the true z (m) of a loop at every sample of `inputs`. `law`: the controller of a compiled plant."""
    names, u = [x.name for x in machine.trace.inputs], 0.0
    count = len(inputs["r"])
    rows = np.array([inputs.get(name, np.zeros(count)) for name in names]).T
    references = np.array([inputs[name] for name in ("r", "r_dot", "r_ddot", "r_dddot")]).T
    at = [x.name for x, _ in machine.trace.outputs].index("z_true")
    machine.state[()] = np.zeros((), machine.memory)
    z = np.empty(count)
    for n in range(count):
        machine.inputs[:] = rows[n]
        if law is not None:
            machine.inputs[names.index("u")] = u
        machine.step()
        z[n] = machine.outputs[at]
        if law is not None:
            u = law(np.concatenate([machine.outputs[:3], references[n]]))
    return z


def law_of(controller: Controller) -> Law:
    """Return JAX's step of a controller as a function with a state."""
    memory, step = in_jax(controller)
    step = jax.jit(step)

    def law(x: np.ndarray) -> float:
        nonlocal memory
        memory, outputs, _ = step(memory, jnp.asarray(x, float))
        return float(outputs.u)

    return law
