"""Filters of second order (biquads), in continuous time and by the bilinear transform."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import HALF_PI, cosine, sine

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
