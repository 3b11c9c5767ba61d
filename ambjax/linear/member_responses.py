"""The multi-sine that a closed loop adds to a reading, and the response of each member of an ensemble to it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.fast_path import SHORTEST
from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import Rollouts, map_members, size
from ambjax.linear.equilibrium import ideal, reading
from ambjax.numerics.declared import require_number
from ambjax.numerics.records import Scalar, canonical, leaf, record, replaced, static
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Ending
from ambjax.simulation.rollout import Result, prepare
from ambjax.simulation.sliding import Slide
from ambjax.simulation.trajectory import ALIVE
from ambjax.world.plant import Plant
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Constant

# Default amplitude of e, as a share of the gap s_0; at the velocity sensor, of s_0 times the plant's pole.
AMPLITUDE = 0.01
# The compiled program has a multiple of PADDED lines, so that measurements with a few lines more or less share it.
PADDED = 16
# An ensemble of at most this many members runs in calls of SHORTEST members. These calls share one program and use all
# cores.
FEW = 4 * SHORTEST


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


class Responses(NamedTuple):
    """Measured responses of the members of an ensemble [N] at L lines.

    - `frequency` [L]: lines, Hz.
    - `S`, `KS` [N, L]: complex; meaningless for members that do not hold the rotor.
    - `saturated` [N]: share of the samples with |u| at the limit of the supply.
    - `held` [N]: whether the rotor was held.
    - `amplitude`: largest |e|, m or m/s.
    """

    frequency: np.ndarray
    S: np.ndarray
    KS: np.ndarray
    saturated: np.ndarray
    held: np.ndarray
    amplitude: float


def member_responses(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    frequencies: Sequence[float] | np.ndarray,
    channel: Reading = "z",
    amplitude: Scalar | None = None,
    r: float = 0.0,
    settle: int = 1,
    periods: int = 1,
) -> Responses:
    """Inject the same multi-sine into each member of an ensemble, whose varying leaves are arrays [N].

    The arguments are those of `injected`; `channel` is its argument `reading`. `scenario.member` [N] contains the
    numbers of the members.
    """
    gap, pole = (float(np.mean(np.asarray(x))) for x in (scenario.plant.s_0, scenario.plant.pole))
    require_number("amplitude", amplitude, optional=True)
    amplitude = AMPLITUDE * gap * (pole if channel == "z_dot" else 1.0) if amplitude is None else float(amplitude)
    if not amplitude > 0:
        raise ValueError(f"amplitude = {amplitude:g}: it must be above 0.")
    require_number("settle", settle, 0, whole=True)
    require_number("periods", periods, 1, whole=True)
    require_number("r", r)
    wave = multisine(_harmonics(frequencies, clock), clock.samples, float(clock.sample_period), amplitude, channel)
    skip = settle * clock.samples
    method = None if isinstance(clock.method, Slide) else clock.method
    longer = replaced(clock, samples=skip + periods * clock.samples, method=method)
    system, longer = prepare(*_at_rest(cascade, scenario, r), longer)
    response = Response(padded(wave, PADDED * math.ceil(len(wave.harmonics) / PADDED)), scenario.voltage_limit, skip)
    tree = canonical((system, longer, response))
    found = map_members(_responses, tree, call=SHORTEST if size(tree) <= FEW else None, vectorised=True)
    return responses_of(found.metrics, found.trajectory.lost_code, wave, clock, amplitude)


def responses_of(sums: FourierSums, code: Any, wave: MultiSine, clock: Clock, amplitude: float) -> Responses:
    """Return the responses to a wave from the sums and the status codes of the members. `clock`: of one period."""
    e = float(wave.size) * np.exp(1j * np.asarray(wave.phases))
    read, u = (np.asarray(x)[..., : len(e)] for x in (sums.read, sums.u))
    S, KS = ((x[:, 0] + 1j * x[:, 1]) / e for x in (read, u))
    frequency = np.asarray(wave.harmonics) / float(clock.duration)
    return Responses(frequency, S, KS, np.asarray(sums.saturated), np.asarray(code) == ALIVE, amplitude)


def _responses(tree: Any, axes: Any) -> Result:
    """Simulate a block of members, with the wave of the fold (`Response`) added to the readings."""
    waved = [(dataclasses.replace(system, wave=fold.wave), clock, fold) for system, clock, fold in (tree, axes)]
    return Rollouts()(*waved)


def padded(wave: MultiSine, lines: int) -> MultiSine:
    """Return the wave with this number of lines."""
    padding = (0, lines - len(wave.harmonics))
    phases = np.pad(wave.phases, padding, constant_values=0.5 * np.pi)
    return dataclasses.replace(wave, harmonics=np.pad(wave.harmonics, padding), phases=phases)


def _at_rest(cascade: Cascade, scenario: Scenario, r: float) -> tuple[Cascade, Scenario]:
    """Return cascade and scenario that start at rest at the constant reference r (m), without disturbances."""
    scenario = dataclasses.replace(scenario.undisturbed(), reference=Constant(r))
    i, i_model, z = _rest(*canonical((scenario, cascade.model, r)))
    scenario = dataclasses.replace(scenario, initial=Initial(r, 0.0, float(i) if np.ndim(i) == 0 else i))
    # The observer does not start at the first measurement: a slow observer would keep the noise of this measurement as
    # an initial error.
    laws = {"inversion": cascade.inversion.started(i_model), "observer": cascade.observer.started(z)}
    return dataclasses.replace(cascade, **laws), scenario


def _values_at_rest(scenario: Scenario, model: Plant, r: Scalar) -> tuple[Array, Array, Array]:
    """Return the currents of plant and model at rest at r (m), in A, and the reading of the position there, m."""
    i = scenario.plant.equilibrium(r)[0]
    z = reading(ideal(scenario), Measurement(jnp.asarray(r), 0.0 * i, i), (0.0, 0.0)).z
    return i, model.equilibrium(r)[0], z


_rest = compiled_quickest(_values_at_rest)  # a command would compile each operation alone


def _harmonics(frequencies: Sequence[float] | np.ndarray, clock: Clock) -> np.ndarray:
    """Return the harmonics [L] of 1/duration nearest to the frequencies (Hz), sorted, each once."""
    f, base = np.asarray(frequencies), 1 / float(clock.duration)
    harmonics = np.unique(np.round(f / base)) if f.dtype.kind in "iuf" else np.zeros(0)
    if not harmonics.size or not np.isfinite(f).all() or harmonics[0] < 1 or harmonics[-1] >= clock.samples / 2:
        raise ValueError(
            f"injection.frequencies: they must be at least {base:g} Hz, the inverse of {clock.samples} samples, "
            f"and below {0.5 / float(clock.sample_period):g} Hz, half the sampling rate. Change them or clock.samples."
        )
    if harmonics[-1] * clock.samples > np.iinfo(jnp.result_type(int)).max:
        raise ValueError(
            f"clock.samples = {clock.samples}: a period is too long for the integers of JAX. Set JAX_ENABLE_X64=1."
        )
    return harmonics.astype(int)
