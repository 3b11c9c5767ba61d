"""Observers, which estimate the motion of the rotor for the other laws."""

import dataclasses
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.control.exact import DERIVATIVES, ExactDifferentiator
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, rate
from ambjax.control.stages import Observer, Stateless, no_slope
from ambjax.numerics.records import Scalar, bounded, gain, record
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement


@record
class Direct(Stateless, Observer[tuple[()]]):
    """No observer: the estimate is the measurement, as in the paper.

    Use it where position and velocity are measured with little noise: `Cascade(observer=observer.Direct())`.
    """

    analytic = True

    slope = no_slope

    def __call__(self, model: Plant, inputs: Measurement, state: tuple[()]) -> tuple[Measurement, tuple[()]]:
        return inputs, ()


@record
class Complementary(Observer[Array]):
    """Complementary filter of the measured position and velocity: z_hat' = z_dot + l (z_measured - z_hat).

    The estimate z_hat (m) integrates the velocity, and converges to the measured position at the rate l (1/s). Noise of
    the position sensor passes through a low-pass of corner l, noise of the velocity through a low-pass of gain 1/l.

    Use it where both the position and the velocity are measured: `Cascade(observer=observer.Complementary(l=10.0))`.
    """

    analytic = True
    l: Scalar = gain(10.6, "1/s", "corner between velocity and position sensor; left out: w/50")
    z_hat: Scalar | None = bounded(None, "m", -1.0, 1.0, "initial estimate; none: the first measurement")
    memory = (("z_hat", "m", "estimate of the displacement"),)

    def init(self, model: Plant, measured: Measurement) -> Array:
        return jnp.asarray(measured.z if self.z_hat is None else self.z_hat)

    def designed(self, model: Plant, sampling: Sampling | None) -> "Complementary":
        return Complementary(model.pole / 50)

    def started(self, z: Array) -> "Complementary":
        return dataclasses.replace(self, z_hat=z)

    def scale(self, model: Plant) -> Scalar:
        return model.s_0 / 50

    def slope(self, model: Plant) -> Scalar:
        return self.l

    def __call__(self, model: Plant, inputs: Measurement, state: Array) -> tuple[Measurement, Array]:
        return inputs._replace(z=state), inputs.z_dot + self.l * (inputs.z - state)

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {"l": rate(context, 1e-3, 1, "corner from w/1000 to w")}


@record
class Difference(Observer[Array]):
    """Filtered difference: the estimated velocity is w (z - z_f) with z_f' = w (z - z_f). z itself is not filtered.

    With implicit steps on a processor, it is the backward difference (z_n - z_{n-1})/T through a low-pass with the pole
    exp(-w T). On a ramp, the estimate is exact after the initial transient. It follows a change of the velocity with
    a lag of 1/w, and amplifies noise of the position by w.

    Use it where the velocity is not measured and no model is to be used: `Cascade(observer=observer.Difference())`.
    """

    w: Scalar = gain(
        5310.0, "1/s", "corner of the low-pass on the differenced position; left out: ten times the pole of the magnets"
    )
    estimates_velocity: ClassVar[bool] = True
    memory = (("z_f", "m", "position through the low-pass"),)

    def designed(self, model: Plant, sampling: Sampling | None) -> "Difference":
        return Difference(10 * model.pole)

    def init(self, model: Plant, measured: Measurement) -> Array:
        return jnp.asarray(measured.z)

    def scale(self, model: Plant) -> Scalar:
        return model.s_0 / 50

    def slope(self, model: Plant) -> Scalar:
        return self.w

    def __call__(self, model: Plant, inputs: Measurement, state: Array) -> tuple[Measurement, Array]:
        z_dot = self.w * (inputs.z - state)
        return inputs._replace(z_dot=z_dot), z_dot

    def step(self, model: Plant, inputs: Measurement, state: Array, period: Scalar) -> tuple[Measurement, Array]:
        """Step z_f+ = exp(-w T) z_f + (1 - exp(-w T)) z. The estimated velocity is (1 - exp(-w T))/T (z_n - z_f)."""
        z_dot = -jnp.expm1(-self.w * period) / period * (inputs.z - state)
        return inputs._replace(z_dot=z_dot), state + period * z_dot

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {"w": rate(context, 1, 20, "corner from w to 20 w")}


class Predicted(NamedTuple):
    """State of `Kalman`: the estimate; on a processor, the prediction for a sample from the readings before it.

    - `z`, `z_dot`: position, m, and velocity, m/s.
    - `d`: disturbance, m/s^2.
    - `z_ddot`: acceleration of the model at the last sample, m/s^2; unused in continuous time.
    """

    z: Array
    z_dot: Array
    d: Array
    z_ddot: Array


