"""A whole machine: one rotor on several magnetic bearing axes, each with its own sensors, amplifier and cascade.

The axes are coupled by the rotor alone: its coordinates give the motion at each magnet and each sensor, and the forces
of the magnets accelerate the coordinates.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.numerics.records import Scalar, record
from ambjax.numerics.small_matrices import solve, times
from ambjax.numerics.smooth import away_from_zero
from ambjax.simulation.between import SampledState, plant_status
from ambjax.simulation.edges import NO_EDGES, Edges
from ambjax.simulation.integrate import InitialValueProblem
from ambjax.simulation.loop import ClosedLoop, LoopState
from ambjax.simulation.machine_axes import MachineAxes, begun, loop_of, with_loop
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.trajectory import ALIVE, DIVERGED, INSTANT_TREE, TOUCHED, Instant, Row, Span
from ambjax.world.rotation import Rotation
from ambjax.world.sensor import Errors

T = TypeVar("T")
# States of the axes, or their rates: one stacked pytree for each group, of type SampledState, LoopState or PlantOnly.
Groups = tuple


class MachineState(NamedTuple):
    """State of a machine.

    - `q`, `q_dot` [n]: coordinates of the rotor and their rates.
    - `axes`: states of the groups, without displacement and velocity, which follow from q and q_dot.
    - `law`: state of the law of the machine, () without one.
    """

    q: Array
    q_dot: Array
    axes: Groups
    law: Any = ()


class MachineRow(NamedTuple):
    """Signals of a machine at one sample: time (s), coordinates [n], speed (rad/s), and the rows of the axes [c]."""

    t: Array
    alive: Array
    q: Array
    speed: Array
    axes: Row


class PlantOnly(NamedTuple):
    """State of a group of which only the plant is integrated."""

    plant: Any


@record
class Machine(MachineAxes):
    """A rotor on c bearing axes, as a `rollout.System`: base class of both kinds of loop."""

    def realised(self) -> Self:
        """Return the machine of one member: random signals drawn, a random key for each axis, and M inverted."""
        if self.inverse is not None:
            return self
        n = self.rotor.M.shape[-1]
        key = jax.tree.map(lambda x: x[0], self.loops()[0].scenario).key()
        inverse = solve(jnp.asarray(self.rotor.M)[None], jnp.eye(n, dtype=jnp.result_type(float))[None])[0]
        realised = functools.partial(_realised, self.rotor.rotation)
        axes = tuple(self.each(realised, self.split(jnp.arange(self.count))))
        return dataclasses.replace(self, rotor=self.rotor.realised(key), axes=axes, inverse=inverse)

    def sensor_errors(self, sample: Scalar) -> tuple[Errors, ...]:
        return tuple(self.each(lambda axis: axis.sensor_errors(sample)))

    def start(self) -> MachineState:
        q = jnp.asarray(self.start_q)
        z = self.split(times(self.rotor.at_sensors, q))

        def one(axis: Sampled | ClosedLoop, z: Array) -> SampledState | LoopState:
            loop = loop_of(axis)
            begin = dataclasses.replace(loop.scenario.initial, z=z, z_dot=jnp.zeros_like(z))
            scenario = dataclasses.replace(loop.scenario, initial=begin)
            return with_loop(axis, dataclasses.replace(loop, scenario=scenario)).start()

        axes = self.each(one, z)
        law = begun(self, self.rotor.speed_at(0.0), axes, self.sensor_errors(0))
        return MachineState(q, jnp.zeros_like(q), still(axes), law)

    def moving(self, rows: Array, q: Array, q_dot: Array, axes: Groups) -> Groups:
        """Return the states of the groups with the motion at the places of `rows` [c, n]."""
        z, z_dot = self.split(times(rows, q)), self.split(times(rows, q_dot))
        return tuple(
            own._replace(plant=own.plant._replace(z=a, z_dot=b)) for own, a, b in zip(axes, z, z_dot, strict=True)
        )

    def at_magnets(self, state: MachineState) -> Groups:
        return self.moving(self.rotor.at_magnets, *state[:3])

    def at_sensors(self, state: MachineState) -> Groups:
        return self.moving(self.rotor.at_sensors, *state[:3])

    def with_stops(self, instant: Instant, q: Array) -> Instant:
        """Return the signals of all axes at one instant, with the displacements at stops at places of their own."""
        rows = self.rotor.at_stops
        return instant if rows is None else instant._replace(sizes=instant.sizes._replace(z_stop=times(rows, q)))

    def coupled(
        self, outside: tuple[Array, Scalar], state: MachineState, rates: Sequence, law: object = ()
    ) -> MachineState:
        """Return the rates of the machine.

        `outside`: other forces [n] and the speed (rad/s). `rates`: rates of the groups, of which each axis has its own
        mass and weight. `law`: rates of the state of the law.
        """
        (others, W), rotor = outside, self.rotor
        accelerations = self.join([own.plant.z_dot for own in rates])
        magnets = materialised(self.plants("m") * (accelerations + self.plants("g")))
        forces = jnp.sum(rotor.at_magnets * magnets[:, None], 0) + others
        forces = forces - times(rotor.D + W * rotor.G, state.q_dot) - times(rotor.K, state.q)
        return MachineState(state.q_dot, times(self.inverse, materialised(forces)), still(rates), law)

    def moved(
        self, outside: tuple[Array, Scalar], state: MachineState, parts: Sequence[tuple[Any, Instant]], law: object = ()
    ) -> tuple[MachineState, Instant]:
        """Return the rates of the machine as `coupled` does, with elastic stops, and the signals of all axes.

        `parts`: rates and signals of the groups.
        """
        rates, signals = zip(*parts, strict=True)
        forces = self.pushed(outside[0], state.q, state.q_dot)
        moved = self.coupled((forces, outside[1]), state, rates, law)
        return moved, self.with_stops(self.join(signals), state.q)

    def outside(self, t: Scalar) -> tuple[Array, Array]:
        """Return the forces on the coordinates other than the magnets' [n], and the speed (rad/s), at t (s)."""
        return self.rotor.forces(t), self.rotor.speed_at(t)

    def edges(self) -> Edges:
        at = self.rotor.edges()
        return Edges(at, len(at) if self.cuts is None else self.cuts)

    def status(self, state: MachineState) -> Array:
        """Return the status code of the rotor: the largest of its axes; DIVERGED if a coordinate is not finite."""
        finite = 0.0 * (jnp.sum(state.q) + jnp.sum(state.q_dot)) == 0
        rows, limits = self.limited()
        at = self.moving(rows[: self.count], *state[:3])
        codes = self.join(self.each(lambda axis, own: plant_status(loop_of(axis), own.plant), at))
        if len(rows) > self.count:
            beyond = jnp.abs(times(rows, state.q)) >= limits
            codes = jnp.append(codes, jnp.where(jnp.any(beyond), TOUCHED, ALIVE))
        return jnp.where(finite, jnp.max(codes), DIVERGED)

    def motion(self, state: MachineState) -> tuple[Array, Array]:
        """Return displacements (m) and velocities (m/s) at the places of `limited` [k]."""
        rows, _ = self.limited()
        return times(rows, state.q), times(rows, state.q_dot)

    def rest(self, state: MachineState, code: Array) -> MachineState:
        """Return the state in which a lost rotor is frozen: at rest, moved on in proportion to the limit it reached."""
        axes = self.each(lambda axis, own: axis.rest(own, code), self.at_sensors(state))
        rows, limits = self.limited()
        share = jnp.max(jnp.abs(times(rows, state.q)) / limits)
        q = jnp.where((code == TOUCHED) & (share > 0), state.q / away_from_zero(share, 1e-30), state.q)
        return MachineState(q, jnp.zeros_like(state.q_dot), still(axes), state.law)

    def demands(self, t: Scalar, state: MachineState, errors: Sequence[object]) -> Groups:
        """Return further arguments of the row of each group: the demanded forces, if the row computes the command."""
        raise NotImplementedError

    def row(self, t: Scalar, state: MachineState, errors: Sequence[object], alive: Array) -> MachineRow:
        demands = self.demands(t, state, errors)

        def rows(axes: Groups) -> Row:
            one = lambda axis, own, error, demand: axis.row(t, own, error, alive, *demand)  # noqa: E731
            return self.join(self.each(one, axes, errors, demands))

        row, sensed = rows(self.at_magnets(state)), rows(self.at_sensors(state))
        row = row._replace(z_measured=sensed.z_measured, refused=sensed.refused)
        if self.rotor.at_stops is not None:
            row = row._replace(z_stop=times(self.rotor.at_stops, state.q))
        return MachineRow(jnp.asarray(t), alive, state.q, self.rotor.speed_at(t), row)

    def completed(self, row: MachineRow, span: Span) -> MachineRow:
        def one(axis: Sampled | ClosedLoop, row: Row, most: object, least: object, densities: object) -> Row:
            return axis.completed(row, Span(span.time, most, least, densities))

        parts = (self.split(x) for x in (row.axes, span.most, span.least, span.densities))
        return row._replace(axes=self.join(self.each(one, *parts)))

    def singularity(self, row: MachineRow) -> Array:
        return jnp.min(self.join(self.each(lambda axis, row: axis.singularity(row), self.split(row.axes))))

    def scale(self, own: Sequence) -> MachineState:
        """Return the characteristic size of each component of the state. `own`: those of the groups' states."""
        z, z_dot = (self.join([getattr(one.plant, name) for one in own]) for name in ("z", "z_dot"))
        rows = jnp.max(jnp.abs(self.rotor.at_magnets) + jnp.abs(self.rotor.at_sensors), 0)
        # a coordinate that no axis sees, such as the axial one without a thrust bearing, has the size of the others
        rows = jnp.where(rows > 0, rows, 1.0)
        law = () if self.law is None else self.law.scale()
        return MachineState(jnp.max(z) / rows, jnp.max(z_dot) / rows, still(own), law)

    def problem_of(self, inputs: Callable, observed: Callable, scale: Sequence) -> InitialValueProblem:
        """Return the initial value problem with these inputs, rates with signals, and sizes of the groups' states."""
        edges = self.edges()
        signals = jax.tree.map(lambda _: jnp.zeros(self.count), INSTANT_TREE)
        rates = lambda inputs, state: observed(inputs, state)[0]  # noqa: E731
        sizes, edges = self.scale(scale), edges if edges.most else NO_EDGES
        signals, limit = self.with_stops(signals, jnp.asarray(self.start_q)), self.limited()[1]
        return InitialValueProblem(
            inputs, rates, sizes, self.status, None, observed, signals, edges=edges, motion=self.motion, limit=limit
        )


def still(axes: Sequence) -> Groups:
    """Return the states of the groups, or their rates, without displacement and velocity."""
    return tuple(own._replace(plant=own.plant._replace(z=(), z_dot=())) for own in axes)


def _realised(rotation: Rotation, axis: Sampled | ClosedLoop, number: Array) -> Sampled | ClosedLoop:
    """Return the loop of one axis with the rotor's speed, its random signals drawn, and the random key of this axis."""
    loop = loop_of(axis)
    if loop.scenario.rotor is not None:
        loop = dataclasses.replace(loop, scenario=dataclasses.replace(loop.scenario, rotor=rotation))
    loop = loop.realised()
    high, low = jax.random.key_data(jax.random.fold_in(loop.scenario.key(), number))
    return with_loop(axis, dataclasses.replace(loop, key=(high, low)))
