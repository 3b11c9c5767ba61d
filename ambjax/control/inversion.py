"""Inversion laws: the reference current for a demanded force."""

import abc
import dataclasses
import functools
from typing import ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.base import Requirement, scaled_steepness
from ambjax.control.defaults import adaptation_gain, sign_steepness
from ambjax.control.sampling import Relay, Sampling
from ambjax.control.search import Interval, SearchContext, steepness
from ambjax.control.stages import CurrentDemand, ForceDemand, InversionLaw, Relaxation, Stateless, no_slope
from ambjax.numerics.records import Scalar, bounded, gain, record
from ambjax.numerics.relax import relax, relaxation
from ambjax.numerics.smooth import TWO_OVER_PI, away_from_zero, smooth_sign
from ambjax.world.plant import Plant

# Lower bound of |dv/di| as a share of its value at the origin. Eq. (6) divides by zero on the singular curve C; with
# the bound the rate stays finite. `Trajectory.singular_at` is the time at which C is first crossed.
GRADIENT_FLOOR = 1e-4


def v_and_gradient(model: Plant, inputs: ForceDemand, i_ref: Array) -> tuple[Array, Array]:
    """Return v and dv/di at (z, i_ref), with |dv/di| bounded from below."""
    v, dv_di = model.v_and_dv_di(inputs.z, i_ref, inputs.gaps)
    return v, away_from_zero(dv_di, GRADIENT_FLOOR * 4 * model.i_0 / model.s_0**2)


@record
class AdaptiveReference(InversionLaw[Array]):
    """Base class of a law whose state is i_ref (A), moved by a smoothed sign of v_tilde with the gain gamma.

    The default gamma is 7.5e4 for the plant of Table 1. For other plants it is |dv/dz| w s_0 at the origin, where w is
    the pole of the magnets: gamma then exceeds Delta_1 of Eq. (7) up to the speed w s_0.
    """

    gamma: Scalar = gain(7.5e4, "A^2/m^2/s", "adaptation gain; above Delta_1 of Eq. (7); left out: 4 w (i_0/s_0)^2")
    p: Scalar = sign_steepness("sign of v_tilde", unit="m^2/A^2")
    printed: ClassVar = True
    i_ref: Scalar = bounded(0.0, "A", -1e6, 1e6, "initial current reference")
    memory = (("i_ref", "A", "current reference of the next sample"),)

    def designed(self, model: Plant, sampling: Sampling | None) -> Self:
        scaled = scaled_steepness(self, model)
        gamma, p = adaptation_gain(model), scaled.p
        if sampling is not None and not sampling.implicit:  # an explicit step then ends at v_tilde = 0
            p = min(float(p), 1 / (TWO_OVER_PI * float(gamma) * sampling.period))
        return dataclasses.replace(scaled, gamma=gamma, p=p)

    def init(self, model: Plant) -> Array:
        return jnp.asarray(self.i_ref)

    def started(self, i_ref: Array) -> Self:
        return dataclasses.replace(self, i_ref=i_ref)

    def scale(self, model: Plant) -> Scalar:
        return model.i_0 / 25

    def slope(self, model: Plant) -> Scalar:
        return TWO_OVER_PI * self.gamma * self.p

    def size(self, model: Plant) -> Scalar:
        return model.v_size

    def layer(self, model: Plant) -> Scalar:
        """Return 0.3 of the boundary layer in i_ref (A): its width in v_tilde is 1/p, in i_ref 1/(p dv/di(0, 0))."""
        return 0.3 / (self.p * model.dv_di(0.0, 0.0))


