"""The paper's position law with integral action: its sliding variable contains the integral of the error."""

from typing import ClassVar

import jax.numpy as jnp
from jax import Array

from ambjax.control.defaults import switching_gain, switching_steepness
from ambjax.control.force import force_for, sliding_variable
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, manifold, position_switch, rate, steepness
from ambjax.control.stages import OneIntegral, PositionInputs, PositionLaw
from ambjax.numerics.records import Scalar, gain, record
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign
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
    c: Scalar = gain(default=17.0, unit="1/s", doc="coefficient of the error in the sliding variable; left out: w")
    c_int: Scalar = gain(
        default=70.0, unit="1/s^2", doc="gain of the integral of the error, 0: none; left out: w^2/4", zero=True
    )
    k: Scalar = gain(
        default=25.0, unit="m/s^2", doc="switching gain; above the disturbance bound Q_z; left out: w^2 s_0/2"
    )
    p: Scalar = gain(
        default=25.0,
        unit="s/m",
        doc="steepness of the smoothed sign; left out: pi/(w s_0), or scaled to the nominal plant if k is given",
        steepness=True,
    )
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

    def size(self, model: Plant) -> Scalar:
        return model.sigma_size

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        """Return e_dot + c e, the sliding variable without its integral."""
        return sliding_variable(self.c, motion, reference)

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
