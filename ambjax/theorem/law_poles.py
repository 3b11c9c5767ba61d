"""Poles of each law on a processor: of its own step, in a loop with an ideal plant.

The step of a law is differentiated, so a sign counts with its slope inside the boundary layer or the band. A position
law controls the rotor by a force that acts at once, a current law controls the current of the nominal plant. Both act
after the delay of the processor. An observer and an inversion law act on their own states, without delay.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.base import Law, set_valued_signs, steepnesses
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState
from ambjax.control.sampling import Sampling
from ambjax.control.schedule import extremes
from ambjax.control.stages import CurrentDemand, CurrentInputs, ForceDemand, PositionLaw, step_law
from ambjax.simulation.clock import Clock
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# A pole closer to 1 than this number is at rest, as that of an integral with a negligible gain.
ROUNDING = 1e-9
# Smallest damping ratio of a stable law. A law below it is at its limit: dead-beat control whose output acts one sample
# late, for example, oscillates with a period of six samples, and only the resistance of the coil damps it.
LEAST_DAMPING = 0.01
# A loop: the map of its state over one sample, and its state at rest.
Loop = tuple[Callable[[Array], Array], Array]


@dataclasses.dataclass(frozen=True)
class LawPoles:
    """The poles of a law on a processor, in the z-plane.

    `implicit`: whether the law makes an implicit step. `radius`: largest magnitude of a pole; inf for an explicit step
    of a set-valued sign. `damping`: smallest damping ratio of a pole, -Re(s)/|s| for z = exp(s); 1 if no pole
    oscillates. `remedies`: what to change if the law is not stable, and the case does not have yet.
    """

    stage: str
    implicit: bool
    radius: float
    damping: float
    remedies: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the law, without the other laws, is stable, and oscillations decay."""
        return self.radius < 1 and self.damping >= LEAST_DAMPING


def law_poles(cascade: Cascade, clock: Clock) -> list[LawPoles]:
    """Return the poles of every law that has gains. `cascade`: of one member.

    A position law that demands a voltage has no row, because its plant includes the current.
    """
    sampling, cascade, lines = sampling_of(cascade, clock), cascade.on_processor(), []
    for stage, law in zip(CascadeState._fields, cascade.laws, strict=True):
        gains = any("steepness" in field.metadata for field in dataclasses.fields(law))
        if not gains or (isinstance(law, PositionLaw) and law.demand == "voltage"):
            continue
        implicit, remedies = law.has_own_step(sampling.implicit), _remedies(stage, law, cascade, sampling)
        if set_valued_signs(law) and not implicit:
            lines.append(LawPoles(stage, implicit, math.inf, -1.0, remedies))
            continue
        poles = np.concatenate([_poles(stage, one, cascade.model, sampling) for one in extremes(law)])
        poles = poles[np.abs(poles - 1) > ROUNDING]
        s = np.log(np.where(np.abs(poles) > 1e-300, poles, 1e-300) + 0j)
        damping = float(np.min(-np.real(s) / np.abs(s), initial=1.0))
        lines.append(LawPoles(stage, implicit, float(np.max(np.abs(poles), initial=0.0)), damping, remedies))
    return lines


def _remedies(stage: str, law: Law, cascade: Cascade, sampling: Sampling) -> tuple[str, ...]:
    """Return what makes the poles of a law slower or better damped: only what is not set and affects this law."""
    implicit = not sampling.implicit and law.has_own_step(True)
    predict = bool(LOOPS[stage][1]) and sampling.late > 0 and not cascade.timing.predicts
    keys = ['discretisation = "implicit"'] * implicit + ["predict = true"] * predict
    gains = "lower the gain or p" if steepnesses(law) else "lower the gains"
    return (gains, "shorten clock.sample_period", *[f"set {' and '.join(keys)}"] * bool(keys))


def _poles(stage: str, law: Law, model: Plant, sampling: Sampling) -> np.ndarray:
    """Return the poles of a loop. States that its signals do not change, or that do not change them, have none."""
    A, signals = np.asarray(_matrix(law, model, stage=stage, sampling=sampling)), LOOPS[stage][1]
    changing = (np.eye(len(A)) != A).any(1)
    used = _reached(A, signals) & _reached(A.T, signals) if signals else changing
    return np.linalg.eigvals(A[used][:, used])


@functools.partial(compiled_quickest, static_argnames=("stage", "sampling"))
def _matrix(law: Law, model: Plant, *, stage: str, sampling: Sampling) -> Array:
    step, start = LOOPS[stage][0](law, model, sampling)
    return jax.jacfwd(step)(start)


def _reached(A: np.ndarray, signals: int) -> np.ndarray:
    """Return which states the first `signals` states change, over any number of samples."""
    reached = np.arange(len(A)) < signals
    for _ in A:
        reached = reached | (A[:, reached] != 0).any(1)
    return reached


