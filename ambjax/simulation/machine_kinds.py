"""A whole machine on a processor and in continuous time: how its laws step, and how its rotor and coils move."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.machine_law import MachineLaw
from ambjax.numerics.records import Scalar, record
from ambjax.numerics.shapes import stack_axes
from ambjax.simulation.between import SampledState, acting, amplified, lags, under
from ambjax.simulation.edges import NO_EDGES, most_inside
from ambjax.simulation.integrate import Advanced, Begin, InitialValueProblem, Integrator, WholeState, in_turn
from ambjax.simulation.loop import ClosedLoop, ExternalInputs
from ambjax.simulation.machine_axes import demanded_now, jumped, loop_of
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.trajectory import DIVERGED, Instant
from ambjax.simulation.whole_machine import Groups, Machine, MachineState, PlantOnly, still
from ambjax.world.rotor import Rotor

# Voltages of the groups as functions of time, or outputs of their amplifiers.
Voltages = list


@record
class SampledMachine(Machine):
    """A machine whose cascades run on a processor, one step of all axes per sample."""

    def jump(self, t: Scalar, state: MachineState, errors: Sequence[object]) -> MachineState:
        if self.law is not None:
            W, at = self.rotor.speed_at(t), self.at_sensors(state)
            axes, law = jumped(self, t, W, at, state.law, errors)
            return state._replace(axes=still(axes), law=law)
        axes = self.each(lambda axis, own, error: axis.jump(t, own, error), self.at_sensors(state), errors)
        return state._replace(axes=still(axes))

    def demands(self, t: Scalar, state: MachineState, errors: Sequence[object]) -> Groups:
        return ((),) * len(self.groups)

    def advance(self, method: Integrator, errors: object, begin: Begin, period: Scalar) -> Advanced:
        t, state, memory, code = begin
        finite = jnp.min(self.join([own.finite for own in state.axes]))
        code = jnp.where((code == 0) & (finite == 0), DIVERGED, code)
        pieces, u_a = self._pieces(jnp.asarray(t), period, state.axes)
        first = MachineState(state.q, state.q_dot, tuple(PlantOnly(own.plant) for own in state.axes))
        parts = [(self._problem(state, voltages), time) for voltages, time in pieces]
        reached = in_turn(method, parts, Begin(t, first, memory, code))
        sensed = [self.at_sensors(one) for one in (first, *(after.state for after in reached))]

        def filtered(axis: Sampled, own: SampledState, *states: PlantOnly) -> Array | tuple[()]:
            return axis.filtered(t, own.z_filtered, [one.plant for one in states], [time for _, time in pieces])

        z_filtered = self.each(filtered, state.axes, *sensed)
        end = reached[-1].state
        ended = zip(state.axes, end.axes, z_filtered, u_a, strict=True)
        axes = tuple(own._replace(plant=at.plant, z_filtered=z, u_a=u) for own, at, z, u in ended)
        return reached[-1]._replace(state=MachineState(end.q, end.q_dot, axes, state.law))

    def _pieces(self, t: Array, period: Scalar, axes: Groups) -> tuple[list[tuple[Voltages, Scalar]], Voltages]:
        """Divide a sample. Return the groups' voltages as functions of time, with the durations (s) of the pieces.

        The second result contains the amplifiers' outputs at the end (V). With a low-pass of a sensor, pieces also end
        at the jumps of loads.
        """
        processor = loop_of(self.axes[0]).cascade.timing
        delay, whole = jnp.asarray(processor.delay)[0], bool(processor.whole)
        groups = []
        for loop, own in zip(self.loops(), axes, strict=True):
            commanded = acting((own.command.u, *own.past), delay, period, whole)
            groups.append(amplified(loop.scenario.amplifier, t, own.u_a, commanded, divided=False))
        low_passed = any(map(lags, self.loops()))
        edges, pieces = self.edges(), []
        for interval in zip(*(intervals for intervals, _ in groups), strict=True):
            voltages, time = [voltage for voltage, _ in interval], interval[0][1]
            pieces += [(voltages, length) for length in (edges.pieces(t, time) if low_passed else [time])]
            t = t + time
        return pieces, [u_a for _, u_a in groups]

    def _problem(self, first: MachineState, voltages: Sequence[Callable]) -> InitialValueProblem:
        """Return the initial value problem of rotor and coils under the voltages of the groups, functions of time (V).

        `first`: state at the sample.
        """
        sampled = self.at_magnets(first)

        def inputs(t: Scalar) -> tuple[object, ...]:
            return self.outside(t), tuple(self.each(lambda axis: axis.loop.inputs(t))), tuple(u(t) for u in voltages)

        def observed(inputs: Any, state: MachineState) -> tuple[MachineState, Instant]:
            outside, own, u = inputs
            at = tuple(one.plant for one in self.at_magnets(state))

            def one(
                axis: Sampled, first: SampledState, own: ExternalInputs, u: Array, plant: object
            ) -> tuple[PlantOnly, Instant]:
                problem = under(self.between_stops(axis.loop), first.plant, first.command, lambda _: u, NO_EDGES)
                rates, instant = problem.rates_and_signals((own, u), plant)
                return PlantOnly(rates), instant

            return self.moved(outside, state, self.each(one, sampled, own, u, at))

        sizes = self.each(lambda axis: PlantOnly(jax.tree.map(jnp.asarray, axis.loop.scenario.plant.scale())))
        return self.problem_of(inputs, observed, sizes)


@record
class ContinuousMachine(WholeState, Machine):
    """A machine whose cascades run in continuous time."""

    def demands(self, t: Scalar, state: MachineState, errors: Sequence[object]) -> Groups:
        if self.law is None:
            return ((),) * len(self.groups)
        own = self.each(lambda axis: axis.inputs(t))
        found = demanded_now(self, self.rotor.speed_at(t), own, self.at_sensors(state), state.law, errors)[0]
        return tuple((one,) for one in found)

    def problem(self, errors: Sequence[object]) -> InitialValueProblem:

        def inputs(t: Scalar) -> tuple[object, ...]:
            return self.outside(t), tuple(self.each(lambda axis: axis.inputs(t)))

        def observed(inputs: Any, state: MachineState) -> tuple[MachineState, Instant]:
            outside, own = inputs
            sensing, law = self.at_sensors(state), ()
            demands: Groups = (None,) * len(self.groups)
            if self.law is not None:
                demands, law = demanded_now(self, outside[1], own, sensing, state.law, errors)
            sensed = tuple(one.plant for one in sensing)
            observe = lambda axis, *now: self.between_stops(axis).observed(*now)  # noqa: E731
            parts = self.each(observe, own, self.at_magnets(state), errors, sensed, demands)
            return self.moved(outside, state, parts, law)

        return self.problem_of(inputs, observed, self.each(lambda axis: axis.scale()))


def machine_of(
    rotor: Rotor, axes: Sequence[Sampled | ClosedLoop], start_q: Array, law: MachineLaw | None = None
) -> Machine:
    """Return the machine of a rotor and the loops of its axes. `start_q` [n]: coordinates at t = 0.

    Axes with the same kinds of parts form a group. Leaves may have an axis of members. `law`: demands the forces of all
    axes; None: each has its own laws.
    """
    numbers: dict[object, list[int]] = {}
    for k, axis in enumerate(axes):
        numbers.setdefault(jax.tree.structure(axis), []).append(k)
    stacked = [stack_axes([axes[k] for k in group]) for group in numbers.values()]
    groups, first = tuple(map(tuple, numbers.values())), axes[0]
    if not isinstance(first, Sampled):
        return ContinuousMachine(rotor, tuple(stacked), start_q, groups, law=law)
    cuts = most_inside(rotor.edges(), first.period)
    return SampledMachine(rotor, tuple(stacked), start_q, groups, law=law, cuts=cuts)
