"""The loop on a processor, with rows of sigma, v_tilde and e as the laws compute them, and of the plant."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar, record
from ambjax.simulation.between import SampledState
from ambjax.simulation.integrate import Advanced, Begin, Integrator
from ambjax.simulation.rollout import Extended
from ambjax.simulation.sampled import Sampled
from ambjax.world.sensor import Errors


class LawSignals(NamedTuple):
    """sigma (m/s), v_tilde (A^2/m^2) and e = i - i_ref (A)."""

    sigma: Array
    v_tilde: Array
    e: Array


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
class LawSignalsRecorder(Extended):
    """System of a loop on a processor whose rows record the signals that its laws compute."""

    loop: Sampled

    def start(self) -> LawSignalsState:
        return LawSignalsState(self.loop.start(), LawSignals(*[jnp.zeros(())] * 3))

    def jump(self, t: Scalar, state: LawSignalsState, errors: Errors) -> LawSignalsState:
        """Step the laws and store the signals that they computed."""
        loop, before = self.loop, state.loop
        cascade, after = loop.loop.cascade, loop.jump(t, before, errors)
        reference = loop.reference(t)
        sample = loop.sample(reference, after.past)
        _, measured, laws = loop.inputs_of_laws(loop.read(before, errors)[1], sample, before)
        estimate, *_ = cascade.estimate(measured, laws.observer, sample)
        sigma, command = cascade.sigma(estimate, reference), after.command
        return LawSignalsState(after, LawSignals(sigma, command.v_tilde, estimate.i - command.i_ref))

    def advance(self, method: Integrator, errors: Errors, begin: Begin[LawSignalsState], period: Scalar) -> Advanced:
        first = Begin(begin.t, begin.state.loop, begin.memory, begin.code)
        after = self.loop.advance(method, errors, first, period)
        return after._replace(state=begin.state._replace(loop=after.state))

    def row(self, t: Scalar, state: LawSignalsState, errors: Errors, alive: Array) -> LawSignalsRow:
        row = self.loop.row(t, state.loop, errors, alive)
        true = LawSignals(row.sigma, row.v_tilde, row.e)
        return LawSignalsRow(row.t, row.u, row.z, row.i_ref, state.computed, true)
