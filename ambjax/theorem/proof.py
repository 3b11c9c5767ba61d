"""Loops that record the signals of the theorem: with the steps of its proof, Section 3.5, or on a processor.

The right-hand sides of the proof's identities, Eqs. (12)-(14), are integrated together with the loop. The integrals are
compared with sigma, v_tilde and e of the loop. If the proof's assumptions hold (exact model, measured state, no limit
on u), the difference is the integration error; otherwise it shows the effect of a violated assumption. V = sigma^2 is
compared with its bound at every sample.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.cascade_state import Sample
from ambjax.control.schedule import with_gains_at
from ambjax.numerics.records import Scalar, record
from ambjax.simulation.between import SampledState
from ambjax.simulation.integrate import InitialValueProblem, WholeState
from ambjax.simulation.loop import ClosedLoop, ExternalInputs, LoopState
from ambjax.simulation.rollout import Extended, ExtendedOnProcessor
from ambjax.simulation.sampled import Sampled
from ambjax.world.sensor import Errors, Measurement
from ambjax.world.waveforms import Reference


class LawSignals(NamedTuple):
    """sigma (m/s), v_tilde (A^2/m^2) and e = i - i_ref (A)."""

    sigma: Array
    v_tilde: Array
    e: Array


class Terms(NamedTuple):
    """Quantities of the proof at one time.

    `moving`: rate of the state of the loop. `values`: sigma, v_tilde and e of the loop. `rates`: right-hand sides of
    Eqs. (12)-(14). q_z and h in m/s^2, q_i and `i_ref_dot` in A/s, d in A^2/m^2/s.
    """

    moving: LoopState
    values: LawSignals
    rates: LawSignals
    i_ref_dot: Array
    q_z: Array
    q_i: Array
    d: Array
    h: Array
    bound: Array
    """upper bound on the derivative of V = sigma^2, m^2/s^3"""


class TheoremRow(NamedTuple):
    """One sample of the monitored loop.

    `distance`: signed distance of (z/s_0, i_ref/i_0) to the singular curve C. `*_residual`: the signal of the loop
    minus the integral of its right-hand side in the proof. `V_margin`: bound on V' minus V', m^2/s^3; positive where it
    holds.
    """

    t: Array
    z: Array
    i_ref: Array
    alive: Array
    q_z: Array
    q_i: Array
    d: Array
    q_z_plus_h: Array
    sigma_residual: Array
    v_tilde_residual: Array
    e_residual: Array
    distance: Array
    V_margin: Array


class MonitoredState(NamedTuple):
    """State of the closed loop, and the integrals of the proof's right-hand sides.

    The integral for e is stored as i_ref + e. By itself, e decays to subnormal numbers, with which arithmetic is a
    hundred times slower.
    """

    loop: LoopState
    integrals: LawSignals


@record
class Monitored(Extended, WholeState):
    """System of the closed loop and the integrals of the proof's right-hand sides."""

    loop: ClosedLoop

    def start(self) -> MonitoredState:
        state = self.loop.start()
        values = self.terms(self.loop.inputs(0.0), state, self.sensor_errors(0)).values
        return MonitoredState(state, values._replace(e=self.motion(state).i))

    def problem(self, errors: Errors) -> InitialValueProblem:
        plant = self.loop.scenario.plant
        _, z_dot, i = map(jnp.asarray, plant.sizes())
        sizes = MonitoredState(self.loop.scale(), LawSignals(z_dot, plant.dv_di(0.0, 0.0) * i / 100, i))

        def rates(inputs: ExternalInputs, state: MonitoredState) -> MonitoredState:
            terms = self.terms(inputs, state.loop, errors)
            return MonitoredState(terms.moving, terms.rates._replace(e=terms.rates.e + terms.i_ref_dot))

        layer = MonitoredState(self.loop.layer(), LawSignals(*[jnp.asarray(jnp.inf)] * 3))
        return InitialValueProblem(self.loop.inputs, rates, sizes, self.status, layer)

    def motion(self, state: LoopState) -> Measurement:
        return self.loop.scenario.plant.measurement(state.plant)

    def terms(self, inputs: ExternalInputs, state: LoopState, errors: Errors) -> Terms:
        """Return the quantities of the proof. The robust term of a law without one is 0."""
        cascade, scenario = self.loop.cascade, self.loop.scenario
        plant, motion = scenario.plant, self.motion(state)
        z, _, i = motion
        command, control, u = self.loop.command(inputs, state, errors)
        moving = self.loop.derivative(inputs, state, control, u)
        v_tilde, e = command.v_tilde, i - command.i_ref
        sigma = cascade.sigma(motion, inputs.reference)
        q_z, q_i = scenario.pushed(inputs.q_z, motion), inputs.q_i
        d = self._drift(inputs, state, errors, command.i_ref, moving)
        h = plant.a * (plant.signals(state.plant).v - v_tilde - plant.v(z, command.i_ref))
        laws = (with_gains_at(law, z, inputs.reference) for law in cascade.laws[1:])
        robust = LawSignals(*(law.robust(x) for law, x in zip(laws, (sigma, v_tilde, e), strict=True)))
        rates = LawSignals(robust.sigma + q_z + h, robust.v_tilde + d, robust.e + q_i)
        # |v(z, i) - v(z, i_ref)| <= L_v |e|: v is quadratic in i, so dv/di is largest at one end.
        L_v = jnp.maximum(jnp.abs(plant.dv_di(z, i)), jnp.abs(plant.dv_di(z, command.i_ref)))
        room = jnp.abs(robust.sigma) - jnp.abs(q_z)
        bound = 2 * jnp.abs(sigma) * (plant.a * (L_v * jnp.abs(e) + jnp.abs(v_tilde)) - room)
        return Terms(moving, LawSignals(sigma, v_tilde, e), rates, command.i_ref_dot, q_z, q_i, d, h, bound)

    def _drift(
        self, inputs: ExternalInputs, state: LoopState, errors: Errors, i_ref: Array, moving: LoopState
    ) -> Array:
        """Return d = v_star' - (dv/dz) z' along the true flow at constant i_ref: the left side of Eq. (7).

        The errors of the sensors and the runout are constant.
        """
        cascade, reference = self.loop.cascade, inputs.reference

        def demanded(reference: Reference, x: LoopState) -> Array:
            force, *_ = cascade.demand(self.loop.received(inputs, x.plant, errors), x.control, Sample(reference))
            return force.v_star - cascade.model.v(force.z, i_ref)

        return jax.jvp(demanded, (reference, state), (reference.rate(), moving))[1]

    def row(self, t: Array, state: MonitoredState, errors: Errors, alive: Array) -> TheoremRow:
        inputs = self.loop.inputs(t)
        terms = self.terms(inputs, state.loop, errors)
        z, _, i = self.motion(state.loop)
        i_ref = i - terms.values.e
        values = terms.values._replace(e=i)
        off = LawSignals(*(a - b for a, b in zip(values, state.integrals, strict=True)))
        # V' = 2 sigma sigma', with sigma' from the plant's own acceleration, not from the identity.
        sigma = lambda r, x: self.loop.cascade.sigma(self.motion(x), r)  # noqa: E731
        moving = (inputs.reference.rate(), terms.moving)
        sigma_dot = jax.jvp(sigma, (inputs.reference, state.loop), moving)[1]
        signals = (terms.q_z, terms.q_i, terms.d, terms.q_z + terms.h, *off)
        acting = (jnp.where(alive, x, 0.0) for x in signals)
        distance = self.loop.scenario.plant.signed_distance_to_C(z, i_ref)
        V_margin = terms.bound - 2 * terms.values.sigma * sigma_dot
        return TheoremRow(t, z, i_ref, alive, *acting, distance=distance, V_margin=V_margin)


