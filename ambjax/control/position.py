"""Position laws: the scaled force that moves the rotor onto the reference."""

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from ambjax.control.base import Requirement
from ambjax.control.chain import FilterChain as FilterChain
from ambjax.control.defaults import SLOPE_W, sign_steepness, switching_gain, switching_steepness
from ambjax.control.force import force_for, sigma_by_c, sigma_size
from ambjax.control.linear_controller import LinearController as LinearController
from ambjax.control.manifolds import IntegralSlidingMode as IntegralSlidingMode
from ambjax.control.manifolds import TerminalSlidingMode as TerminalSlidingMode
from ambjax.control.manifolds import UtkinSlidingMode as UtkinSlidingMode
from ambjax.control.pid import PID as PID
from ambjax.control.pid import FeedbackLinearisation as FeedbackLinearisation
from ambjax.control.pid import StateFeedback as StateFeedback
from ambjax.control.sampling import Relay, Sampling
from ambjax.control.search import Interval, SearchContext, authority, manifold, position_switch, rate, steepness
from ambjax.control.stages import OneIntegral, PositionInputs, PositionLaw, Stateless
from ambjax.numerics.records import Scalar, gain, record
from ambjax.numerics.relax import share, twist
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_root, smooth_sign
from ambjax.world.plant import Plant


