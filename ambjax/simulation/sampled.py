"""The closed loop of a cascade on a processor: sampled measurements, discrete laws, and a held voltage.

At t_n the plant is measured first, and then the laws make a step. The voltage u_n, within the supply's limit, acts from
t_n + delay T until t_{n+1} + delay T; before the first voltage u = 0. Then the plant is integrated to t_{n+1}, under
one voltage, or under two if the delay is not a whole number of samples.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control.cascade import Cascade, CascadeState, Command, Sample
from ambjax.control.guard import Judged, Watch, expected, simulated
from ambjax.control.processor import Processor
from ambjax.numerics.records import Scalar, record, static
from ambjax.numerics.smooth import limited
from ambjax.simulation.clock import Clock
from ambjax.simulation.edges import NO_EDGES, Edges
from ambjax.simulation.integrate import Advanced, InitialValueProblem, Integrator, choose, in_turn
from ambjax.simulation.loop import SHOWN, ClosedLoop, Densities, ExternalInputs, LoopState, Sizes
from ambjax.simulation.span import Instant, Span
from ambjax.simulation.trajectory import DIVERGED, Row
from ambjax.world.amplifier import Amplifier
from ambjax.world.faults import Sensed
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors, FaultyErrors, Measurement
from ambjax.world.signals import Reference, reference_at


class SampledState(NamedTuple):
    """State of the closed loop on a processor. Optional parts are () if the loop does not have them.

    - `plant`, `control`: state of the plant and of the laws.
    - `command`: last command, with u within the supply's limit.
    - `past`: the two voltages before it, V.
    - `sane`: 1, or 0 after a law has returned a number that is not finite.
    - `seen`: output of the low-pass of the position sensor, m.
    - `u_a`: voltage of the amplifier, V.
    - `watch`: state of the guard.
    - `started`: 1, or 0 until the guard has accepted a reading, from which the laws are initialised.
    - `sensed`: last reading of a sensor with faults.
    """

    plant: Any
    control: CascadeState
    command: Command
    past: tuple[Array, Array]
    sane: Array
    seen: Array | tuple[()]
    u_a: Array | tuple[()]
    watch: Any = ()
    started: Array | tuple[()] = ()
    sensed: Sensed | tuple[()] = ()


@record
class Sampled:
    """The closed loop of a cascade on a processor.

    - `loop`: the closed loop in continuous time.
    - `period`: sample period, s.
    - `cuts`: largest number of edges of disturbances inside one sample; None: the number of all edges.
    """

    loop: ClosedLoop
    period: Scalar
    cuts: int | None = static()

    @property
    def processor(self) -> Processor:
        """The processor of the cascade."""
        processor = self.loop.cascade.processor
        assert processor is not None
        return processor

    def realised(self) -> Self:
        return dataclasses.replace(self, loop=self.loop.realised())

    def sensor_errors(self, sample: Scalar) -> Errors | FaultyErrors:
        drawn, sensor = self.loop.sensor_errors(sample), self.loop.scenario.sensor
        if sensor is None or not sensor.faulty:
            return drawn
        return FaultyErrors(*drawn, sensor.struck(self.loop.words(), sample, self.period))

    def start(self) -> SampledState:
        """Return the state at t = 0."""
        scenario, zero = self.loop.scenario, jnp.zeros(())
        plant = scenario.plant.start(scenario.initial.measurement())
        seen = scenario.plant.measurement(plant).z if self._lags else ()
        slow = scenario.amplifier is not None and scenario.amplifier.slow
        measured = self.measured(plant, seen, self.sensor_errors(0))
        command, past, guard = Command(*[zero] * 5), (zero, zero), self.processor.guard
        faulty = scenario.sensor is not None and scenario.sensor.faulty
        return SampledState(
            plant,
            self.loop.cascade.init(measured),
            command,
            past,
            jnp.ones(()),
            seen,
            zero if slow else (),
            guard.start() if guard else (),
            zero if guard and faulty else (),
            Sensed(measured.z, zero) if faulty else (),
        )

    @property
    def _lags(self) -> bool:
        sensor = self.loop.scenario.sensor
        return sensor is not None and sensor.bandwidth is not None

    def measured(self, plant: Any, seen: Any, errors: Errors | FaultyErrors) -> Measurement:
        """Return the readings of sensors without faults; `seen`: output of the position sensor's low-pass, m."""
        true, sensor = self.loop.scenario.plant, self.loop.scenario.sensor
        motion = true.measurement(plant)
        if sensor is None:
            return motion
        if self._lags:
            motion = motion._replace(z=seen)
        return sensor.converted(sensor.reading(motion, errors), true.s_0, true.i_0)

    def jump(self, t: Scalar, state: SampledState, errors: Errors | FaultyErrors) -> SampledState:
        """Do the step of the laws: return the state with the new command, and with the laws' states at t + period."""
        state, measured = self._struck(self.measured(state.plant, state.seen, errors), state, errors)
        return self.decided(measured, self.reference(t), state)

    def reference(self, t: Scalar) -> Reference:
        """Return the reference for the laws of the sample at t (s), which is that of t plus the predicted delay."""
        late = self.processor.ahead * self.period if self.processor.predicts else 0.0
        return reference_at(self.loop.scenario.reference, t + late)

    def _struck(self, measured: Measurement, state: SampledState, errors: Any) -> tuple[SampledState, Measurement]:
        """Apply the faults of the position sensor, and return the new state and measurement."""
        sensor, sensed = self.loop.scenario.sensor, state.sensed
        if sensor is None or not sensed or not isinstance(errors, FaultyErrors):
            return state, measured
        sensed = sensor.sensed(measured.z, sensed, errors.struck, self.period, self.loop.scenario.plant.s_0)
        z = jnp.where(jnp.isnan(sensed.z), 0.0, sensed.z)
        state = state._replace(sensed=sensed._replace(z=z))
        if self.processor.guard is None:  # NaN ends the run; 0 keeps derivatives finite
            state = state._replace(sane=jnp.where(jnp.isnan(sensed.z), 0.0, state.sane))
            return state, measured._replace(z=z)
        return state, measured._replace(z=sensed.z)

    def decided(self, measured: Measurement, reference: Reference, state: SampledState) -> SampledState:
        """Compute the command from a measurement, and return the new state. The plant does not change.

        The exported C code is generated from this function.
        """
        cascade, past, judged, laws = self.loop.cascade, (state.command.u, state.past[0]), None, state.control
        if self.processor.guard is not None:
            estimated = cascade.observer.estimates_velocity
            judged = self.processor.guard.judged(cascade.model, measured, state.watch, self.period, estimated)
            measured = judged.reading
        if not isinstance(state.started, tuple):
            laws = choose(state.started.astype(bool), laws, cascade.init(measured))
        sample = Sample(reference, self.period, jnp.asarray(self.loop.scenario.u_max), past)
        command, control, estimate = cascade.step(measured, laws, sample)
        command = command._replace(u=limited(command.u, sample.u_max))
        new = materialised((control, command, self._watched(judged, estimate, (command.u, *past))))
        # The sum is 0 only if every number is finite: 0 times NaN or infinity is NaN.
        sane = materialised(sum(0.0 * x for x in jax.tree.leaves(new))) == 0
        keeps = sane if judged is None else sane & judged.steps
        old = (state.control, state.command, state.watch)
        control, command, watch = jax.tree.map(lambda a, b: jnp.where(keeps, a, b), new, old)
        started = state.started
        if not isinstance(started, tuple):
            begins = keeps if judged is None else keeps & ~judged.refused
            started = (started.astype(bool) | begins).astype(started.dtype)
        if judged is not None:  # if not judged.steps: the safe command u = 0
            command, sane = command._replace(u=jnp.where(judged.steps, command.u, 0.0)), sane | ~judged.steps
            watch = watch._replace(left=judged.left)
        sane = jnp.where(sane, state.sane, 0.0)
        return state._replace(control=control, command=command, past=past, sane=sane, watch=watch, started=started)

    def _watched(self, judged: Judged | None, estimate: Measurement, voltages: tuple[Array, ...]) -> Watch | tuple[()]:
        """Return the guard's state at the next sample. `voltages`: of this sample and the two previous ones, V."""
        if judged is None:
            return ()
        delay = jnp.asarray(self.processor.ahead)
        # Each voltage is weighted by the fraction of the sample during which it acts.
        (u, before, first), share = voltages, 1 - jnp.abs(delay - 1)
        u = jnp.maximum(1 - delay, 0.0) * u + share * before + jnp.maximum(delay - 1, 0.0) * first
        motion = judged.reading._replace(z_dot=estimate.z_dot)
        return Watch(expected(self.loop.cascade.model, motion, u, self.period), judged.left)

    def advance(
        self,
        method: Integrator,
        errors: Errors | FaultyErrors,
        t: Scalar,
        period: Scalar,
        state: SampledState,
        memory: Any,
        code: Array,
    ) -> Advanced:
        """Integrate the plant to the next sample, under the voltages that act in between."""
        code = jnp.where((code == 0) & (state.sane == 0), DIVERGED, code)
        delay, voltages = jnp.asarray(self.processor.delay), (state.command.u, *state.past)
        late = (delay - jnp.floor(delay)) * period
        acting = [(_one_of(voltages, jnp.ceil(delay)), late), (_one_of(voltages, jnp.floor(delay)), period - late)]
        if self.processor.whole:
            acting = [(acting[1][0], period)]
        voltages, u_a = _amplified(self.loop.scenario.amplifier, jnp.asarray(t), state.u_a, acting)
        stretches = self._stretches(state, jnp.asarray(t), voltages)
        reached = in_turn(method, stretches, t, state.plant, memory, code)
        seen = self._lagged(state, [after.state for after in reached], [time for _, time in stretches])
        after = reached[-1]
        return after._replace(state=state._replace(plant=after.state, seen=seen, u_a=u_a))

    def _lagged(self, state: SampledState, reached: list[Any], times: list[Scalar]) -> Any:
        """Return the output of the position sensor's low-pass, m, after the plant's motion through these states."""
        seen: Any = state.seen
        sensor = self.loop.scenario.sensor
        if sensor is None or not self._lags:
            return seen
        motions = [self.loop.scenario.plant.measurement(plant) for plant in (state.plant, *reached)]
        for before, after, time in zip(motions, motions[1:], times, strict=False):
            seen = sensor.lagged(seen, before, after, time)
        return seen

    def _stretches(
        self, state: SampledState, t: Array, voltages: list[tuple[Callable[[Scalar], Array], Scalar]]
    ) -> list[tuple[InitialValueProblem, Scalar]]:
        """Return the initial value problems from t (s) on, with their durations (s), for the voltages that act."""
        at = self.loop.scenario.edges()
        edges = Edges(at, len(at) if self.cuts is None else min(self.cuts, len(at)))
        if not edges.most:
            edges = NO_EDGES
        if not self._lags:
            return [(self._under(state, voltage, edges), time) for voltage, time in voltages]
        # The solution of the sensor's low-pass requires a motion that is smooth over each part, so divide at edges too.
        cut = []
        for voltage, time in voltages:
            cut += [(self._under(state, voltage, NO_EDGES), length) for length in edges.pieces(t, time)]
            t = t + time
        return cut

    def _under(self, state: SampledState, voltage: Any, edges: Edges) -> InitialValueProblem:
        """Return the initial value problem of the plant, with `voltage` (V) as a function of time."""
        loop, command = self.loop, state.command
        plant, e = loop.scenario.plant, loop.scenario.plant.measurement(state.plant).i - command.i_ref

        def inputs(t: Scalar) -> tuple[ExternalInputs, Array]:
            return loop.inputs(t), voltage(t)

        def rates(inputs: tuple[ExternalInputs, Array], x: Any) -> Any:
            outside, u = inputs
            return plant.rates(x, self._at_coil(outside, u, x), outside.q_z, outside.q_i)

        def observed(inputs: tuple[ExternalInputs, Array], x: Any) -> tuple[Any, Instant]:
            (outside, u), motion, heat = inputs, plant.measurement(x), plant.signals(x).heat
            u = self._at_coil(outside, u, x)
            sigma = loop.cascade.position.sigma(motion, outside.reference)
            sizes = Sizes(motion.z, motion.z - outside.reference.r, sigma, u, motion.i, e, command.v_tilde)
            return rates(inputs, x), Instant(sizes, Densities(u, u * u, heat))

        scale = jax.tree.map(jnp.asarray, plant.scale())
        return InitialValueProblem(inputs, rates, scale, self._status, None, observed, SHOWN, edges=edges)

    def _at_coil(self, outside: ExternalInputs, u: Array, x: Any) -> Array:
        """Return the voltage at the coils, V, for the amplifier's voltage u."""
        plant, amplifier = self.loop.scenario.plant, self.loop.scenario.amplifier
        if amplifier is None:
            return u

        def holding_voltage() -> Array:
            still, driven = (plant.measurement(plant.rates(x, volt, outside.q_z, outside.q_i)).i for volt in (0.0, 1.0))
            return still / (still - driven)  # i' is linear in u

        return amplifier.at_coil(u, plant.measurement(x).i, self.loop.scenario.u_max, holding_voltage)

    def _status(self, plant: Any) -> Array:
        return self.loop.judged(plant, self.loop.scenario.plant.scale(), plant)

    def status(self, state: SampledState) -> Array:
        return self._status(state.plant)

    def rest(self, state: SampledState, code: Array) -> SampledState:
        """Return the state in which a lost rotor is frozen, with the drive off."""
        zero = jnp.zeros_like(state.command.u)
        plant = self.loop.rest(LoopState(state.plant, state.control), code).plant
        seen = self.loop.scenario.plant.measurement(plant).z if self._lags else ()
        off = state._replace(command=state.command._replace(u=zero), past=(zero, zero))
        return off._replace(plant=plant, seen=seen, u_a=jax.tree.map(jnp.zeros_like, state.u_a))

    def row(self, t: Scalar, state: SampledState, errors: Errors | FaultyErrors, alive: Array) -> Row:
        """Return the signals of sample n: the plant's state, u_n, and i_ref before the step of the laws."""
        seen = self.measured(state.plant, state.seen, errors)
        if state.sensed:
            seen = seen._replace(z=state.sensed.z)
        row = self.loop.signals(t, self.loop.inputs(t), state.plant, state.command, seen, alive)
        guard = self.processor.guard
        return row if guard is None else row._replace(refused=alive & guard.refused(state.watch, state.watch)[0])

    def noted(self, row: Row, span: Span) -> Row:
        noted = self.loop.noted(row, span)
        return noted if self.loop.scenario.amplifier is None else noted._replace(u_peak=span.most.u)

    def singularity(self, row: Row) -> Array:
        return self.loop.singularity(row)


