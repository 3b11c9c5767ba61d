"""The controller of industrial magnetic bearings: PID, lead-lag, notches and low-pass in series, by biquads."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.control.force import force_of_current, linear_mechanics, resting_current, sliding_variable
from ambjax.control.pid import StateFeedback
from ambjax.control.regulator import optimal_gains
from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, rate
from ambjax.control.stages import PositionInputs, PositionLaw, unwinding
from ambjax.numerics.records import Scalar, gain, record
from ambjax.numerics.smooth import HALF_PI, cosine, sine
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# Largest frequency at which prewarping makes the response exact, as a share of the Nyquist frequency.
NYQUIST_SHARE = 0.98


class Biquad(NamedTuple):
    """d + (c_1 s + c_0)/(s^2 + a_1 s + a_0). A filter without effect has d = 1 and c_1 = c_0 = 0 exactly.

    Units: 1/s for c_1 and a_1, 1/s^2 for c_0 and a_0. `centre`: angular frequency (1/s) at which the sampled filter has
    exactly this response; None: 0. It is limited to NYQUIST_SHARE of the Nyquist frequency.
    """

    d: Scalar
    c_1: Scalar
    c_0: Scalar
    a_1: Scalar
    a_0: Scalar
    centre: Scalar | None = None

    def output(self, u: Array, x: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        """Return the output for an input u and a state x, and the rate of the state, in observer canonical form."""
        w = jnp.sqrt(jnp.asarray(self.a_0))
        return self.d * u + x[0], (self.c_1 * u - self.a_1 * x[0] + w * x[1], self.c_0 / w * u - w * x[0])

    def steady(self, u: Array) -> tuple[Array, tuple[Array, Array]]:
        """Return the output and the state for a constant input u."""
        x = self.c_0 / self.a_0 * u
        return self.d * u + x, (x, (self.a_1 * x - self.c_1 * u) / jnp.sqrt(jnp.asarray(self.a_0)))

    def steady_sampled(self, u: Array, period: Scalar) -> tuple[Array, tuple[Array, Array]]:
        """Return the output and the state of the sampled filter for a constant input u."""
        K = self._bilinear(period)
        over = 1 / (K * K + K * self.a_1 + self.a_0)
        y = self.c_0 / self.a_0 * u
        second = (self.c_0 - K * self.c_1) * over * u - (K * K - K * self.a_1 + self.a_0) * over * y
        return self.d * u + y, (y - (self.c_0 + K * self.c_1) * over * u, second)

    def _bilinear(self, period: Scalar) -> Scalar:
        """Return K of the bilinear transform s = K (1 - q)/(1 + q), q the backward shift."""
        if self.centre is None:
            return 2 / period
        # w/tan(w T/2) for w = centre, at most NYQUIST_SHARE of the Nyquist frequency
        half = jnp.minimum(jnp.asarray(self.centre) * period / 2, NYQUIST_SHARE * HALF_PI)
        turns = half / (4 * HALF_PI)
        return 2 * half / period * cosine(turns) / sine(turns)

    def step(self, u: Array, x: tuple[Array, Array], period: Scalar) -> tuple[Array, tuple[Array, Array]]:
        """Return the output and the next state of the sampled filter, in transposed direct form II.

        s = K (1 - q)/(1 + q), q the backward shift: K = 2/T, or w/tan(w T/2) at the centre w.
        """
        K = self._bilinear(period)
        square = K * K
        over = 1 / (square + K * self.a_1 + self.a_0)
        y = (self.c_0 + K * self.c_1) * over * u + x[0]
        first = 2 * self.c_0 * over * u - 2 * (self.a_0 - square) * over * y
        second = (self.c_0 - K * self.c_1) * over * u - (square - K * self.a_1 + self.a_0) * over * y
        return self.d * u + y, (first + x[1], second)


def low_pass(w: Scalar) -> Biquad:
    """Return the Butterworth low-pass of second order with the corner w (1/s)."""
    return Biquad(0.0, 0.0, w * w, 2**0.5 * w, w * w)


def notch(w: Scalar, width: Scalar, depth: Scalar) -> Biquad:
    """Return the notch (s^2 + depth width w s + w^2)/(s^2 + width w s + w^2): its gain at w (1/s) is `depth`."""
    return Biquad(1.0, (depth - 1) * width * w, 0.0, width * w, w * w, centre=w)


def lead_lag(zero: Scalar, pole: Scalar) -> Biquad:
    """Return (1 + s/zero)/(1 + s/pole) with another pole and zero, which cancel, at -pole; zero and pole in 1/s."""
    rest = (1 - pole / zero) * pole
    return Biquad(pole / zero, rest, rest * pole, 2 * pole, pole * pole)


class ChainState(NamedTuple):
    """State of `FilterChain`, in A: derivative filter, integral, and the two states of each biquad."""

    derivative: Array
    integral: Array
    biquads: tuple[tuple[Array, Array], ...]


@record
class FilterChain(PositionLaw[ChainState]):
    """v_star = dv/dz z + dv/di i_star, i_star = i_r - H e: PID, lead-lag, two notches and a low-pass in series.

    H(s) = (k_p + k_int/s + k_d s/(1 + s/w_f)) (1 + s/w_z)/(1 + s/w_p) N_1(s) N_2(s) w_lp^2/(s^2 + sqrt(2) w_lp s +
    w_lp^2), e = z - r, with the notches N_k(s) = (s^2 + depth_k width_k w_k s + w_k^2)/(s^2 + width_k w_k s + w_k^2).
    The law does not use the velocity. As in `StateFeedback`, i_star is the demanded current, and i_r keeps the
    linearised rotor on the reference. With inversion.Linearised, i_ref is i_star. In the default values, w is the pole
    of the magnets. Schweitzer and Maslen, Magnetic Bearings (2009), 8.2. The rate of the integral includes k_aw (i_star
    - i), which limits the integral while the supply limits u.

    On a processor each part is discretised by the bilinear transform. The response of a notch is exact at its centre,
    or at 0.98 of the Nyquist frequency if the centre is higher. The lead-lag is off if w_z = w_p, a notch is off if
    its depth is 1, and the low-pass is off if w_lp is None (left out). By default, all of them are off. With k_int = 0
    and k_d > 0, the law is a PD controller.

    Use it where an existing drive has these filters, or no velocity is estimated:
    `Cascade(position=position.FilterChain(w_lp=1e4))`.
    """

    analytic = True
    k_p: Scalar = gain(135.0, "A/m", "proportional gain; left out: LQR in continuous time")
    k_int: Scalar = gain(5310.0, "A/m/s", "integral gain, 0: none; left out: LQR in continuous time", zero=True)
    k_d: Scalar = gain(0.219, "A s/m", "derivative gain, 0: none; left out: LQR in continuous time", zero=True)
    w_f: Scalar = gain(1.06e4, "1/s", "bandwidth of the derivative filter; left out: 20 w")
    k_aw: Scalar = gain(10.6, "1/s", "anti-windup rate, 0: none; left out: w/50", zero=True)
    w_z: Scalar = gain(2650.0, "1/s", "zero of the lead-lag; left out: 5 w")
    w_p: Scalar = gain(2650.0, "1/s", "pole of the lead-lag; left out: 5 w")
    w_1: Scalar = gain(5310.0, "1/s", "centre of the first notch; left out: 10 w")
    width_1: Scalar = gain(0.5, "1", "width of the first notch, as a share of its centre")
    depth_1: Scalar = gain(1.0, "1", "gain of the first notch at its centre; 1: no notch", zero=True)
    w_2: Scalar = gain(10600.0, "1/s", "centre of the second notch; left out: 20 w")
    width_2: Scalar = gain(0.5, "1", "width of the second notch, as a share of its centre")
    depth_2: Scalar = gain(1.0, "1", "gain of the second notch at its centre; 1: no notch", zero=True)
    w_lp: Scalar | None = gain(None, "1/s", "corner of the low-pass; left out: no low-pass", optional=True)

    @property
    def memory(self) -> tuple[tuple[str, str, str], ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        parts = {"lead_lag": "lead-lag", "notch_1": "first notch", "notch_2": "second notch"}
        parts |= {} if self.w_lp is None else {"low_pass": "low-pass"}
        states = ((f"{name}_{k}", "A", f"state of the {part}") for name, part in parts.items() for k in (1, 2))
        return ("derivative", "A", "filter of the derivative"), ("integral", "A", "integral term"), *states

    def init(self, model: Plant) -> ChainState:
        return jax.tree.map(jnp.zeros_like, self.scale(model))

    def begin(self, model: Plant, inputs: PositionInputs) -> ChainState:
        """Return the filters in the steady state for the first error, and an integral of 0."""
        e = jnp.asarray(inputs[0].z - inputs[1].r)
        return _begun(self.k_d * self.w_f * e, self.k_p * e, [part.steady for part in self._parts()])

    def begin_sampled(self, model: Plant, inputs: PositionInputs, period: Scalar) -> ChainState:
        e = jnp.asarray(inputs[0].z - inputs[1].r)
        parts = [functools.partial(part.steady_sampled, period=period) for part in self._parts()]
        derivative = -self.k_d * self.w_f / (1 + self.w_f * period / 2) * e
        return _begun(derivative, self.k_p * e + self.k_int * period / 2 * e, parts)

    def scale(self, model: Plant) -> ChainState:
        size = jnp.asarray(model.i_0 / 25)
        return ChainState(size, size, ((size, size),) * len(self._parts()))

    def designed(self, model: Plant, sampling: Sampling | None) -> "FilterChain":
        """Return the law with the gains of `optimal_gains` in continuous time, and k_aw and corners from the pole."""
        (k_int, k_p, k_d), w = map(float, optimal_gains(model)), float(model.pole)
        return dataclasses.replace(
            self, k_p=k_p, k_d=k_d, k_int=k_int, k_aw=w / 50, w_f=20 * w, w_z=5 * w, w_p=5 * w, w_1=10 * w, w_2=20 * w
        )

    def slope(self, model: Plant) -> Scalar:
        """Return the largest of k_aw, the poles of all parts, b k_d and sqrt(b k_p), 1/s."""
        b = linear_mechanics(model).b
        corners = [self.w_f, self.k_aw, self.w_p, self.w_1, self.w_2, b * self.k_d, jnp.sqrt(b * self.k_p)]
        corners += [] if self.w_lp is None else [self.w_lp]
        return jnp.max(jnp.stack([jnp.asarray(x) for x in corners]))

    def sigma(self, motion: Measurement, reference: Reference) -> Array:
        """Return e_dot + (k_p/k_d) e, the error that the feedback of e and e_dot drives to zero; e_dot if k_d = 0."""
        damped = jnp.asarray(self.k_d) > 0
        c = jnp.where(damped, self.k_p / jnp.where(damped, self.k_d, 1.0), 0.0)
        return sliding_variable(c, motion, reference)

    def _parts(self) -> list[Biquad]:
        parts = [
            lead_lag(self.w_z, self.w_p),
            notch(self.w_1, self.width_1, self.depth_1),
            notch(self.w_2, self.width_2, self.depth_2),
        ]
        return parts if self.w_lp is None else [*parts, low_pass(self.w_lp)]

    def __call__(self, model: Plant, inputs: PositionInputs, state: ChainState) -> tuple[Array, ChainState]:
        motion, reference = inputs
        e = motion.z - reference.r
        # k_d s/(1 + s/w_f) = k_d w_f (1 - w_f/(s + w_f)): the state is k_d w_f^2/(s + w_f) e
        y = self.k_p * e + state.integral + self.k_d * self.w_f * e - state.derivative
        derivative, rates = self.w_f * (self.k_d * self.w_f * e - state.derivative), []
        for part, x in zip(self._parts(), state.biquads, strict=True):
            y, moved = part.output(y, x)
            rates.append(moved)
        i_star = resting_current(model, reference) - y
        integral = self.k_int * e + unwinding(self.k_aw, self.k_int) * (i_star - motion.i)
        return force_of_current(model, motion.z, i_star), ChainState(derivative, integral, tuple(rates))

    def step(self, model: Plant, inputs: PositionInputs, state: ChainState, period: Scalar) -> tuple[Array, ChainState]:
        """Step each part by the bilinear transform.

        The anti-windup adds h (i_star - i)/(1 + h) to the integral, h = k_aw T.
        """
        motion, reference = inputs
        e = motion.z - reference.r
        half, leak = self.w_f * period / 2, unwinding(self.k_aw, self.k_int) * period
        # derivative: k_d w_f (1 - q)/(1 + half - (1 - half) q), with the backward shift q
        differentiated = self.k_d * self.w_f / (1 + half) * e + state.derivative
        derivative = -self.k_d * self.w_f / (1 + half) * e + (1 - half) / (1 + half) * differentiated
        y = self.k_p * e + state.integral + self.k_int * period / 2 * e + differentiated
        after = []
        for part, x in zip(self._parts(), state.biquads, strict=True):
            y, moved = part.step(y, x, period)
            after.append(moved)
        i_star = resting_current(model, reference) - y
        integral = state.integral + self.k_int * period * e + leak / (1 + leak) * (i_star - motion.i)
        return force_of_current(model, motion.z, i_star), ChainState(derivative, integral, tuple(after))

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        names = ["w_f", *["w_lp"] * (self.w_lp is not None)]
        corners = {name: rate(context, 2, 100, "corner from 2 w to 100 w") for name in names}
        corners |= {name: rate(context, 1, 50, "corner from w to 50 w") for name in ("w_z", "w_p")}
        corners |= {name: rate(context, 2, 50, "centre from 2 w to 50 w") for name in ("w_1", "w_2")}
        shares = {f"width_{k}": Interval(0.1, 2.0, "a tenth to twice the centre") for k in (1, 2)}
        shares |= {f"depth_{k}": Interval(0.03, 1.0, "a depth of 30 dB to no notch", True) for k in (1, 2)}
        return StateFeedback().ranges(context) | corners | shares


def _begun(derivative: Array, y: Array, parts: Sequence[Callable[..., Any]]) -> ChainState:
    """Return the state of a chain for an output y (A) of the PID."""
    states = []
    for steady in parts:
        y, state = steady(y)
        states.append(state)
    return ChainState(derivative, jnp.zeros_like(derivative), tuple(states))
