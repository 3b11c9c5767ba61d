"""Measurement of the sensitivity by injection into the nonlinear simulation, as on a machine.

A periodic multi-sine e is added to the reading of the position or velocity sensor, after low-pass and converter. After
the loop has settled, the Fourier coefficients of e and of the sum (reading plus e) are computed over whole periods. At
each frequency of the multi-sine, S is the coefficient of the sum divided by that of e (ISO 14839-3, as secondary
sources cite it). The simulation includes the converter, the noise, the limits and the nonlinear signs.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.linear.analysis import Zones
from ambjax.linear.member_responses import Reading, Responses, member_responses
from ambjax.numerics.declared import require_number
from ambjax.numerics.records import Scalar
from ambjax.simulation.clock import Clock, takes_case
from ambjax.world.scenario import Scenario

# LINES: number of logarithmically spaced lines. NEAR: number of lines near a peak. AROUND: their range as multiples of
# the frequency of the peak.
LINES, NEAR, AROUND = 36, 11, (0.75, 1.33)
# Number of injections into a loop with noise, which differ in the noise.
REPETITIONS = 8


class Injection(NamedTuple):
    """Measured sensitivity of a loop. The frequencies of the multi-sine are called lines.

    - `frequency` [L]: lines, Hz.
    - `S`, `T`, `KS` [L]: complex means over the members that hold the rotor; None if no member holds it. T = reading/e
      (1), S = 1 + T (1), KS = u/e (V/m, or V s/m at the velocity sensor).
    - `peak`: largest |S| over the lines; None without S.
    - `peak_low`, `peak_high`: confidence interval of |S| at the line of the peak, from the members. Equal to `peak` if
      the scenario is not random; otherwise None if fewer than two members hold the rotor. None without S.
    - `peak_frequency`: line of the peak, Hz; None without S.
    - `lost`, `members`: number of members that lost the rotor or stalled, and of all members.
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


def frequency_lines(zones: Zones, clock: Clock, peak: float | None = None) -> np.ndarray:
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


@takes_case
def injected(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    frequencies: Sequence[float] | np.ndarray,
    *,
    reading: Reading = "z",
    amplitude: Scalar | None = None,
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
    - `frequencies`: lines, Hz, rounded to whole multiples of 1/clock.duration (see `frequency_lines`).
    - `reading`: "z" adds e to the reading of the position sensor, "z_dot" to that of the velocity sensor.
    - `amplitude`: largest |e|, m or m/s; None: 1 % of s_0, or of s_0 times the plant's unstable pole (1/s).
    - `members`, `seed`: size and seed of an ensemble whose members differ in the noise.
    - `settle`, `periods`: periods of the multi-sine before the measurement, and during it.
    - `confidence`: level of the confidence interval of the peak.

    In continuous time e(t) is a continuous function of time. It is added to one reading only: an e at the position
    sensor does not change the velocity reading. The Fourier sums use the values of the signals at the samples.

    Returns an `Injection`. Raises ValueError as `rollout` does, for a frequency that the period or the samples cannot
    resolve, and for `reading` = "z_dot" if the observer does not use the velocity reading.
    """
    if reading == "z_dot" and cascade.observer.estimates_velocity:
        raise ValueError(
            f"injection.reading = 'z_dot': the observer {type(cascade.observer).__name__} estimates the velocity and "
            "reads no velocity sensor. Inject at 'z'."
        )
    require_number("members", members, 1, whole=True)
    require_number("confidence", confidence, 0, 1)
    scenario = dataclasses.replace(scenario, seed=seed, member=np.arange(members))
    one = member_responses(cascade, scenario, clock, frequencies, reading, amplitude, r, settle, periods)
    return injection_of(one, scenario.random, confidence)


class MemberPeaks(NamedTuple):
    """Measured peaks of |S| of the members of an ensemble [N]: `peak` (inf if lost), `frequency` (Hz), `lost`.

    A stalled member counts as lost. The frequency of a lost member has no meaning.
    """

    peak: np.ndarray
    frequency: np.ndarray
    lost: np.ndarray


@takes_case
def injected_members(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    frequencies: Sequence[float] | np.ndarray,
    *,
    amplitude: Scalar | None = None,
    r: float = 0.0,
    periods: int = 4,
) -> MemberPeaks:
    """Measure the peak of |S| of each member of an ensemble at rest at the constant reference r (m).

    The other arguments are those of `member_responses`. Each member is measured once, with its own noise, over
    `periods` periods of the multi-sine. Noise biases the peak of a member upwards. Raises ValueError as `injected`
    does.
    """
    one = member_responses(cascade, scenario, clock, frequencies, amplitude=amplitude, r=r, periods=periods)
    size = np.where(one.held[:, None], np.abs(one.S), np.inf)
    return MemberPeaks(size.max(axis=1), one.frequency[size.argmax(axis=1)], ~one.held)


def injection_of(one: Responses, random: bool, confidence: float = 0.95) -> Injection:
    """Return the means over the members that did not lose the rotor."""
    S, KS, saturated = (x[one.held] for x in (one.S, one.KS, one.saturated))
    counts = len(one.held) - len(S), len(one.held)
    none = Injection(one.frequency, None, None, None, None, None, None, None, *counts, one.amplitude, None)
    if not len(S):
        return none
    mean = np.mean(S, axis=0)
    k = int(np.argmax(np.abs(mean)))
    peak = float(np.abs(mean[k]))
    # The component of each member's S in the direction of the mean S. Its mean is |mean S|; the mean of |S| is biased.
    along = np.real(S[:, k] * np.conj(mean[k])) / peak
    low, high = _interval(along, confidence) if random else (peak, peak)
    peaks = {"peak": peak, "peak_low": low, "peak_high": high, "peak_frequency": float(one.frequency[k])}
    return none._replace(S=mean, T=mean - 1, KS=np.mean(KS, axis=0), saturated=float(np.mean(saturated)), **peaks)


def _interval(x: np.ndarray, confidence: float) -> tuple[float | None, float | None]:
    """Return the interval of the mean of independent x [M] by Student's t; None, None for M = 1."""
    from scipy.stats import t

    if len(x) == 1:
        return None, None
    half = float(t.ppf(0.5 + 0.5 * confidence, len(x) - 1) * np.std(x, ddof=1) / np.sqrt(len(x)))
    return float(np.mean(x)) - half, float(np.mean(x)) + half
