"""The loop of a cascade on a processor: sensors read, laws stepped, a voltage held, the plant in between.

At t_n, in this order: the plant is measured; the laws step; u_n, held within the supply's limit, acts from
t_n + delay T until t_{n+1} + delay T (before the first, u = 0); the plant alone moves to t_{n+1}, under one voltage, or
under two where the delay is no whole number of samples.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade import Cascade, CascadeState, Command, Sample
from ambjax.control.processor import Processor
from ambjax.numerics.records import Scalar, record
from ambjax.simulation.clock import Clock
from ambjax.simulation.integrate import Advanced, Integrator, Problem, in_turn
from ambjax.simulation.loop import SHOWN, ClosedLoop, Densities, Inputs, LoopState, Sizes, limited
from ambjax.simulation.span import Instant, Span
from ambjax.simulation.trajectory import DIVERGED, Row
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors
from ambjax.world.signals import reference_at


class SampledState(NamedTuple):
    """State of the plant and of the laws; what they decided last, u within the supply's limit; the two voltages
    before, V; and 1, or 0 once a law has left the numbers."""

    plant: Any
    control: CascadeState
    command: Command
    past: tuple[Array, Array]
    sane: Array


@record
class Sampled:
    """The closed loop with its cascade on a processor, one step a `period` (s)."""

    loop: ClosedLoop
    period: Scalar

    @property
    def processor(self) -> Processor:
        """What the cascade runs on."""
        processor = self.loop.cascade.processor
        assert processor is not None
        return processor

    def realised(self) -> "Sampled":
        return Sampled(self.loop.realised(), self.period)

    def hold(self, sample: Scalar) -> Errors:
        return self.loop.hold(sample)

    def start(self) -> SampledState:
        plant, control = self.loop.start()
        zero = jnp.zeros(())
        return SampledState(plant, control, Command(*[zero] * 5), (zero, zero), jnp.ones(()))

    def jump(self, t: Scalar, state: SampledState, hold: Errors) -> SampledState:
        """The laws' step: what they decide now, and their states at the next sample."""
        scenario, processor = self.loop.scenario, self.processor
        late = processor.delay * self.period if processor.predict else 0.0
        past = (state.command.u, state.past[0])
        sample = Sample(reference_at(scenario.reference, t + late), self.period, jnp.asarray(scenario.u_max), past)
        measured = self.loop.measured(state.plant, hold)
        command, control = self.loop.cascade.step(measured, state.control, sample)
        command = command._replace(u=limited(command.u, sample.u_max))
        new = (control, command)
        sane = functools.reduce(jnp.logical_and, map(jnp.isfinite, jax.tree.leaves(new)))
        control, command = jax.tree.map(lambda a, b: jnp.where(sane, a, b), new, (state.control, state.command))
        return SampledState(state.plant, control, command, past, jnp.where(sane, state.sane, 0.0))

    def advance(
        self,
        method: Integrator,
        hold: Errors,
        t: Scalar,
        period: Scalar,
        state: SampledState,
        memory: Any,
        code: Array,
    ) -> Advanced:
        """The plant to the next sample, under the voltages that act on the way."""
        code = jnp.where((code == 0) & (state.sane == 0), DIVERGED, code)
        delay, voltages = jnp.asarray(self.processor.delay), (state.command.u, *state.past)
        begun = jnp.ceil(delay)
        stretches = [(self._under(state, _one_of(voltages, begun)), (delay - jnp.floor(delay)) * period)]
        stretches += [(self._under(state, _one_of(voltages, jnp.floor(delay))), period - stretches[0][1])]
        if self.processor.whole:
            stretches = [(stretches[1][0], period)]
        after = in_turn(method, stretches, t, state.plant, memory, code)
        return after._replace(state=state._replace(plant=after.state))

    def _under(self, state: SampledState, u: Array) -> Problem:
        """What an integrator is given while this voltage acts."""
        loop, command = self.loop, state.command
        plant, e = loop.scenario.plant, loop.scenario.plant.measurement(state.plant).i - command.i_ref

        def rates(inputs: Inputs, x: Any) -> Any:
            return plant.rates(x, u, inputs.q_z, inputs.q_i)

        def observed(inputs: Inputs, x: Any) -> tuple[Any, Instant]:
            motion, heat = plant.measurement(x), plant.signals(x).heat
            sigma = loop.cascade.position.sigma(motion, inputs.reference)
            sizes = Sizes(motion.z, motion.z - inputs.reference.r, sigma, u, motion.i, e, command.v_tilde)
            return rates(inputs, x), Instant(sizes, Densities(u, u * u, heat))

        scale = jax.tree.map(jnp.asarray, plant.scale())
        return Problem(loop.inputs, rates, scale, self._fate, None, observed, SHOWN)

    def _fate(self, plant: Any) -> Array:
        return self.loop.judged(plant, self.loop.scenario.plant.scale(), plant)

    def fate(self, state: SampledState) -> Array:
        return self._fate(state.plant)

    def rest(self, state: SampledState, code: Array) -> SampledState:
        """Frozen, and the drive off."""
        zero = jnp.zeros_like(state.command.u)
        plant = self.loop.rest(LoopState(state.plant, state.control), code).plant
        return state._replace(plant=plant, command=state.command._replace(u=zero), past=(zero, zero))

    def row(self, t: Scalar, state: SampledState, hold: Errors, alive: Array) -> Row:
        """Sample n: the plant, u_n, and i_ref before its step."""
        return self.loop.signals(t, self.loop.inputs(t), state.plant, state.command, hold, alive)

    def noted(self, row: Row, span: Span) -> Row:
        return self.loop.noted(row, span)

    def singularity(self, row: Row) -> Array:
        return self.loop.singularity(row)


def _one_of(voltages: tuple[Array, ...], lag: Array) -> Array:
    """The voltage of the sample so many before."""
    now, before, first = voltages
    return jnp.where(lag < 0.5, now, jnp.where(lag < 1.5, before, first))


def system_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> ClosedLoop | Sampled:
    """The loop to roll out: with the cascade in continuous time, or on its processor."""
    if cascade.processor is None:
        return ClosedLoop(cascade, scenario)
    return Sampled(ClosedLoop(cascade.on_processor(), scenario), clock.sample_period)
