"""A multi-sine, the systems that add it to the reading of the position sensor, and the Fourier sums of the response."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.folds import Ending
from ambjax.simulation.loop import ClosedLoop, Realised
from ambjax.simulation.sampled import Sampled, SampledState
from ambjax.simulation.trajectory import Row
from ambjax.world.sensor import Errors, FaultyErrors, Measurement
from ambjax.world.signals import Reference


@record
class MultiSine:
    """Sum of cosines at harmonics of a base frequency: e(t) = sum of size cos(2 pi harmonic t/(samples T) + phase).

    - `harmonics` [L]: whole numbers below half of `samples`.
    - `size`: amplitude of every cosine, m.
    - `phases` [L]: rad.
    - `period`: sample period T, s.
    - `samples`: samples in a period of the multi-sine.
    """

    harmonics: Array
    size: Scalar = leaf(unit="m", at_least=0, at_most=1.0)
    phases: Array
    period: Scalar = leaf(unit="s", at_least=1e-9, at_most=1e6)
    samples: int = static()

    def angles(self, sample: Array) -> Array:
        """Return 2 pi harmonic n/samples [L] at sample n, rad, between 0 and 2 pi. The product is one of integers."""
        product = self.harmonics.astype(sample.dtype) * (sample % self.samples)
        return (2 * jnp.pi / self.samples) * (product % self.samples)

    def at(self, sample: Array) -> Array:
        """Return e at a sample, m."""
        return self.size * jnp.sum(jnp.cos(self.angles(sample) + self.phases))

    def __call__(self, t: Scalar) -> Array:
        """Return e at time t (s), m."""
        turn = jnp.asarray(t) / (self.samples * self.period) % 1.0
        return self.size * jnp.sum(jnp.cos(2 * jnp.pi * self.harmonics * turn + self.phases))


def multisine(harmonics: np.ndarray, samples: int, period: float, amplitude: float) -> MultiSine:
    """Return the multi-sine with equal sizes and Schroeder phases, whose largest |e_n| is `amplitude` (m).

    Schroeder phases -pi l (l - 1)/L keep the largest value low (M. R. Schroeder, IEEE Trans. Inf. Theory 16 (1970)).
    """
    number = np.arange(len(harmonics))
    phases = -np.pi * number * (number + 1) / len(harmonics)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[harmonics] = 0.5 * samples * np.exp(1j * phases)
    largest = np.max(np.abs(np.fft.irfft(spectrum, samples)))
    return MultiSine(np.asarray(harmonics, float), amplitude / largest, phases, period, samples)  # pyright: ignore


class InjectedInputs(NamedTuple):
    """`ExternalInputs` of the loop, and e (m)."""

    reference: Reference
    q_z: Array
    q_i: Array
    e: Array


@record
class InjectedLoop(Realised):
    """The closed loop of one member in continuous time, with e(t) added to the reading of z.

    The sliding step does not apply: it evaluates the laws without e.
    """

    wave: MultiSine

    def inputs(self, t: Scalar) -> Any:
        return InjectedInputs(*super().inputs(t), self.wave(t))

    def received(self, inputs: Any, plant: Any, errors: Errors) -> Measurement:
        measured = super().received(inputs, plant, errors)
        return measured._replace(z=measured.z + inputs.e)


@record
class InjectedSampled(Sampled):
    """The closed loop on a processor, with e_n added to the reading of z, after converter and faults."""

    wave: MultiSine

    def injected(self, t: Scalar) -> Array:
        """Return e (m) at the sample at t (s)."""
        return self.wave.at(jnp.round(jnp.asarray(t) / self.period).astype(int))

    def jump(self, t: Scalar, state: SampledState, errors: Errors | FaultyErrors) -> SampledState:
        state, measured = self.read(state, errors)
        return self.with_command(measured._replace(z=measured.z + self.injected(t)), self.reference(t), state)

    def row(self, t: Scalar, state: SampledState, errors: Errors | FaultyErrors, alive: Array) -> Row:
        row = super().row(t, state, errors, alive)
        return row._replace(z_measured=row.z_measured + self.injected(t))


def with_wave(system: ClosedLoop | Sampled, wave: MultiSine) -> Any:
    """Return the system of one member, for a rollout, with e added to the reading of z."""
    system = system.realised()
    if isinstance(system, Sampled):
        return InjectedSampled(system.loop, system.period, system.cuts, wave)
    assert isinstance(system, Realised)
    return InjectedLoop(system.cascade, system.scenario, system.key, wave)


class FourierSums(NamedTuple):
    """Sums of a `Response`: samples so far, of the reading (m) and of u (V) [2, L] each, and the samples at u_max."""

    sample: Array
    read: Array
    u: Array
    saturated: Array


@record
class Response:
    """Fourier coefficients, at the lines of `wave`, of what the controller reads (m) and of u (V).

    The sums are over the samples from number `skip` on, a whole number of periods of the wave. `u_max`: limit of the
    supply, V. The result is a `FourierSums` with real and imaginary parts of the coefficients, and with the share of
    samples at u_max.
    """

    wave: MultiSine
    u_max: Scalar
    skip: int = static()

    def init(self) -> FourierSums:
        zero = jnp.zeros((2, *self.wave.harmonics.shape), jnp.result_type(float))
        return FourierSums(jnp.asarray(0), zero, zero, zero[0, 0])

    def update(self, carry: FourierSums, row: Any, span: Any) -> FourierSums:
        angles = self.wave.angles(carry.sample)
        counts = carry.sample >= self.skip
        basis = jnp.where(counts, jnp.stack([jnp.cos(angles), -jnp.sin(angles)]), 0.0)
        read, u = carry.read + basis * row.z_measured, carry.u + basis * row.u
        saturated = carry.saturated + (counts & (jnp.abs(row.u) >= self.u_max))
        return FourierSums(carry.sample + 1, read, u, saturated)

    def result(self, carry: FourierSums, ending: Ending) -> FourierSums:
        count = carry.sample - self.skip
        return FourierSums(count, 2 / count * carry.read, 2 / count * carry.u, carry.saturated / count)