@record
class SlidingMode(Stateless, PositionLaw[tuple[()]]):
    """v_star = (-2 k_z z/m - c (z_dot - r_dot) + r_ddot + g - k sgn(sigma)) / a. Eq. (5), sgn smoothed.

    The default gains are those of Table 2 for the plant of Table 1. For other plants the error has a double pole at -w,
    the pole of the magnets (`control.defaults`).

    Use it as the paper does, on a known plant under bounded disturbances; a constant force leaves an offset:
    `Cascade(position=position.SlidingMode(c=300.0))`.
    """

    analytic = True
    c: Scalar = gain(17.0, "1/s", "decay rate on the sliding manifold; left out: w")
    k: Scalar = gain(25.0, "m/s^2", "switching gain; above the disturbance bound Q_z; left out: w^2 s_0/2")
    p: Scalar = sign_steepness("sign of sigma", SLOPE_W)
    requirement: ClassVar = Requirement("k", "Q_z")
    switching: ClassVar = ("k",)
    printed: ClassVar = True

    def designed(self, model: Plant, sampling: Sampling | None) -> "SlidingMode":
        return SlidingMode(model.pole, switching_gain(model), switching_steepness(model))

    def slope(self, model: Plant) -> Scalar:
        return jnp.maximum(TWO_OVER_PI * self.k * self.p, self.c)

    size = sigma_size
    sigma = sigma_by_c

    def __call__(self, model: Plant, inputs: PositionInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        motion, reference = inputs
        robust = self.robust(self.sigma(motion, reference))
        return force_for(self.c, model, motion, reference, robust), ()

    def relay(self) -> Relay:
        return Relay(self.k, self.p)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        k = position_switch(context, self.p)
        return {"c": manifold(context), "k": k, **steepness(context, "k")}

    def step(self, model: Plant, inputs: PositionInputs, state: tuple[()], period: Scalar) -> tuple[Array, tuple[()]]:
        """Step with the sign of sigma at the end of the step: without disturbance sigma does not overshoot 0."""
        motion, reference = inputs
        robust = -self.k * share(self.sigma(motion, reference), period * self.k, self.p)
        return force_for(self.c, model, motion, reference, robust), ()


@record
class SuperTwisting(OneIntegral, PositionLaw[Array]):
    """sigma_dot = -k_1 sqrt|sigma| sgn(sigma) + w, w' = -k_2 sgn(sigma): super-twisting, the paper's future work.

    Levant, Int. J. Control 58 (1993) 1247-1263. Both terms are smoothed with p: the root as sigma / (sigma^2 +
    1/p^2)^(1/4), whose slope at zero is sqrt(p). The state w (m/s^2) is an integral, so a constant disturbance leaves
    no offset. For the plant of Table 1, the default slope at zero is k_1 sqrt(p) = 400 1/s, about that of SlidingMode.
    For other plants, sigma has a double pole at -W/2, and the error on the manifold a pole at -W, where W is the pole
    of the magnets.

    Use it where a constant or slowly varying force acts: `Cascade(position=position.SuperTwisting())`.
    """

    c: Scalar = gain(17.0, "1/s", "decay rate on the sliding manifold; left out: W")
    k_1: Scalar = gain(40.0, "m^0.5/s^1.5", "gain of the root term; left out: sqrt(W^3 s_0/pi)")
    k_2: Scalar = gain(
        50.0, "m/s^3", "gain of the integral, 0: none; above the bound on dq_z/dt; left out: W^3 s_0/8", zero=True
    )
    p: Scalar = sign_steepness(
        "root and sign of sigma", "pi/(W s_0), or scaled to the nominal plant if k_1 or k_2 is given", default=100.0
    )
    switching: ClassVar = ("k_1", "k_2")
    printed: ClassVar = True
    memory = (("w", "m/s^2", "integral of the sign of sigma"),)

    def designed(self, model: Plant, sampling: Sampling | None) -> "SuperTwisting":
        p, w = switching_steepness(model), model.pole
        return SuperTwisting(w, w / p**0.5, w**2 / 4 / (TWO_OVER_PI * p), p)

    def scale(self, model: Plant) -> Scalar:
        return jnp.abs(model.g) / 50 + 1e-3

    def slope(self, model: Plant) -> Scalar:
        root, integral = self.k_1 * jnp.sqrt(self.p), TWO_OVER_PI * self.k_2 * self.p
        # sigma'' + root sigma' + integral sigma = 0 at the origin: the faster of the two modes.
        pole = (root + jnp.sqrt(jnp.maximum(root**2 - 4 * integral, 0.0))) / 2
        return jnp.maximum(jnp.maximum(pole, jnp.sqrt(integral)), self.c)

    size = sigma_size
    sigma = sigma_by_c

    def __call__(self, model: Plant, inputs: PositionInputs, state: Array) -> tuple[Array, Array]:
        motion, reference = inputs
        sigma = self.sigma(motion, reference)
        robust = state - self.k_1 * smooth_root(sigma, self.p)
        return force_for(self.c, model, motion, reference, robust), -self.k_2 * smooth_sign(sigma, self.p)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        if context.stepped or self.p is None:
            size = context.w**3 * float(context.model.s_0)
            root = authority(context, size**0.5, (1e-3, 0.3), "sqrt(w^3 s_0)")
            return {"c": manifold(context), "k_1": root, "k_2": authority(context, size, (1e-5, 0.1), "w^3 s_0")}
        root, integral = float(self.p) ** 0.5, TWO_OVER_PI * float(self.p)
        return {
            "c": manifold(context),
            "k_1": rate(context, 1 / 3, 100, "slope k_1 sqrt(p) from w/3 to 100 w", root),
            "k_2": rate(context, 1e-2, 10, "corner sqrt(2/pi k_2 p) from w/100 to 10 w", integral, 2),
        }

    def step(self, model: Plant, inputs: PositionInputs, state: Array, period: Scalar) -> tuple[Array, Array]:
        """Step with both terms at the end of the step (R. Seeber and B. Andritsch, Automatica 173 (2025) 112027).

        The robust term is -k_1 root(y) + 2 w+ - w, where w+ = w - T k_2 sgn(y), and y solves
        y + T k_1 root(y) + T^2 k_2 sgn(y) = sigma.
        """
        motion, reference = inputs
        sigma = self.sigma(motion, reference)
        reach = period * period * self.k_2
        root, sign = twist(sigma, period * self.k_1, reach, self.p)
        after = state - period * self.k_2 * sign
        robust = 2 * after - state - self.k_1 * root
        return force_for(self.c, model, motion, reference, robust), after
