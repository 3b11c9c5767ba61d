"""State feedback with integral action, with optimal gains for the linearised mechanics."""

import dataclasses

import jax.numpy as jnp
from jax import Array

from ambjax.control.force import force_of_current, linear_mechanics, resting_current
from ambjax.control.regulator import optimal_gains
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, rate
from ambjax.control.stages import OneIntegral, PositionInputs, PositionLaw, unwinding
from ambjax.numerics.records import Scalar, gain, record
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference


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
    k_p: Scalar = gain(default=135.0, unit="A/m", doc="proportional gain; left out: LQR")
    k_d: Scalar = gain(default=0.219, unit="A s/m", doc="derivative gain; left out: LQR")
    k_int: Scalar = gain(default=5310.0, unit="A/m/s", doc="integral gain, 0: none; left out: LQR", zero=True)
    k_aw: Scalar = gain(default=10.6, unit="1/s", doc="anti-windup rate, 0: none; left out: w/50", zero=True)
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

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        """Return e_dot + (k_p/k_d) e, the error that the feedback of e and e_dot drives to zero."""
        return motion.z_dot - reference.r_dot + self.k_p / self.k_d * (motion.z - reference.r)

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
