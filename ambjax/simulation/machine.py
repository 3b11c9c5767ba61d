"""A whole machine: one rotor on several magnetic bearing axes, each with its own sensors, amplifier and cascade.

Each axis is the loop of one axis, `Sampled` or `ClosedLoop`; the leaves of all axes are stacked, with a leading axis of
length c. The axes are coupled by the rotor alone: its coordinates give the motion at each magnet and each sensor, and
the forces of the magnets accelerate the coordinates.
"""

import dataclasses
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, leaf, part, record
from ambjax.numerics.small_matrices import solve
from ambjax.simulation.between import acting, lags, plant_status, under
from ambjax.simulation.edges import NO_EDGES, Edges
from ambjax.simulation.folds import Ending
from ambjax.simulation.integrate import Advanced, InitialValueProblem, Integrator, in_turn
from ambjax.simulation.loop import INSTANT_TREE, ClosedLoop, ExternalInputs, Realised
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.span import Instant, Span
from ambjax.simulation.trajectory import DIVERGED, Row
from ambjax.world.amplifier import Amplifier
from ambjax.world.rotor import Rotor
from ambjax.world.sensor import Measurement


class MachineState(NamedTuple):
    """State of a machine.

    - `q`, `q_dot` [n]: coordinates of the rotor and their rates.
    - `axes`: states of the axes, stacked [c], without displacement and velocity, which follow from q and q_dot.
    """

    q: Array
    q_dot: Array
    axes: Any


class MachineRow(NamedTuple):
    """Signals of a machine at one sample: time (s), coordinates [n], speed (rad/s), and the rows of the axes [c]."""

    t: Array
    alive: Array
    q: Array
    speed: Array
    axes: Row


@record
class PerAxis:
    """A fold of one axis for each axis. `fold`: the folds of the axes, stacked [c]."""

    fold: Any = part(doc="the folds of the axes", channels=True)

    def init(self) -> Any:
        return jax.vmap(lambda fold: fold.init())(self.fold)

    def update(self, carry: Any, row: MachineRow, span: Span) -> Any:
        one = Row(*[0] * len(Row._fields))._replace(t=None, alive=None)  # pyright: ignore[reportArgumentType]
        axes = 0, 0, one, Span(None, 0, 0, 0)  # pyright: ignore[reportArgumentType]
        rows = row.axes._replace(t=row.t, alive=row.alive)
        return jax.vmap(lambda fold, *now: fold.update(*now), in_axes=axes)(self.fold, carry, rows, span)

    def result(self, carry: Any, ending: Ending) -> Any:
        return jax.vmap(lambda fold, own: fold.result(own, ending))(self.fold, carry)