def _one_of(voltages: tuple[Array, ...], lag: Array) -> Array:
    """Return the voltage of the sample `lag` samples ago, lag = 0, 1 or 2."""
    now, before, first = voltages
    return jnp.where(lag < 0.5, now, jnp.where(lag < 1.5, before, first))


def _amplified(
    amplifier: Amplifier | None, t: Array, u_a: Any, acting: list[tuple[Array, Scalar]]
) -> tuple[list[tuple[Callable[[Scalar], Array], Scalar]], Any]:
    """Return the amplifier's voltage as functions of time with their durations (s), and the voltage at the end.

    `acting`: commanded voltages (V) from t on, each with its duration (s). With a slew-rate limit each is divided at
    the end of its ramp, where the voltage has a corner.
    """
    if amplifier is None or not amplifier.slow:
        return [(lambda _, u=u: u, time) for u, time in acting], u_a
    given = []
    for u, time in acting:
        voltage = lambda now, u_a=u_a, u=u, t=t: amplifier.followed(u_a, u, now - t)  # noqa: E731
        ramp = jnp.minimum(amplifier.ramp(u_a, u), time)
        given += [(voltage, time)] if amplifier.slew is None else [(voltage, ramp), (voltage, time - ramp)]
        u_a, t = amplifier.followed(u_a, u, jnp.asarray(time)), t + time
    return given, u_a


def check_parts(cascade: Cascade, scenario: Scenario) -> None:
    """Raise ValueError, with the path and the fix, for parts of a loop that are not compatible."""
    if cascade.processor is None:
        cascade.check_smooth()
        if (path := scenario.on_processor) is not None:
            raise ValueError(
                f"{path} is for a controller on a processor, and this one runs in continuous time. Add [processor], or "
                "leave it out."
            )
    sensor = scenario.sensor
    if sensor is not None and not sensor.velocity and not cascade.observer.estimates_velocity:
        raise ValueError(
            "sensor.velocity = false: the velocity is not measured, and controller.observer does not estimate it. "
            'Choose one that does: kind = "kalman", for example.'
        )


def system_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> ClosedLoop | Sampled:
    """Return the closed loop of the cascade, in continuous time or on its processor."""
    if cascade.processor is None:
        return ClosedLoop(cascade, scenario)
    period = clock.sample_period
    return Sampled(ClosedLoop(simulated(cascade.on_processor(), scenario, period), scenario), period, clock.cuts)
