"""The blocks of a case, and the loop: a step of the plant, then a step of the controller, as in the simulator."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp

from ambjax.codegen.block import Block, Number, Ports
from ambjax.codegen.controller import Controller, Memory, Parameters, controller_of
from ambjax.codegen.interface import DISTURBANCES, OUTPUTS, REFERENCES, LoopInputs, Status
from ambjax.codegen.plant_step import PlantMemory, PlantParameters, PlantStep, plant_of
from ambjax.control.cascade import Cascade
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar
from ambjax.simulation.clock import Clock
from ambjax.simulation.integrate import FixedSteps
from ambjax.simulation.method import choose_method
from ambjax.simulation.trajectory import ALIVE
from ambjax.world.scenario import Scenario

WHAT = ("controller", "plant", "loop")


# Parameters, and state, of the controller and of the plant. In this state, `Memory.started` is a real number, 0 or 1.
LoopParameters = tuple[Parameters, PlantParameters]
LoopMemory = tuple[Memory, PlantMemory]


@dataclasses.dataclass(frozen=True)
class LoopStep(Block):
    """The controller and the plant of a case as one block.

    The outputs are those of the controller, then those of the plant; the status bits are those of the controller, then
    two of the plant that report a lost rotor.
    """

    parameters: LoopParameters
    controller: Controller
    plant: PlantStep

    noun: ClassVar[str] = "loop"
    ports: ClassVar[Any] = LoopInputs
    inputs: ClassVar[Ports] = DISTURBANCES | REFERENCES
    outputs: ClassVar[Ports] = {**OUTPUTS, **PlantStep.outputs}
    bits: ClassVar[Mapping[str, str]] = {
        **Controller.bits,
        **PlantStep.bits,
        "invalid": "the reference or a parameter of the controller is NaN or out of range: u is held; or an input "
        "of the plant is not finite: 0 replaces it; or the plant's delay is out of range",
    }
    crowded = ("saturated", "refused", "touched", "diverged")

    def step(
        self, parameters: LoopParameters, memory: LoopMemory, inputs: LoopInputs, period: Scalar, read: frozenset[str]
    ) -> tuple[LoopMemory, tuple, tuple]:
        """Advance the plant under the commanded voltages, read its sensors, and step the controller."""
        laws, machine = memory
        before = choose(machine.started, laws, self.start()[0])
        given = self.plant.ports._make([before.last.u, *inputs[: len(DISTURBANCES)]])
        plant, motion, lost = self.plant.step(parameters[1], machine, given, period, read)
        readings = self.controller.ports._make([*motion[:3], *inputs[len(DISTURBANCES) :]])
        control, command, status = self.controller.step(parameters[0], before, readings, period, read)
        alive, off = plant.lost == ALIVE, jnp.zeros(())
        frozen = before._replace(last=before.last._replace(u=off), before=(off,) * len(before.before))
        control = choose(alive, control, frozen)
        status = Status._make([*(alive & bit for bit in status[:-1]), (alive & status.invalid) | lost.invalid])
        outputs = command._replace(u=control.last.u), motion
        return (control, plant), outputs, (status, lost.touched, lost.diverged)

    def start(self) -> LoopMemory:
        control = self.controller.start()
        return control._replace(started=jnp.zeros(())), self.plant.start()

    def numbers(self) -> list[Number]:
        own = [x._replace(name=f"controller.{x.name}") for x in self.controller.numbers()]
        return [*own, *self.plant.numbers()]

    def states(self) -> list[Number]:
        own = [x._replace(name=f"controller.{x.name}") for x in self.controller.states()]
        words = "1 after the first accepted readings, which start the laws"
        begun = Number("controller.started", "", words, among=(0.0, 1.0, 1.0, 1.0))
        return [*own, begun, *(x._replace(name=f"plant.{x.name}") for x in self.plant.states())]

    def sizes(self) -> tuple[list[float], list[float]]:
        (states, inputs), (plant, disturbances) = self.controller.sizes(), self.plant.sizes()
        return [*states, 1.0, *plant], [*disturbances[1:], *inputs[-len(REFERENCES) :]]

    def bounds(self) -> dict[str, int]:
        names = list(self.inputs)
        return {f"controller.limits.{name}": names.index(name) for name in REFERENCES}

    def described(self) -> list[str]:
        return [*self.controller.described(), *self.plant.described()]


def block_of(what: str, cascade: Cascade, scenario: Scenario, clock: Clock) -> Block:
    """Return a block of a case. `what`: the block, one of WHAT.

    If the clock's method has no fixed number of steps, the plant uses the method that `choose_method` selects instead.

    Raises ValueError for a case that cannot be exported.
    """
    period = float(clock.sample_period)
    controller = controller_of(cascade, scenario.command_limit, period, scenario)
    if what == "controller":
        return controller
    method = clock.method
    if not isinstance(method, FixedSteps):
        method = choose_method(cascade, scenario, period, reverse=True)
        assert isinstance(method, FixedSteps)
    plant = plant_of(cascade, scenario, period, method)
    if what == "plant":
        return plant
    return LoopStep((controller.parameters, plant.parameters), controller.period, controller, plant)