class LawSignalsRow(NamedTuple):
    """One sample: time (s), limited voltage (V), z (m), i_ref (A), and signals.

    `computed`: signals that the laws compute from the estimate (with prediction: at the end of the delay). `true`:
    sigma and e of the plant at the sample; v_tilde is the computed one.
    """

    t: Array
    u: Array
    z: Array
    i_ref: Array
    computed: LawSignals
    true: LawSignals


class LawSignalsState(NamedTuple):
    """State of the loop, and the signals that its laws computed at the last sample."""

    loop: SampledState
    computed: LawSignals


@record
class LawSignalsRecorder(ExtendedOnProcessor):
    """System of a loop on a processor whose rows record the signals that its laws compute."""

    loop: Sampled

    def start(self) -> LawSignalsState:
        return LawSignalsState(self.loop.start(), LawSignals(*[jnp.zeros(())] * 3))

    def jump(self, t: Scalar, state: LawSignalsState, errors: Errors) -> LawSignalsState:
        loop, before = self.loop, state.loop
        cascade, after = loop.loop.cascade, loop.jump(t, before, errors)
        reference = loop.reference(t)
        sample = loop.sample(reference, after.past)
        _, measured, laws = loop.inputs_of_laws(loop.read(before, errors)[1], sample, before)
        estimate, *_ = cascade.estimate(measured, laws.observer, sample)
        sigma, command = cascade.sigma(estimate, reference), after.command
        return LawSignalsState(after, LawSignals(sigma, command.v_tilde, estimate.i - command.i_ref))

    def row(self, t: Scalar, state: LawSignalsState, errors: Errors, alive: Array) -> LawSignalsRow:
        row = self.loop.row(t, state.loop, errors, alive)
        true = LawSignals(row.sigma, row.v_tilde, row.e)
        return LawSignalsRow(row.t, row.u, row.z, row.i_ref, state.computed, true)
