"""What is exported: the step that the simulator runs, with what it reads, keeps and gives, each by name.

`Controller.step` is `Sampled.decided`, within it the check of the inputs and the start from the first good measurement.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade import Cascade, CascadeState, Command
from ambjax.numerics.records import Scalar, leaf, numbers, record
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled, SampledState
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference

(U_MAX,) = (field for field in dataclasses.fields(Scenario) if field.name == "u_max")
# Ends of the inputs that are believed, in the model's sizes: gaps, a gap within a sample, bias currents.
GAPS, CURRENTS = 2.0, 100.0
NEAR = 0.1


def _end(of: str, unit: str) -> Any:
    return leaf(unit=unit, at_least=1e-30, at_most=1e30, doc=f"largest |{of}| that is believed")


@record
class Limits:
    """Where the step no longer does what it is asked: the supply's end, and those of its inputs."""

    u_max: Scalar = dataclasses.field(metadata=U_MAX.metadata)
    near: Scalar = leaf(
        unit="1", at_least=-1e30, at_most=1, doc="where Eq. (9), 1 at rest and 0 on the singular curve, counts as near"
    )
    z: Scalar = _end("z", "m")
    z_dot: Scalar = _end("z_dot", "m/s")
    i: Scalar = _end("i", "A")
    r: Scalar = _end("r", "m")
    r_dot: Scalar = _end("r_dot", "m/s")
    r_ddot: Scalar = _end("r_ddot", "m/s^2")
    r_dddot: Scalar = _end("r_dddot", "m/s^3")


class Inputs(NamedTuple):
    """What a step reads: sensors, and the reference of the instant at which its voltage takes effect."""

    z: Array
    z_dot: Array
    i: Array
    r: Array
    r_dot: Array
    r_ddot: Array
    r_dddot: Array


class Memory(NamedTuple):
    """What a step keeps for the next."""

    laws: CascadeState
    last: Command
    before: Array
    """voltage of the sample before the last, V"""
    started: Array


class Status(NamedTuple):
    """What a step reports, a bit each."""

    saturated: Array
    refused: Array
    failed: Array
    singular: Array


class Answer(NamedTuple):
    """What a step gives."""

    u: Array
    i_ref: Array
    v_star: Array
    v_tilde: Array


INPUTS = {
    "z": ("m", "rotor displacement, measured"),
    "z_dot": ("m/s", "its rate, measured"),
    "i": ("A", "current deviation, measured"),
    "r": ("m", "reference of z at the instant at which this step's voltage takes effect"),
    "r_dot": ("m/s", "its rate"),
    "r_ddot": ("m/s^2", "its second derivative"),
    "r_dddot": ("m/s^3", "its third derivative"),
}
OUTPUTS = {
    "u": ("V", "voltage to apply, within the supply's limit"),
    "i_ref": ("A", "current reference"),
    "v_star": ("A^2/m^2", "demanded scaled force"),
    "v_tilde": ("A^2/m^2", "input error v_star - v(z, i_ref)"),
}
BITS = {
    "saturated": "u is at the supply's limit",
    "refused": "an input or params->processor.delay is NaN or out of range: nothing was computed, u is held",
    "failed": "a law gave no finite number: its state is kept, u is held",
    "singular": "(z, i_ref) is near the singular curve of Eq. (9)",
}


class Number(NamedTuple):
    """A parameter or a state: dotted name, unit, what is allowed, meaning, value."""

    name: str
    unit: str
    allowed: str
    doc: str
    value: float


class Parameters(NamedTuple):
    """All numbers that the C may change: those of the cascade and the limits."""

    controller: Cascade
    limits: Limits


