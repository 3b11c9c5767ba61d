"""The cascade: an observer, a position law, an inversion law and a current law in series, with a nominal plant.

Each stage may take any of its laws, independently of the other stages (the paper's first contribution).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control import current, inversion, observer, position
from ambjax.control.base import default_law, hard_signs, hardened, softened
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

    observer: Any
    position: Any
    inversion: Any
    current: Any


class Command(NamedTuple):
    """Outputs of the stages: v_star and v_tilde (A^2/m^2), i_ref (A), i_ref_dot (A/s), u (V, before the limit)."""

    v_star: Array
    v_tilde: Array
    i_ref: Array
    i_ref_dot: Array
    u: Array


class Sample(NamedTuple):
    """Inputs of a cascade on a processor at a sample, apart from the measurement.

    `reference`: at the instant from which the voltage of this sample acts. `period`: s. `u_max`: limit of the supply,
    V. `past`: voltages of the last sample and of the one before it, V.
    """

    reference: Reference
    period: Scalar
    u_max: Scalar
    past: tuple[Array, Array]


# Marks a law that is left out. `Cascade.__post_init__` replaces it by the default law.
_LEFT_OUT: Any = None
# The default law of each stage.
USUAL = {
    "observer": observer.Direct,
    "position": position.SlidingMode,
    "inversion": inversion.Adaptive,
    "current": current.SlidingMode,
}


@record
class Cascade:
    """The controller: four laws, the nominal plant `model`, and the processor.

    The laws compute with `model`; the true plant is `Scenario.plant`. A law left out is the paper's, with the gains of
    Table 2 and a steepness p scaled to the model (`base.default_law`; 25 for the plant of Table 1).
    `dataclasses.replace` with another model keeps the existing laws. `processor` is None in continuous time, as in the
    paper.
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
                object.__setattr__(self, stage, default_law(kind, self.model))

    def init(self, measured: Measurement, reference: Reference | None = None) -> CascadeState:
        """Return the states of all laws at t = 0, in continuous time or on the processor.

        In continuous time a position law may begin at the first error, if the reference at t = 0 is given.
        """
        observed, rest = self.observer.init(self.model, measured), (self.position, self.inversion, self.current)
        if self.processor is not None:
            return CascadeState(observed, *(law.init_sampled(self.model) for law in rest))
        states = [law.init(self.model) for law in rest]
        if reference is not None:
            estimate, _ = self.observer(self.model, measured, observed)
            states[0] = self.position.begin(self.model, (estimate, reference))
        return CascadeState(observed, *states)

    def scale(self) -> CascadeState:
        """Return the characteristic size of each number of the laws' states; integration errors are relative to it."""
        if self.processor is None:
            return CascadeState(*(law.scale(self.model) for law in self.laws))
        return CascadeState(*(law.scale_sampled(self.model) for law in self.laws))

    def layer(self) -> CascadeState:
        """Return, for each state, the largest integration error that keeps it inside the layer of a smoothed sign."""
        return CascadeState(*(law.layer(self.model) for law in self.laws))

    def slopes(self) -> dict[str, Scalar]:
        """Return the largest slope of each law (1/s) by stage."""
        return {stage: law.slope(self.model) for stage, law in zip(CascadeState._fields, self.laws, strict=True)}

    @property
    def laws(self) -> tuple[Observer, PositionLaw, InversionLaw, CurrentLaw]:
        """The four laws in order."""
        return self.observer, self.position, self.inversion, self.current

    def demand(
        self, measured: Measurement, state: CascadeState, reference: Reference
    ) -> tuple[ForceDemand, Measurement, CascadeState]:
        """Return the demanded force, the estimate it was computed from, and the rates of observer and position law.

        The rates of z and v_star are total derivatives along the reference, z_dot, the nominal z_ddot and the law
        states. An inversion law without a state needs them for i_ref'; XLA removes them where they are unused. If the
        observer estimates the velocity, the derivative is taken along the estimate.
        """

        def wanted(
            reference: Reference, z: Array, z_dot: Array, observed: object, positioned: object
        ) -> tuple[tuple[Array, Array], tuple[Measurement, object, object]]:
            estimate, observed_rate = self.observer(self.model, Measurement(z, z_dot, measured.i), observed)
            if self.observer.estimates_velocity:
                # XLA aborts when it compiles a one-kernel rollout (`compiler.fast_path`) in which z_dot is unused
                estimate = estimate._replace(z_dot=estimate.z_dot + 0.0 * z_dot)
            v_star, positioned_rate = self.position(self.model, (estimate, reference), positioned)
            return (estimate.z, v_star), (estimate, observed_rate, positioned_rate)

        point = (reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (estimate, observed_rate, positioned_rate) = wanted(*point)
        gaps = self.model.gaps(estimate.z)
        z_ddot = self.model.z_ddot(estimate.z, estimate.i)
        if self.observer.estimates_velocity:
            law = functools.partial(self.position, self.model)
            z_rate, v_star_rate = _rates(law, estimate, z_ddot, reference, state.position, positioned_rate)
        else:
            along = (reference.rate(), measured.z_dot, z_ddot, observed_rate, positioned_rate)
            z_rate, v_star_rate = jax.jvp(lambda *x: wanted(*x)[0], point, along)[1]
        rates = CascadeState(observed_rate, positioned_rate, (), ())
        return ForceDemand(z, z_rate, v_star, v_star_rate, gaps), estimate, rates

    def on_processor(self, *delays: Scalar, between: bool = False) -> "Cascade":
        """Return the cascade with all choices made that determine its compiled program.

        A sign with steepness inf becomes set-valued. The processor also admits `delays` (samples), or with `between`
        every delay between them. Raises ValueError as `Processor.resolved` does.
        """
        assert self.processor is not None
        laws = {stage: hardened(getattr(self, stage)) for stage in USUAL}
        return dataclasses.replace(self, **laws, processor=self.processor.resolved(*delays, between=between))

    def check_smooth(self) -> None:
        """Raise ValueError for a steepness of inf: in continuous time a sign must be smoothed."""
        for stage in USUAL:
            law = getattr(self, stage)
            for name in hard_signs(law):
                raise ValueError(
                    f"controller.{stage}.{name} = inf: in continuous time a sign must be smoothed. Give a number, or "
                    "add [processor], on which the sign itself is stepped."
                )

    def in_continuous_time(self) -> "Cascade":
        """Return the cascade without its processor; a steepness of inf becomes the default one for the model."""
        laws = {stage: softened(getattr(self, stage), self.model) for stage in USUAL}
        return dataclasses.replace(self, **laws, processor=None)

    def _advance(self, sample: Sample) -> Callable[..., Any]:
        """Return `laws.stepped` with the model, the period and the discretisation of this cascade."""
        implicit = self.processor is not None and self.processor.implicit
        return functools.partial(stepped, model=self.model, period=sample.period, implicit=implicit)

    def estimate(self, measured: Measurement, state: State, sample: Sample) -> tuple[Measurement, State, Measurement]:
        """Run the observer for one sample.

        `state` is the observer's. Returns the estimate for the other laws (with prediction: at the end of the delay),
        the observer's next state, and the estimate at the sample itself.
        """
        processor: Any = self.processor
        now, state = self._advance(sample)(self.observer, measured, state)
        estimate = now
        if processor.predicts:
            estimate = carried(self.model, now, sample.past, processor.stretches(sample.period))
        return estimate, state, now

    def step(
        self, measured: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[Command, CascadeState, Measurement]:
        """Return the command of one sample on a processor, the laws' next states, and the observer's estimate.

        With prediction, all laws but the observer use the estimate at the end of the delay.
        """
        advance = self._advance(sample)

        def wanted(
            reference: Reference, z: Array, z_dot: Array, observed: object, positioned: object
        ) -> tuple[tuple[Array, Array], tuple[Measurement, Measurement, object, object]]:
            estimate, observed, now = self.estimate(Measurement(z, z_dot, measured.i), observed, sample)
            v_star, positioned = advance(self.position, (estimate, reference), positioned)
            return (estimate.z, v_star), (now, estimate, observed, positioned)

        point = (sample.reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (now, estimate, observed, positioned) = wanted(*point)
        # an inversion law without a state needs the rates for i_ref'; XLA removes them where they are unused
        z_ddot = self.model.z_ddot(estimate.z, estimate.i)
        rates = jax.tree.map(
            lambda a, b: (b - a) / sample.period, (state.observer, state.position), (observed, positioned)
        )
        if self.observer.estimates_velocity:
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
        """Return the command and the rate of every law's state. `u_max`: limit of the supply, V (inf: none)."""
        force, estimate, rates = self.demand(measured, state, reference)
        wanted, inversion_rate = self.inversion(self.model, force, state.inversion)
        u, current_rate = self.current(self.model, CurrentInputs(estimate, wanted, u_max, force.gaps), state.current)
        v_tilde = force.v_star - self.model.v_and_dv_di(force.z, wanted.i_ref, force.gaps)[0]
        command = Command(force.v_star, v_tilde, wanted.i_ref, wanted.i_ref_dot, u)
        return command, rates._replace(inversion=inversion_rate, current=current_rate)


def _rates(
    law: Callable[..., tuple[Array, State]],
    estimate: Measurement,
    z_ddot: Array,
    reference: Reference,
    state: State,
    rate: State,
) -> tuple[Array, Array]:
    """Return the rates of z and v_star along an estimate that moves with its own velocity and with z_ddot."""

    def v_star(reference: Reference, z: Array, z_dot: Array, state: State) -> Array:
        return law((Measurement(z, z_dot, estimate.i), reference), state)[0]

    point = (reference, estimate.z, estimate.z_dot, state)
    return estimate.z_dot, jax.jvp(v_star, point, (reference.rate(), estimate.z_dot, z_ddot, rate))[1]
