"""The axes of a machine: the loops of one axis in groups, stops at places of their own, and laws of all axes.

Each axis is the loop of one axis, `Sampled` or `ClosedLoop`. Axes with the same kinds of parts form a group, whose
leaves are stacked, with a leading axis. With a law of the machine, which demands the forces of all axes, each axis
keeps its guard, its notch and its inner laws; it has no observer.
"""

import dataclasses
import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.control.machine_law import Demanded, MachineInputs
from ambjax.control.stages import ForceDemand
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, leaf, matrix, part, record, static
from ambjax.numerics.small_matrices import times
from ambjax.simulation.between import SampledState
from ambjax.simulation.loop import ClosedLoop, LoopState
from ambjax.simulation.sampled import Sampled
from ambjax.world.plant import State
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import POLE, Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

T = TypeVar("T")


@record
class MachineAxes:
    """The parts of a machine with c bearing axes, and what concerns each axis alone."""

    rotor: Rotor = part(doc="the rotor")
    axes: tuple[Any, ...] = part(doc="the loops of the groups, `Sampled` or `ClosedLoop`, stacked", channels=True)
    start_q: Array = leaf(shape="n", unit="m or rad", at_least=-10.0, at_most=10.0, doc="coordinates at t = 0, at rest")
    groups: tuple[tuple[int, ...], ...] = static(doc="numbers of the axes of each group")
    inverse: Array | None = matrix("n n", "inverse of the mass matrix", default=None)
    cuts: int | None = static(
        default=None, doc="largest number of jumps of the rotor's loads in one sample; None: the number of all jumps"
    )
    law: Any = part(default=None, doc="law that demands the forces of all axes; none: each axis has its own laws")

    @property
    def count(self) -> int:
        return sum(map(len, self.groups))

    def split(self, x: T) -> tuple[T, ...]:
        """Return the part of each group of arrays [c, ...] of all axes."""
        if len(self.groups) == 1:
            return (x,)
        return tuple(jax.tree.map(operator.itemgetter(np.array(group)), x) for group in self.groups)

    def join(self, parts: Sequence[T]) -> T:
        """Return arrays [c, ...] of all axes from those of the groups."""
        if len(parts) == 1:
            return parts[0]
        order = np.argsort(np.concatenate([np.array(group) for group in self.groups]))
        return jax.tree.map(lambda *x: jnp.concatenate(x)[order], *parts)

    def each(self, function: Callable[..., T], *groups: Sequence[object]) -> list[T]:
        """Return function(loop, ...) of every axis, stacked for each group. `groups`: further arguments."""
        return [jax.vmap(function)(*own) for own in zip(self.axes, *groups, strict=True)]

    def loops(self) -> tuple[ClosedLoop, ...]:
        return tuple(map(loop_of, self.axes))

    def plants(self, name: str) -> Array:
        """Return a number of the plant of every axis [c]."""
        return self.join([getattr(loop.scenario.plant, name) for loop in self.loops()])

    @property
    def near(self) -> str:
        """The signal of each axis that counts against its clearance."""
        return "z" if self.rotor.at_stops is None else "z_stop"

    def limited(self) -> tuple[Array, Array]:
        """Return the rows [k, n] of the places at which |displacement| is limited, and the limits [k], m.

        The first c are those of `Scenario.limit`: at the stops, or at the magnets if the stops are elastic. Beside
        rigid stops at places of their own, the magnets limit the displacement too.
        """
        rotor, scenarios = self.rotor, [loop.scenario for loop in self.loops()]
        limits = self.join([jnp.asarray(one.limit) for one in scenarios])
        if rotor.at_stops is None or scenarios[0].stop is not None:
            return rotor.at_magnets, limits
        return jnp.concatenate([rotor.at_stops, rotor.at_magnets]), jnp.concatenate([limits, POLE * self.plants("s_0")])

    def between_stops(self, loop: ClosedLoop) -> ClosedLoop:
        """Return the loop of an axis without an elastic stop at a place of its own: `pushed` adds its force."""
        if self.rotor.at_stops is None:
            return loop
        return dataclasses.replace(loop, scenario=dataclasses.replace(loop.scenario, stop=None))

    def pushed(self, forces: Array, q: Array, q_dot: Array) -> Array:
        """Return the forces [n] on the coordinates with those of elastic stops at places of their own."""
        rows, scenarios = self.rotor.at_stops, tuple(loop.scenario for loop in self.loops())
        if rows is None or scenarios[0].stop is None:
            return forces

        def one(scenario: Scenario, z: Array, z_dot: Array) -> Array:
            assert scenario.stop is not None
            return scenario.stop.force(Measurement(z, z_dot, jnp.zeros_like(z)), scenario.touchdown)

        motion = self.split(times(rows, q)), self.split(times(rows, q_dot))
        stops = self.join([jax.vmap(one)(*own) for own in zip(scenarios, *motion, strict=True)])
        return forces + jnp.sum(rows * stops[:, None], 0)


def loop_of(axis: Sampled | ClosedLoop) -> ClosedLoop:
    """Return the loop of an axis in continuous time."""
    return axis.loop if isinstance(axis, Sampled) else axis


def with_loop(axis: Sampled | ClosedLoop, loop: ClosedLoop) -> Sampled | ClosedLoop:
    """Return the axis with another loop in continuous time."""
    return dataclasses.replace(axis, loop=loop) if isinstance(axis, Sampled) else loop


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
