"""Laws of a machine in its loop: they demand the forces of all axes.

Each axis keeps its guard, its notch and its inner laws; it has no observer.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.control.machine_law import Demanded, MachineInputs
from ambjax.control.stages import ForceDemand
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar
from ambjax.simulation.between import SampledState
from ambjax.simulation.loop import ClosedLoop, LoopState
from ambjax.simulation.machine_axes import MachineAxes
from ambjax.simulation.sampled import Sampled
from ambjax.world.plant import State
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

T = TypeVar("T")


def inputs_of(
    machine: MachineAxes, references: Reference, W: Scalar, u_max: Array, past: tuple[Array, ...], period: Scalar
) -> MachineInputs:
    """Return the inputs of the law of a machine. All arguments but W and `period` have one number for each axis [c]."""
    cascades = [loop.cascade for loop in machine.loops()]

    def joined(function: Callable[..., T], *parts: object) -> T:
        groups = zip(cascades, *map(machine.split, parts), strict=True)
        return machine.join([jax.vmap(function)(*own) for own in groups])

    def start(measured: Measurement) -> State:
        return joined(lambda cascade, m: cascade.model.start(m), measured)

    def driven(u: Array, states: State) -> State:
        return joined(Cascade.driven, u, states)

    def scaled(force: Array) -> Array:
        return joined(lambda cascade, f: (f / cascade.model.m + cascade.model.g) / cascade.model.a, force)

    return MachineInputs(references, jnp.asarray(W), u_max, start, driven, scaled, past, period)


def forces(machine: MachineAxes, demanded: Demanded) -> tuple[tuple[ForceDemand, Measurement], ...]:
    """Return the demands of the groups, with the gaps of their nominal plants, and the estimates."""
    found = []
    for loop, force, estimate in zip(
        machine.loops(), machine.split(demanded.force), machine.split(demanded.estimate), strict=True
    ):
        gaps = jax.vmap(lambda cascade, z: cascade.model.gaps(z))(loop.cascade, force.z)
        found.append((force._replace(gaps=gaps), estimate))
    return tuple(found)


def jumped(
    machine: MachineAxes, t: Scalar, W: Scalar, axes: Sequence[SampledState], law: Any, errors: Sequence[object]
) -> tuple[list[SampledState], Any]:
    """Step the laws of all axes at time t (s). `axes`: states of the groups. `law`: state of the law of the machine."""

    def read(axis: Sampled, own: SampledState, error: Any) -> tuple:
        own, measured = axis.read(own, error)
        measured = axis.injected(measured, t)
        sample, checked, measured, laws = axis.received(measured, axis.reference(t), own)
        measured, notched = axis.loop.cascade.observed(measured, laws.observer, sample.reference, sample.period)
        return own, sample, checked, measured, laws._replace(observer=notched)

    parts = machine.each(read, axes, errors)
    samples, measured = (machine.join([part[k] for part in parts]) for k in (1, 3))
    inputs = inputs_of(machine, samples.reference, W, samples.u_max, samples.past, samples.period[0])
    assert machine.law is not None
    flags = [own.started for own, *_ in parts if not isinstance(own.started, tuple)]
    if flags:  # a guard that has not accepted all readings of one sample: the law begins again
        started = jnp.min(jnp.concatenate(flags)) > 0.5
        law = choose(started, law, machine.law.begin(measured, inputs))
    demanded, after = machine.law.step(measured, law, inputs)

    def finished(
        axis: Sampled, part: tuple, demand: tuple[ForceDemand, Measurement], now: Measurement
    ) -> tuple[SampledState, Array]:
        own, sample, checked, _, laws = part
        (force, estimate), cascade = demand, axis.loop.cascade
        command, control = cascade.commanded(force, estimate, laws, sample)
        return axis.accepted(own, sample, checked, (command, control, now))

    ended = machine.each(finished, parts, forces(machine, demanded), machine.split(demanded.now))
    keeps = jnp.all(jnp.concatenate([kept for _, kept in ended]))
    return [own for own, _ in ended], choose(keeps, after, law)


def demanded_now(
    machine: MachineAxes, W: Scalar, own: Sequence[Any], sensed: Sequence[Any], law: Any, errors: Sequence[object]
) -> tuple[tuple[tuple[ForceDemand, Measurement], ...], Any]:
    """Return the demands of the groups in continuous time, and the rates of the state of the law."""

    def read(loop: ClosedLoop, own: Any, state: LoopState, error: Any) -> Measurement:
        measured = loop.received(own, state.plant, error)
        return loop.cascade.observed(measured, state.control.observer, own.reference)[0]

    measured = machine.join(machine.each(read, own, sensed, errors))
    limits = machine.join([jnp.asarray(loop.scenario.command_limit) for loop in machine.loops()])
    references = machine.join([one.reference for one in own])
    assert machine.law is not None
    demanded, rates = machine.law(measured, law, inputs_of(machine, references, W, limits, (), 0.0))
    return forces(machine, demanded), rates


def begun(machine: MachineAxes, W: Scalar, axes: Sequence[Any], errors: Sequence[object]) -> Any:
    """Return the state of the law at t = 0. `axes`: states of the groups at the places of the sensors."""
    if machine.law is None:
        return ()

    def read(axis: Sampled | ClosedLoop, own: Any, error: Any) -> tuple[Measurement, Any]:
        if isinstance(axis, Sampled):
            measured = axis.measured(own.plant, own.z_filtered, error)
            return measured, axis.sample(axis.reference(0.0), own.past)
        return axis.received(axis.inputs(0.0), own.plant, error), axis.inputs(0.0).reference

    parts = machine.each(read, axes, errors)
    measured, rest = machine.join([one for one, _ in parts]), machine.join([one for _, one in parts])
    if isinstance(rest, Reference):
        return machine.law.begin(measured, inputs_of(machine, rest, W, jnp.zeros(()), (), 0.0))
    inputs = inputs_of(machine, rest.reference, W, rest.u_max, rest.past, rest.period[0])
    return machine.law.begin(measured, inputs)