@record
class Machine:
    """A rotor on c bearing axes, as a `rollout.System`: base class of both kinds of loop.

    All axes have the same kinds of parts; their numbers differ.
    """

    rotor: Rotor = part(doc="the rotor")
    axes: Any = part(doc="the loops of the axes, `Sampled` or `ClosedLoop`, stacked [c]", channels=True)
    start_q: Array = leaf(shape="n", unit="m or rad", at_least=-10.0, at_most=10.0, doc="coordinates at t = 0, at rest")
    inverse: Array | None = leaf(
        default=None, shape="n n", at_least=-1e30, at_most=1e30, optional=True, doc="inverse of the mass matrix"
    )

    def loops(self) -> Any:
        """Return the loops of the axes in continuous time, stacked [c]."""
        return self.axes

    def realised(self) -> Self:
        """Return the machine of one member: random signals drawn, a random key for each axis, and M inverted."""
        if self.inverse is not None:
            return self
        count, n = self.rotor.at_magnets.shape
        key = jax.tree.map(lambda x: x[0], self.loops().scenario).key()
        inverse = solve(self.rotor.M[None], jnp.eye(n, dtype=self.rotor.M.dtype)[None])[0]
        axes = jax.vmap(_realised)(self.axes, jnp.arange(count))
        return dataclasses.replace(self, rotor=self.rotor.realised(key), axes=axes, inverse=inverse)

    def sensor_errors(self, sample: Scalar) -> Any:
        return jax.vmap(lambda axis: axis.sensor_errors(sample))(self.axes)

    def start(self) -> MachineState:
        q = jnp.asarray(self.start_q)
        z, zero = _times(self.rotor.at_sensors, q), jnp.zeros(len(self.rotor.at_sensors))

        def one(axis: Any, z: Array, z_dot: Array) -> Any:
            loop = _loop(axis)
            begin = dataclasses.replace(loop.scenario.initial, z=z, z_dot=z_dot)
            scenario = dataclasses.replace(loop.scenario, initial=begin)
            return _with_loop(axis, dataclasses.replace(loop, scenario=scenario)).start()

        return MachineState(q, jnp.zeros_like(q), _still(jax.vmap(one)(self.axes, z, zero)))

    def moving(self, rows: Array, q: Array, q_dot: Array, axes: Any) -> Any:
        """Return the states of the axes with the motion at the places of `rows` [c, n]."""
        plant = axes.plant._replace(z=_times(rows, q), z_dot=_times(rows, q_dot))
        return axes._replace(plant=plant)

    def at_magnets(self, state: MachineState) -> Any:
        """Return the states of the axes with the motion at the magnets."""
        return self.moving(self.rotor.at_magnets, *state)

    def at_sensors(self, state: MachineState) -> Any:
        """Return the states of the axes with the motion at the sensors."""
        return self.moving(self.rotor.at_sensors, *state)

    def coupled(
        self, outside: tuple[Array, Array], state: MachineState, axis_rates: Any, plant: Any
    ) -> MachineState:
        """Return the rates of the machine.

        `outside`: other forces [n] and the speed (rad/s). `axis_rates`: rates of the axes [c], each with the mass and
        the weight of its axis. `plant`: the plants of the axes, stacked.
        """
        (others, W), rotor = outside, self.rotor
        magnets = plant.m * (axis_rates.plant.z_dot + plant.g)
        forces = jnp.sum(rotor.at_magnets * magnets[:, None], 0) + others
        forces = forces - _times(rotor.D + W * rotor.G, state.q_dot) - _times(rotor.K, state.q)
        return MachineState(state.q_dot, _times(self.inverse, forces), _still(axis_rates))

    def outside(self, t: Scalar) -> tuple[Array, Array]:
        """Return the forces on the coordinates other than the magnets' [n], and the speed (rad/s), at t (s)."""
        return self.rotor.forces(t), self.rotor.speed_at(t)

    def status(self, state: MachineState) -> Array:
        """Return the status code of the rotor: the largest of its axes; DIVERGED if a coordinate is not finite."""
        finite = 0.0 * (jnp.sum(state.q) + jnp.sum(state.q_dot)) == 0
        return jnp.where(finite, jnp.max(self.axis_codes(self.at_magnets(state))), DIVERGED)

    def axis_codes(self, axes: Any) -> Array:
        """Return the status codes of the axes [c]. `axes`: their states with the motion at the magnets."""
        return jax.vmap(lambda loop, state: plant_status(loop, state.plant))(self.loops(), axes)

    def motion(self, state: MachineState) -> tuple[Array, Array]:
        """Return displacements (m) and velocities (m/s) at the magnets [c]."""
        return _times(self.rotor.at_magnets, state.q), _times(self.rotor.at_magnets, state.q_dot)

    def rest(self, state: MachineState, code: Array) -> MachineState:
        axes = jax.vmap(lambda axis, own: axis.rest(own, code))(self.axes, self.at_sensors(state))
        return MachineState(state.q, jnp.zeros_like(state.q_dot), _still(axes))

    def row(self, t: Scalar, state: MachineState, errors: Any, alive: Array) -> MachineRow:
        def rows(axes: Any) -> Row:
            return jax.vmap(lambda axis, own, error: axis.row(t, own, error, alive))(self.axes, axes, errors)

        row, sensed = rows(self.at_magnets(state)), rows(self.at_sensors(state))
        row = row._replace(z_measured=sensed.z_measured, refused=sensed.refused)
        return MachineRow(jnp.asarray(t), alive, state.q, self.rotor.speed_at(t), row)

    def completed(self, row: MachineRow, span: Span) -> MachineRow:
        return row._replace(axes=self.axes.completed(row.axes, span))

    def singularity(self, row: MachineRow) -> Array:
        return jnp.min(self.loops().singularity(row.axes))

    def scales(self, axes: Any) -> tuple[Array, Array]:
        """Return characteristic sizes of the coordinates and of their rates [n], from those of the axes [c]."""
        rows = jnp.abs(self.rotor.at_magnets) + jnp.abs(self.rotor.at_sensors)
        # a coordinate that no axis sees, such as the axial one without a thrust bearing, has the size of the others
        per_size = jnp.max(rows, 0)
        per_size = jnp.where(per_size > 0, per_size, 1.0)
        return jnp.max(axes.z) / per_size, jnp.max(axes.z_dot) / per_size


