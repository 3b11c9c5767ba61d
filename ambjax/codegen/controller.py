"""The exported controller: the simulator's step, with names for its inputs, states, parameters and outputs."""

import dataclasses
import functools
import math
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.codegen.block import Block, Number, Ports, earlier, numbers_of, scales
from ambjax.codegen.interface import INPUTS, OUTPUTS, STATUS, Status, StepInputs, StepOutputs
from ambjax.control.base import memory_of, steepnesses
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Command
from ambjax.control.guard import GAPS, Watch
from ambjax.control.schedule import schedules
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, leaf, record
from ambjax.simulation.between import SampledState
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import guarded
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement, Sensor
from ambjax.world.waveforms import Reference

T = TypeVar("T")

(U_MAX,) = (field for field in dataclasses.fields(Scenario) if field.name == "u_max")
# A step sets the bit `singular` if `Bearing.singularity` (Eq. (9): 1 at z = 0, 0 on C) is at most this value.
NEAR = 0.1


def _end(of: str, unit: str) -> Any:
    return leaf(unit=unit, at_least=1e-30, at_most=1e30, doc=f"largest valid |{of}|")


@record
class StepLimits:
    """The limit of the command, the threshold of the bit `singular`, and the limits of the reference.

    `controller_of` sets the largest |r| to GAPS gaps, and the limit of each derivative to the previous limit divided by
    the sample period. The user of the exported code may change all of them.
    """

    u_max: Scalar = dataclasses.field(metadata=U_MAX.metadata)
    near: Scalar = leaf(
        unit="1", at_least=-1e30, at_most=1, doc="threshold of Eq. (9) of the bit `singular`; 1 at rest, 0 on the curve"
    )
    r: Scalar = _end("r", "m")
    r_dot: Scalar = _end("r_dot", "m/s")
    r_ddot: Scalar = _end("r_ddot", "m/s^2")
    r_dddot: Scalar = _end("r_dddot", "m/s^3")


class Memory(NamedTuple):
    """State that one step passes to the next."""

    laws: CascadeState
    last: Command
    before: tuple[Array, ...]
    """commands of the samples before the last, the most recent first, V or A"""
    watch: Watch | tuple[()]
    """state of the guard"""
    started: Array


class Parameters(NamedTuple):
    """All numbers that a user of the exported code may change: the parameters of the cascade, and the limits."""

    controller: Cascade
    limits: StepLimits


