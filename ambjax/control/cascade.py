"""The cascade: observer, position, inversion and current law in a row, around a nominal plant.

Its modularity is the paper's first contribution: any law of a stage may stand with any of the others.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control import answers, current, inversion, observer, position
from ambjax.control.laws import (
    CurrentInputs,
    CurrentLaw,
    ForceDemand,
    InversionLaw,
    Observer,
    PositionLaw,
    State,
    stepped,
)
from ambjax.control.processor import Processor, carried
from ambjax.numerics.records import Scalar, record
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference


class CascadeState(NamedTuple):
    """The state of each law, or its rate."""

    observer: State
    position: State
    inversion: State
    current: State


class Command(NamedTuple):
    """What the cascade decides, stage by stage: A^2/m^2, A^2/m^2, A, A/s, V (before the supply's limit)."""

    v_star: Array
    v_tilde: Array
    i_ref: Array
    i_ref_dot: Array
    u: Array


class Sample(NamedTuple):
    """What a cascade on a processor meets at a sample: reference where its voltage takes effect, period in s, the
    supply's limit and the voltages of the sample before and of the one before that, V."""

    reference: Reference
    period: Scalar
    u_max: Scalar
    past: tuple[Array, Array]


# A law that is left out: made for the model once, when the cascade is.
_LEFT_OUT: Any = None
# The law of each stage that stands in a cascade unless another is named.
USUAL = {
    "observer": observer.Direct,
    "position": position.SlidingMode,
    "inversion": inversion.Adaptive,
    "current": current.SlidingMode,
}


@record
class Cascade:
    """The controller. `model` is the plant it believes in; the true one lives in the Scenario.

    A law left out is the paper's, with the gains of Table 2 and a p that suits the model (`answers.default_law`): 25
    for the plant of Table 1. Laws are made once: `dataclasses.replace` with another model keeps those that are there.
    `processor`: what the cascade runs on; None: continuous time, as in the paper.
    """

    observer: Observer = _LEFT_OUT
    position: PositionLaw = _LEFT_OUT
    inversion: InversionLaw = _LEFT_OUT
    current: CurrentLaw = _LEFT_OUT
    model: Plant = Plant()
    processor: Processor | None = None

    def __post_init__(self) -> None:
        for stage, kind in USUAL.items():
            if getattr(self, stage) is _LEFT_OUT:
                object.__setattr__(self, stage, answers.default_law(kind, self.model))

    def init(self, measured: Measurement) -> CascadeState:
        """States of all laws at t = 0, in continuous time or on the processor."""
        rest = self.position, self.inversion, self.current
        if self.processor is None:
            states = [law.init(self.model) for law in rest]
        else:
            states = [answers.init_sampled(law, self.model) for law in rest]
        return CascadeState(self.observer.init(self.model, measured), *states)

    def scale(self) -> CascadeState:
        """Size that matters of each number of the laws' states."""
        if self.processor is None:
            return CascadeState(*(law.scale(self.model) for law in self.laws))
        return CascadeState(*(answers.scale_sampled(law, self.model) for law in self.laws))

    def layer(self) -> CascadeState:
        """The largest error with which each state stays where a smoothed sign turns."""
        return CascadeState(*(answers.layer(law, self.model) for law in self.laws))

    def slopes(self) -> dict[str, Scalar]:
        """The steepest rate of each law by stage, 1/s."""
        return {stage: law.slope(self.model) for stage, law in zip(CascadeState._fields, self.laws, strict=True)}

    @property
    def laws(self) -> tuple[Observer, PositionLaw, InversionLaw, CurrentLaw]:
        """The four laws in order."""
        return self.observer, self.position, self.inversion, self.current

    def demand(
        self, measured: Measurement, state: CascadeState, reference: Reference
    ) -> tuple[ForceDemand, Measurement, CascadeState]:
        """The force wanted, the estimate it is wanted for, and the rates of observer and position law.

        The rates of z and v_star are derivatives along (reference, z_dot, nominal z_ddot, law states): what
        a law that inverts statically needs for i_ref'. Unused, they are never computed. Where the velocity is
        estimated it is the estimate that moves so.
        """

        def wanted(reference: Reference, z: Array, z_dot: Array, observed: State, positioned: State):
            estimate, observed_rate = self.observer(self.model, Measurement(z, z_dot, measured.i), observed)
            if answers.estimates_velocity(self.observer):
                # XLA's compiler aborts on a one-kernel rollout (`numerics.kernel`) in which nothing reads z_dot
                estimate = estimate._replace(z_dot=estimate.z_dot + 0.0 * z_dot)
            v_star, positioned_rate = self.position(self.model, (estimate, reference), positioned)
            return (estimate.z, v_star), (estimate, observed_rate, positioned_rate)

        point = (reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (estimate, observed_rate, positioned_rate) = wanted(*point)
        gaps = self.model.gaps(estimate.z)
        z_ddot = self.model.z_ddot(estimate.z, estimate.i)
        if answers.estimates_velocity(self.observer):
            law = functools.partial(self.position, self.model)
            z_rate, v_star_rate = _rates(law, estimate, z_ddot, reference, state.position, positioned_rate)
        else:
            along = (reference.rate(), measured.z_dot, z_ddot, observed_rate, positioned_rate)
            z_rate, v_star_rate = jax.jvp(lambda *x: wanted(*x)[0], point, along)[1]
        rates = CascadeState(observed_rate, positioned_rate, (), ())
        return ForceDemand(z, z_rate, v_star, v_star_rate, gaps), estimate, rates

    def on_processor(self, *delays: Scalar, between: bool = False) -> "Cascade":
        """The cascade with everything settled that decides which program is compiled for it: signs whose steepness is
        inf become set-valued, and its processor is ready for `delays` (samples) too, or for all `between` them. Raises
        as `Processor.resolved`."""
        assert self.processor is not None
        laws = {stage: answers.hardened(getattr(self, stage)) for stage in USUAL}
        return dataclasses.replace(self, **laws, processor=self.processor.resolved(*delays, between=between))

    def check_smooth(self) -> None:
        """Raise ValueError for a sign without a layer, which continuous time does not know."""
        for stage in USUAL:
            law = getattr(self, stage)
            for name in answers.hard_signs(law):
                raise ValueError(
                    f"controller.{stage}.{name} = inf: in continuous time a sign must be smoothed. Give a number, or "
                    "add [processor], on which the sign itself is stepped."
                )

    def in_continuous_time(self) -> "Cascade":
        """The cascade without its processor; signs without a layer get the steepness that suits the model."""
        laws = {stage: answers.softened(getattr(self, stage), self.model) for stage in USUAL}
        return dataclasses.replace(self, **laws, processor=None)

    def _advance(self, sample: Sample) -> Callable[..., Any]:
        """`stepped` on this cascade's processor."""
        implicit = self.processor is not None and self.processor.implicit
        return functools.partial(stepped, model=self.model, period=sample.period, implicit=implicit)

    def estimate(self, measured: Measurement, state: State, sample: Sample) -> tuple[Measurement, State, Measurement]:
        """What the laws act on at a sample, carried over the delay if that is predicted; the observer's next state; and
        its estimate at the sample itself. `state`: the observer's."""
        processor: Any = self.processor
        now, state = self._advance(sample)(self.observer, measured, state)
        estimate = now
        if processor.predicts:
            estimate = carried(self.model, now, sample.past, processor.stretches(sample.period))
        return estimate, state, now

    def step(
        self, measured: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[Command, CascadeState, Measurement]:
        """Command of one sample on a processor, states of the laws for the next one, and the observer's estimate.

        With prediction all but the observer act on the estimate carried over the delay.
        """
        advance = self._advance(sample)

        def wanted(reference: Reference, z: Array, z_dot: Array, observed: State, positioned: State):
            estimate, observed, now = self.estimate(Measurement(z, z_dot, measured.i), observed, sample)
            v_star, positioned = advance(self.position, (estimate, reference), positioned)
            return (estimate.z, v_star), (now, estimate, observed, positioned)

        point = (sample.reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (now, estimate, observed, positioned) = wanted(*point)
        # what a law that inverts statically needs for i_ref'; unused, it is never computed
        z_ddot = self.model.z_ddot(estimate.z, estimate.i)
        rates = jax.tree.map(
            lambda a, b: (b - a) / sample.period, (state.observer, state.position), (observed, positioned)
        )
        if answers.estimates_velocity(self.observer):
            law = functools.partial(advance, self.position)
            z_rate, v_star_rate = _rates(law, estimate, z_ddot, sample.reference, state.position, rates[1])
        else:
            along = (sample.reference.rate(), measured.z_dot, z_ddot, *rates)
            z_rate, v_star_rate = jax.jvp(lambda *x: wanted(*x)[0], point, along)[1]
        v_star = materialised(v_star)
        force = ForceDemand(z, z_rate, v_star, v_star_rate, self.model.gaps(z))
        demand, inverted = advance(self.inversion, force, state.inversion)
        u, driven = advance(self.current, CurrentInputs(estimate, demand, sample.u_max, force.gaps), state.current)
        v_tilde = v_star - self.model.v_and_dv_di(z, demand.i_ref, force.gaps)[0]
        after = CascadeState(observed, positioned, inverted, driven)
        return Command(v_star, v_tilde, demand.i_ref, demand.i_ref_dot, u), after, now

    def __call__(
        self, measured: Measurement, state: CascadeState, reference: Reference, u_max: Scalar
    ) -> tuple[Command, CascadeState]:
        """Command and rate of every law's state. `u_max` is the supply's limit in V (inf: none)."""
        force, estimate, rates = self.demand(measured, state, reference)
        wanted, inversion_rate = self.inversion(self.model, force, state.inversion)
        u, current_rate = self.current(self.model, CurrentInputs(estimate, wanted, u_max, force.gaps), state.current)
        v_tilde = force.v_star - self.model.v_and_dv_di(force.z, wanted.i_ref, force.gaps)[0]
        command = Command(force.v_star, v_tilde, wanted.i_ref, wanted.i_ref_dot, u)
        return command, rates._replace(inversion=inversion_rate, current=current_rate)


def _rates(
    law: Any, estimate: Measurement, z_ddot: Array, reference: Reference, state: State, rate: State
) -> tuple[Array, Array]:
    """Rates of z and of a position law's v_star where the estimate itself moves, by its velocity and with z_ddot."""

    def v_star(reference: Reference, z: Array, z_dot: Array, state: State) -> Array:
        return law((Measurement(z, z_dot, estimate.i), reference), state)[0]

    point = (reference, estimate.z, estimate.z_dot, state)
    return estimate.z_dot, jax.jvp(v_star, point, (reference.rate(), estimate.z_dot, z_ddot, rate))[1]