def sampling_of(cascade: Cascade, clock: Clock) -> Sampling:
    """Return the sampling of the laws of a cascade with a processor."""
    return cascade.on_processor().timing.sampling(clock.sample_period)


def _advance(law: Law, model: Plant, sampling: Sampling) -> Callable[..., Any]:
    return functools.partial(step_law, law, model=model, period=sampling.period, implicit=sampling.implicit)


def _rest(model: Plant) -> tuple[Measurement, Array, Reference]:
    """Return the motion at rest at z = 0, the scaled force that carries the weight (A^2/m^2), and the reference 0."""
    zero, i = jnp.zeros(()), jnp.asarray(model.equilibrium(0.0)[0])
    return Measurement(zero, zero, i), jnp.asarray(model.g / model.a), Reference(zero, zero, zero)


def _state(state: Any) -> tuple[Array, Callable[[Array], Any]]:
    return ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, float), state))


def _observer(law: Any, model: Plant, sampling: Sampling) -> Loop:
    rest, _, _ = _rest(model)
    start, restore = _state(law.init(model, rest))
    return lambda x: ravel_pytree(_advance(law, model, sampling)(rest, restore(x))[1])[0], start


def _inversion(law: Any, model: Plant, sampling: Sampling) -> Loop:
    rest, v, _ = _rest(model)
    zero = jnp.zeros(())
    start, restore = _state(law.started(rest.i).init_sampled(model))
    demand = ForceDemand(rest.z, zero, v, zero)
    return lambda x: ravel_pytree(_advance(law, model, sampling)(demand, restore(x))[1])[0], start


def _position(law: Any, model: Plant, sampling: Sampling) -> Loop:
    """Return the loop of a rotor under the demanded force. State: z, z_dot, the law's, the past demands."""
    _, v, reference = _rest(model)
    laws, restore = _state(law.init_sampled(model))
    T, weights, kept = sampling.period, _weights(sampling.late), _kept(sampling.late)

    def step(x: Array) -> Array:
        z, z_dot, past = x[0], x[1], tuple(x[-kept:])
        at_sample = past[kept - 1]  # the demand that acts at the sample
        motion = Measurement(z, z_dot, model.current_for(z, at_sample))
        v_star, after = _advance(law, model, sampling)((motion, reference), restore(x[2:-kept]))
        for share, force in reversed(list(zip(weights, (v_star, *past), strict=True))):
            rate, h = model.a * force + 2 * model.k_z / model.m * z - model.g, share * T
            z, z_dot = z + h * z_dot + h * h / 2 * rate, z_dot + h * rate
        return ravel_pytree((z, z_dot, after, (v_star, *past)[:kept]))[0]

    return step, jnp.concatenate([jnp.zeros(2), laws, jnp.full(kept, v)])


def _current(law: Any, model: Plant, sampling: Sampling) -> Loop:
    """Return the loop of the current at z = 0. State: i, the law's, the past commands."""
    rest, _, _ = _rest(model)
    demand, laws = CurrentDemand(rest.i, jnp.zeros(())), law.init_sampled(model)
    start, restore = _state(laws)
    u = _advance(law, model, sampling)(CurrentInputs(rest, demand, jnp.inf), laws)[0]
    weights, kept = _weights(sampling.late), _kept(sampling.late)

    def rate(i: Array, u: Array) -> Array:
        return law.driven(model, u, model.start(rest._replace(i=i))).i

    decay, gain = jax.grad(rate, (0, 1))(rest.i, u)

    def step(x: Array) -> Array:
        i, past = x[0], tuple(x[-kept:])
        inputs = CurrentInputs(rest._replace(i=i), demand, jnp.inf)
        command, after = _advance(law, model, sampling)(inputs, restore(x[1:-kept]))
        for share, voltage in reversed(list(zip(weights, (command, *past), strict=True))):
            h = share * sampling.period
            reach = jnp.where(decay == 0, h, jnp.expm1(decay * h) / decay)
            i = i + reach * (rate(rest.i, u) + decay * (i - rest.i) + gain * (voltage - u))
        return ravel_pytree((i, after, (command, *past)[:kept]))[0]

    return step, jnp.concatenate([rest.i[None], start, jnp.full(kept, u)])


def _kept(late: float) -> int:
    """Return the number of past outputs that a loop needs whose outputs begin to act `late` samples later."""
    return max(math.ceil(late), 1)


def _weights(late: float) -> list[float]:
    """Return the shares of a sample in which its own output and the past ones act, if an output begins to act `late`
    samples after it was computed. The oldest acts first.
    """
    return [max(1 - abs(late - lag), 0.0) for lag in range(_kept(late) + 1)]


# The loop of each stage, and the number of signals that its law controls. They are the first components of its state.
# If there are none, the law acts on its own states.
LOOPS: dict[str, tuple[Callable[[Any, Plant, Sampling], Loop], int]] = {
    "observer": (_observer, 0),
    "position": (_position, 2),
    "inversion": (_inversion, 0),
    "current": (_current, 1),
}
