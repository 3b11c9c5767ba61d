"""Software in the loop: JAX's plant under the compiled C, beside JAX's plant under JAX's controller."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Command
from ambjax.export.controller import BITS, INPUTS, OUTPUTS
from ambjax.export.machine import Compiled
from ambjax.numerics.records import Scalar, canonical, record, static
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.metrics import Standard
from ambjax.simulation.rollout import run
from ambjax.simulation.sampled import Sampled, SampledState, system_of
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference

FAULTS = [1 << k for k, name in enumerate(BITS) if name in ("refused", "failed")]


class Kept(NamedTuple):
    """What the C keeps, and how often it refused an input or a law gave no number."""

    numbers: Array
    started: Array
    faults: Array


class Machines:
    """Compiled controllers as one function of numbers: which of them, what it keeps, what it reads."""

    def __init__(self, *machines: Compiled):
        self.machines = machines
        self.room = max(machine.state["numbers"].size for machine in machines)

    def step(self, which: Any, numbers: Any, started: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray]:
        """Numbers kept, and started, bits and outputs."""
        machine = self.machines[int(which)]
        count = machine.state["numbers"].size
        machine.state["numbers"], machine.state["started"] = np.asarray(numbers)[:count], int(started)
        machine.inputs[:] = np.asarray(inputs)
        bits = machine.step()
        kept = np.zeros(self.room)
        kept[:count] = machine.state["numbers"]
        return kept, np.array([float(machine.state["started"]), float(bits), *machine.outputs], float)


@record
class Looped(Sampled):
    """The sampled loop with its laws in C: `which` of the machines."""

    which: Scalar
    machines: Machines = static()

    def realised(self) -> "Looped":
        return dataclasses.replace(self, loop=self.loop.realised())

    def start(self) -> SampledState:
        zero = jnp.zeros(())
        return super().start()._replace(control=Kept(jnp.zeros(self.machines.room), zero, zero))

    def decided(self, measured: Measurement, reference: Reference, state: SampledState) -> SampledState:
        kept: Any = state.control
        inputs = jnp.stack([*measured, *reference])
        shapes = jax.ShapeDtypeStruct((self.machines.room,), float), jax.ShapeDtypeStruct((2 + len(OUTPUTS),), float)
        numbers, rest = jax.pure_callback(
            self.machines.step, shapes, self.which, kept.numbers, kept.started, inputs, vmap_method="sequential"
        )
        answer = dict(zip(OUTPUTS, rest[2:], strict=True))
        command = Command(**answer, i_ref_dot=jnp.zeros(()))
        faulty = rest[1].astype(int) & sum(FAULTS) != 0
        after: Any = Kept(numbers, rest[0], kept.faults + faulty)
        past = (state.command.u, state.past[0])
        return SampledState(state.plant, after, command, past, jnp.where(faulty, 0.0, state.sane))


class Loop(NamedTuple):
    """One closed loop: displacement (m) over time, every metric, and how many samples ended in a fault of the C."""

    z: np.ndarray
    metrics: dict[str, float]


run_jit = jax.jit(run, static_argnames=("every",))


def loops(cascade: Any, scenario: Scenario, clock: Clock, fold: Standard, machines: list[Compiled]) -> list[Loop]:
    """The case under JAX's controller, and under each compiled one."""
    given: Any = system_of(cascade, scenario, clock)
    found = [_loop(given, clock, fold)]
    host = Machines(*machines)
    for which in range(len(machines)):
        found.append(_loop(Looped(ClosedLoop(given.loop.cascade, scenario), given.period, which, host), clock, fold))
    return found


def _loop(system: Any, clock: Clock, fold: Standard) -> Loop:
    system, clock, fold = canonical((system, clock, fold))
    outcome = run_jit(system, clock, fold, every=1)
    return Loop(np.asarray(outcome.trajectory.rows.z), {k: float(v) for k, v in outcome.measured.items()})
