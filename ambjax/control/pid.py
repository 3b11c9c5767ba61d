"""Linear position laws: PID, feedback linearisation with a PD controller, and state feedback with integral action."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.control.force import force_for, force_of_current, linear_mechanics, resting_current, sigma_by_gains
from ambjax.control.regulator import optimal_gains
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, rate
from ambjax.control.stages import OneIntegral, PositionInputs, PositionLaw, Stateless, unwinding
from ambjax.numerics.records import Scalar, gain, record
from ambjax.world.plant import Plant


class PIDState(NamedTuple):
    """State of `PID`: filtered rate of the error (m/s), and its integral term (m/s^2)."""

    rate: Array
    integral: Array


@record
class PID(PositionLaw[PIDState]):
    """v_star = (-2 k_z z/m + r_ddot + g - k_p e - k_d d - x)/a, e = z - r, d' = w_f (e_dot - d), x' = k_int e + ...

    A PID controller with a filtered derivative (Astrom and Murray, Feedback Systems, 2008, 10.1 and 10.4). As in Eq.
    (5), v_star cancels the stiffness and the weight of the nominal plant. If v = v_star, e_ddot = -k_p e - k_d d - x,
    so the gains do not depend on the plant. d is e_dot after a low-pass of bandwidth w_f, where e_dot contains the
    observer's estimate of the velocity.

    With back-calculation as anti-windup, the integral is x' = k_int e + k_aw (a v_star - a v(z, i)). While the supply
    limits u, the force v(z, i) of the measured current differs from v_star, and x moves v_star towards v(z, i) at the
    rate k_aw. The term also acts, for a shorter time, while the current follows its reference without a limit.

    With the default gains for a model, and without the filter, the closed loop has a pole at -w and two at -w/2, where
    w is the unstable pole of the magnets. With an ideal current, the peak of |S| is then 1.15.

    Use it as the reference of a comparison, or where an integral and an anti-windup are required:
    `Cascade(position=position.PID(k_aw=100.0))`.
    """

    analytic = True
    k_p: Scalar = gain(3.52e5, "1/s^2", "proportional gain; left out: 5/4 w^2")
    k_int: Scalar = gain(3.74e7, "1/s^3", "integral gain, 0: none; left out: w^3/4", zero=True)
    k_d: Scalar = gain(1062.0, "1/s", "derivative gain; left out: 2 w")
    w_f: Scalar = gain(1.06e4, "1/s", "bandwidth of the filter of the derivative; left out: 20 w")
    k_aw: Scalar = gain(26.5, "1/s", "anti-windup rate, 0: none; left out: w/20", zero=True)
    memory = (("rate", "m/s", "filtered rate of the error"), ("integral", "m/s^2", "integral term"))

    def init(self, model: Plant) -> PIDState:
        return PIDState(jnp.zeros(()), jnp.zeros(()))

    def scale(self, model: Plant) -> PIDState:
        return PIDState(jnp.asarray(model.sigma_size), jnp.abs(model.g) / 50 + 1e-3)

    def begin(self, model: Plant, inputs: PositionInputs) -> PIDState:
        """Return the filter in the steady state for the first rate of the error, and an integral of 0."""
        rate = jnp.asarray(inputs[0].z_dot - inputs[1].r_dot)
        return PIDState(rate, jnp.zeros_like(rate))

    def designed(self, model: Plant, sampling: Sampling | None) -> "PID":
        w = model.pole
        return PID(k_p=1.25 * w**2, k_int=w**3 / 4, k_d=2 * w, w_f=20 * w, k_aw=w / 20)

    def slope(self, model: Plant) -> Scalar:
        """Return the largest of the rates w_f, k_d, k_aw, sqrt(k_p) and cbrt(k_int)."""
        rates = jnp.stack([jnp.asarray(x) for x in (self.w_f, self.k_d, self.k_aw)])
        return jnp.maximum(jnp.max(rates), jnp.maximum(jnp.sqrt(self.k_p), jnp.cbrt(self.k_int)))

    sigma = sigma_by_gains

    def __call__(self, model: Plant, inputs: PositionInputs, state: PIDState) -> tuple[Array, PIDState]:
        motion, reference = inputs
        e, e_dot = motion.z - reference.r, motion.z_dot - reference.r_dot
        v_star = self._force(model, inputs, state.rate, state.integral)
        lacking = model.a * (v_star - model.v(motion.z, motion.i))
        integral = self.k_int * e + unwinding(self.k_aw, self.k_int) * lacking
        return v_star, PIDState(self.w_f * (e_dot - state.rate), integral)

    def _force(self, model: Plant, inputs: PositionInputs, rate: Array, integral: Scalar) -> Array:
        motion, reference = inputs
        wanted = -self.k_p * (motion.z - reference.r) - self.k_d * rate - integral
        return force_for(0.0, model, motion, reference, wanted)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {
            "k_p": rate(context, 1 / 30, 3, "corner sqrt(k_p) from w/30 to 3 w", power=2),
            "k_int": rate(context, 1 / 100, 1, "corner cbrt(k_int) from w/100 to w", power=3),
            "k_d": rate(context, 1 / 10, 10, "rate k_d from w/10 to 10 w"),
            "w_f": rate(context, 1, 100, "bandwidth from w to 100 w"),
            "k_aw": rate(context, 1e-3, 1, "rate from w/1000 to w"),
        }

    def step(self, model: Plant, inputs: PositionInputs, state: PIDState, period: Scalar) -> tuple[Array, PIDState]:
        """Step the filter and the anti-windup by backward Euler, which is stable for any rate.

        d+ = d + T w_f (e_dot - d+); v_star uses d+ and x; x+ = x + T (k_int e + k_aw (a v_star(x+) - a v(z, i))).
        """
        motion, reference = inputs
        e, e_dot = motion.z - reference.r, motion.z_dot - reference.r_dot
        follow, leak = period * self.w_f, period * unwinding(self.k_aw, self.k_int)
        after = (state.rate + follow * e_dot) / (1 + follow)
        lacking = model.a * (self._force(model, inputs, after, 0.0) - model.v(motion.z, motion.i))
        integral = (state.integral + period * self.k_int * e + leak * lacking) / (1 + leak)
        return self._force(model, inputs, after, state.integral), PIDState(after, integral)


@record
class FeedbackLinearisation(Stateless, PositionLaw[tuple[()]]):
    """v_star = (-2 k_z z/m + r_ddot + g - k_p e - k_d e_dot)/a, e = z - r: feedback linearisation with a PD controller.

    The demanded force cancels stiffness and weight. With inversion.ClosedForm, which cancels the nonlinear magnet, the
    nominal mechanics become e_ddot = -k_p e - k_d e_dot at any z (H. Khalil, Nonlinear Systems, 2002, 13.2 and 13.3).
    There is no integral: a disturbance q_z leaves the offset q_z/k_p. The default gains for a model place a double pole
    at -w, where w is the unstable pole of the magnets. With an ideal current, |S| is then 1 at every frequency.

    Use it on a known plant without constant disturbances, or as the simplest law with an exact inversion:
    `Cascade(position=position.FeedbackLinearisation())`.
    """

    analytic = True
    k_p: Scalar = gain(2.82e5, "1/s^2", "proportional gain; left out: w^2")
    k_d: Scalar = gain(1062.0, "1/s", "derivative gain; left out: 2 w")

    def designed(self, model: Plant, sampling: Sampling | None) -> "FeedbackLinearisation":
        return FeedbackLinearisation(model.pole**2, 2 * model.pole)

    def slope(self, model: Plant) -> Scalar:
        return jnp.maximum(self.k_d, jnp.sqrt(self.k_p))

    sigma = sigma_by_gains

    def __call__(self, model: Plant, inputs: PositionInputs, state: tuple[()]) -> tuple[Array, tuple[()]]:
        motion, reference = inputs
        return force_for(0.0, model, motion, reference, -self.k_d * self.sigma(motion, reference)), ()

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {
            "k_p": rate(context, 1 / 30, 3, "corner sqrt(k_p) from w/30 to 3 w", power=2),
            "k_d": rate(context, 1 / 10, 10, "rate k_d from w/10 to 10 w"),
        }


@record
class StateFeedback(OneIntegral, PositionLaw[Array]):
    """v_star = dv/dz z + dv/di i_star, i_star = i_r - k_p e - k_d e_dot - x, x' = k_int e + k_aw (i_star - i).

    The linear controller of the textbooks (Schweitzer and Maslen, Magnetic Bearings, 2009, 8.3) demands a current
    i_star; e = z - r. With inversion.Linearised, i_ref is i_star. With an exact inversion, the mechanics are linear.
    i_r keeps the linearised rotor on the reference. dv/dz and dv/di are those at z = 0, i = 0. While the supply limits
    u, x moves i_star towards the measured current i at the rate k_aw.

    The default gains k_p, k_d and k_int for a model are optimal (LQR) for the linearised mechanics
    e_ddot = s e + b (i_star - i_r). They minimise the integral of (e/(0.1 s_0))^2 + (0.2 w int e/(0.1 s_0))^2 +
    ((i_star - i_r)/(0.1 i_0))^2; on a processor, the sum over the samples. w is the pole of the magnets.

    Use it with a Kalman filter as LQG: `Cascade(observer=observer.Kalman(), position=position.StateFeedback())`.
    """

    analytic = True
    k_p: Scalar = gain(135.0, "A/m", "proportional gain; left out: LQR")
    k_d: Scalar = gain(0.219, "A s/m", "derivative gain; left out: LQR")
    k_int: Scalar = gain(5310.0, "A/m/s", "integral gain, 0: none; left out: LQR", zero=True)
    k_aw: Scalar = gain(10.6, "1/s", "anti-windup rate, 0: none; left out: w/50", zero=True)
    memory = (("integral", "A", "integral term"),)

    def scale(self, model: Plant) -> Scalar:
        return model.i_0 / 25

    def designed(self, model: Plant, sampling: Sampling | None) -> "StateFeedback":
        """Return the law with k_aw = w/50 and the gains of `optimal_gains`. Raises ValueError as that does."""
        k_int, k_p, k_d = map(float, optimal_gains(model, None if sampling is None else sampling.period))
        return dataclasses.replace(self, k_p=k_p, k_d=k_d, k_int=k_int, k_aw=model.pole / 50)

    def slope(self, model: Plant) -> Scalar:
        """Return the largest of the rates b k_d, sqrt(b k_p), cbrt(b k_int) and k_aw."""
        b = linear_mechanics(model).b
        rates = (b * self.k_d, jnp.sqrt(b * self.k_p), jnp.cbrt(b * self.k_int), self.k_aw)
        return jnp.max(jnp.stack([jnp.asarray(x) for x in rates]))

    sigma = sigma_by_gains

    def __call__(self, model: Plant, inputs: PositionInputs, state: Array) -> tuple[Array, Array]:
        motion, reference = inputs
        i_star = self._current(model, inputs) - state
        rate = self.k_int * (motion.z - reference.r) + unwinding(self.k_aw, self.k_int) * (i_star - motion.i)
        return force_of_current(model, motion.z, i_star), rate

    def _current(self, model: Plant, inputs: PositionInputs) -> Array:
        """Return the demanded current (A) without the integral term."""
        return resting_current(model, inputs[1]) - self.k_d * self.sigma(*inputs)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        b = linear_mechanics(context.model).b
        return {
            "k_p": rate(context, 1, 5, "corner sqrt(b k_p) from w to 5 w", b, 2),
            "k_d": rate(context, 1 / 3, 10, "rate b k_d from w/3 to 10 w", b),
            "k_int": rate(context, 1 / 30, 2, "corner cbrt(b k_int) from w/30 to 2 w", b, 3),
            "k_aw": rate(context, 1e-3, 1, "rate from w/1000 to w"),
        }

    def step(self, model: Plant, inputs: PositionInputs, state: Array, period: Scalar) -> tuple[Array, Array]:
        """Step the anti-windup by backward Euler: x+ = x + T (k_int e + k_aw (i_star(x+) - i)). The output uses x."""
        motion, reference = inputs
        free, leak = self._current(model, inputs), period * unwinding(self.k_aw, self.k_int)
        after = state + period * self.k_int * (motion.z - reference.r) + leak * (free - motion.i)
        return force_of_current(model, motion.z, free - state), after / (1 + leak)