@record
class Adaptive(AdaptiveReference):
    """i_ref' = gamma sgn(v_star - v(z, i_ref)) / (dv/di)(z, i_ref), with i_ref as its state. Eq. (6), sgn smoothed.

    Deviation from the paper: the default gamma is 7.5e4, because the printed value, 1000, violates Eq. (7).

    Use it as the paper does: `Cascade(inversion=inversion.Adaptive(gamma=1e5))`.
    """

    analytic = True
    requirement: ClassVar = Requirement("gamma", "Delta_1")

    def __call__(self, model: Plant, inputs: ForceDemand, state: Array) -> tuple[CurrentDemand, Array]:
        v, gradient = v_and_gradient(model, inputs, state)
        rate = self.gamma * smooth_sign(inputs.v_star - v, self.p, per=gradient)
        return CurrentDemand(state, rate), rate

    def relay(self) -> Relay:
        return Relay(self.gamma, self.p)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        needed, symbol, source = context.delta_1
        times = 1000 if context.stepped else 100
        gamma = Interval(needed, times * needed, f"{symbol} to {times} {symbol}, {source}")
        return {"gamma": gamma, **steepness(context, "gamma")}

    def slide(self, model: Plant, begin: ForceDemand, end: ForceDemand, i_ref: Array, h: Scalar) -> Relaxation:
        """Integrate i_ref over a step: at its initial rate up to the boundary layer, then by one backward Euler step.

        Eq. (14a).
        """
        v_0, gradient_0 = v_and_gradient(model, begin, i_ref)
        v_1, gradient_1 = v_and_gradient(model, end, i_ref)
        w = begin.v_star - v_0
        drift = (end.v_star - v_1 - w) * (1 / jnp.where(h > 0, h, 1.0))
        sliding, slaved, turn, path = relaxation(w, drift, self.gamma, self.p, h)
        return Relaxation(sliding / gradient_0, slaved / gradient_1, turn, path)

    def step(self, model: Plant, inputs: ForceDemand, state: Array, period: Scalar) -> tuple[CurrentDemand, Array]:
        """Step v(z, i_ref) towards v_star; the sign is evaluated at the end of the step. gamma bounds the rate of v."""
        w = inputs.v_star - model.v_and_dv_di(inputs.z, state, inputs.gaps)[0]
        after = model.current_for(inputs.z, inputs.v_star - relax(w, period * self.gamma, self.p))
        return CurrentDemand(state, (after - state) * (1 / period)), after


@record
class FeedForwardAdaptive(AdaptiveReference):
    """i_ref' = (gamma sgn(w) + v_star' - dv/dz z')/(dv/di), w = v_star - v(z, i_ref): Eq. (6) with d of Eq. (8) added.

    The feed-forward of the rates of v_star and z cancels d, so that w' = -gamma sgn(w) on a known plant. gamma must
    therefore exceed only the error of these rates, not Delta_1 of Eq. (7). The rates are those of the nominal model.
    They add the noise of the velocity to i_ref'. In Eq. (6) this noise acts only inside the sign, through v_star.

    Use it where v_star changes fast and the velocity is known with little noise:
    `Cascade(inversion=inversion.FeedForwardAdaptive())`.
    """

    analytic = True
    gamma: Scalar = gain(7.5e4, "A^2/m^2/s", "adaptation gain; above the error of the rates; left out: 4 w (i_0/s_0)^2")

    def __call__(self, model: Plant, inputs: ForceDemand, state: Array) -> tuple[CurrentDemand, Array]:
        v, gradient = v_and_gradient(model, inputs, state)
        ahead = inputs.v_star_rate - model.dv_dz(inputs.z, state) * inputs.z_rate
        rate = self.gamma * smooth_sign(inputs.v_star - v, self.p, per=gradient) + ahead / gradient
        return CurrentDemand(state, rate), rate

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        needed, _, source = context.delta_1
        words = f"a hundredth to 100 times the bound without feed-forward: {source}"
        gamma = Interval(needed / 100, 100 * needed, words)
        return {"gamma": gamma, **steepness(context, "gamma")}

    def step(self, model: Plant, inputs: ForceDemand, state: Array, period: Scalar) -> tuple[CurrentDemand, Array]:
        """Step v towards v_star. z and v_star are extrapolated to the end of the step, where the sign is evaluated."""
        w = inputs.v_star - model.v_and_dv_di(inputs.z, state, inputs.gaps)[0]
        z, v_star = inputs.z + period * inputs.z_rate, inputs.v_star + period * inputs.v_star_rate
        after = model.current_for(z, v_star - relax(w, period * self.gamma, self.p))
        return CurrentDemand(state, (after - state) * (1 / period)), after


