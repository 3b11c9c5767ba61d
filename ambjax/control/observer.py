"""Observers: what the laws are told of the rotor's motion."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.control.search import Interval, SearchContext, rate
from ambjax.numerics import differentiator
from ambjax.numerics.records import Scalar, gain, leaf, record
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement

# States of a differentiator.
DERIVATIVES = (
    ("z", "m", "position after the last sample"),
    ("z_dot", "m/s", "its rate"),
    ("z_ddot", "m/s^2", "its second derivative"),
)


@record
class Direct:
    """The measurement itself, as in the paper."""

    def init(self, model: Plant, measured: Measurement) -> tuple[()]:
        return ()

    def scale(self, model: Plant) -> tuple[()]:
        return ()

    def slope(self, model: Plant) -> Scalar:
        return 0.0

    def __call__(self, model: Plant, inputs: Measurement, state: tuple[()]) -> tuple[Measurement, tuple[()]]:
        return inputs, ()


@record
class Complementary:
    """z_hat' = z_dot + l (z_measured - z_hat): the velocity integrated, pulled slowly to the position.

    Noise of the position sensor is low-passed at l; noise of the velocity is integrated, with memory 1/l.
    """

    l: Scalar = gain(default=10.0, unit="1/s", doc="corner between velocity and position sensor")
    z_hat: Scalar | None = leaf(
        default=None,
        unit="m",
        at_least=-1.0,
        at_most=1.0,
        optional=True,
        doc="initial estimate; none: first measurement",
    )
    memory = (("z_hat", "m", "estimate of the displacement"),)

    def init(self, model: Plant, measured: Measurement) -> Array:
        return jnp.asarray(measured.z if self.z_hat is None else self.z_hat)

    def scale(self, model: Plant) -> Scalar:
        return model.s_0 / 50

    def slope(self, model: Plant) -> Scalar:
        return self.l

    def __call__(self, model: Plant, inputs: Measurement, state: Array) -> tuple[Measurement, Array]:
        return inputs._replace(z=state), inputs.z_dot + self.l * (inputs.z - state)

    def ranges(self, site: SearchContext) -> dict[str, Interval]:
        return {"l": rate(site, 1e-3, 1, "corner from w/1000 to w")}


@record
class Difference:
    """z_dot = w (z - z_f), z_f' = w (z - z_f): the position differenced and low-passed at w; z itself passes.

    On a processor the backward difference (z_n - z_{n-1})/T through the low-pass with the pole exp(-w T): exact on a
    ramp, late by 1/w. Noise of the position reaches the velocity w times as large.
    """

    w: Scalar = gain(default=2000.0, unit="1/s", doc="corner of the low-pass on the differenced position")
    estimates_velocity: ClassVar[bool] = True
    memory = (("z_f", "m", "position through the low-pass"),)

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
        """With z_f+ = exp(-w T) z_f + (1 - exp(-w T)) z, the difference of z_n and z_f filters that of neighbours."""
        z_dot = -jnp.expm1(-self.w * period) / period * (inputs.z - state)
        return inputs._replace(z_dot=z_dot), state + period * z_dot

    def ranges(self, site: SearchContext) -> dict[str, Interval]:
        return {"w": rate(site, 1, 20, "corner from w to 20 w")}


class Predicted(NamedTuple):
    """State of `Kalman`: position (m), velocity (m/s) and disturbance (m/s^2) estimated for this sample from those
    before; and the model's acceleration at the last (m/s^2), which continuous time does not need."""

    z: Array
    z_dot: Array
    d: Array
    z_ddot: Array


@record
class Kalman:
    """A steady-state Kalman filter: the model driven by the measured current, and a disturbance that it does not know.

    z_hat' = z_dot_hat + 3 w e, z_dot_hat' = z_ddot(z, i) + d_hat + 3 w^2 e, d_hat' = w^3 e, e = z - z_hat, with Eq. (1)
    at the measured z and i: whatever the gap, errors decay with three equal poles at w (A. J. Krener and A. Isidori,
    Syst. Control Lett. 3 (1983) 47-52). One gain stands for both covariances: under white noise of intensity S_r
    (m^2 s; std^2 T on a processor) and a disturbance whose rate is white with S_q (m^2/s^5), the velocity's variance
    is 7/4 (S_r w^3 + S_q / w^3), least at w = (S_q/S_r)^(1/6), 8 % above the Riccati equation's in rms.
    """

    w: Scalar = gain(default=800.0, unit="1/s", doc="three equal poles of the estimation error")
    estimates_velocity: ClassVar[bool] = True
    memory = (
        ("z", "m", "position estimated for this sample from those before"),
        ("z_dot", "m/s", "velocity, likewise"),
        ("d", "m/s^2", "disturbance, likewise"),
        ("z_ddot", "m/s^2", "the model's acceleration at the last sample"),
    )

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
        """The estimate includes this sample; q = exp(-w T) is the triple pole.

        Gains 1 - q^3, 3/2 (1-q)^2 (1+q)/T, (1-q)^3/T^2: the fading-memory filter, least squares that forget (N.
        Morrison, Introduction to Sequential Smoothing and Prediction, 1969). Between samples the model's
        acceleration moves linearly: the last one was held, and what it lacked is added here.
        """
        z_ddot = model.z_ddot(inputs.z, inputs.i)
        more = z_ddot - state.z_ddot
        z, z_dot = state.z + period**2 / 6 * more, state.z_dot + period / 2 * more
        e, off = inputs.z - z, -jnp.expm1(-self.w * period)
        z = z + (1 - (1 - off) ** 3) * e
        z_dot = z_dot + 1.5 * off**2 * (2 - off) / period * e
        d = state.d + off**3 / period**2 * e
        whole = z_ddot + d
        after = Predicted(z + period * z_dot + period**2 / 2 * whole, z_dot + period * whole, d, z_ddot)
        return Measurement(z, z_dot, inputs.i), after

    def ranges(self, site: SearchContext) -> dict[str, Interval]:
        return {"w": rate(site, 0.5, 5, "poles from w/2 to 5 w")}


