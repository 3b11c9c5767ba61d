"""Position laws with other sliding manifolds than the paper's: two with an integral, and a terminal one."""

import dataclasses
import functools
from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from ambjax.control.base import scaled_steepness
from ambjax.control.defaults import SLOPE_W, sign_steepness, switching_gain, switching_steepness
from ambjax.control.force import force_for, sigma_by_c, sigma_by_gains, sigma_size, sliding_variable
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, manifold, position_switch, rate, steepness
from ambjax.control.stages import OneIntegral, PositionInputs, PositionLaw, Stateless
from ambjax.numerics.records import Scalar, gain, record
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, safe_sqrt, smooth_root, smooth_sign
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference


@record
class IntegralSlidingMode(OneIntegral, PositionLaw[Array]):
    """v_star = (-2 k_z z/m - c e_dot - c_int e + r_ddot + g - k sgn(s))/a, s = e_dot + c e + c_int x, x' = e = z - r.

    Eq. (5) with the integral of the error in the sliding variable (Slotine and Li, Applied Nonlinear Control, 1991,
    7.1): s' = -k sgn(s) + q_z as in Eq. (12), and e_ddot + c e_dot + c_int e = 0 on the manifold. The smoothed sign of
    Eq. (5) leaves an offset under a constant force, because s is then not zero. Here e = 0 at rest for any constant s.
    There is no anti-windup: the law continues to integrate while the supply limits u. The default gains are those of
    SlidingMode; c_int = c^2/4 gives two equal poles on the manifold.

    Use it instead of `SlidingMode` under a constant force: `Cascade(position=position.IntegralSlidingMode())`.
    """

    analytic = True
    c: Scalar = gain(17.0, "1/s", "coefficient of the error in the sliding variable; left out: w")
    c_int: Scalar = gain(70.0, "1/s^2", "gain of the integral of the error, 0: none; left out: w^2/4", zero=True)
    k: Scalar = gain(25.0, "m/s^2", "switching gain; above the disturbance bound Q_z; left out: w^2 s_0/2")
    p: Scalar = sign_steepness("sign", SLOPE_W)
    switching: ClassVar = ("k",)
    printed: ClassVar = True
    memory = (("x", "m s", "integral of the error"),)

    def designed(self, model: Plant, sampling: Sampling | None) -> "IntegralSlidingMode":
        w = model.pole
        return IntegralSlidingMode(w, w**2 / 4, switching_gain(model), switching_steepness(model))

    def scale(self, model: Plant) -> Scalar:
        return model.s_0 / 500

    def slope(self, model: Plant) -> Scalar:
        return jnp.maximum(TWO_OVER_PI * self.k * self.p, jnp.maximum(self.c, jnp.sqrt(self.c_int)))

    size = sigma_size
    sigma = sigma_by_c  # without the integral

    def __call__(self, model: Plant, inputs: PositionInputs, state: Array) -> tuple[Array, Array]:
        motion, reference = inputs
        s = self.sigma(motion, reference) + self.c_int * state
        return self._force(model, inputs, -self.k * smooth_sign(s, self.p)), self._integrated(inputs)

    def _force(self, model: Plant, inputs: PositionInputs, robust: Array) -> Array:
        motion, reference = inputs
        return force_for(self.c, model, motion, reference, robust - self.c_int * (motion.z - reference.r))

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        k = position_switch(context, self.p)
        c_int = rate(context, 1 / 30, 2, "corner sqrt(c_int) from w/30 to 2 w", power=2)
        return {"c": manifold(context), "c_int": c_int, "k": k, **steepness(context, "k")}

    def step(self, model: Plant, inputs: PositionInputs, state: Array, period: Scalar) -> tuple[Array, Array]:
        """Step with the sign of s at the end of the step, as `SlidingMode` does; x+ = x + T e."""
        motion, reference = inputs
        s = self.sigma(motion, reference) + self.c_int * state
        robust = -self.k * share(s, period * self.k, self.p)
        return self._force(model, inputs, robust), state + period * self._integrated(inputs)

    def _integrated(self, inputs: PositionInputs) -> Array:
        """Return the rate of the integral: the error, or 0 if its gain c_int is 0."""
        return jnp.where(jnp.asarray(self.c_int) > 0, inputs[0].z - inputs[1].r, 0.0)


