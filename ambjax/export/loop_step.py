"""The exported loop: the plant's step, then the controller's, in the order of the simulator."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.export.block import Block, Ports
from ambjax.export.controller import Controller, Memory, Parameters
from ambjax.export.interface import BITS, INPUTS, OUTPUTS, Status, StepInputs, StepOutputs
from ambjax.export.numbering import Number
from ambjax.export.plant_ports import DISTURBANCES, LOSSES, READINGS, PlantInputs, PlantOutputs
from ambjax.export.plant_step import Machine, PlantMemory, PlantStep
from ambjax.numerics.records import Scalar
from ambjax.simulation.integrate import choose
from ambjax.simulation.trajectory import ALIVE

REFERENCES = {name: port for name, port in INPUTS.items() if name not in READINGS}


class LoopInputs(NamedTuple):
    """Inputs of a step of the loop: those of the plant over the sample before, and the reference."""

    q_z: Array
    q_i: Array
    w_z: Array
    w_z_dot: Array
    w_i: Array
    r: Array
    r_dot: Array
    r_ddot: Array
    r_dddot: Array


class LoopMemory(NamedTuple):
    """State of controller and plant; `control.started` is a real number, 0 or 1."""

    control: Memory
    plant: PlantMemory


class LoopParameters(NamedTuple):
    """Parameters of controller and plant."""

    controller: Parameters
    machine: Machine


class LoopOutputs(NamedTuple):
    """Outputs of a step of the loop."""

    command: StepOutputs
    motion: PlantOutputs


class LoopStatus(NamedTuple):
    """Status of the controller, and whether the rotor is lost."""

    controller: Status
    touched: Array
    diverged: Array


@dataclasses.dataclass(frozen=True)
class LoopStep(Block):
    """Controller and plant of a case as one block."""

    parameters: LoopParameters
    controller: Controller
    plant: PlantStep

    noun: ClassVar[str] = "loop"
    ports: ClassVar[Any] = LoopInputs
    inputs: ClassVar[Ports] = DISTURBANCES | REFERENCES
    outputs: ClassVar[Ports] = OUTPUTS | READINGS
    bits = (
        BITS | {"invalid": "an input or a parameter is NaN or out of range: u is held, or a disturbance is 0"} | LOSSES
    )
    crowded = ("saturated", "refused", "touched", "diverged")

    def step(
        self, parameters: LoopParameters, memory: LoopMemory, inputs: LoopInputs, period: Scalar, read: frozenset[str]
    ) -> tuple[LoopMemory, LoopOutputs, LoopStatus]:
        """Advance and read the plant under the last voltage, then step the controller. A lost rotor's voltage is 0."""
        before = choose(memory.plant.started, memory.control, self.start().control)
        given = PlantInputs._make([before.last.u, *inputs[: len(DISTURBANCES)]])
        plant, motion, lost = self.plant.step(parameters.machine, memory.plant, given, period, read)
        readings: Any = StepInputs._make([*motion[:3], *inputs[len(DISTURBANCES) :]])
        control, command, status = self.controller.step(parameters.controller, before, readings, period, read)
        alive, off = plant.lost == ALIVE, jnp.zeros(())
        frozen = before._replace(last=before.last._replace(u=off), before=off)
        control = choose(alive, control, frozen)
        outputs = LoopOutputs(command._replace(u=control.last.u), motion)
        status = Status._make([*(alive & bit for bit in status[:-1]), (alive & status.invalid) | lost.invalid])
        return LoopMemory(control, plant), outputs, LoopStatus(status, lost.touched, lost.diverged)

    def start(self) -> LoopMemory:
        control = self.controller.start()
        return LoopMemory(control._replace(started=jnp.zeros(())), self.plant.start())

    def numbers(self) -> list[Number]:
        own = [x._replace(name=f"controller.{x.name}") for x in self.controller.numbers()]
        return [*own, *self.plant.numbers()]

    def states(self) -> list[Number]:
        own = [x._replace(name=f"controller.{x.name}") for x in self.controller.states()]
        words = "1 after the first accepted readings, which start the laws"
        begun = Number("controller.started", "", "", words, 0.0, among=(0.0, 1.0, 1.0, 1.0))
        return [*own, begun, *(x._replace(name=f"plant.{x.name}") for x in self.plant.states())]

    def sizes(self) -> tuple[list[float], list[float]]:
        (states, inputs), (plant, disturbances) = self.controller.sizes(), self.plant.sizes()
        return [*states, 1.0, *plant], [*disturbances[1:], *inputs[-len(REFERENCES) :]]

    def bounds(self) -> dict[str, int]:
        names = list(self.inputs)
        return {f"controller.limits.{name}": names.index(name) for name in REFERENCES}

    def described(self) -> list[str]:
        return [*self.controller.described(), *self.plant.described()]


def loop_of(controller: Controller, plant: PlantStep) -> LoopStep:
    """Return the loop of an exported controller and an exported plant of one case."""
    return LoopStep(LoopParameters(controller.parameters, plant.parameters), controller.period, controller, plant)