@record
class SampledMachine(Machine):
    """A machine whose cascades run on a processor, one step of all axes per sample."""

    def loops(self) -> Any:
        return self.axes.loop

    def jump(self, t: Scalar, state: MachineState, errors: Any) -> MachineState:
        """Step the laws of all axes at time t (s)."""
        axes = jax.vmap(lambda axis, own, error: axis.jump(t, own, error))(self.axes, self.at_sensors(state), errors)
        return state._replace(axes=_still(axes))

    def advance(
        self, method: Integrator, errors: Any, t: Scalar, period: Scalar, state: MachineState, memory: object, code: Any
    ) -> Advanced:
        """Integrate rotor and coils from the sample at t (s) to the next one."""
        axes = state.axes
        code = jnp.where((code == 0) & (jnp.min(axes.finite) == 0), DIVERGED, code)
        processor = self.axes.loop.cascade.processor
        delay = jnp.asarray(processor.delay)[0]
        voltages = acting((axes.command.u, *axes.past), delay, period, bool(processor.whole))
        pieces, u_a = self._pieces(jnp.asarray(t), voltages, axes.u_a)
        begin = MachineState(state.q, state.q_dot, _PlantOnly(axes.plant))
        parts = [(self._problem(state, voltage), time) for voltage, time in pieces]
        reached = in_turn(method, parts, t, begin, memory, code)
        states = [begin, *[after.state for after in reached]]
        z_filtered = self._filtered(jnp.asarray(t), axes, states, [time for _, time in pieces])
        end = reached[-1].state
        axes = axes._replace(plant=end.axes.plant, z_filtered=z_filtered, u_a=u_a)
        return reached[-1]._replace(state=MachineState(end.q, end.q_dot, axes))

    def _pieces(self, t: Array, voltages: Any, u_a: Any) -> tuple[list[Any], Any]:
        """Return the voltages [c] as functions of time with their durations (s), and the amplifiers' outputs at the end.

        With a low-pass of the sensors, pieces also end at the jumps of loads.
        """
        amplifier = self.axes.loop.scenario.amplifier
        slow, given = isinstance(amplifier, Amplifier) and amplifier.slow, []
        edges = Edges(self.rotor.edges(), len(self.rotor.edges()))
        for u, time in voltages:
            voltage = (lambda now, u=u, u_a=u_a, t=t: amplifier.followed(u_a, u, now - t)) if slow else lambda _, u=u: u
            lengths = edges.pieces(t, time) if lags(self.axes.loop) else [time]
            given += [(voltage, length) for length in lengths]
            u_a, t = (amplifier.followed(u_a, u, jnp.asarray(time)) if slow else u_a), t + time
        return given, u_a

    def _problem(self, first: MachineState, voltage: Any) -> InitialValueProblem:
        """Return the initial value problem of rotor and coils under `voltage` [c] (V), a function of time.

        `first`: state at the sample.
        """
        sampled = self.at_magnets(first)

        def inputs(t: Scalar) -> Any:
            return self.outside(t), jax.vmap(lambda loop: loop.inputs(t))(self.loops()), voltage(t)

        def observed(inputs: Any, state: MachineState) -> tuple[MachineState, Instant]:
            outside, own, u = inputs
            magnets = self.at_magnets(state).plant

            def one(loop: Any, first: Any, command: Any, at: ExternalInputs, u: Array, plant: Any) -> Any:
                problem: Any = under(loop, first, command, lambda _: u, NO_EDGES)
                return problem.observed((at, u), plant)

            rates, instant = jax.vmap(one)(self.loops(), sampled.plant, sampled.command, own, u, magnets)
            return self.coupled(outside, state, _PlantOnly(rates), self.loops().scenario.plant), instant

        scale = jax.vmap(lambda loop: jax.tree.map(jnp.asarray, loop.scenario.plant.scale()))(self.loops())
        scale = MachineState(*self.scales(scale), _still(_PlantOnly(scale)))
        edges = Edges(self.rotor.edges(), len(self.rotor.edges()))
        return InitialValueProblem(
            inputs,
            lambda inputs, state: observed(inputs, state)[0],
            scale,
            self.status,
            None,
            observed,
            jax.tree.map(lambda _: jnp.zeros(len(self.rotor.at_magnets)), INSTANT_TREE),
            edges=edges if edges.most else NO_EDGES,
            motion=self.motion,
            limit=self.axes.loop.scenario.limit,
        )

    def _filtered(self, t: Array, axes: Any, states: list[Any], times: list[Scalar]) -> Any:
        """Return the outputs of the sensors' low-passes [c] at the next sample, m."""
        if not lags(self.axes.loop):
            return axes.z_filtered
        z_filtered, sensor = axes.z_filtered, self.axes.loop.scenario.sensor
        motions = []
        for state, at in zip(states, [t + sum(times[:k]) for k in range(len(times) + 1)], strict=True):
            sensed = self.moving(self.rotor.at_sensors, state.q, state.q_dot, state.axes).plant
            motion = Measurement(sensed.z, sensed.z_dot, jnp.zeros_like(sensed.z))
            if sensor.runout is not None:
                runout, rate = jax.jvp(sensor.runout, (at,), (jnp.ones_like(at),))
                motion = motion._replace(z=motion.z + runout, z_dot=motion.z_dot + rate)
            motions.append(motion)
        for before, after, time in zip(motions, motions[1:], times, strict=False):
            z_filtered = sensor.lagged(z_filtered, before, after, time)
        return z_filtered