# Speed below which the root of `TerminalSlidingMode` is smoothed, as a share of c l.
WIDTH = 0.01


@record
class UtkinSlidingMode(OneIntegral, PositionLaw[Array]):
    """v_star = (-2 k_z z/m + r_ddot + g - k_p e - k_d e_dot - k sgn(s))/a, s = e_dot + k_d e + x, x' = k_p e.

    Integral sliding mode: feedback linearisation, and a sign that cancels the disturbance (V. Utkin and J. Shi, Proc.
    35th IEEE Conf. Decision and Control, 1996, 4591-4596). x starts at -(e_dot + k_d e), so that s = 0 from the
    beginning: there is no reaching phase, and for |q_z| < k the error follows e_ddot = -k_p e - k_d e_dot at all times,
    up to the smoothing of the sign. `IntegralSlidingMode` starts its integral at 0 instead. A trajectory does not
    contain s; it reports e_dot + (k_p/k_d) e as sigma. The default k_p and k_d for a model place a double pole at -w/3,
    where w is the unstable pole of the magnets.

    Use it where the motion must be that of a PD controller from the start:
    `Cascade(position=position.UtkinSlidingMode())`.
    """

    k_p: Scalar = gain(3.1e4, "1/s^2", "proportional gain; left out: (w/3)^2")
    k_d: Scalar = gain(354.0, "1/s", "derivative gain; left out: 2 w/3")
    k: Scalar = gain(25.0, "m/s^2", "switching gain; above the disturbance bound Q_z; left out: w^2 s_0/2")
    p: Scalar = sign_steepness("sign of s", SLOPE_W)
    switching: ClassVar = ("k",)
    memory = (("integral", "m/s", "integral of k_p e"),)
    own_steps = ("implicit", "explicit")

    def begin(self, model: Plant, inputs: PositionInputs) -> Array:
        """Return the integral x for which s = 0."""
        return -sliding_variable(self.k_d, *inputs)

    def scale(self, model: Plant) -> Scalar:
        return model.sigma_size

    def designed(self, model: Plant, sampling: Sampling | None) -> "UtkinSlidingMode":
        k_p, k_d = (model.pole / 3) ** 2, 2 * model.pole / 3
        return UtkinSlidingMode(k_p, k_d, switching_gain(model), switching_steepness(model))

    def slope(self, model: Plant) -> Scalar:
        rates = (TWO_OVER_PI * self.k * self.p, self.k_d, jnp.sqrt(self.k_p))
        return functools.reduce(jnp.maximum, rates)

    size = sigma_size
    sigma = sigma_by_gains

    def __call__(self, model: Plant, inputs: PositionInputs, state: Array) -> tuple[Array, Array]:
        s = sliding_variable(self.k_d, *inputs) + state
        return self._force(model, inputs, smooth_sign(s, self.p)), self.k_p * (inputs[0].z - inputs[1].r)

    def _force(self, model: Plant, inputs: PositionInputs, sign: Array) -> Array:
        motion, reference = inputs
        return force_for(0.0, model, motion, reference, -self.k_d * self.sigma(motion, reference) - self.k * sign)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {
            "k_p": rate(context, 1 / 30, 3, "corner sqrt(k_p) from w/30 to 3 w", power=2),
            "k_d": rate(context, 1 / 10, 10, "rate k_d from w/10 to 10 w"),
            "k": position_switch(context, self.p),
            **steepness(context, "k"),
        }

    def step(self, model: Plant, inputs: PositionInputs, state: Array, period: Scalar) -> tuple[Array, Array]:
        motion, reference = inputs
        sign = share(sliding_variable(self.k_d, *inputs) + state, period * self.k, self.p)
        return self._force(model, inputs, sign), state + period * self.k_p * (motion.z - reference.r)


