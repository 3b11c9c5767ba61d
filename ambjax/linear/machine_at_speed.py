"""A whole machine at rest and constant speed, with a test signal for each axis: its equilibrium."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.control.machine_law import MachineInputs
from ambjax.linear.equilibrium import TOLERANCE, at_rest, ideal, inverse, newton_of, reading, sizes_of, start_of
from ambjax.numerics.records import Scalar
from ambjax.numerics.small_matrices import times
from ambjax.numerics.smooth import TWO_PI
from ambjax.simulation.machine_axes import forces, inputs_of
from ambjax.simulation.machine_kinds import SampledMachine
from ambjax.simulation.whole_machine import Machine, MachineState, PlantOnly, still
from ambjax.world.rotation import PER_MINUTE
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement

T = TypeVar("T")
# Parts of a point or of its rates: one stacked pytree for each group.
Groups = tuple


class MachineRest(NamedTuple):
    """A machine at rest: coordinates [n]; plants, laws and commands [c_g] of the groups; state of its law, or ()."""

    q: Array
    plant: Groups
    control: Groups
    u: Groups
    law: object = ()


class MachineAtSpeed:
    """The machine at constant speed without what a linear system cannot contain (`ideal`), with test signals e [c]."""

    def __init__(self, machine: Machine, W: Scalar, period: Scalar):
        self.machine, self.W, self.period = machine.realised(), W, period
        loops = self.machine.loops()
        self.scenario = tuple(jax.vmap(ideal)(loop.scenario) for loop in loops)
        speed = W / (TWO_PI * PER_MINUTE)
        laws = [jax.vmap(lambda cascade: cascade.at_speed(speed))(loop.cascade) for loop in loops]
        self.cascade = tuple(cascade.with_processor(guard=None) for cascade in laws)
        self.rotor = self.machine.rotor
        self.low_passed = [one.sensors.bandwidth is not None for one in self.scenario]
        self.lagged = [one.actuator.slow for one in self.scenario]

    @property
    def sampled(self) -> bool:
        """Whether the laws run on a processor."""
        return isinstance(self.machine, SampledMachine)

    def each(self, function: Callable[..., T], *groups: Sequence[object]) -> list[T]:
        """Return function(cascade, scenario, ...) of every axis, stacked for each group."""
        return [jax.vmap(function)(*own) for own in zip(self.cascade, self.scenario, *groups, strict=True)]

    def start(self) -> tuple[MachineRest, MachineRest]:
        """Return the machine at q = 0, where each axis carries its share of the weight, and the sizes of the states."""
        points = self.each(lambda cascade, scenario: start_of(cascade, scenario, self.period, 0.0))
        sizes = self.each(lambda cascade, scenario, point: sizes_of(cascade, scenario, point), points)
        q = jnp.zeros_like(jnp.asarray(self.rotor.gravity))
        size = self.machine.scale(sizes)
        first = MachineRest(q, *_parts(points))
        if self.machine.law is not None:
            e = tuple(jnp.zeros_like(u) for u in first.u)
            measured = self.read(q, jnp.zeros_like(q), first.plant, self.sensed(q), e)
            law = self.machine.law.begin(self.machine.join(measured), self.inputs(self.past(first.u)))
            first = first._replace(law=jax.tree.map(lambda x: jnp.asarray(x, q.dtype), law))
        return first, jax.tree.map(
            lambda x, s: jnp.zeros_like(x) + s, first, MachineRest(size.q, *_parts(sizes), size.law)
        )

    def read(
        self, q: Array, q_dot: Array, plant: Groups, z: Sequence[object], e: Sequence[object]
    ) -> list[Measurement]:
        """Return the readings of the groups. `z`: outputs of the low-passes, or () without."""
        states = self.machine.moving(self.rotor.at_sensors, q, q_dot, tuple(map(PlantOnly, plant)))

        def one(_: object, scenario: Scenario, own: PlantOnly, z: Array | tuple[()], e: Array) -> Measurement:
            motion = scenario.plant.measurement(own.plant)
            return reading(scenario, motion if isinstance(z, tuple) else motion._replace(z=z), (e, 0.0))

        return self.each(one, states, z, e)

    def rates(self, q: Array, q_dot: Array, plant: Groups, u: Groups) -> MachineState:
        """Return the rates of (q, q_dot, plant) under voltages or commanded currents u."""
        states = self.machine.moving(self.rotor.at_magnets, q, q_dot, tuple(map(PlantOnly, plant)))

        def one(_: object, scenario: Scenario, own: PlantOnly, u: Array) -> PlantOnly:
            return PlantOnly(scenario.plant.rates(own.plant, scenario.coil_voltage(u, own.plant)))

        moved = self.each(one, states, u)
        return self.machine.coupled((jnp.asarray(self.rotor.gravity), self.W), MachineState(q, q_dot, ()), moved)

    def inputs(self, past: Sequence[Any]) -> MachineInputs:
        """Return the inputs of the law of the machine. `past`: commands on their way, of the groups."""
        count = self.machine.count
        reference = jax.tree.map(lambda x: jnp.zeros(count) + x, at_rest(0.0))
        return inputs_of(
            self.machine, reference, self.W, jnp.full(count, jnp.inf), self.machine.join(past), self.period
        )

    def laws(
        self, measured: Sequence[Measurement], control: Groups, law: object, past: Sequence[Any]
    ) -> tuple[Groups, Groups, object]:
        """Return the commands of the groups, and the next states of the laws, or their rates in continuous time."""
        reference, unlimited, count = at_rest(0.0), jnp.asarray(jnp.inf), len(self.cascade)
        demands: Groups = ((None, None),) * count
        notched: Groups = (None,) * count

        def sample(past: tuple) -> Sample:
            return Sample(reference, self.period if self.sampled else None, unlimited, past)

        def notch(cascade: Cascade, _: object, read: Measurement, state: CascadeState, past: tuple) -> tuple:
            return cascade.observed(read, state.observer, reference, sample(past).period)

        whole = self.machine.law
        if whole is not None:
            act = whole.step if self.sampled else whole
            parts = self.each(notch, measured, control, past)
            demanded, law = act(self.machine.join([one for one, _ in parts]), law, self.inputs(past))
            demands, notched = forces(self.machine, demanded), tuple(after for _, after in parts)

        def one(
            cascade: Cascade, _: object, measured: Measurement, control: CascadeState, past: tuple, *demand: Any
        ) -> tuple[Array, CascadeState]:
            (force, estimate), own = demand
            if force is not None:
                command, after = cascade.commanded(force, estimate, control, sample(past))
                after = after._replace(observer=own)
            else:
                command, after, _ = cascade.step(measured, control, sample(past))
            return command.u, after

        found = self.each(one, measured, control, past, demands, notched)
        return tuple(u for u, _ in found), tuple(after for _, after in found), law

    def past(self, u: Groups) -> Groups:
        """Return the commands on their way under constant commands u; () in continuous time."""
        pasts = (one.timing.constant_past(own) for one, own in zip(self.cascade, u, strict=True))
        return tuple(past if self.sampled else () for past in pasts)

    def sensed(self, q: Array) -> Groups:
        """Return the displacements at the sensors, for the groups with a low-pass."""
        z = self.machine.split(times(self.rotor.at_sensors, q))
        return tuple(own if on else () for own, on in zip(z, self.low_passed, strict=True))

    def residual(self, point: MachineRest) -> MachineRest:
        """Return what is 0 at an equilibrium, in the units of the states."""
        zero, e = jnp.zeros_like(point.q), tuple(jnp.zeros_like(u) for u in point.u)
        moved = self.rates(point.q, zero, point.plant, point.u)
        poles = [scenario.plant.pole for scenario in self.scenario]
        measured = self.read(point.q, zero, point.plant, self.sensed(point.q), e)
        u, after, law = self.laws(measured, point.control, point.law, self.past(point.u))
        fastest = jnp.max(self.machine.join(poles))
        if self.sampled:
            change = jax.tree.map(lambda a, b: b - a, point.control, after)
            law = jax.tree.map(lambda a, b: b - a, point.law, law)
        else:
            change = tuple(jax.tree.map(lambda x, w=w: x / w, own) for own, w in zip(after, poles, strict=True))
            law = jax.tree.map(lambda x: x / fastest, law)
        axes = zip(moved.axes, poles, strict=True)
        plant = tuple(jax.tree.map(lambda x, w=w: x / w, own.plant) for own, w in axes)
        return MachineRest(moved.q_dot / fastest**2, plant, change, jax.tree.map(jnp.subtract, u, point.u), law)

    def rest(self, held: "MachineAtSpeed") -> MachineRest:
        """Return the equilibrium, or the nearest point found. `held`: the same machine, without derivatives."""
        start, sizes = held.start()
        scale, (flat, restore) = ravel_pytree(sizes)[0], ravel_pytree(start)
        newton = newton_of(lambda y: held.deviation(restore(y * scale), scale), flat / scale)
        found = newton.error <= TOLERANCE * jnp.finfo(flat.dtype).eps
        # one more step with a constant Jacobian, as in `equilibrium`
        step = inverse(newton.J) @ self.deviation(restore(newton.y * scale), scale)
        return restore((newton.y - jnp.where(found, step, 0.0)) * scale)

    def deviation(self, point: MachineRest, scale: Array) -> Array:
        """Return the residual relative to the sizes of the states."""
        return ravel_pytree(self.residual(point))[0] / scale


def plants_of(axes: Sequence) -> Groups:
    """Return the plants of the groups."""
    return tuple(own.plant for own in axes)


def _parts(points: Sequence) -> tuple[Groups, Groups, Groups]:
    """Return the plants without motion, the laws and the commands of the groups' points."""
    return plants_of(still(points)), tuple(one.control for one in points), tuple(one.u for one in points)
