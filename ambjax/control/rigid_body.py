"""Control in the coordinates of the rigid rotor: translation and tilt instead of the axes of the bearings."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.control.machine_law import Demanded, MachineInputs, MachineLaw
from ambjax.control.schedule import extremes
from ambjax.control.stages import ForceDemand, rates_along
from ambjax.numerics.linear import rk4_step
from ambjax.numerics.records import Scalar, leaf, matrix, part, record
from ambjax.numerics.small_matrices import times
from ambjax.world.plant import State
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference


@record
class RigidBody(MachineLaw):
    """Observers and position laws in the n rigid coordinates that the magnets hold: x, y, perhaps z, beta_x, beta_y.

    The readings y of the sensors give the coordinates C_r^+ y. The position law of each coordinate demands an
    acceleration for its mass m or I_t, with the weight. The accelerations alpha give the forces B_r^+ M alpha of the
    magnets. C_r and B_r are the rigid parts of the rows of sensors and magnets, and ^+ is the pseudo-inverse.

    The nominal plant of a coordinate is one magnet: it has the stiffness, the force per current and the largest force
    that all magnets together have along the coordinate. Its displacement is that of the coordinate, in m or rad, and
    its gap is the displacement at which the rotor touches the magnets. Its current is the one that gives the
    acceleration which the measured currents of all axes give.

    With prediction, the rigid rotor with the nominal magnets of all axes is integrated over the delay.
    """

    laws: Cascade = part(doc="observer, position law and nominal plant of each coordinate", channels=True)
    from_sensors: Array = matrix("n c", "C_r^+: coordinates per reading")
    at_sensors: Array = matrix("c n", "C_r: displacements at the sensors per coordinate")
    at_magnets: Array = matrix("c n", "B_r: displacements at the magnets per coordinate")
    accelerations: Array = matrix("n c", "accelerations of the coordinates per acceleration of each axis")
    weights: Array = matrix("c", "weight per mass of each axis, m/s^2")
    forces: Array = matrix("c n", "scaled forces of the magnets, A^2/m^2, per acceleration of each coordinate")
    gyroscopic: Array | None = leaf(
        default=None, shape="n n", at_least=-1e30, at_most=1e30,
        doc="M^-1 G: gyroscopic accelerations to compensate, per speed (rad/s) and rate; none: no compensation",
    )  # fmt: skip

    def scale(self) -> CascadeState:
        sizes = jax.vmap(lambda law: law.scale()._replace(inversion=(), current=()))(self.laws)
        return jax.tree.map(jnp.asarray, sizes)

    def begin(self, measured: Measurement, inputs: MachineInputs) -> CascadeState:
        now, reference = self._read(measured, inputs), self._reference(inputs)
        observed = jax.vmap(lambda law, m: extremes(law.observer)[0].init(law.model, m))(self.laws, now)
        period = inputs.period if self.laws.sampled else None
        estimate, _ = self._observed(now, observed, reference, period)
        estimate, _ = self._predicted(estimate, measured.i, inputs)
        begun = jax.vmap(lambda law, m, r: law.begun_position(m, r, period))
        return CascadeState(observed, begun(self.laws, estimate, reference), (), ())

    def step(self, measured: Measurement, state: CascadeState, inputs: MachineInputs) -> tuple[Demanded, CascadeState]:
        reference = self._reference(inputs)
        now, observed = self._observed(self._read(measured, inputs), state.observer, reference, inputs.period)
        estimate, i = self._predicted(now, measured.i, inputs)

        def one(law: Cascade, estimate: Measurement, r: Reference, before: Any) -> tuple[ForceDemand, Any]:
            act = functools.partial(law.positioned, period=inputs.period)
            v_star, after = act(estimate, r, before)
            rate = jax.tree.map(lambda a, b: (b - a) / inputs.period, before, after)
            z_ddot = law.model.z_ddot(estimate.z, estimate.i)
            rates = rates_along(act, estimate, z_ddot, r, before, rate)
            return ForceDemand(estimate.z, rates[0], v_star, rates[1]), after

        force, positioned = jax.vmap(one)(self.laws, estimate, reference, state.position)
        after = CascadeState(observed, positioned, (), ())
        return self._demanded(force, estimate, i, now, inputs), after

    def __call__(
        self, measured: Measurement, state: CascadeState, inputs: MachineInputs
    ) -> tuple[Demanded, CascadeState]:
        now, reference = self._read(measured, inputs), self._reference(inputs)
        demand = jax.vmap(lambda law, m, own, r: law.demand(m, own, Sample(r))[:3])
        force, estimate, rates = demand(self.laws, now, state, reference)
        return self._demanded(force, estimate, measured.i, estimate, inputs), rates

    def _reference(self, inputs: MachineInputs) -> Reference:
        return jax.tree.map(lambda x: times(self.from_sensors, x), inputs.reference)

    def _observed(
        self, now: Measurement, state: Any, reference: Reference, period: Scalar | None
    ) -> tuple[Measurement, Any]:
        observe = jax.vmap(lambda law, m, own, r: law.observed(m, own, r, period))
        return observe(self.laws, now, state, reference)

    def _read(self, measured: Measurement, inputs: MachineInputs) -> Measurement:
        """Return the readings in coordinates [n]."""
        q, q_dot = times(self.from_sensors, measured.z), times(self.from_sensors, measured.z_dot)
        return self._with_current(q, q_dot, measured.i, inputs)

    def _with_current(self, q: Array, q_dot: Array, i: Array, inputs: MachineInputs) -> Measurement:
        """Return the motion of the coordinates, with the currents [n] of their nominal plants."""
        states = inputs.start(Measurement(times(self.at_magnets, q), times(self.at_magnets, q_dot), i))
        given = self._accelerations(inputs.driven(jnp.zeros_like(i), states))
        current = jax.vmap(lambda law, q, x: law.model.current_for(q, x / law.model.a))(self.laws, q, given)
        return Measurement(q, q_dot, current)

    def _accelerations(self, rates: State) -> Array:
        """Return the accelerations [n] by the magnets alone, from the rates of the axes' nominal plants."""
        return times(self.accelerations, rates.z_dot + self.weights)

    def _predicted(self, now: Measurement, i: Array, inputs: MachineInputs) -> tuple[Measurement, Array]:
        """Return motion and currents at the end of the delay, and the currents of the axes there."""
        if not self.laws.timing.predicts:
            return now, i
        laws = self.laws
        lengths = jax.vmap(lambda law: law.timing.prediction_steps(inputs.period))(laws)
        weight = jnp.asarray(laws.model.g)

        def rates(u: Array, x: tuple[Array, Array, State]) -> tuple[Array, Array, State]:
            q, q_dot, coils = x
            at = coils._replace(z=times(self.at_magnets, q), z_dot=times(self.at_magnets, q_dot))
            moved = inputs.driven(u, at)
            q_ddot = self._accelerations(moved) - weight
            if self.gyroscopic is not None:
                q_ddot = q_ddot - inputs.W * times(self.gyroscopic, q_dot)
            return q_dot, q_ddot, moved._replace(z=0.0 * u, z_dot=0.0 * u)

        zero = jnp.zeros_like(i)
        x = now.z, now.z_dot, inputs.start(Measurement(zero, zero, i))
        for u, length in reversed(list(zip(inputs.past[: len(lengths)], lengths, strict=True))):
            x = rk4_step(functools.partial(rates, u), x, length[0])
        q, q_dot, coils = x
        return self._with_current(q, q_dot, coils.i, inputs), coils.i

    def _demanded(
        self, force: ForceDemand, estimate: Measurement, i: Array, now: Measurement, inputs: MachineInputs
    ) -> Demanded:
        """Return the demands of the axes from those of the coordinates."""
        a = jnp.asarray(self.laws.model.a)
        wanted, rate = a * force.v_star, a * force.v_star_rate
        if self.gyroscopic is not None:
            turning = inputs.W * self.gyroscopic
            acceleration = jax.vmap(lambda law, m: law.model.z_ddot(m.z, m.i))(self.laws, estimate)
            wanted, rate = wanted + times(turning, estimate.z_dot), rate + times(turning, acceleration)
        z, z_rate = times(self.at_magnets, force.z), times(self.at_magnets, force.z_rate)
        demand = ForceDemand(z, z_rate, times(self.forces, wanted), times(self.forces, rate))
        motion = Measurement(demand.z, times(self.at_magnets, estimate.z_dot), i)
        sensed = Measurement(times(self.at_sensors, now.z), times(self.at_sensors, now.z_dot), i)
        return Demanded(demand, motion, sensed)
