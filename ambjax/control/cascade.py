"""The cascade: an observer, a position law, an inversion law and a current law in series, with a nominal plant.

The laws of the stages can be combined freely (the first contribution of the paper).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control import current, inversion, observer, position
from ambjax.control.base import default_law, set_valued_signs, with_default_steepness, with_set_valued_signs
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
    begin_law,
    step_law,
)
from ambjax.control.synchronous_notch import SynchronousNotch
from ambjax.numerics.records import Scalar, is_traced, part, record, replaced
from ambjax.world.plant import Plant
from ambjax.world.plant import State as NominalState
from ambjax.world.rotation import Rotation
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# In place of a processor in continuous time: no delay, no prediction and no guard.
_CONTINUOUS = Processor(delay=0.0, predict=False, guard=None)
# Marks a law that is not given. `Cascade.__post_init__` replaces it by the default law.
_LEFT_OUT: Any = None
# The default law of each stage.
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
            position = with_gains_at(self.position, estimate.z, reference)
            states[0] = position.begin(self.model, (estimate, reference))
        return CascadeState(observed, *states)

    def begun(self, measured: Measurement, sample: Sample, laws: CascadeState, started: Array) -> CascadeState:
        """Return the states of all laws with which a processor steps at a sample.

        They are `laws` if `started`; otherwise the initial states for these readings. The position law starts from its
        first estimate (`laws.begin_law`).
        """
        laws = _chosen(started, laws, self.init(measured))
        estimate, *_ = self.estimate(measured, laws.observer, sample)
        position = with_gains_at(self.position, estimate.z, sample.reference)
        inputs, implicit = (estimate, sample.reference), self.timing.implicit
        begun = begin_law(position, inputs, model=self.model, period=sample.period, implicit=implicit)
        return laws._replace(position=_chosen(started, laws.position, begun))

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
        """The four laws in order."""
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
        """Whether the laws run on a processor."""
        return self.processor is not None

    @property
    def timing(self) -> Processor:
        """The field `processor`; in continuous time, a processor without delay, prediction and guard."""
        return self.processor or _CONTINUOUS

    def with_processor(self, **fields: object) -> "Cascade":
        """Return the cascade with other fields of its processor. In continuous time, it does not change."""
        return dataclasses.replace(self, processor=self.processor and replaced(self.processor, **fields))

    def driven(self, u: Array, state: NominalState) -> NominalState:
        """Return the rates of the nominal plant under the command u, V or A."""
        return self.current.driven(self.model, u, state)

    def demand(
        self, measured: Measurement, state: CascadeState, reference: Reference
    ) -> tuple[ForceDemand, Measurement, CascadeState]:
        """Return the demanded force, the observer's estimate, and the rates of the states of observer and position law.

        `measured`: readings of z (m), z_dot (m/s) and i (A). `state`: states of all laws. `reference`: r and its rates.
        The rates of z and v_star in the demanded force are total derivatives in time: they include the rates of the
        reference, z_dot, the nominal z_ddot and the rates of the states of the laws. Static inversions and the adaptive
        inversion with feed-forward use them to compute i_ref'; XLA removes them for other laws. If the observer
        estimates the velocity, this estimate is the rate of z, and the rates of the observer's states are not included.

        The returned rates of the inversion and current laws are ().
        """

        def demanded(
            reference: Reference, z: Array, z_dot: Array, observed: object, positioned: object
        ) -> tuple[tuple[Array, Array], tuple[Measurement, object, object]]:
            estimate, observed_rate = self.observed(Measurement(z, z_dot, measured.i), observed, reference)
            if self.observer.estimates_velocity:
                # XLA aborts when it compiles a one-kernel rollout (`compiler.fast_path`) in which z_dot is unused
                estimate = estimate._replace(z_dot=estimate.z_dot + 0.0 * z_dot)
            v_star, positioned_rate = self._demanded(estimate, reference, positioned)
            return (estimate.z, v_star), (estimate, observed_rate, positioned_rate)

        point = (reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (estimate, observed_rate, positioned_rate) = demanded(*point)
        gaps = self.model.gaps(estimate.z)
        z_ddot = self.model.z_ddot(estimate.z, estimate.i)
        if self.observer.estimates_velocity:
            point = (estimate, z_ddot, reference, state.position, positioned_rate)
            z_rate, v_star_rate = rates_along(self._demanded, *point)
        else:
            along = (reference.rate(), measured.z_dot, z_ddot, self._observer_rate(observed_rate), positioned_rate)
            z_rate, v_star_rate = jax.jvp(lambda *x: demanded(*x)[0], point, along)[1]
        rates = CascadeState(observed_rate, positioned_rate, (), ())
        return ForceDemand(z, z_rate, v_star, v_star_rate, gaps), estimate, rates

    def observed(
        self, measured: Measurement, state: Any, reference: Reference, sample: Sample | None = None
    ) -> tuple[Measurement, Any]:
        """Pass the readings through the notch and the observer.

        Returns the estimate, and the next states of both; in continuous time (`sample` is None), their rates.
        """
        observer = with_gains_at(self.observer, measured.z, reference)
        own, notched = state if self.notch is not None else (state, state)
        if self.notch is not None:
            through = self.notch if sample is None else functools.partial(self.notch.step, period=sample.period)
            z, notched = through(measured, notched)
            measured = measured._replace(z=z)
        if sample is None:
            estimate, own = observer(self.model, measured, own)
        else:
            estimate, own = self._advance(sample)(observer, measured, own)
        return estimate, own if self.notch is None else (own, notched)

    def _observer_rate(self, rate: Any) -> Any:
        """Return the rate of the states of observer and notch for the rate of z: a notch adds no motion."""
        return rate if self.notch is None else (rate[0], jax.tree.map(jnp.zeros_like, rate[1]))

    def _demanded(self, estimate: Measurement, reference: Reference, state: State) -> tuple[Array, State]:
        """Return v_star (A^2/m^2) and the rate of the state of the position law."""
        return with_gains_at(self.position, estimate.z, reference)(self.model, (estimate, reference), state)

    def on_processor(self, *delays: Scalar, between: bool = False) -> "Cascade":
        """Fix all choices that determine the compiled program, so that the cascade can be used in jit, grad or vmap.

        A sign with steepness inf becomes set-valued. The program also supports the delays `delays` (samples) and, if
        `between` is true, every delay between them. With another delay set inside jit, grad or vmap, a rollout is lost
        at t = 0 with z = NaN. Raises ValueError as `Processor.resolved` does.
        """
        laws = {stage: with_set_valued_signs(getattr(self, stage)) for stage in DEFAULT_LAWS}
        return dataclasses.replace(self, **laws, processor=self.timing.resolved(*delays, between=between))

    def reads_velocity(self, period: Scalar) -> bool:
        """Return whether the command or a state of a law depends on the measured velocity.

        `period`: sample period, s. True if a number is traced, because the laws are then not evaluated. Otherwise the
        laws of the first member are evaluated at three velocities, and the results compared.
        """
        if self.observer.estimates_velocity or self.timing.predicts:
            return not self.observer.estimates_velocity
        if any(map(is_traced, jax.tree.leaves((self, period)))):
            return True
        one = self.on_processor() if self.sampled else self
        one, period = jax.tree.map(lambda x: np.ravel(np.asarray(x, float))[0], (one, period))
        z, z_dot, i = (float(x) for x in one.model.sizes())
        results = [
            one._response(Measurement(jnp.asarray(z), jnp.asarray(v), jnp.asarray(i)), period)
            for v in (-1e3 * z_dot, z_dot, 1e3 * z_dot)
        ]
        return len({tuple(map(float, jax.tree.leaves(result))) for result in results}) > 1

    def _response(self, measured: Measurement, period: Scalar) -> Any:
        """Return the command, and the next states or the rates of the states, for the first reading at z = 0."""
        zero = jnp.zeros(())
        reference, still = Reference(zero, zero, zero), measured._replace(z_dot=zero)
        state = self.init(still, reference)
        if not self.sampled:
            command, after = self(measured, state, reference, jnp.inf)
        else:
            sample = Sample(reference, period, jnp.inf, self.timing.constant_past(zero))
            command, after, _ = self.step(measured, state, sample)
        return command.u, after

    def check_smooth(self) -> None:
        """Raise ValueError for a law with a steepness of inf: in continuous time a sign must be smoothed."""
        for stage in DEFAULT_LAWS:
            law = getattr(self, stage)
            for name in set_valued_signs(law):
                raise ValueError(
                    f"controller.{stage}.{name} = inf: in continuous time a sign must be smoothed. Give a finite "
                    "number, or add [processor], which allows the set-valued sign."
                )

    def in_continuous_time(self) -> "Cascade":
        """Return the cascade without its processor. A steepness of inf becomes the default steepness for the model."""
        laws = {
            stage: with_default_steepness(getattr(self, stage), self.model).in_continuous_time()
            for stage in DEFAULT_LAWS
        }
        return dataclasses.replace(self, **laws, processor=None)

    def _advance(self, sample: Sample) -> Callable[..., Any]:
        """Return `laws.step_law` with the model and the discretisation of this cascade, and the period of `sample`."""
        return functools.partial(step_law, model=self.model, period=sample.period, implicit=self.timing.implicit)

    def estimate(self, measured: Measurement, state: State, sample: Sample) -> tuple[Measurement, State, Measurement]:
        """Step the observer on a processor.

        Returns the estimate for the other laws (with prediction: at the end of the delay), the next state of the
        observer, and the estimate at the sample itself.
        """
        now, state = self.observed(measured, state, sample.reference, sample)
        estimate = now
        if self.timing.predicts:
            steps = self.timing.prediction_steps(sample.period)
            estimate = predicted_over_delay(self.model, self.driven, now, sample.past, steps)
        return estimate, state, now

    def positioned(
        self, sample: Sample, estimate: Measurement, reference: Reference, state: State
    ) -> tuple[Array, State]:
        """Step the position law on a processor. Return v_star (A^2/m^2), and the next state of the law."""
        law = with_gains_at(self.position, estimate.z, reference)
        return self._advance(sample)(law, (estimate, reference), state)

    def step(
        self, measured: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[Command, CascadeState, Measurement]:
        """Step all laws on a processor.

        `measured`: the readings. `state`: states of all laws. `sample`: reference, period, limit of u, past commands.
        With prediction, all laws except the observer use the estimate at the end of the delay. Returns the command, the
        next states of the laws, and the observer's estimate at the sample itself.
        """
        force_for = functools.partial(self.positioned, sample)

        def demanded(
            reference: Reference, z: Array, z_dot: Array, observed: object, positioned: object
        ) -> tuple[tuple[Array, Array], tuple[Measurement, Measurement, object, object]]:
            reading, at = Measurement(z, z_dot, measured.i), sample._replace(reference=reference)
            estimate, observed, now = self.estimate(reading, observed, at)
            v_star, positioned = force_for(estimate, reference, positioned)
            return (estimate.z, v_star), (now, estimate, observed, positioned)

        point = (sample.reference, measured.z, measured.z_dot, state.observer, state.position)
        (z, v_star), (now, estimate, observed, positioned) = demanded(*point)
        # The adaptive inversion with feed-forward needs the rates of z and v_star; XLA removes them for other laws.
        z_ddot = self.model.z_ddot(estimate.z, estimate.i)
        rates = jax.tree.map(
            lambda a, b: (b - a) / sample.period, (state.observer, state.position), (observed, positioned)
        )
        if self.observer.estimates_velocity:
            z_rate, v_star_rate = rates_along(force_for, estimate, z_ddot, sample.reference, state.position, rates[1])
        else:
            along = (sample.reference.rate(), measured.z_dot, z_ddot, self._observer_rate(rates[0]), rates[1])
            z_rate, v_star_rate = jax.jvp(lambda *x: demanded(*x)[0], point, along)[1]
        v_star = materialised(v_star)
        force = ForceDemand(z, z_rate, v_star, v_star_rate, self.model.gaps(z))
        command, after = self.commanded(force, estimate, state, sample)
        return command, after._replace(observer=observed, position=positioned), now

    def commanded(
        self, force: ForceDemand, estimate: Measurement, state: CascadeState, sample: Sample
    ) -> tuple[Command, CascadeState]:
        """Step inversion and current law on a processor for a demanded force; the other states do not change."""
        advance = self._advance(sample)
        inversion = with_gains_at(self.inversion, force.z, sample.reference)
        current = with_gains_at(self.current, force.z, sample.reference)
        demand, inverted = advance(inversion, force, state.inversion)
        u, driven = advance(current, CurrentInputs(estimate, demand, sample.u_max, force.gaps), state.current)
        v_tilde = force.v_star - self.model.v_and_dv_di(force.z, demand.i_ref, force.gaps)[0]
        after = state._replace(inversion=inverted, current=driven)
        return Command(force.v_star, v_tilde, demand.i_ref, demand.i_ref_dot, u), after

    def __call__(
        self, measured: Measurement, state: CascadeState, reference: Reference, u_max: Scalar
    ) -> tuple[Command, CascadeState]:
        """Return the command in continuous time and the rates of the states of all laws.

        `measured`: readings of z (m), z_dot (m/s) and i (A). `state`: states of all laws. `reference`: r and its rates.
        `u_max`: limit of u: of the supply, V, or of the commanded current, A; inf: none.
        """
        force, estimate, rates = self.demand(measured, state, reference)
        command, inner = self.command_rates(force, estimate, state, reference, u_max)
        return command, rates._replace(inversion=inner.inversion, current=inner.current)

    def command_rates(
        self, force: ForceDemand, estimate: Measurement, state: CascadeState, reference: Reference, u_max: Scalar
    ) -> tuple[Command, CascadeState]:
        """Return the command in continuous time for a demanded force, and the rates; those of the others are ()."""
        inversion = with_gains_at(self.inversion, force.z, reference)
        current = with_gains_at(self.current, force.z, reference)
        demand, inversion_rate = inversion(self.model, force, state.inversion)
        u, current_rate = current(self.model, CurrentInputs(estimate, demand, u_max, force.gaps), state.current)
        v_tilde = force.v_star - self.model.v_and_dv_di(force.z, demand.i_ref, force.gaps)[0]
        command = Command(force.v_star, v_tilde, demand.i_ref, demand.i_ref_dot, u)
        return command, CascadeState((), (), inversion_rate, current_rate)


def _chosen(condition: Array, yes: State, no: State) -> State:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def rates_along(
    law: Callable[..., tuple[Array, State]],
    estimate: Measurement,
    z_ddot: Array,
    reference: Reference,
    state: State,
    rate: State,
) -> tuple[Array, Array]:
    """Return the rates of z (m/s) and v_star (A^2/m^2/s) if the estimate moves with its own z_dot and with `z_ddot`."""

    def v_star(reference: Reference, z: Array, z_dot: Array, state: State) -> Array:
        return law(Measurement(z, z_dot, estimate.i), reference, state)[0]

    point = (reference, estimate.z, estimate.z_dot, state)
    return estimate.z_dot, jax.jvp(v_star, point, (reference.rate(), estimate.z_dot, z_ddot, rate))[1]