@dataclasses.dataclass(frozen=True)
class Controller(Block):
    """A cascade on its processor as it is exported: its parameters and the sample period, s.

    `velocity`: whether the velocity is measured.
    """

    parameters: Parameters
    velocity: bool = True

    noun: ClassVar[str] = "controller"
    ports: ClassVar[Any] = StepInputs
    inputs: ClassVar[Ports] = INPUTS
    bits = STATUS
    crowded = ("saturated", "refused")

    @property
    def commands(self) -> str:
        """What the output u is: a "voltage" or a "current"."""
        return self.parameters.controller.current.commands

    @property
    def outputs(self) -> Ports:  # pyright: ignore[reportIncompatibleVariableOverride]
        current = {"u": ("A", "current to command to the amplifier, within its limit")}
        return OUTPUTS | (current if self.commands == "current" else {})

    def step(
        self, parameters: Parameters, memory: Memory, inputs: StepInputs, period: Scalar, read: frozenset[str]
    ) -> tuple[Memory, StepOutputs, Status]:
        cascade, limits = parameters
        measured = Measurement(*inputs[:3])
        if not self.velocity:  # the simulator reads 0
            measured = measured._replace(z_dot=jnp.zeros_like(inputs.z_dot))
        checked = [name for name in StepInputs._fields[3:] if name in read]
        fine = [jnp.abs(getattr(inputs, name)) <= getattr(limits, name) for name in checked]
        processor = cascade.timing
        if processor.predicts or processor.guard is not None:  # the number of prediction steps is fixed at export
            fine += [processor.delay >= 0, processor.delay <= (processor.most or 0)]
        signs = [getattr(law, name) for law in cascade.laws for name in steepnesses(law)]
        fine += [jnp.isfinite(p) for p in jax.tree.leaves(signs)]  # p = inf needs another program
        valid = functools.reduce(jnp.logical_and, fine, jnp.asarray(True))
        sensor = Sensor(velocity=self.velocity)
        system = Sampled(ClosedLoop(cascade, Scenario(u_max=limits.u_max, sensor=sensor)), period, 0)
        before, watch = memory.before, memory.watch
        state = SampledState(
            plant=(),
            control=memory.laws,
            command=memory.last,
            past=before,
            finite=jnp.ones(()),
            watch=watch,
            started=memory.started,
        )
        after = system.with_command(measured, Reference(*inputs[3:]), state)
        last = choose(valid, after.command, memory.last)
        watch, refused, safe = after.watch, jnp.asarray(False), jnp.asarray(False)
        if processor.guard and memory.watch:
            refused, safe = processor.guard.refused(memory.watch, watch)
        assert not isinstance(after.started, tuple)  # an array in the state stays an array
        laws, started = choose(valid, (after.control, after.started), (memory.laws, memory.started))
        # an invalid or failed sample resets the guard: the next reading within its limits is accepted
        watch = choose(valid & (after.finite != 0), watch, jax.tree.map(jnp.zeros_like, watch))
        kept = Memory(laws, last, after.past[: len(before)], watch, started)
        status = Status(
            jnp.abs(last.u) >= limits.u_max,
            valid & refused,
            valid & (after.finite == 0),
            valid & ~refused & (cascade.model.singularity(measured.z, last.i_ref) <= limits.near),
            valid & safe,
            ~valid,
        )
        return kept, StepOutputs(last.u, last.i_ref, last.v_star, last.v_tilde), status

    def start(self) -> Memory:
        """Return the memory before the first step: zero commands, zero states of the laws, no predicted readings."""
        cascade, zero = self.parameters.controller, jnp.zeros(())
        processor = cascade.timing
        laws = jax.tree.map(jnp.zeros_like, cascade.init(Measurement(zero, zero, zero)))
        before, watch = processor.constant_past(zero)[1:], processor.guard.start() if processor.guard else ()
        return Memory(laws, Command(*[zero] * 5), before, watch, jnp.asarray(False))

    def numbers(self) -> list[Number]:
        found = [
            *numbers_of(self.parameters.controller, home="controller."),
            *numbers_of(self.parameters.limits, "limits."),
        ]
        assert [x.value for x in found] == [float(x) for x in jax.tree.leaves(self.parameters)]
        processor = self.parameters.controller.timing
        if self.commands == "current":
            u_max = {"unit": "A", "doc": "limit of the commanded current; inf: none"}
            found = [x._replace(**u_max) if x.name == "limits.u_max" else x for x in found]
        most = float(processor.most or 0)
        ends = (0.0, most, most + 0.5, -0.5, math.nan)
        delay = {"allowed": f"from 0 to {processor.most}", "ends": ends, "least": 0.0, "most": most}
        return [x._replace(**delay) if x.name == "processor.delay" else x for x in found]

    def states(self) -> list[Number]:
        cascade, memory = self.parameters.controller, self.start()
        found = []
        for stage, law, state in zip(CascadeState._fields, cascade.laws, memory.laws, strict=True):
            notch = cascade.notch if stage == "observer" else None
            entries = memory_of(law, state if notch is None else state[0])
            if notch is not None:
                entries += [(f"notch_{name}", unit, doc) for name, unit, doc in notch.memory()]
            assert len(entries) == len(jax.tree.leaves(state)), f"{type(law).__name__}.memory: one entry for each state"
            if any(jnp.shape(x) != () for x in jax.tree.leaves(state)):
                raise ValueError(
                    f"controller.{stage}: a state of {type(law).__name__} is an array; only scalars can be exported."
                )
            words = f"state of {type(law).__name__}"
            found += [Number(f"{stage}.{name}", unit, doc or words) for name, unit, doc in entries]
        commands = {**self.outputs, "i_ref_dot": ("A/s", "rate of i_ref")}
        for name in memory.last._fields:
            found.append(Number(f"last.{name}", commands[name][0], f"last {commands[name][1]}"))
        found += earlier(memory.before, commands["u"][0], "u")
        if memory.watch:
            names = {f"watch.{name}": (INPUTS[name][0], "predicted reading") for name in memory.watch.expected._fields}
            names["watch.left"] = ("samples", "number of samples for which a reading may still be replaced")
            found += [Number(name, unit, doc) for name, (unit, doc) in names.items()]
        return found

    def sizes(self) -> tuple[list[float], list[float]]:
        cascade, limits = self.parameters
        model = cascade.model
        z, z_dot, i = scales(model.sizes())
        pole, weight, v = float(model.pole), float(model.i_0), float(model.v_size)
        if self.commands == "voltage":
            weight *= float(model.R)
        u = float(limits.u_max) if math.isfinite(limits.u_max) else 10 * weight + 1.0
        guard = cascade.timing.guard
        watch = [z, z_dot, i, float(guard.samples)] if guard and guard.samples is not None else []
        # commands are in the order of their pytree
        states = [*scales(cascade.scale()), v, v, i, i * pole, u, *[u] * len(self.start().before), *watch]
        return states, [z, z_dot, i, z, z * pole, z * pole**2, z * pole**3]

    def bounds(self) -> dict[str, int]:
        return {f"{of}.{name}": k for k, name in enumerate(INPUTS) for of in ("limits", "processor.guard")}

    def described(self) -> list[str]:
        cascade, lines = self.parameters.controller, []
        for stage, law in zip(CascadeState._fields, cascade.laws, strict=True):
            hard = [name for name in steepnesses(law) if getattr(law, name) is None]
            ends = "".join(f", {name} = inf (a set-valued sign)" for name in hard)
            over = "".join(f", {name} as a function of the {one.over}" for name, one in schedules(law).items())
            lines.append(f"{stage}: {type(law).__name__}{ends}{over}")
        return [*lines, f"processor: {cascade.processor}"]


def controller_of(cascade: Cascade, u_max: Scalar, period: float, scenario: Scenario | None = None) -> Controller:
    """Return the controller of a case. Raises ValueError for a cascade in continuous time.

    `u_max`: limit of the command (`Scenario.command_limit`), V or A. `period`: sample period, s. `scenario`: its
    clearance and sensors determine those limits of the guard that the case does not give. None: the model's clearance,
    and sensors without error.
    """
    if not cascade.sampled:
        raise ValueError(
            "[processor] is missing: only a controller on a processor can be exported, and this case is in continuous "
            "time. Add [processor], tune the gains for it, and export the tuned case."
        )
    cascade, period = cascade.on_processor().turning(scenario and scenario.rotor), float(period)
    model = cascade.model
    scenario = scenario or Scenario(plant=model)
    cascade = guarded(cascade, scenario, period)
    limits = StepLimits(u_max, NEAR, *(GAPS * float(model.s_0) / period**n for n in range(4)))
    plain = jax.tree.map(lambda x: float(x) if jnp.shape(x) == () else x, Parameters(cascade, limits))
    return Controller(plain, period, scenario.sensors.velocity)