@dataclasses.dataclass(frozen=True)
class Controller:
    """A cascade on its processor, as it is exported. Raises ValueError for one in continuous time."""

    parameters: Parameters
    period: float

    def step(
        self, parameters: Parameters, memory: Memory, inputs: Inputs, period: Scalar, read: frozenset[str]
    ) -> tuple[Memory, Answer, Status]:
        """One sample. Inputs that are not in `read` are not looked at, nor is the delay where nothing is predicted."""
        cascade, limits = parameters
        measured = Measurement(*inputs[:3])
        fine = [jnp.abs(getattr(inputs, name)) <= getattr(limits, name) for name in Inputs._fields if name in read]
        processor: Any = cascade.processor
        if processor.predicts:  # the prediction's parts are those of the delay that was exported
            fine += [processor.delay >= 0, processor.delay <= processor.most]
        good = functools.reduce(jnp.logical_and, fine, jnp.asarray(True))
        laws = choose(memory.started, memory.laws, cascade.init(measured))
        system = Sampled(ClosedLoop(cascade, Scenario(u_max=limits.u_max)), period)
        state = SampledState((), laws, memory.last, (memory.before, memory.before), jnp.ones(()), (), ())
        after = system.decided(measured, Reference(*inputs[3:]), state)
        last = choose(good, after.command, memory.last)
        kept = Memory(choose(good, after.control, memory.laws), last, after.past[0], memory.started | good)
        status = Status(
            jnp.abs(last.u) >= limits.u_max,
            ~good,
            good & (after.sane == 0),
            good & (cascade.model.singularity(measured.z, last.i_ref) <= limits.near),
        )
        return kept, Answer(last.u, last.i_ref, last.v_star, last.v_tilde), status

    def start(self) -> Memory:
        """Before the first step: no voltage, laws without a state."""
        cascade, zero = self.parameters.controller, jnp.zeros(())
        laws = jax.tree.map(jnp.zeros_like, cascade.init(Measurement(zero, zero, zero)))
        return Memory(laws, Command(*[zero] * 5), zero, jnp.asarray(False))


def choose(condition: Array, a: Any, b: Any) -> Any:
    """a where `condition` holds, else b."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def controller_of(cascade: Cascade, u_max: Scalar, period: float) -> Controller:
    """The controller of a case. Raises ValueError for one without [processor]."""
    if cascade.processor is None:
        raise ValueError(
            "[processor] is missing: what runs on a processor is exported, and this case is in continuous time. Add "
            "[processor], tune for it, and export that."
        )
    cascade, period = cascade.on_processor(), float(period)
    model = cascade.model
    gap, current = GAPS * float(model.s_0), CURRENTS * float(model.i_0)
    rates = [gap / period**n for n in range(4)]
    limits = Limits(u_max, NEAR, gap, rates[1], current, *rates)  # pyright: ignore[reportCallIssue]
    plain = jax.tree.map(lambda x: float(x) if jnp.shape(x) == () else x, Parameters(cascade, limits))
    return Controller(plain, period)


def parameters_of(parameters: Parameters) -> list[Number]:
    """Every number of the parameters, in the order of its leaves. Raises ValueError for an array."""
    found = [*_numbers(parameters.controller, ""), *_numbers(parameters.limits, "limits.")]
    assert [x.value for x in found] == [float(x) for x in jax.tree.leaves(parameters)]
    processor: Any = parameters.controller.processor
    ends = {"processor.delay": f"from 0 to {processor.most}"}
    return [x._replace(allowed=ends.get(x.name, x.allowed)) for x in found]


def _numbers(node: Any, path: str) -> Iterator[Number]:
    for field in dataclasses.fields(node):
        value, name = getattr(node, field.name), f"{path}{field.name}"
        if field.metadata.get("static") or value is None:
            continue
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{name}.")
        elif jnp.shape(value) == ():
            yield _number(name, field, float(value))
        else:
            raise ValueError(f"controller.{name} has the shape {jnp.shape(value)}: only scalars can be exported.")


def _number(name: str, field: dataclasses.Field, value: float) -> Number:
    meta = field.metadata
    unit, doc = meta.get("unit", ""), meta.get("doc", "")
    allowed = numbers(field) if meta.get("leaf") else ""
    for word in (f" ({unit})", "a finite number ", "a number "):
        allowed = allowed.replace(word, "")
    return Number(name, unit, allowed, doc, value)
