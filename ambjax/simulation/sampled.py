"""The loop of a cascade on a processor: sensors read, laws stepped, a voltage held, the plant in between.

At t_n, in this order: the plant is measured; the laws step; u_n, held within the supply's limit, acts from
t_n + delay T until t_{n+1} + delay T (before the first, u = 0); the plant alone moves to t_{n+1}, under one voltage, or
under two where the delay is no whole number of samples.
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
    """State of the plant and of the laws; what they decided last, u within the supply's limit; the two voltages
    before, V; 1, or 0 once a law has left the numbers; output of the sensor's low-pass (m) and the voltage of the
    amplifier, where they have a state; the state of the guard, if there is one; 1, or 0 until the laws have begun with
    an accepted reading, where the first may be refused; the last reading of a sensor that has faults."""

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
    """The closed loop with its cascade on a processor, one step a `period` (s).

    `cuts`: at most so many edges of disturbances lie inside one sample; None: all that there are.
    """

    loop: ClosedLoop
    period: Scalar
    cuts: int | None = static()

    @property
    def processor(self) -> Processor:
        """What the cascade runs on."""
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
        """What sensors without faults report of the plant's state; `seen`: output of the position's low-pass, m."""
        true, sensor = self.loop.scenario.plant, self.loop.scenario.sensor
        motion = true.measurement(plant)
        if sensor is None:
            return motion
        if self._lags:
            motion = motion._replace(z=seen)
        return sensor.converted(sensor.reading(motion, errors), true.s_0, true.i_0)

    def jump(self, t: Scalar, state: SampledState, errors: Errors | FaultyErrors) -> SampledState:
        """The laws' step: what they decide now, and their states at the next sample."""
        state, measured = self._struck(self.measured(state.plant, state.seen, errors), state, errors)
        return self.decided(measured, self.reference(t), state)

    def reference(self, t: Scalar) -> Reference:
        """What the laws of the sample at t (s) follow: the reference of the instant that they act on."""
        late = self.processor.ahead * self.period if self.processor.predicts else 0.0
        return reference_at(self.loop.scenario.reference, t + late)

    def _struck(self, measured: Measurement, state: SampledState, errors: Any) -> tuple[SampledState, Measurement]:
        """The state and the measurement once faults have struck the position sensor."""
        sensor, sensed = self.loop.scenario.sensor, state.sensed
        if sensor is None or not sensed or not isinstance(errors, FaultyErrors):
            return state, measured
        sensed = sensor.sensed(measured.z, sensed, errors.struck, self.period, self.loop.scenario.plant.s_0)
        z = jnp.where(jnp.isnan(sensed.z), 0.0, sensed.z)
        state = state._replace(sensed=sensed._replace(z=z))
        if self.processor.guard is None:  # NaN ends the run, and derivatives stay finite
            state = state._replace(sane=jnp.where(jnp.isnan(sensed.z), 0.0, state.sane))
            return state, measured._replace(z=z)
        return state, measured._replace(z=sensed.z)

    def decided(self, measured: Measurement, reference: Reference, state: SampledState) -> SampledState:
        """What the processor computes of a measurement, and keeps: all but the plant. The exported C is this."""
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
        # 0 times a number is 0, times anything else it is not
        sane = materialised(sum(0.0 * x for x in jax.tree.leaves(new))) == 0
        keeps = sane if judged is None else sane & judged.steps
        old = (state.control, state.command, state.watch)
        control, command, watch = jax.tree.map(lambda a, b: jnp.where(keeps, a, b), new, old)
        started = state.started
        if not isinstance(started, tuple):
            begins = keeps if judged is None else keeps & ~judged.refused
            started = (started.astype(bool) | begins).astype(started.dtype)
        if judged is not None:  # else the safe command; its sample says nothing of the laws
            command, sane = command._replace(u=jnp.where(judged.steps, command.u, 0.0)), sane | ~judged.steps
            watch = watch._replace(left=judged.left)
        sane = jnp.where(sane, state.sane, 0.0)
        return state._replace(control=control, command=command, past=past, sane=sane, watch=watch, started=started)

    def _watched(self, judged: Judged | None, estimate: Measurement, voltages: tuple[Array, ...]) -> Watch | tuple[()]:
        """The guard's state at the next sample, `voltages` being those of this sample and of those before."""
        if judged is None:
            return ()
        delay = jnp.asarray(self.processor.ahead)
        # shares of the sample for which each of them acts
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
        """The plant to the next sample, under the voltages that act on the way."""
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
        """Output of the position sensor's low-pass after the plant went through these states, m."""
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
        """What is integrated from t on, under these voltages, each for its time (s)."""
        at = self.loop.scenario.edges()
        edges = Edges(at, len(at) if self.cuts is None else min(self.cuts, len(at)))
        if not edges.most:
            edges = NO_EDGES
        if not self._lags:
            return [(self._under(state, voltage, edges), time) for voltage, time in voltages]
        # the sensor's low-pass is solved for a motion that is smooth over each stretch
        cut = []
        for voltage, time in voltages:
            cut += [(self._under(state, voltage, NO_EDGES), length) for length in edges.pieces(t, time)]
            t = t + time
        return cut

    def _under(self, state: SampledState, voltage: Any, edges: Edges) -> InitialValueProblem:
        """What an integrator is given while the coils' voltage is this function of time and of the plant's state."""
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
        """Frozen, and the drive off."""
        zero = jnp.zeros_like(state.command.u)
        plant = self.loop.rest(LoopState(state.plant, state.control), code).plant
        seen = self.loop.scenario.plant.measurement(plant).z if self._lags else ()
        off = state._replace(command=state.command._replace(u=zero), past=(zero, zero))
        return off._replace(plant=plant, seen=seen, u_a=jax.tree.map(jnp.zeros_like, state.u_a))

    def row(self, t: Scalar, state: SampledState, errors: Errors | FaultyErrors, alive: Array) -> Row:
        """Sample n: the plant, u_n, and i_ref before its step."""
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
    """The voltage of the sample so many before."""
    now, before, first = voltages
    return jnp.where(lag < 0.5, now, jnp.where(lag < 1.5, before, first))


def _amplified(
    amplifier: Amplifier | None, t: Array, u_a: Any, acting: list[tuple[Array, Scalar]]
) -> tuple[list[tuple[Callable[[Scalar], Array], Scalar]], Any]:
    """An amplifier's voltage as functions of time, each with how long it holds (s), and that at the end.

    From t on it is commanded what is `acting`, each (V) for its time. It has a corner where a ramp ends.
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
    """Raise ValueError, with the path and the fix, for parts of a loop that do not work together."""
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
    """The loop to roll out: with the cascade in continuous time, or on its processor."""
    if cascade.processor is None:
        return ClosedLoop(cascade, scenario)
    period = clock.sample_period
    return Sampled(ClosedLoop(simulated(cascade.on_processor(), scenario, period), scenario), period, clock.cuts)
