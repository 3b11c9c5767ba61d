"""The closed loop of a cascade on a processor: sampled measurements, discrete laws, and a held voltage.

At t_n the sensors measure the plant, the laws make a step, and then the plant is integrated to t_{n+1}. The voltage
u_n, within the limit of the supply, acts from t_n + delay T until t_{n+1} + delay T. Before t_0 + delay T, u = 0. One
voltage acts during a sample, or two if the delay is not a whole number of samples.
"""

import dataclasses
import functools
import itertools
import operator
from collections.abc import Sequence
from typing import Any, Self

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control.cascade_state import CascadeState, Command, Sample
from ambjax.control.guard import GuardResult, Watch, expected
from ambjax.control.processor import Processor
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, record, static
from ambjax.numerics.smooth import limited
from ambjax.simulation.between import SampledState, acting, amplified, at_sample, lags, plant_status, subproblems
from ambjax.simulation.integrate import Advanced, Begin, Integrator, in_turn
from ambjax.simulation.loop import AddedSignal, ClosedLoop, LoopState, with_signal
from ambjax.simulation.trajectory import DIVERGED, Row, Span
from ambjax.world.faults import Sensed
from ambjax.world.sensor import Errors, Measurement
from ambjax.world.waveforms import Reference, reference_at


@record
class Sampled:
    """The closed loop of a cascade on a processor.

    - `loop`: the closed loop in continuous time.
    - `period`: sample period, s.
    - `cuts`: largest number of jumps (edges) of disturbances inside one sample; None: the number of all edges.
    - `wave`: test signal, added to a reading after the converter and the faults; None: none. `z_measured` of a row is
      then the sum of this reading and e.
    """

    loop: ClosedLoop
    period: Scalar
    cuts: int | None = static()
    wave: AddedSignal | None = None

    @property
    def processor(self) -> Processor:
        return self.loop.cascade.timing

    def realised(self) -> Self:
        return dataclasses.replace(self, loop=self.loop.realised())

    def sensor_errors(self, sample: Scalar) -> Errors:
        """Return the errors of all sensors in sample number `sample`: noise, runout and the onsets of faults."""
        drawn = self.loop.sensor_errors(sample)
        return self.loop.scenario.sensors.on_processor(drawn, self.loop.words(), sample, self.period)

    def start(self) -> SampledState:
        scenario, zero = self.loop.scenario, jnp.zeros(())
        plant = scenario.plant.start(scenario.initial.measurement())
        z_filtered = self._sensed(plant, zero).z if lags(self.loop) else ()
        measured = self.measured(plant, z_filtered, self.sensor_errors(0))
        command, past, guard = Command(*[zero] * 5), self.processor.constant_past(zero), self.processor.guard
        faulty = scenario.sensors.faulty
        cascade = self.loop.cascade
        sample = self.sample(self.reference(0.0), past)
        return SampledState(
            plant,
            cascade.begun(measured, sample, cascade.init(measured), jnp.asarray(False)),
            command,
            past,
            jnp.ones(()),
            z_filtered,
            zero if scenario.actuator.slow else (),
            guard.start() if guard else (),
            zero if guard and faulty else (),
            Sensed(measured.z, zero) if faulty else (),
        )

    def measured(self, plant: object, z_filtered: Array | tuple[()], errors: Errors) -> Measurement:
        """Return the readings of the sensors, before the faults of the position sensor are applied."""
        true, sensor = self.loop.scenario.plant, self.loop.scenario.sensors
        motion = true.measurement(plant)
        if lags(self.loop):
            motion = motion._replace(z=z_filtered)
        return sensor.converted(sensor.reading(motion, errors), true.s_0, true.i_0)

    def jump(self, t: Scalar, state: SampledState, errors: Errors) -> SampledState:
        state, measured = self.read(state, errors)
        return self.with_command(self.injected(measured, t), self.reference(t), state)

    def injected(self, measured: Measurement, t: Scalar) -> Measurement:
        """Return the readings with the test signal of the sample that begins at t (s)."""
        if self.wave is None:
            return measured
        return with_signal(measured, self.wave, self.wave.at(jnp.round(jnp.asarray(t) / self.period).astype(int)))

    def read(self, state: SampledState, errors: Errors) -> tuple[SampledState, Measurement]:
        """Return the state with the new state of the faulty sensor, and the readings of the sensors, with faults."""
        measured = self.measured(state.plant, state.z_filtered, errors)
        sensor, sensed = self.loop.scenario.sensors, state.sensed
        if not sensed or not errors.onsets:
            return state, measured
        sensed = sensor.sensed(measured.z, sensed, errors.onsets, self.period, self.loop.scenario.plant.s_0)
        z = jnp.where(jnp.isnan(sensed.z), 0.0, sensed.z)
        state = state._replace(sensed=sensed._replace(z=z))
        if self.processor.guard is None:  # a NaN reading ends the run; z = 0 in place of NaN keeps derivatives finite
            state = state._replace(finite=jnp.where(jnp.isnan(sensed.z), 0.0, state.finite))
            return state, measured._replace(z=z)
        return state, measured._replace(z=sensed.z)

    def reference(self, t: Scalar) -> Reference:
        """Return the reference of the laws in the sample at t (s); with prediction, that at the end of the delay."""
        late = self.processor.ahead * self.period if self.processor.predicts else 0.0
        return reference_at(self.loop.scenario.reference, t + late)

    def with_command(self, measured: Measurement, reference: Reference, state: SampledState) -> SampledState:
        """Compute the command from the readings, and return the state with it. The plant does not change.

        The exported C is traced from this function.
        """
        sample, checked, measured, laws = self.received(measured, reference, state)
        return self.accepted(state, sample, checked, self.loop.cascade.step(measured, laws, sample))[0]

    def received(
        self, measured: Measurement, reference: Reference, state: SampledState
    ) -> tuple[Sample, GuardResult | None, Measurement, CascadeState]:
        """Return what the laws step with: the inputs of the sample, and the results of `inputs_of_laws`."""
        past = self.processor.remembered(state.command.u, *state.past)
        sample = self.sample(reference, past)
        return sample, *self.inputs_of_laws(measured, sample, state)

    def accepted(
        self,
        state: SampledState,
        sample: Sample,
        checked: GuardResult | None,
        stepped: tuple[Command, CascadeState, Measurement],
    ) -> tuple[SampledState, Array]:
        """Return the state with the results of the laws, and whether they are kept."""
        (command, control, estimate), past = stepped, sample.past
        command = command._replace(u=limited(command.u, sample.u_max))
        new: Any = materialised((control, command, self._next_guard_state(checked, estimate, (command.u, *past))))
        # The sum is 0 only if every number is finite: 0 times NaN or infinity is NaN.
        finite = materialised(sum(0.0 * x for x in jax.tree.leaves(new))) == 0
        keeps = finite if checked is None else finite & checked.steps
        old = (state.control, state.command, state.watch)
        control, command, watch = choose(keeps, new, old)
        started = state.started
        if not isinstance(started, tuple):
            begins = keeps if checked is None else keeps & ~checked.refused
            started = (started.astype(bool) | begins).astype(started.dtype)
        if checked is not None:  # if not checked.steps: the safe command u = 0
            command, finite = command._replace(u=jnp.where(checked.steps, command.u, 0.0)), finite | ~checked.steps
            watch = watch._replace(left=checked.left)
        finite = jnp.where(finite, state.finite, 0.0)
        state = state._replace(control=control, command=command, past=past, finite=finite, watch=watch, started=started)
        return state, jnp.asarray(keeps)

    def sample(self, reference: Reference, past: tuple[Array, ...]) -> Sample:
        """Return the inputs of the cascade at a sample. `past`: u of the samples before, the most recent first."""
        return Sample(reference, self.period, jnp.asarray(self.loop.scenario.command_limit), past)

    def inputs_of_laws(
        self, measured: Measurement, sample: Sample, state: SampledState
    ) -> tuple[GuardResult | None, Measurement, CascadeState]:
        """Return the result of the guard, and the readings and the states with which the laws step at this sample."""
        cascade, checked, laws = self.loop.cascade, None, state.control
        if self.processor.guard is not None:
            velocity = self.loop.measures_velocity
            checked = self.processor.guard.check(cascade.model, measured, state.watch, self.period, velocity)
            measured = checked.reading
        if not isinstance(state.started, tuple):
            laws = cascade.begun(measured, sample, laws, state.started.astype(bool))
        return checked, measured, laws

    def _next_guard_state(
        self, checked: GuardResult | None, estimate: Measurement, voltages: tuple[Array, ...]
    ) -> Watch | tuple[()]:
        """Return the guard's state for the next sample. `voltages`: of this sample and of those before it, V."""
        if checked is None:
            return ()
        cascade, delay = self.loop.cascade, jnp.asarray(self.processor.ahead)
        # Each voltage is weighted by the fraction of the sample during which it acts.
        shares = [jnp.maximum(1 - jnp.abs(delay - lag), 0.0) for lag in range(len(voltages))]
        u = functools.reduce(operator.add, map(operator.mul, shares, voltages))
        motion = checked.reading._replace(z_dot=estimate.z_dot)
        return Watch(expected(cascade.driven, cascade.model.start(motion), u, self.period), checked.left)

    def advance(self, method: Integrator, errors: Errors, begin: Begin, period: Scalar) -> Advanced:
        t, state, memory, code = begin
        code = jnp.where((code == 0) & (state.finite == 0), DIVERGED, code)
        delay, whole = jnp.asarray(self.processor.delay), bool(self.processor.whole)
        commanded = acting((state.command.u, *state.past), delay, period, whole)
        voltages, u_a = amplified(self.loop.scenario.actuator, jnp.asarray(t), state.u_a, commanded)
        parts = subproblems(self.loop, state.plant, state.command, jnp.asarray(t), voltages, self.cuts)
        reached = in_turn(method, parts, Begin(t, state.plant, memory, code))
        states = [state.plant, *(after.state for after in reached)]
        z_filtered = self.filtered(t, state.z_filtered, states, [time for _, time in parts])
        after = reached[-1]
        return after._replace(state=state._replace(plant=after.state, z_filtered=z_filtered, u_a=u_a))

    def filtered(
        self, t: Scalar, z: Array | tuple[()], plants: Sequence[object], times: Sequence[Scalar]
    ) -> Array | tuple[()]:
        """Return the output of the position sensor's low-pass at the next sample, m. `z`: that at t (s).

        `plants`: states of the plant at t, and after each of the `times` (s).
        """
        if isinstance(z, tuple):
            return z
        instants = itertools.accumulate(times, initial=t)
        motions = [self._sensed(*at) for at in zip(plants, instants, strict=True)]
        for before, after, time in zip(motions, motions[1:], times, strict=False):
            z = self.loop.scenario.sensors.lagged(z, before, after, time)
        return z

    def _sensed(self, plant: object, t: Scalar) -> Measurement:
        """Return the motion of the surface that the position sensor reads at t (s)."""
        scenario = self.loop.scenario
        return scenario.sensors.over_surface(scenario.plant.measurement(plant), t)

    def status(self, state: SampledState) -> Array:
        return plant_status(self.loop, state.plant)

    def rest(self, state: SampledState, code: Array) -> SampledState:
        zero = jnp.zeros_like(state.command.u)
        plant = self.loop.rest(LoopState(state.plant, state.control), code).plant
        z_filtered = self.loop.scenario.plant.measurement(plant).z if lags(self.loop) else ()
        off = state._replace(command=state.command._replace(u=zero), past=self.processor.constant_past(zero))
        return off._replace(plant=plant, z_filtered=z_filtered, u_a=jax.tree.map(jnp.zeros_like, state.u_a))

    def row(self, t: Scalar, state: SampledState, errors: Errors, alive: Array) -> Row:
        """Return the signals of sample n: the plant's state, u_n, and i_ref before the step of the laws.

        If the command is a current, u is the voltage with which the amplifier produces, in this state, the current
        commanded for this instant: the one that acts after the delay.
        """
        measured = self.measured(state.plant, state.z_filtered, errors)
        if state.sensed:
            measured = measured._replace(z=state.sensed.z)
        inputs, command = self.loop.inputs(t), state.command
        if self.loop.scenario.drive == "current":
            i = at_sample((command.u, *state.past), jnp.asarray(self.processor.delay))
            command = command._replace(u=self.loop.scenario.coil_voltage(i, state.plant, inputs.q_i))
        measured = self.injected(measured, t)
        row = self.loop.signals(t, inputs, state.plant, command, measured, alive)
        if self.wave is not None:
            row = row._replace(z_measured=getattr(measured, self.wave.reading))
        guard = self.processor.guard
        return row if guard is None else row._replace(refused=alive & guard.refused(state.watch, state.watch)[0])

    def completed(self, row: Row, span: Span) -> Row:
        """Return the row with mean and peak voltage; with an amplifier, the peak is that at the coils."""
        completed = self.loop.completed(row, span)
        return completed if self.loop.scenario.amplifier is None else completed._replace(u_peak=span.most.u)

    def singularity(self, row: Row) -> Array:
        return self.loop.singularity(row)
