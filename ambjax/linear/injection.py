"""Measurement of the sensitivity by injection into the nonlinear simulation, as on a machine.

A periodic multi-sine e is added to the reading of the position or velocity sensor, after low-pass and converter. When
the loop has settled, S at each frequency of the multi-sine is the quotient of the Fourier coefficients of the reading,
e included, and of e, over whole periods (ISO 14839-3, as secondary sources cite it). The simulation includes converter,
noise, limits and the true signs.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import map_members
from ambjax.linear.analysis import Zones
from ambjax.linear.equilibrium import ideal, reading
from ambjax.linear.multisine import MultiSine, Reading, Response, multisine, with_wave
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import prepare, run
from ambjax.simulation.sliding import Slide
from ambjax.simulation.trajectory import ALIVE
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.signals import Constant

# Default amplitude of e, as a share of the gap s_0; at the velocity sensor, of s_0 times the plant's pole.
AMPLITUDE = 0.01
# Number of logarithmically spaced lines; number of lines near a peak, and their range as multiples of its frequency.
LINES, NEAR, AROUND = 30, 11, (0.75, 1.33)


class Injection(NamedTuple):
    """Measured sensitivity of a loop. The frequencies of the multi-sine are called lines.

    - `frequency` [L]: lines, Hz.
    - `S`, `T`, `KS` [L]: complex means over the members that did not lose the rotor; None if all did. S = reading/e
      (1), T = S - 1 (1), KS = u/e (V/m, or V s/m at the velocity sensor).
    - `peak`: largest |S| over the lines; None without S.
    - `peak_low`, `peak_high`: confidence interval of |S| at the line of the peak, from the members. Equal to `peak` if
      the scenario is not random; None with one member.
    - `peak_frequency`: line of the peak, Hz; None without S.
    - `lost`, `members`: number of members that lost the rotor, and of all members.
    - `amplitude`: largest |e|, m, or m/s at the velocity sensor.
    - `saturated`: share of the samples with |u| at the limit of the supply; None without S.
    """

    frequency: np.ndarray
    S: np.ndarray | None
    T: np.ndarray | None
    KS: np.ndarray | None
    peak: float | None
    peak_low: float | None
    peak_high: float | None
    peak_frequency: float | None
    lost: int
    members: int
    amplitude: float
    saturated: float | None


def lines(zones: Zones, clock: Clock, peak: float | None = None) -> np.ndarray:
    """Return lines [L] in Hz for `injected`: logarithmic over the frequency range of `zones`, denser near `peak` (Hz).

    `clock.duration` is one period of the multi-sine, and the lines are whole multiples of its inverse. Raises
    ValueError as `Zones.range` does.
    """
    low, high = zones.range(clock.sample_period)
    f = np.geomspace(low, high, LINES)
    if peak:
        near = peak * np.linspace(*AROUND, NEAR)
        f = np.concatenate([f, near[(near > low) & (near < high)]])
    harmonics = np.round(f * float(clock.duration)).astype(int)
    return np.unique(np.clip(harmonics, 1, (clock.samples - 1) // 2)) / float(clock.duration)


def injected(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    frequencies: Sequence[float] | np.ndarray,
    *,
    reading: Reading = "z",
    amplitude: float | None = None,
    members: int = 1,
    seed: int = 0,
    r: float = 0.0,
    settle: int = 1,
    periods: int = 1,
    confidence: float = 0.95,
) -> Injection:
    """Measure the sensitivity of the loop at rest at the constant reference r (m), without disturbances.

    - `clock`: its samples are one period of the multi-sine. The integrator `Slide` is replaced, because it does not
      apply to this loop.
    - `frequencies`: lines, Hz, rounded to whole multiples of 1/clock.duration (see `lines`).
    - `reading`: "z" adds e to the reading of the position sensor, "z_dot" to that of the velocity sensor.
    - `amplitude`: largest |e|, m or m/s; None: 1 % of s_0, or of s_0 times the plant's unstable pole (1/s).
    - `members`, `seed`: size and seed of an ensemble whose members differ in the noise.
    - `settle`, `periods`: periods of the multi-sine before the measurement, and during it.
    - `confidence`: level of the confidence interval of the peak.

    In continuous time e(t) is continuous. It is added to one reading only: e on the position does not change the
    velocity reading. The Fourier sums are over samples.

    Returns an `Injection`. Raises ValueError as `rollout` does, for a frequency that the period or the samples cannot
    resolve, and for `reading` = "z_dot" if the observer does not use the velocity reading.
    """
    if reading == "z_dot" and cascade.observer.estimates_velocity:
        raise ValueError(
            f"injection.reading = 'z_dot': the observer {type(cascade.observer).__name__} estimates the velocity and "
            "reads no velocity sensor. Inject at 'z'."
        )
    usual = AMPLITUDE * float(scenario.plant.s_0) * (float(scenario.plant.pole) if reading == "z_dot" else 1.0)
    amplitude = usual if amplitude is None else float(amplitude)
    if not amplitude > 0:
        raise ValueError(f"injection.amplitude = {amplitude:g}: it must be above 0.")
    if members < 1 or settle < 0 or periods < 1:
        raise ValueError(
            f"injection: members = {members}, settle = {settle}, periods = {periods}: members and periods must be at "
            "least 1, settle at least 0."
        )
    wave = multisine(_harmonics(frequencies, clock), clock.samples, float(clock.sample_period), amplitude, reading)
    random = scenario.random
    cascade, scenario = _at_rest(cascade, scenario, r)
    scenario = dataclasses.replace(scenario, seed=seed, member=np.arange(members))
    skip = settle * clock.samples
    method = None if isinstance(clock.method, Slide) else clock.method
    longer = dataclasses.replace(clock, samples=skip + periods * clock.samples, method=method)
    system, longer = prepare(cascade, scenario, longer)
    response = Response(_tiled(wave, members), scenario.u_max, skip)
    sums, code = map_members(_member, canonical((system, longer, response)))
    kept = code == ALIVE
    e = float(wave.size) * np.exp(1j * np.asarray(wave.phases))
    S, KS = ((x[kept, 0] + 1j * x[kept, 1]) / e for x in (sums.read, sums.u))
    frequency = np.asarray(wave.harmonics) / float(clock.duration)
    return _summary(frequency, S, KS, sums.saturated[kept], members, amplitude, confidence, random)


def _member(tree: Any) -> tuple[Any, Any]:
    """Return the `FourierSums` and the status code of one member."""
    system, clock, response = tree
    outcome = run(with_wave(system, response.wave), clock, response, 0)
    return outcome.measured, outcome.trajectory.lost_code


def _tiled(wave: MultiSine, members: int) -> MultiSine:
    """Return the wave with its arrays [L] repeated for each member, [N, L]."""
    harmonics, phases = (np.tile(x, (members, 1)) for x in (wave.harmonics, wave.phases))
    return dataclasses.replace(wave, harmonics=harmonics, phases=phases)


def _at_rest(cascade: Cascade, scenario: Scenario, r: float) -> tuple[Cascade, Scenario]:
    """Return cascade and scenario that start at rest at the constant reference r (m), without disturbances."""
    initial = Initial(r, 0.0, float(scenario.plant.equilibrium(r)[0]))
    scenario = dataclasses.replace(scenario.undisturbed(), reference=Constant(r), initial=initial)
    inversion = cascade.inversion.started(cascade.model.equilibrium(r)[0])
    # The observer does not start at the first measurement: a slow observer would keep its noise as an initial error.
    rest = initial.measurement()
    z = reading(ideal(scenario), rest, (0.0, 0.0)).z
    return dataclasses.replace(cascade, inversion=inversion, observer=cascade.observer.started(z)), scenario


def _harmonics(frequencies: Sequence[float] | np.ndarray, clock: Clock) -> np.ndarray:
    """Return the harmonics [L] of 1/duration nearest to the frequencies (Hz), sorted, each once."""
    f, base = np.asarray(frequencies, float), 1 / float(clock.duration)
    harmonics = np.unique(np.round(f / base))
    if not harmonics.size or not np.isfinite(f).all() or harmonics[0] < 1 or harmonics[-1] >= clock.samples / 2:
        raise ValueError(
            f"injection.frequencies: they must be at least {base:g} Hz, one period of {clock.samples} samples, "
            f"and below {0.5 / float(clock.sample_period):g} Hz, half the sampling rate. Change them or clock.samples."
        )
    if harmonics[-1] * clock.samples > np.iinfo(jnp.result_type(int)).max:
        raise ValueError(
            f"clock.samples = {clock.samples}: a period is too long for the integers of JAX. Set JAX_ENABLE_X64=1."
        )
    return harmonics.astype(int)


def _summary(
    frequency: np.ndarray,
    S: np.ndarray,
    KS: np.ndarray,
    saturated: np.ndarray,
    members: int,
    amplitude: float,
    confidence: float,
    random: bool,
) -> Injection:
    """Return the means over the M members that did not lose the rotor: of S and KS [M, L], and saturated [M]."""
    lost = members - len(S)
    if not len(S):
        return Injection(frequency, None, None, None, None, None, None, None, lost, members, amplitude, None)
    mean = np.mean(S, axis=0)
    k = int(np.argmax(np.abs(mean)))
    peak = float(np.abs(mean[k]))
    # The component of each member's S in the direction of the mean S. Its mean is |mean S|; the mean of |S| is biased.
    along = np.real(S[:, k] * np.conj(mean[k])) / peak
    low, high = _interval(along, confidence) if random else (peak, peak)
    return Injection(
        frequency,
        mean,
        mean - 1,
        np.mean(KS, axis=0),
        peak,
        low,
        high,
        float(frequency[k]),
        lost,
        members,
        amplitude,
        float(np.mean(saturated)),
    )


def _interval(x: np.ndarray, confidence: float) -> tuple[float | None, float | None]:
    """Return the interval of the mean of independent x [M] by Student's t; None, None for M = 1."""
    from scipy.stats import t

    if len(x) == 1:
        return None, None
    half = float(t.ppf(0.5 + 0.5 * confidence, len(x) - 1) * np.std(x, ddof=1) / np.sqrt(len(x)))
    return float(np.mean(x)) - half, float(np.mean(x)) + half