@record
class TerminalSlidingMode(Stateless, PositionLaw[tuple[()]]):
    """v_star = (-2 k_z z/m + r_ddot + g - 2/3 c^2 l |y|^(1/2) sgn(y) - k sgn(sigma))/a, y = e_dot/(c l).

    Non-singular terminal sliding mode (Y. Feng, X. Yu and Z. Man, Automatica 38 (2002) 2159-2167) with the exponent
    3/2: sigma = c (e + l |y|^(3/2) sgn(y)). On sigma = 0 the rate of the error is -c l |e/l|^(2/3) sgn(e), so an error
    e_0 reaches 0 in the finite time 3 |e_0/l|^(1/3)/c. At |e| = l the error decays at the rate c, as on the manifold of
    Eq. (4). Below |e| = l it decays faster. The root is smoothed below |y| = 0.01, and the sign with p. The law has no
    integral.

    Use it where an error must vanish in a finite time: `Cascade(position=position.TerminalSlidingMode())`.
    """

    c: Scalar = gain(530.0, "1/s", "decay rate on the manifold where |e| = l; left out: w")
    l: Scalar = gain(1e-4, "m", "error at which the decay rate is c; left out: s_0/50")
    k: Scalar = gain(280.0, "m/s^2", "switching gain; above the disturbance bound Q_z; left out: w^2 s_0/5")
    p: Scalar = sign_steepness("sign of sigma")

    def designed(self, model: Plant, sampling: Sampling | None) -> "TerminalSlidingMode":
        scaled = scaled_steepness(self, model)
        return dataclasses.replace(scaled, c=model.pole, l=model.s_0 / 50, k=model.pole**2 * model.s_0 / 5)

    def slope(self, model: Plant) -> Scalar:
        """Return the larger of the rate of the sign at |y| = 1 (d sigma/d e_dot is 3/2 there) and that of the root."""
        return jnp.maximum(1.5 * TWO_OVER_PI * self.k * self.p, 2 / 3 * self.c * WIDTH**-0.5)

    size = sigma_size

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        y = self._speed(motion, reference)
        return self.c * (motion.z - reference.r + self.l * y * safe_sqrt(jnp.abs(y)))

    def _speed(self, motion: Measurement, reference: Reference) -> Array:
        return (motion.z_dot - reference.r_dot) / (self.c * self.l)

    def __call__(self, model: Plant, inputs: PositionInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        return self._force(model, inputs, smooth_sign(self.sigma(*inputs), self.p)), ()

    def _force(self, model: Plant, inputs: PositionInputs, sign: Array) -> Array:
        root = smooth_root(self._speed(*inputs), 1 / WIDTH)
        return force_for(0.0, model, *inputs, -2 / 3 * self.c**2 * self.l * root - self.k * sign)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        size = float(context.model.s_0)
        return {
            "c": rate(context, 1 / 30, 2, "rate from w/30 to 2 w"),
            "l": Interval(1e-3 * size, size, "a thousandth of the gap to the gap"),
            "k": position_switch(context, self.p),
            **steepness(context, "k"),
        }

    def step(self, model: Plant, inputs: PositionInputs, state: tuple[()], period: Scalar) -> tuple[Array, tuple[()]]:
        """Step with the sign of sigma at the end of the step.

        d sigma/d e_dot = 3/2 |y|^(1/2) is evaluated at the largest |y| that can occur in the step.
        """
        reach = period * self.k
        most = jnp.abs(self._speed(*inputs)) + reach / (self.c * self.l)
        sign = share(self.sigma(*inputs), 1.5 * reach * safe_sqrt(most), self.p)
        return self._force(model, inputs, sign), ()
