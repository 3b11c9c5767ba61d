"""The axes of a machine: the loops of one axis in groups, and stops at places of their own.

Each axis is the loop of one axis, `Sampled` or `ClosedLoop`. Axes with the same kinds of parts form a group, whose
leaves are stacked, with a leading axis.
"""

import dataclasses
import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import leaf, matrix, part, record, static
from ambjax.numerics.small_matrices import times
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import POLE, Scenario
from ambjax.world.sensor import Measurement

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
        """Number of axes."""
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
        """Return the loops of the groups in continuous time."""
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