@record
class IRED1:
    """The robust exact differentiator of order 1, implicit on a processor: z_dot exactly where |z_ddot| <= L.

    `ambjax.numerics.differentiator` has the equations. z itself passes. In continuous time its sign is smoothed.
    """

    L: Scalar = gain(default=50.0, unit="m/s^2", doc="bound on the acceleration")
    estimates_velocity: ClassVar[bool] = True
    memory = DERIVATIVES[:2]

    def init(self, model: Plant, measured: Measurement) -> tuple[Array, ...]:
        return jnp.asarray(measured.z), jnp.zeros(())

    def scale(self, model: Plant) -> tuple[Scalar, ...]:
        return differentiator_scale(model)[:2]

    def slope(self, model: Plant) -> Scalar:
        return differentiator.slope(1, self.L, _width(model))

    def layer(self, model: Plant) -> tuple[Scalar, ...]:
        return 0.3 * _width(model), jnp.inf

    def __call__(self, model: Plant, inputs: Measurement, state: Any) -> tuple[Measurement, Any]:
        return _smooth(self.L, model, inputs, state)

    def step(self, model: Plant, inputs: Measurement, state: Any, period: Scalar) -> tuple[Measurement, Any]:
        """The estimate includes this sample."""
        return _implicit(self.L, inputs, state, period)

    def ranges(self, site: SearchContext) -> dict[str, Interval]:
        return {"L": _bound(site, 2)}


@record
class IRED2:
    """The robust exact differentiator of order 2: as that of order 1, with the rate of the acceleration bounded."""

    L: Scalar = gain(default=3e4, unit="m/s^3", doc="bound on the rate of the acceleration")
    estimates_velocity: ClassVar[bool] = True
    memory = DERIVATIVES

    def init(self, model: Plant, measured: Measurement) -> tuple[Array, ...]:
        return jnp.asarray(measured.z), jnp.zeros(()), jnp.zeros(())

    def scale(self, model: Plant) -> tuple[Scalar, ...]:
        return differentiator_scale(model)

    def slope(self, model: Plant) -> Scalar:
        return differentiator.slope(2, self.L, _width(model))

    def layer(self, model: Plant) -> tuple[Scalar, ...]:
        return 0.3 * _width(model), jnp.inf, jnp.inf

    def __call__(self, model: Plant, inputs: Measurement, state: Any) -> tuple[Measurement, Any]:
        return _smooth(self.L, model, inputs, state)

    def step(self, model: Plant, inputs: Measurement, state: Any, period: Scalar) -> tuple[Measurement, Any]:
        """The estimate includes this sample."""
        return _implicit(self.L, inputs, state, period)

    def ranges(self, site: SearchContext) -> dict[str, Interval]:
        return {"L": _bound(site, 3)}


# The width of the smoothed sign of a differentiator in continuous time, as a share of the gap.
WIDTH = 1e-6


def _width(model: Plant) -> Scalar:
    return WIDTH * model.s_0


def _smooth(L: Scalar, model: Plant, inputs: Measurement, state: Any) -> tuple[Measurement, Any]:
    return inputs._replace(z_dot=state[1]), differentiator.smooth_rates(state, inputs.z, L, _width(model))


def _implicit(L: Scalar, inputs: Measurement, state: Any, period: Scalar) -> tuple[Measurement, Any]:
    after = differentiator.implicit_step(state, inputs.z, L, period)
    return inputs._replace(z_dot=differentiator.velocity(after, period)), after


def differentiator_scale(model: Plant) -> tuple[Scalar, Scalar, Scalar]:
    """What still matters of position, velocity and acceleration: m, m/s, m/s^2."""
    z, z_dot, _ = model.sizes()
    return z, z_dot, jnp.abs(model.g) / 50 + 1e-3


def _bound(site: SearchContext, power: int) -> Interval:
    words = f"(x w)^{power} s_0, x from 1/10 to 1"
    return rate(site, 0.1, 1, words, 1 / float(site.model.s_0), power)
