"""Current laws: the voltage that drives the current to its reference, or the current that an amplifier follows."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from ambjax.control.base import Requirement, scaled_steepness
from ambjax.control.defaults import current_rate, sign_steepness
from ambjax.control.sampling import Relay, Sampling, non_oscillating
from ambjax.control.search import Interval, SearchContext, authority, rate, steepness, switch
from ambjax.control.stages import CurrentInputs, CurrentLaw, OneIntegral, Stateless, no_slope, unwinding
from ambjax.numerics.records import Scalar, bounded, gain, record
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, limited
from ambjax.world.plant import Plant, State


@record
class SlidingMode(Stateless, CurrentLaw[tuple[()]]):
    """u = kappa/(2(s_0+z)) (-2 z_dot i/(s_0+z) + i_ref' - k_i sgn(i - i_ref)) + R i. Eq. (11), sgn smoothed.

    The default k_i is that of Table 2 for the plant of Table 1. For other plants it gives the sign the slope
    2/pi k_i p = w_c at 0, where w_c is the bandwidth of the current loop (`control.defaults`).

    Use it as the paper does: `Cascade(current=current.SlidingMode(k_i=1000.0))`.
    """

    analytic = True
    k_i: Scalar = gain(152.0, "A/s", "switching gain; above the disturbance bound Q_i; left out: w_c i_0/4")
    p: Scalar = sign_steepness("sign of the current error", unit="1/A")
    requirement: ClassVar = Requirement("k_i", "Q_i")
    printed: ClassVar = True

    def designed(self, model: Plant, sampling: Sampling | None) -> "SlidingMode":
        scaled = scaled_steepness(self, model)
        return dataclasses.replace(scaled, k_i=current_rate(model, sampling) / (TWO_OVER_PI * scaled.p))

    def slope(self, model: Plant) -> Scalar:
        return TWO_OVER_PI * self.k_i * self.p

    def size(self, model: Plant) -> Scalar:
        return model.i_0

    def __call__(self, model: Plant, inputs: CurrentInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        return self._voltage(model, inputs, self.robust(inputs.measured.i - inputs.demand.i_ref)), ()

    def step(self, model: Plant, inputs: CurrentInputs, state: tuple[()], period: Scalar) -> tuple[Array, tuple[()]]:
        e = inputs.measured.i - inputs.demand.i_ref
        return self._voltage(model, inputs, -self.k_i * share(e, period * self.k_i, self.p)), ()

    def _voltage(self, model: Plant, inputs: CurrentInputs, robust: Array) -> Array:
        measured, demand = inputs.measured, inputs.demand
        inverse = (inputs.gaps or model.gaps(measured.z)).inverses[1]
        wanted = -2 * measured.z_dot * inverse * measured.i + demand.i_ref_dot + robust
        return (model.kappa / 2) * inverse * wanted + model.R * measured.i

    def relay(self) -> Relay:
        return Relay(self.k_i, self.p)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        if context.stepped or self.p is None:
            fast = context.w * float(context.model.i_0)
            k_i = authority(context, fast, (0.1, 1e3), "w i_0 in A/s: pole times bias current", "Q_i")
            return {"k_i": k_i, **steepness(context, "k_i")}
        return {"k_i": switch(context, "k_i", self.p, 200, "Q_i")}


@record
class ProportionalIntegral(OneIntegral, CurrentLaw[Array]):
    """u = k_p (i_ref - i) + L i_ref' + x, x' = k_int (i_ref - i) + k_aw (clip(u) - u), with x in V.

    This linear law uses the inductance L at z = 0 and has no motional term. While the supply limits u to clip(u),
    back-calculation changes the integral x so that u returns to clip(u) at the rate k_aw (Astrom and Murray, Feedback
    Systems, 2008, 10.4). The default gains for a model give the current loop the bandwidth w_c = 10 w, where w is the
    unstable pole of the magnets. On a processor with sample period T, w_c is at most 1/(4 T). The phase margin is then
    above 50 degrees with one sample of delay.

    Use it where the drive has a PI controller, or the resistance is not known:
    `Cascade(current=current.ProportionalIntegral())`.
    """

    analytic = True
    k_p: Scalar = gain(1.76e5, "V/A", "proportional gain; left out: w_c L")
    k_int: Scalar = gain(2.33e8, "V/A/s", "integral gain, 0: none; left out: w_c^2 L/4", zero=True)
    k_aw: Scalar = gain(1330.0, "1/s", "anti-windup rate, 0: none; left out: w_c/4", zero=True)
    memory = (("x", "V", "integral of the current error"),)

    def scale(self, model: Plant) -> Scalar:
        return model.R * model.i_0 / 10 + 1e-3

    def designed(self, model: Plant, sampling: Sampling | None) -> "ProportionalIntegral":
        w, L = float(current_rate(model, sampling)), float(model.L)
        return ProportionalIntegral(w * L, w**2 * L / 4, w / 4)

    def slope(self, model: Plant) -> Scalar:
        return jnp.maximum(self.k_p / model.L, self.k_aw)

    def __call__(self, model: Plant, inputs: CurrentInputs, state: Array) -> tuple[Array, Array]:
        error = inputs.demand.i_ref - inputs.measured.i
        u = self.k_p * error + model.L * inputs.demand.i_ref_dot + state
        excess = limited(u, inputs.u_max) - u
        return u, self.k_int * error + unwinding(self.k_aw, self.k_int) * excess

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        per = 1 / float(context.model.L)
        return {
            "k_p": rate(context, 1 / 3, 200, "bandwidth k_p / L from w/3 to 200 w", per),
            "k_int": rate(context, 1 / 30, 30, "corner sqrt(k_int / L) from w/30 to 30 w", per, 2),
            "k_aw": rate(context, 1e-2, 10, "rate from w/100 to 10 w"),
        }


@record
class DeadBeat(Stateless, CurrentLaw[tuple[()]]):
    """Law that inverts Eq. (2) for i' = i_ref' - w (i - i_ref). Each implicit step multiplies i - i_ref by 1 - share.

    In continuous time u = kappa/(2(s_0+z)) (-2 z_dot i/(s_0+z) + i_ref' - w (i - i_ref)) + R i. On a processor with
    implicit steps u is the constant voltage that, for constant z and z_dot, changes the current in one sample from i to
    i_ref + T i_ref' + (1 - share) (i - i_ref). With share = 1 (dead-beat), the current is at its reference one sample
    after u begins to act, unless the supply limits u (Astrom and Wittenmark, Computer-Controlled Systems, 1997, 4.3).
    Implicit steps do not use w. Explicit steps and the law in continuous time do not use share. There is no integral,
    so a wrong resistance of the model leaves an offset.

    Use it on a processor: `Cascade(current=current.DeadBeat(share=0.5))`.
    """

    analytic = True
    w: Scalar = gain(5310.0, "1/s", "decay rate of the current error in continuous time; left out: w_c")
    share: Scalar = gain(
        1.0,
        "1",
        "share of the current error that each sample removes; 1: dead-beat; left out: 1 with prediction; without it, "
        "the largest share that does not oscillate (1/4 for a delay of one sample)",
    )

    def designed(self, model: Plant, sampling: Sampling | None) -> "DeadBeat":
        share = 1.0 if sampling is None else non_oscillating(sampling.late)
        return DeadBeat(current_rate(model, sampling), share)

    def slope(self, model: Plant) -> Scalar:
        return self.w

    def __call__(self, model: Plant, inputs: CurrentInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        measured, demand = inputs.measured, inputs.demand
        inverse = (inputs.gaps or model.gaps(measured.z)).inverses[1]
        wanted = demand.i_ref_dot - self.w * (measured.i - demand.i_ref) - 2 * measured.z_dot * inverse * measured.i
        return (model.kappa / 2) * inverse * wanted + model.R * measured.i, ()

    def step(self, model: Plant, inputs: CurrentInputs, state: tuple[()], period: Scalar) -> tuple[Array, tuple[()]]:
        """Return the voltage that moves i to its wanted value in one sample.

        The model is i' = b u - decay i. Its coefficients b = 2 (s_0+z)/kappa and decay are constant in the sample.
        """
        measured, demand = inputs.measured, inputs.demand
        gaps = inputs.gaps or model.gaps(measured.z)
        per_volt = (2 / model.kappa) * gaps.lower
        decay = per_volt * model.R - 2 * measured.z_dot * gaps.inverses[1]
        i = measured.i
        change = period * demand.i_ref_dot - self.share * (i - demand.i_ref)
        return (change * (1 / period) / _mean_decay(decay * period) + decay * i) / per_volt, ()

    def idle_gains(self, implicit: bool | None) -> tuple[str, ...]:
        """Return the gain without effect: w with implicit steps; share with explicit steps and in continuous time."""
        return ("w",) if implicit else ("share",)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {
            "w": rate(context, 1, 100, "decay rate from 1 to 100 times the pole"),
            "share": Interval(0.1, 1.0, "a tenth of the error to all of it", True),
        }


@record
class OpenLoop(Stateless, CurrentLaw[tuple[()]]):
    """u = R i_ref: the voltage that holds the reference current. The current is not fed back.

    Use it with a position law that demands a voltage, such as position.LinearController. With inversion.Linearised, u
    is then the demanded voltage. On a processor u = R (i_ref + T i_ref'), where i_ref + T i_ref' is the reference that
    the inversion computes at this sample.

    `Cascade(current=current.OpenLoop())` applies it.
    """

    analytic = True
    accepts: ClassVar = ("voltage",)

    slope = no_slope

    def __call__(self, model: Plant, inputs: CurrentInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        return model.R * inputs.demand.i_ref, ()

    def step(self, model: Plant, inputs: CurrentInputs, state: tuple[()], period: Scalar) -> tuple[Array, tuple[()]]:
        return model.R * (inputs.demand.i_ref + period * inputs.demand.i_ref_dot), ()

    own_steps = ("implicit", "explicit")


@record
class AmplifierCurrent(Stateless, CurrentLaw[tuple[()]]):
    """u = i_ref in A, for an amplifier that controls the current (`actuator.mode = "current"`).

    On a processor u is the i_ref that the inversion has computed at this sample. The prediction over the delay and the
    guard use the nominal amplifier, i' = 2 pi bandwidth (u - i).

    Use it with an amplifier that closes the current loop: `Cascade(current=current.AmplifierCurrent())`.
    """

    bandwidth: Scalar = bounded(1e3, "Hz", 1, 1e6, "nominal bandwidth; left out: actuator.bandwidth")
    commands = "current"
    own_steps = ("implicit", "explicit")

    slope = no_slope

    def __call__(self, model: Plant, inputs: CurrentInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        return inputs.demand.i_ref, ()

    def step(self, model: Plant, inputs: CurrentInputs, state: tuple[()], period: Scalar) -> tuple[Array, tuple[()]]:
        return inputs.demand.i_ref + period * inputs.demand.i_ref_dot, ()

    def driven(self, model: Plant, u: Array, state: State) -> State:
        return model.rates(state, 0.0)._replace(i=2 * jnp.pi * self.bandwidth * (u - state.i))


def _mean_decay(x: Array) -> Array:
    """Return (1 - exp(-x))/x with |x| limited to 30."""
    x = limited(x, 30.0)
    near = jnp.abs(x) < 1e-3
    far = jnp.where(near, 1.0, x)
    return jnp.where(near, 1 - x / 2 + x * x / 6 - x * x * x / 24, -jnp.expm1(-far) / far)