@record
class ContinuousMachine(Machine):
    """A machine whose cascades run in continuous time."""

    def problem(self, errors: Any) -> InitialValueProblem:
        """Return the initial value problem of one sample, with the measurement errors held."""

        def inputs(t: Scalar) -> Any:
            return self.outside(t), jax.vmap(lambda loop: loop.inputs(t))(self.axes)

        def observed(inputs: Any, state: MachineState) -> tuple[MachineState, Instant]:
            outside, own = inputs
            observe = jax.vmap(lambda loop, *now: loop.observed(*now))
            rates, instant = observe(self.axes, own, self.at_magnets(state), errors, self.at_sensors(state).plant)
            return self.coupled(outside, state, rates, self.axes.scenario.plant), instant

        scale = jax.vmap(lambda loop: loop.scale())(self.axes)
        edges = Edges(self.rotor.edges(), len(self.rotor.edges()))
        return InitialValueProblem(
            inputs,
            lambda inputs, state: observed(inputs, state)[0],
            MachineState(*self.scales(scale.plant), _still(scale)),
            self.status,
            None,
            observed,
            jax.tree.map(lambda _: jnp.zeros(len(self.rotor.at_magnets)), INSTANT_TREE),
            edges=edges if edges.most else NO_EDGES,
            motion=self.motion,
            limit=self.axes.scenario.limit,
        )


class _PlantOnly(NamedTuple):
    """State of the axes of which only the plant is integrated."""

    plant: Any


def _times(matrix: Any, x: Array) -> Array:
    """Return matrix @ x as a sum of products, which XLA compiles within one kernel."""
    return jnp.sum(matrix * x, -1)


def _still(axes: Any) -> Any:
    """Return the states of the axes, or their rates, without displacement and velocity."""
    return axes._replace(plant=axes.plant._replace(z=(), z_dot=()))


def _loop(axis: Sampled | ClosedLoop) -> ClosedLoop:
    return axis.loop if isinstance(axis, Sampled) else axis


def _with_loop(axis: Any, loop: ClosedLoop) -> Any:
    return dataclasses.replace(axis, loop=loop) if isinstance(axis, Sampled) else loop


def _realised(axis: Any, number: Array) -> Any:
    """Return the loop of one axis with its random signals drawn, and with the random key of this axis."""
    loop = _loop(axis.realised())
    key = jax.random.fold_in(loop.scenario.key(), number)
    high, low = jax.random.key_data(key)
    return _with_loop(axis, Realised(loop.cascade, loop.scenario, (high, low)))


def machine_of(rotor: Rotor, axes: Sampled | ClosedLoop, start_q: Array) -> Machine:
    """Return the machine of a rotor and its axes, stacked [c]. `start_q` [n]: coordinates at t = 0."""
    kind = SampledMachine if isinstance(axes, Sampled) else ContinuousMachine
    return kind(rotor, axes, start_q)