class StaticInversionState(NamedTuple):
    """State of a static inversion on a processor: i_ref (A), and a flag that is 0 before the first sample, then 1."""

    i_ref: Array
    begun: Array


class StaticInversion(Stateless, InversionLaw[tuple[()]]):
    """Base class of a law whose i_ref is a function of z and v_star.

    In continuous time the law has no state, and i_ref' is exact.

    On a processor, the law returns the i_ref that it computed at the last sample, and the rate i_ref' that moves i_ref
    to the new value in one period. The new value is the state of the law. Without this state, the current law would
    respond twice to each change of i_ref: to i_ref', and to the change itself.
    """

    analytic = True
    own_steps = ("implicit", "explicit")
    memory = (("i_ref", "A", "current reference of the next sample"), ("begun", "1", "1 after the first sample"))

    @abc.abstractmethod
    def inverse(self, model: Plant, z: Array, v_star: Array) -> Array:
        """Return the current (A) for a position and a demanded force."""

    def init_sampled(self, model: Plant) -> StaticInversionState:
        return StaticInversionState(jnp.zeros(()), jnp.zeros(()))

    def scale_sampled(self, model: Plant) -> StaticInversionState:
        return StaticInversionState(jnp.asarray(model.i_0 / 25), jnp.ones(()))

    slope = no_slope

    def __call__(self, model: Plant, inputs: ForceDemand, state: tuple[()]) -> tuple[CurrentDemand, tuple[()]]:
        at, along = (inputs.z, inputs.v_star), (inputs.z_rate, inputs.v_star_rate)
        return CurrentDemand(*jax.jvp(functools.partial(self.inverse, model), at, along)), ()

    def step(
        self, model: Plant, inputs: ForceDemand, state: StaticInversionState, period: Scalar
    ) -> tuple[CurrentDemand, StaticInversionState]:
        """Return i_ref of the last sample (at the first sample: its own), and the rate from it to the new i_ref."""
        after = self.inverse(model, inputs.z, inputs.v_star)
        i_ref = jnp.where(state.begun > 0.5, state.i_ref, after)
        return CurrentDemand(i_ref, (after - i_ref) * (1 / period)), StaticInversionState(after, jnp.ones(()))


@record
class ClosedForm(StaticInversion):
    """Static inversion: i_ref is the root of v(z, i_ref) = v_star that stays finite at z = 0, with its exact rate.

    The paper argues against this law (Mouille and Lottin 1992): it is exact on a known plant, but passes every jump of
    v_star, such as noise, directly to i_ref. It has no state in continuous time. On a processor it equals the adaptive
    law with gamma = inf after the first sample.

    Use it where v_star has little noise: `Cascade(inversion=inversion.ClosedForm())`.
    """

    def inverse(self, model: Plant, z: Array, v_star: Array) -> Array:
        return model.current_for(z, v_star)


@record
class Linearised(StaticInversion):
    """i_ref = (v_star - (dv/dz) z)/(dv/di), both derivatives at z = 0, i = 0: the textbook's linear magnet.

    In forces: i = (F + k_s z)/k_i, with the negative stiffness k_s and the force-current factor k_i (Schweitzer and
    Maslen, Magnetic Bearings, 2009, 2.1). With position.PID it is the loop of the textbook. The inversion error v_tilde
    is zero at z = 0, and for v_star = 0 at every z; elsewhere it is of third order in z and v_star.

    Use it for small displacements, or for a linear controller: `Cascade(inversion=inversion.Linearised())`.
    """

    accepts: ClassVar = ("force", "voltage")
    singular = False

    def inverse(self, model: Plant, z: Array, v_star: Array) -> Array:
        return (v_star - model.dv_dz(0.0, 0.0) * z) / model.dv_di(0.0, 0.0)