@record
class Kalman(Observer[Predicted]):
    """Steady-state Kalman filter of the nominal model with an unknown disturbance d, driven by the measured current.

    z_hat' = z_dot_hat + 3 w e, z_dot_hat' = z_ddot(z, i) + d_hat + 3 w^2 e, d_hat' = w^3 e, e = z - z_hat, with z_ddot
    of Eq. (1) at the measured z and i. The estimation errors have three equal poles at -w, at any z (A. J. Krener and
    A. Isidori, Syst. Control Lett. 3 (1983) 47-52). With implicit steps on a processor the poles are exp(-w T), so the
    filter is stable for every w.

    The gain w replaces both covariances. Let the position noise be white with intensity S_r (m^2 s; std^2 T on a
    processor), and the rate of the disturbance white with intensity S_q (m^2/s^5). The variance of the velocity is then
    7/4 (S_r w^3 + S_q / w^3). It is smallest at w = (S_q/S_r)^(1/6), where the rms error is 8 % above that of the
    optimal filter.

    Use it where the velocity is not measured and the plant is known: `Cascade(observer=observer.Kalman(w=1000.0))`.
    """

    analytic = True
    w: Scalar = gain(
        1590.0,
        "1/s",
        "decay rate of the estimation error, which has three poles at -w; left out: three times the pole of the "
        "magnets",
    )
    estimates_velocity: ClassVar[bool] = True
    memory = (
        ("z", "m", "position predicted for the next sample"),
        ("z_dot", "m/s", "velocity predicted for the next sample"),
        ("d", "m/s^2", "disturbance predicted for the next sample"),
        ("z_ddot", "m/s^2", "acceleration of the model at the last sample"),
    )

    def designed(self, model: Plant, sampling: Sampling | None) -> "Kalman":
        return Kalman(3 * model.pole)

    def init(self, model: Plant, measured: Measurement) -> Predicted:
        zero = jnp.zeros(())
        return Predicted(jnp.asarray(measured.z), zero, zero, model.z_ddot(measured.z, measured.i))

    def scale(self, model: Plant) -> Predicted:
        z, z_dot, _ = model.sizes()
        z_ddot = jnp.abs(model.g) / 50 + 1e-3
        return Predicted(z, z_dot, z_ddot, z_ddot)

    def slope(self, model: Plant) -> Scalar:
        return 3 * self.w

    def __call__(self, model: Plant, inputs: Measurement, state: Predicted) -> tuple[Measurement, Predicted]:
        e, w = inputs.z - state.z, self.w
        z_ddot = model.z_ddot(inputs.z, inputs.i) + state.d + 3 * w**2 * e
        rates = Predicted(state.z_dot + 3 * w * e, z_ddot, w**3 * e, jnp.zeros_like(e))
        return Measurement(state.z, state.z_dot, inputs.i), rates

    def step(
        self, model: Plant, inputs: Measurement, state: Predicted, period: Scalar
    ) -> tuple[Measurement, Predicted]:
        """Update the estimate with the measurement of a sample; the errors have the triple pole q = exp(-w T).

        The gains 1 - q^3, 3/2 (1-q)^2 (1+q)/T and (1-q)^3/T^2 are those of the fading-memory filter (N. Morrison,
        Introduction to Sequential Smoothing and Prediction, 1969). The acceleration of the model is interpolated
        linearly between samples. The last step assumed a constant acceleration, and this step corrects its prediction.
        """
        z_ddot = model.z_ddot(inputs.z, inputs.i)
        change = z_ddot - state.z_ddot
        z, z_dot = state.z + period**2 / 6 * change, state.z_dot + period / 2 * change
        e, off = inputs.z - z, -jnp.expm1(-self.w * period)
        z = z + (1 - (1 - off) ** 3) * e
        z_dot = z_dot + 1.5 * off**2 * (2 - off) / period * e
        d = state.d + off**3 / period**2 * e
        whole = z_ddot + d
        after = Predicted(z + period * z_dot + period**2 / 2 * whole, z_dot + period * whole, d, z_ddot)
        return Measurement(z, z_dot, inputs.i), after

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        return {"w": rate(context, 0.5, 5, "poles from w/2 to 5 w")}


@record
class IRED1(ExactDifferentiator):
    """Robust exact differentiator of order 1: without noise, z_dot is exact after a finite time if |z_ddot| <= L.

    `ambjax.control.exact` has the equations. z itself is not filtered. In continuous time, the sign is
    smoothed. With implicit steps on a processor, it is evaluated at the end of the step.

    Use it where the velocity is not measured, and a bound of the acceleration is known:
    `Cascade(observer=observer.IRED1())`.
    """

    L: Scalar = gain(56.3, "m/s^2", "bound on the acceleration; left out: w^2 s_0/25")
    order: ClassVar[int] = 1
    memory = DERIVATIVES[:2]


@record
class IRED2(ExactDifferentiator):
    """Robust exact differentiator of order 2: as `IRED1`, but exact while the rate of the acceleration is at most L.

    Use it where a bound of the rate of the acceleration is known: `Cascade(observer=observer.IRED2())`.
    """

    L: Scalar = gain(2.99e4, "m/s^3", "bound on the rate of the acceleration; left out: w^3 s_0/25")
    order: ClassVar[int] = 2
    memory = DERIVATIVES
