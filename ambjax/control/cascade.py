"""The cascade: an observer, a position law, an inversion law and a current law in series, with a nominal plant.

The laws of the stages can be combined freely (the first contribution of the paper).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control import current, inversion, observer, position
from ambjax.control.base import default_law, with_default_steepness, with_set_valued_signs
from ambjax.control.cascade_state import CascadeState, Command, Sample
from ambjax.control.processor import Processor, predicted_over_delay
from ambjax.control.schedule import extremes, with_gains_at
from ambjax.control.stages import (
    CurrentInputs,
    CurrentLaw,
    ForceDemand,
    InversionLaw,
    Observer,
    PositionLaw,
    State,
    rates_along,
    step_law,
)
from ambjax.control.synchronous_notch import SynchronousNotch
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar, part, record, replaced
from ambjax.world.plant import Plant
from ambjax.world.plant import State as NominalState
from ambjax.world.rotation import Rotation
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# In place of a processor in continuous time: no delay, no prediction and no guard.
_CONTINUOUS = Processor(delay=0.0, predict=False, guard=None)
# Marks a law that is not given. `Cascade.__post_init__` replaces it by the default law.
_LEFT_OUT: Any = None
DEFAULT_LAWS = {
    "observer": observer.Direct,
    "position": position.SlidingMode,
    "inversion": inversion.Adaptive,
    "current": current.SlidingMode,
}


@record
class Cascade:
    """The controller: four laws, the nominal plant `model`, and the processor.

    The laws compute with `model`; the true plant is `Scenario.plant`. The default laws are those of the paper, with the
    gains of Table 2, except gamma = 7.5e4 (`inversion.Adaptive`). Their steepness p is 25 for the plant of Table 1 and
    is scaled to other models (`base.default_law`). `dataclasses.replace` with another model does not change the laws.
    `processor` is None in continuous time, as in the paper. Any gain of a law may be a `Schedule`.
    """

    observer: Observer = part(default=_LEFT_OUT, doc="law that estimates z, z_dot and i; default: `Direct`")
    position: PositionLaw = part(default=_LEFT_OUT, doc="law that computes v_star; default: `SlidingMode`")
    inversion: InversionLaw = part(default=_LEFT_OUT, doc="law that computes i_ref; default: `Adaptive`")
    current: CurrentLaw = part(default=_LEFT_OUT, doc="law that computes u; default: `SlidingMode`")
    model: Plant = part(default=Plant(), doc="the nominal plant")
    processor: Processor | None = part(default=None, doc="processor of the controller; None: continuous time")
    notch: SynchronousNotch | None = part(default=None, doc="notch at the speed of the rotor; None: no notch")

    def __post_init__(self) -> None:
        for stage, kind in DEFAULT_LAWS.items():
            if getattr(self, stage) is _LEFT_OUT:
                object.__setattr__(self, stage, default_law(kind, self.model))

    def init(self, measured: Measurement, reference: Reference | None = None) -> CascadeState:
        """Return the states of all laws at t = 0, in continuous time or on the processor.

        `measured`: the first measurement, from which the observer starts. `reference`: the reference and its rates at
        t = 0; in continuous time, the initial state of the position law may depend on them (`PositionLaw.begin`). On a
        processor, `begun` gives the states of the first sample.
        """
        observed = extremes(self.observer)[0].init(self.model, measured)
        observed = observed if self.notch is None else (observed, self.notch.init(measured))
        rest = [extremes(law)[0] for law in self.laws[1:]]
        if self.sampled:
            return CascadeState(observed, *(law.init_sampled(self.model) for law in rest))
        states = [law.init(self.model) for law in rest]
        if reference is not None:
            estimate, _ = self.observed(measured, observed, reference)
            states[0] = self.begun_position(estimate, reference, None)
        return CascadeState(observed, *states)

    def begun(self, measured: Measurement, sample: Sample, laws: CascadeState, started: Array) -> CascadeState:
        """Return the states of all laws with which a processor steps at a sample.

        They are `laws` if `started`; otherwise the initial states for these readings and the first estimate.
        """
        laws = choose(started, laws, self.init(measured))
        estimate, *_ = self.estimate(measured, laws.observer, sample)
        begun = self.begun_position(estimate, sample.reference, sample.period)
        return laws._replace(position=choose(started, laws.position, begun))

    def begun_position(self, estimate: Measurement, reference: Reference, period: Scalar | None) -> Any:
        """Return the first state of the position law, on a processor with this period (s) or in continuous time."""
        law = with_gains_at(self.position, estimate.z, reference)
        return law.first_state(self.model, (estimate, reference), period, self.timing.implicit)

    def scale(self) -> CascadeState:
        """Return the characteristic size of each state of the laws; integration errors are relative to it."""
        laws = [extremes(law)[0] for law in self.laws]
        sizes = [(one.scale_sampled if self.sampled else one.scale)(self.model) for one in laws]
        if self.notch is not None:
            sizes[0] = sizes[0], self.notch.scale(self.model)
        return CascadeState(*sizes)

    def layer(self) -> CascadeState:
        """Return `Law.layer` of all laws; with schedules, the smaller of the two values of `extremes`."""
        layers = ([one.layer(self.model) for one in extremes(law)] for law in self.laws)
        least = [jax.tree.map(lambda *x: functools.reduce(jnp.minimum, x), *each) for each in layers]
        if self.notch is not None:
            least[0] = least[0], jax.tree.map(lambda x: jnp.inf * jnp.ones_like(x), self.notch.scale(self.model))
        return CascadeState(*least)

    def slopes(self) -> dict[str, Scalar]:
        """Return the fastest rate of each law in closed loop (slope), 1/s, by the name of its stage."""
        laws = zip(CascadeState._fields, map(extremes, self.laws), strict=True)
        return {stage: functools.reduce(jnp.maximum, [one.slope(self.model) for one in ends]) for stage, ends in laws}

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        """Return the sliding variable of the position law (m/s) for a motion (m, m/s, A) and a reference (m)."""
        return with_gains_at(self.position, motion.z, reference).sigma(motion, reference)

    @property
    def laws(self) -> tuple[Observer, PositionLaw, InversionLaw, CurrentLaw]:
        return self.observer, self.position, self.inversion, self.current

    def turning(self, rotor: Rotation | None) -> "Cascade":
        """Return the cascade whose notch has the speed of this rotor; None, or no notch: the cascade itself."""
        if self.notch is None or rotor is None:
            return self
        return dataclasses.replace(self, notch=dataclasses.replace(self.notch, rotor=rotor))

    def at_speed(self, speed: Scalar | None = None) -> "Cascade":
        """Return the cascade whose notch has a constant speed (rpm); None: that at t = 0."""
        return self if self.notch is None else dataclasses.replace(self, notch=self.notch.at(speed))

    @property
    def sampled(self) -> bool:
        return self.processor is not None

    @property
    def timing(self) -> Processor:
        """The field `processor`; in continuous time, a processor without delay, prediction and guard."""
        return self.processor or _CONTINUOUS

    def with_processor(self, **fields: object) -> "Cascade":
        """Return the cascade with other fields of its processor. In continuous time, it does not change."""
        return dataclasses.replace(self, processor=self.processor and replaced(self.processor, **fields))

    def driven(self, u: Array, state: NominalState) -> NominalState:
        return self.current.driven(self.model, u, state)

    def demand(
        self, measured: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[ForceDemand, Measurement, CascadeState, Measurement]:
        """Pass the readings through observer and position law. The arguments are those of `step`.

        Returns the demanded force, the estimate, the states of all laws with the next ones (in continuous time: the
        rates) of observer and position law, and the estimate at the sample itself.
        The rates of z and v_star in the demanded force are total derivatives in time: they include the rates of the
        reference, z_dot, the nominal z_ddot and the rates of the states of the laws. Static inversions and the adaptive
        inversion with feed-forward use them to compute i_ref'; XLA removes them for other laws. If the observer
        estimates the velocity, this estimate is the rate of z, and the rates of the observer's states are not included.
        """
        period, estimated = sample.period, self.observer.estimates_velocity

        def demanded(
            reference: Reference, z: Array, z_dot: Array, observed: object, positioned: object
        ) -> tuple[tuple[Array, Array], tuple[Measurement, Measurement, object, object]]:
            reading, at = Measurement(z, z_dot, measured.i), sample._replace(reference=reference)
            estimate, observed, now = self.estimate(reading, observed, at)
            if period is None and estimated:
                # XLA aborts when it compiles a one-kernel rollout (`compiler.fast_path`) in which z_dot is unused
                estimate = estimate._replace(z_dot=estimate.z_dot + 0.0 * z_dot)
            v_star, positioned = self.positioned(estimate, reference, positioned, period)
            return (estimate.z, v_star), (now, estimate, observed, positioned)

        point = (sample.reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (now, estimate, *after) = demanded(*point)
        z_ddot, rates = self.model.z_ddot(estimate.z, estimate.i), list[Any](after)
        if period is not None:
            rates = jax.tree.map(lambda a, b: (b - a) / period, [state.observer, state.position], after)
        if estimated:
            law = functools.partial(self.positioned, period=period)
            z_rate, v_star_rate = rates_along(law, estimate, z_ddot, sample.reference, state.position, rates[1])
        else:
            if self.notch is not None:  # a notch adds no motion
                rates[0] = rates[0][0], jax.tree.map(jnp.zeros_like, rates[0][1])
            along = (sample.reference.rate(), measured.z_dot, z_ddot, *rates)
            z_rate, v_star_rate = jax.jvp(lambda *x: demanded(*x)[0], point, along)[1]
        v_star = v_star if period is None else materialised(v_star)
        force = ForceDemand(z, z_rate, v_star, v_star_rate, self.model.gaps(z))
        return force, estimate, state._replace(observer=after[0], position=after[1]), now

    def observed(
        self, measured: Measurement, state: Any, reference: Reference, period: Scalar | None = None
    ) -> tuple[Measurement, Any]:
        """Pass the readings through the notch and the observer.

        Returns the estimate, and the next states of both; in continuous time (`period` is None), their rates.
        """
        observer = with_gains_at(self.observer, measured.z, reference)
        own, notched = state if self.notch is not None else (state, state)
        if self.notch is not None:
            through = self.notch if period is None else functools.partial(self.notch.step, period=period)
            z, notched = through(measured, notched)
            measured = measured._replace(z=z)
        estimate, own = self._acting(period)(observer, measured, own)
        return estimate, own if self.notch is None else (own, notched)

    def positioned(
        self, estimate: Measurement, reference: Reference, state: State, period: Scalar | None = None
    ) -> tuple[Array, State]:
        """Return v_star (A^2/m^2), and the next state of the position law, or without a period its rate."""
        law = with_gains_at(self.position, estimate.z, reference)
        return self._acting(period)(law, (estimate, reference), state)

    def on_processor(self, *delays: Scalar, between: bool = False) -> "Cascade":
        """Fix all choices that determine the compiled program, so that the cascade can be used in jit, grad or vmap.

        A sign with steepness inf becomes set-valued. The program also supports the delays `delays` (samples) and, if
        `between` is true, every delay between them. With another delay set inside jit, grad or vmap, a rollout is lost
        at t = 0 with z = NaN. Raises ValueError as `Processor.resolved` does.
        """
        laws = {stage: with_set_valued_signs(getattr(self, stage)) for stage in DEFAULT_LAWS}
        return dataclasses.replace(self, **laws, processor=self.timing.resolved(*delays, between=between))

    def in_continuous_time(self) -> "Cascade":
        """Return the cascade without its processor. A steepness of inf becomes the default steepness for the model."""
        smooth = {stage: with_default_steepness(getattr(self, stage), self.model) for stage in DEFAULT_LAWS}
        laws = {stage: law.in_continuous_time() for stage, law in smooth.items()}
        return dataclasses.replace(self, **laws, processor=None)

    def _acting(self, period: Scalar | None) -> Callable[..., Any]:
        return functools.partial(step_law, model=self.model, period=period, implicit=self.timing.implicit)

    def estimate(self, measured: Measurement, state: State, sample: Sample) -> tuple[Measurement, State, Measurement]:
        """Pass the readings through the observer, and predict.

        Returns the estimate for the other laws (with prediction: at the end of the delay), the next state of the
        observer (in continuous time: its rate), and the estimate at the sample itself.
        """
        now, state = self.observed(measured, state, sample.reference, sample.period)
        if sample.period is None or not self.timing.predicts:
            return now, state, now
        steps = self.timing.prediction_steps(sample.period)
        return predicted_over_delay(self.model, self.driven, now, sample.past, steps), state, now

    def step(
        self, measured: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[Command, CascadeState, Measurement]:
        """Step all laws on a processor.

        `measured`: readings of z (m), z_dot (m/s) and i (A). `state`: states of all laws. With prediction, all laws
        except the observer use the estimate at the end of the delay. Returns the command, the next states of the laws
        (in continuous time: their rates), and the observer's estimate at the sample itself.
        """
        force, estimate, after, now = self.demand(measured, state, sample)
        return *self.commanded(force, estimate, after, sample), now

    def commanded(
        self, force: ForceDemand, estimate: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[Command, CascadeState]:
        """Pass a demanded force through inversion and current law; the other states do not change.

        Returns the command, and the next states of both laws; in continuous time, their rates.
        """
        act = self._acting(sample.period)
        inversion = with_gains_at(self.inversion, force.z, sample.reference)
        current = with_gains_at(self.current, force.z, sample.reference)
        demand, inverted = act(inversion, force, state.inversion)
        u, driven = act(current, CurrentInputs(estimate, demand, sample.u_max, force.gaps), state.current)
        v_tilde = force.v_star - self.model.v_and_dv_di(force.z, demand.i_ref, force.gaps)[0]
        after = state._replace(inversion=inverted, current=driven)
        return Command(force.v_star, v_tilde, demand.i_ref, demand.i_ref_dot, u), after

    def __call__(
        self, measured: Measurement, state: CascadeState, reference: Reference, u_max: Scalar
    ) -> tuple[Command, CascadeState]:
        """Return the command in continuous time and the rates of the states of all laws, as `step` does.

        `u_max`: limit of u: of the supply, V, or of the commanded current, A; inf: none.
        """
        return self.step(measured, state, Sample(reference, None, u_max))[:2]
