"""The closed loop as one system of ordinary differential equations: plant and cascade together."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, Self

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Command, Sample
from ambjax.control.stages import ForceDemand
from ambjax.numerics.records import Scalar, part, record, static
from ambjax.numerics.smooth import larger, limited
from ambjax.simulation.edges import Edges
from ambjax.simulation.integrate import InitialValueProblem, WholeState
from ambjax.simulation.sliding import slide, slides
from ambjax.simulation.trajectory import ALIVE, DIVERGED, INSTANT_TREE, TOUCHED, Densities, Instant, Row, Sizes, Span
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors, Measurement
from ambjax.world.waveforms import Reference, reference_at

# A state that exceeds its scale by this factor counts as diverged. For such a state the model is not valid, but the
# numbers are still finite.
DIVERGENCE = 1e6


class ExternalInputs(NamedTuple):
    """External inputs of the loop at one instant.

    The reference, the disturbances q_z (m/s^2) and q_i (A/s), the runout (m), and a test signal e (m or m/s). The
    runout is () if the sensor has none; e is () without a test signal.
    """

    reference: Reference
    q_z: Array
    q_i: Array
    runout: Array | tuple[()]
    e: Array | tuple[()] = ()


# The demanded force and the estimate, if another law computes them; None: observer and position law of the cascade do.
Demand = tuple[ForceDemand, Measurement] | None


class LoopState(NamedTuple):
    """State of the plant, then of the cascade. `numerics.linear.factor` relies on this order."""

    plant: Any
    control: CascadeState


class AddedSignal(Protocol):
    """A test signal e (m or m/s) that is added to a reading. `reading`: the name of this reading, z or z_dot."""

    @property
    def reading(self) -> str: ...
    def at(self, sample: Array) -> Array: ...
    def __call__(self, t: Scalar) -> Array: ...


@record
class ClosedLoop(WholeState):
    """The closed loop of a cascade in a scenario, in continuous time.

    The argument `errors` of its methods contains the measurement errors, which are constant over a sample. With a test
    signal, `z_measured` of a row is the reading to which it is added, and the integrator `Slide` does not apply.
    """

    cascade: Cascade
    scenario: Scenario
    key: tuple[Scalar, Scalar] | None = part(
        default=None, doc="random key of the member as two 32-bit words; None: signals are not drawn yet"
    )
    normals: Sequence[Array] | None = part(
        default=None, doc="the three normal numbers of the sensors' noise in a sample; None: drawn from the key"
    )
    wave: AddedSignal | None = part(default=None, doc="test signal; None: none")
    cuts: int = static(default=0, doc="largest number of edges in a sample at which a fixed number of steps ends")

    def realised(self) -> Self:
        """Return the loop of one member, with its random signals drawn and the random key of its sensors."""
        if self.key is not None:
            return self
        cascade, scenario = self.cascade.turning(self.scenario.rotor), self.scenario.realised()
        return dataclasses.replace(self, cascade=cascade, scenario=scenario, key=self.scenario.words())

    @property
    def measures_velocity(self) -> bool:
        """Whether the controller reads a measured velocity."""
        return self.scenario.sensors.velocity and not self.cascade.observer.estimates_velocity

    def words(self) -> tuple[Scalar, Scalar]:
        """Return the random key of the member as two 32-bit words."""
        return self.scenario.words() if self.key is None else self.key

    def sensor_errors(self, sample: Scalar) -> Errors:
        sensors = self.scenario.sensors
        if self.normals is not None:
            return Errors(*sensors.scaled(self.normals))
        return Errors(*sensors.noise(self.words(), sample))

    def start(self) -> LoopState:
        plant = self.scenario.plant.start(self.scenario.initial.measurement())
        inputs = self.inputs(0.0)._replace(e=())
        measured = self.received(inputs, plant, self.sensor_errors(0))
        return LoopState(plant, self.cascade.init(measured, inputs.reference))

    def scale(self) -> LoopState:
        """Return the characteristic size of each component of the state; integration errors are relative to it."""
        return jax.tree.map(jnp.asarray, LoopState(self.scenario.plant.scale(), self.cascade.scale()))

    def layer(self) -> LoopState:
        """Return, for each state, the largest error that keeps it in the boundary layer of its sign; inf: the plant."""
        plant = jax.tree.map(lambda _: jnp.inf, self.scenario.plant.scale())
        return jax.tree.map(jnp.asarray, LoopState(plant, self.cascade.layer()))

    def inputs(self, t: Scalar) -> ExternalInputs:
        """Return the reference, the disturbances, the runout and the test signal at time t, s."""
        scenario, runout = self.scenario, self.scenario.sensors.runout
        runout = () if runout is None else runout(t)
        e = () if self.wave is None else self.wave(t)
        return ExternalInputs(reference_at(scenario.reference, t), scenario.acceleration(t), scenario.q_i(t), runout, e)

    def received(self, inputs: ExternalInputs, plant: object, errors: Errors) -> Measurement:
        """Return the readings that the controller receives, with the runout and the test signal."""
        motion = self.scenario.plant.measurement(plant)
        measured = self.scenario.sensors.reading(motion, errors._replace(runout=inputs.runout))
        return with_signal(measured, self.wave, inputs.e)

    def command(
        self, inputs: ExternalInputs, state: LoopState, errors: Errors, sensed: object = None, demanded: Demand = None
    ) -> tuple[Command, CascadeState, Array]:
        """Return the command of the cascade, the rates of its states, and the voltage at the coils, V.

        `sensed`: state of the plant at the place of the sensor; None: that of `state`.
        """
        u_max = jnp.asarray(self.scenario.command_limit)
        measured = self.received(inputs, state.plant if sensed is None else sensed, errors)
        if demanded is None:
            command, rates = self.cascade(measured, state.control, inputs.reference, u_max)
        else:
            command, rates = self.cascade.commanded(*demanded, state.control, Sample(inputs.reference, None, u_max))
            _, notched = self.cascade.observed(measured, state.control.observer, inputs.reference)
            rates = rates._replace(observer=notched)
        return command, rates, self.scenario.coil_voltage(limited(command.u, u_max), state.plant, inputs.q_i)

    def rates(self, inputs: ExternalInputs, state: LoopState, errors: Errors) -> LoopState:
        """Return the time derivative of the state: Eqs. (1), (2) and the laws."""
        _, control, u = self.command(inputs, state, errors)
        return self.derivative(inputs, state, control, u)

    def observed(
        self, inputs: ExternalInputs, state: LoopState, errors: Errors, sensed: object = None, demanded: Demand = None
    ) -> tuple[LoopState, Instant]:
        """Return the rates of the state, and the signals to record now. `sensed`: as in `command`."""
        command, control, u = self.command(inputs, state, errors, sensed, demanded)
        signals = self.instant(inputs.reference, state.plant, command.i_ref, command.v_tilde, u)
        return self.derivative(inputs, state, control, u), signals

    def instant(self, reference: Reference, plant: object, i_ref: Array, v_tilde: Array, u: Array) -> Instant:
        """Return the signals to record at one instant. `u`: applied voltage, V."""
        motion, heat = self.scenario.plant.measurement(plant), self.scenario.plant.signals(plant).heat
        sigma = self.cascade.sigma(motion, reference)
        sizes = Sizes(motion.z, motion.z - reference.r, sigma, u, motion.i, motion.i - i_ref, v_tilde)
        return Instant(sizes, Densities(u, u * u, heat))

    def derivative(self, inputs: ExternalInputs, state: LoopState, control: CascadeState, u: Array) -> LoopState:
        """Return the time derivative of the state. `u`: applied voltage, V."""
        plant = self.scenario.plant
        q_z = self.scenario.pushed(inputs.q_z, plant.measurement(state.plant))
        return LoopState(plant.rates(state.plant, u, q_z, inputs.q_i), control)

    def status(self, state: LoopState) -> Array:
        """Return the status code of the rotor, an index of `trajectory.STATUSES`: 0 while it is levitated."""
        return self.status_of(state, self.scale(), state.plant)

    def status_of(self, state: object, scale: object, plant: object) -> Array:
        """Return the status code for a state or a part of it."""
        in_range = [jnp.abs(x) <= DIVERGENCE * s for x, s in zip(*map(jax.tree.leaves, (state, scale)), strict=True)]
        touched = jnp.abs(self.scenario.plant.measurement(plant).z) >= self.scenario.limit
        return jnp.where(
            functools.reduce(jnp.logical_and, in_range), jnp.where(touched, TOUCHED, ALIVE), DIVERGED
        ).astype(jnp.int32)

    def motion(self, plant: object) -> tuple[Array, Array]:
        """Return the displacement (m) and the velocity (m/s) of the rotor for a state of the plant."""
        return self.scenario.plant.measurement(plant)[:2]

    def rest(self, state: LoopState, code: Array) -> LoopState:
        """Return the state in which a lost rotor is frozen: at rest, at the stop that it touched or at its last z."""
        plant = self.scenario.plant
        z = plant.measurement(state.plant).z
        stop = jnp.where(z < 0, -1.0, 1.0) * self.scenario.limit
        return state._replace(plant=plant.rest(state.plant, jnp.where(code == TOUCHED, stop, z)))

    def problem(self, errors: Errors) -> InitialValueProblem:
        step = functools.partial(slide, self, errors) if slides(self.cascade, self.scenario) else None
        rates = lambda inputs, x: self.rates(inputs, x, errors)  # noqa: E731
        observed = lambda inputs, x: self.observed(inputs, x, errors)  # noqa: E731
        jumps = sum(map(jnp.abs, self.scenario.sensors.noises)) > 0
        edges = Edges(self.scenario.edges(reference=True), self.cuts, self.scenario.knots(reference=True))
        motion = lambda state: self.motion(state.plant)  # noqa: E731
        scale, layer, limit = self.scale(), self.layer(), self.scenario.limit
        return InitialValueProblem(
            self.inputs, rates, scale, self.status, layer, observed, INSTANT_TREE, jumps, step, edges, motion, limit
        )

    def row(self, t: Scalar, state: LoopState, errors: Errors, alive: Array, demanded: Demand = None) -> Row:
        """Return the signals at time t (s), with u_mean = u_peak = 0. The drive of a lost rotor is off: u = 0."""
        inputs = self.inputs(t)
        command, _, u = self.command(inputs, state, errors, None, demanded)
        measured = self.received(inputs, state.plant, errors)
        return self.signals(t, inputs, state.plant, command._replace(u=u), measured, alive)

    def signals(
        self, t: Scalar, inputs: ExternalInputs, state: object, command: Command, measured: Measurement, alive: Array
    ) -> Row:
        plant = self.scenario.plant
        motion, signals, (i_1, i_2) = plant.measurement(state), plant.signals(state), plant.currents(state)
        return Row(
            t=jnp.asarray(t),
            z=motion.z,
            z_dot=motion.z_dot,
            i=motion.i,
            i_ref=command.i_ref,
            u=jnp.where(alive, command.u, 0.0),
            u_mean=jnp.zeros_like(command.u),
            u_peak=jnp.zeros_like(command.u),
            i_1=i_1,
            i_2=i_2,
            force=plant.m * plant.a * signals.v,
            B=plant.flux_density(state),
            v=signals.v,
            v_star=command.v_star,
            v_tilde=command.v_tilde,
            sigma=self.cascade.sigma(motion, inputs.reference),
            r=inputs.reference.r,
            q_z=inputs.q_z,
            q_i=inputs.q_i,
            z_measured=measured.z if self.wave is None else getattr(measured, self.wave.reading),
            heat=jnp.where(alive, signals.heat, 0.0),
            refused=jnp.zeros_like(alive),
            alive=alive,
        )

    def completed(self, row: Row, span: Span) -> Row:
        """Return the row of a sample with mean and peak voltage, which are known only at the end of the sample."""
        mean = span.densities.u / jnp.where(span.time > 0, span.time, 1.0)
        return row._replace(u_mean=mean, u_peak=larger(jnp.abs(row.u), span.most.u))

    def singularity(self, row: Row) -> Array:
        """Return a number that is 0 on the singular curve C and positive on its admissible side. Eq. (9)."""
        return self.scenario.plant.singularity(row.z, row.i_ref)


def with_signal(measured: Measurement, wave: AddedSignal | None, e: Array | tuple[()]) -> Measurement:
    """Return the readings with e (m or m/s), the value of `wave`, added to one of them."""
    if wave is None or isinstance(e, tuple):
        return measured
    return measured._replace(**{wave.reading: getattr(measured, wave.reading) + e})
