"""The multi-sine, which a closed loop adds to a sensor's reading, and the Fourier coefficients of the response."""

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.folds import Ending

# Reading to which e is added: z (m) or z_dot (m/s).
Reading = Literal["z", "z_dot"]


@record
class MultiSine:
    """Sum of cosines, e(t) = sum_l size cos(2 pi harmonics_l t/(samples T) + phases_l)."""

    harmonics: Array = leaf(shape="l", at_least=1, at_most=1e9, doc="whole numbers [L] from 1 to below `samples`/2")
    size: Scalar = leaf(unit="m or m/s", at_least=0, at_most=1e3, doc="amplitude of every cosine")
    phases: Array = leaf(shape="l", unit="rad", at_least=-1e3, at_most=1e3, doc="phases [L]")
    period: Scalar = leaf(unit="s", at_least=1e-9, at_most=1e6, doc="sample period T")
    samples: int = static(doc="number of samples in a period of the multi-sine")
    reading: Reading = static(default="z", doc="the reading to which e is added")

    def angles(self, sample: Array) -> Array:
        """Return the angles 2 pi harmonics n/samples [L] at sample number n, between 0 and 2 pi rad.

        The product is computed in integers, so that it has no rounding error.
        """
        product = self.harmonics.astype(sample.dtype) * (sample % self.samples)
        return (2 * jnp.pi / self.samples) * (product % self.samples)

    def at(self, sample: Array) -> Array:
        """Return e (m or m/s) at a sample number."""
        return self.size * jnp.sum(jnp.cos(self.angles(sample) + self.phases))

    def __call__(self, t: Scalar) -> Array:
        """Return e (m or m/s) at time t (s)."""
        turn = jnp.asarray(t) / (self.samples * self.period) % 1.0
        return self.size * jnp.sum(jnp.cos(2 * jnp.pi * self.harmonics * turn + self.phases))


def multisine(
    harmonics: np.ndarray, samples: int, period: float, amplitude: float, reading: Reading = "z"
) -> MultiSine:
    """Return the multi-sine with the given harmonics [L] whose largest |e_n| is `amplitude` (m or m/s).

    `samples`: samples in a period. `period`: sample period, s. All cosines have the same size. Their Schroeder phases
    -pi l (l - 1)/L, l = 1 to L, give a low ratio of the largest value to the size (M. R. Schroeder, IEEE Trans. Inf.
    Theory 16 (1970)).
    """
    number = np.arange(len(harmonics))
    phases = -np.pi * number * (number + 1) / len(harmonics)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[harmonics] = 0.5 * samples * np.exp(1j * phases)
    largest = np.max(np.abs(np.fft.irfft(spectrum, samples)))
    size = amplitude / largest
    return MultiSine(np.asarray(harmonics, float), size, phases, period, samples, reading)  # pyright: ignore


class FourierSums(NamedTuple):
    """Sums of a `Response`.

    - `sample`: number of samples so far.
    - `read`, `u` [2, L]: real and imaginary parts of the Fourier sums of the reading (m or m/s) and of u (V).
    - `saturated`: number of samples with |u| at the limit of the supply.
    """

    sample: Array
    read: Array
    u: Array
    saturated: Array


@record
class Response:
    """Fold: Fourier coefficients, at the frequencies of `wave`, of the reading with e (m or m/s) and of u (V).

    - `wave`: the multi-sine.
    - `u_max`: limit of the supply, V.
    - `skip`: number of the first sample that counts. The samples from there on are whole periods of the wave.
    - `axis`: number of the axis, of a machine.

    The result is a `FourierSums` with the coefficients instead of the sums, with `sample` as the number of samples that
    count, and with `saturated` as their share.
    """

    wave: MultiSine
    u_max: Scalar
    skip: int = static()
    axis: Array | None = None

    def init(self) -> FourierSums:
        zero = jnp.zeros((2, *self.wave.harmonics.shape), jnp.result_type(float))
        return FourierSums(jnp.asarray(0), zero, zero, zero[0, 0])

    def update(self, carry: FourierSums, row: Any, span: Any) -> FourierSums:
        angles = self.wave.angles(carry.sample)
        z, u = (row.z_measured, row.u) if self.axis is None else (row.axes.z_measured[self.axis], row.axes.u[self.axis])
        counts = carry.sample >= self.skip
        basis = jnp.where(counts, jnp.stack([jnp.cos(angles), -jnp.sin(angles)]), 0.0)
        saturated = carry.saturated + (counts & (jnp.abs(u) >= self.u_max))
        return FourierSums(carry.sample + 1, carry.read + basis * z, carry.u + basis * u, saturated)

    def result(self, carry: FourierSums, ending: Ending) -> FourierSums:
        count = carry.sample - self.skip
        return FourierSums(count, 2 / count * carry.read, 2 / count * carry.u, carry.saturated / count)
