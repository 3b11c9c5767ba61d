"""Peaks of the sensitivity functions and stability margins of a linearised loop, in NumPy.

The margins are those of the loop broken at the reading of the position sensor, and broken at the command
(`StateSpace.loop_transfer`).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ambjax.linear.late_command import command_delay
from ambjax.linear.state_space import Place, StateSpace
from ambjax.numerics.small_matrices import held

# Number of logarithmically spaced frequencies in a scan, in addition to those near poles.
POINTS = 600
# Relative width of the bracket of a peak's frequency at which its refinement ends, and points of each of its scans.
NARROW, LOCAL = 1e-6, 17
# Frequency that stands for 0, as a share of the lowest one. At 0 itself the response of an integrator is not finite.
STATIC = 1e-6
# DOUBLINGS: most doublings of the time over which the response to noise is summed, 1e18 samples. SETTLED: relative
# change in a doubling below which the variance is final.
DOUBLINGS, SETTLED = 60, 1e-13
# Relative distance from an end of the band, or from the value there, within which a maximum counts as one at this end.
EDGE = 1e-4
# Largest number of steps to a crossing.
ROUNDS = 60
# Below the band, frequencies from this share of its lowest one on are searched.
BELOW = 1e-3
# |S - 1| that counts as decayed, in continuous time.
DECAYED = 0.01
# End of the default band of a processor, as a share of the sampling rate.
BAND = 0.45


class ResponsePeak(NamedTuple):
    """Largest magnitude of a response in a band, and its frequency, Hz, which is 0 if the static response is largest.

    - `at_edge`: whether it lies at an end of the band, so that it is not known to be a peak.
    - `outside`: the largest magnitude outside the band if it is larger; None if it is not, or if it is not searched.
    """

    height: float
    frequency: float
    at_edge: bool = False
    outside: "ResponsePeak | None" = None


# Of an unstable loop: no response to a test signal is bounded.
NO_PEAK = ResponsePeak(math.inf, math.nan)


class Margins(NamedTuple):
    """Margins of the loop transfer L = 1/S - 1, with the loop broken at one place; named as in python-control.

    - `gm_low`, `gm_high`: the loop stays stable for every factor on L between these two (0, inf: no such limit).
    - `gm`: gain margin, `gm_low` or `gm_high`, whichever is nearer to 1 on a logarithmic scale (inf: no limit).
    - `pm`: phase margin, degrees: the smallest phase change, lag or lead, that makes the loop unstable (inf: |L| is
      never 1).
    - `delay`: smallest additional delay at this place that makes the loop unstable, s (inf: none).
    - `dm`: disk margin 1/max|S - 1/2| (P. Seiler, A. Packard and P. Gahinet, IEEE Control Systems 40:5 (2020)). The
      loop stays stable for every factor on L between (2 - dm)/(2 + dm) and its inverse.
    """

    gm: float
    gm_low: float
    gm_high: float
    pm: float
    delay: float
    dm: float


class LoopMargins(NamedTuple):
    """Margins of a loop broken at the reading of the position sensor, and broken at the command.

    A factor or a delay at the command is that of the drive: of processor, converter and amplifier. The laws remember
    their own commands, and the prediction assumes the delay of the case.
    """

    reading: Margins
    command: Margins

    @property
    def smaller(self) -> Margins:
        """The smaller margin of each kind."""
        one, other = self
        return Margins(
            min(one.gm, other.gm, key=lambda x: abs(math.log(x)) if x else 0.0),
            max(one.gm_low, other.gm_low),
            *(min(a, b) for a, b in zip(one[2:], other[2:], strict=True)),
        )

    def place(self, kind: str) -> Place:
        """Return the place of the smaller margin. `kind`: the name of a field of `Margins`."""
        return "command" if getattr(self.reading, kind) != getattr(self.smaller, kind) else "reading"


Magnitude = Callable[[np.ndarray], np.ndarray]


def peak(system: StateSpace, magnitude: Magnitude, low: float, high: float, end: float | None = None) -> ResponsePeak:
    """Return the largest value of a magnitude at frequency 0 and from `low` to `high` (Hz), with its frequency.

    `magnitude`: function that returns magnitudes [F] for frequencies [F] in Hz. `end`: frequency up to which the
    magnitude is also searched outside the band, above it and below it; None: it is not.
    """
    found = _peak(magnitude, scan(system, low, high))
    if end is None:
        return found
    parts = [(BELOW * low, low)] + ([(high, end)] if end > high else [])
    others = [_peak(magnitude, scan(system, *part)[1:], static=False) for part in parts]
    larger = max(others, key=lambda one: one.height)

    def at_edge(one: ResponsePeak, bottom: float, top: float) -> bool:
        flat = one.height <= (1 + EDGE) * float(magnitude(np.array([top]))[0])  # also if it no longer changes there
        return one.frequency > 0 and (one.frequency <= bottom * (1 + EDGE) or flat)

    larger = larger._replace(at_edge=at_edge(larger, BELOW * low, max(high, end)))
    found = found._replace(at_edge=at_edge(found, low, high))
    return found._replace(outside=larger) if larger.height > found.height * (1 + EDGE) else found


def _peak(magnitude: Magnitude, f: np.ndarray, static: bool = True) -> ResponsePeak:
    """Return the largest value of a magnitude near the frequencies `f`. `static`: whether the first stands for 0."""
    size = magnitude(f)
    k, first = int(np.argmax(size)), int(static)
    if static and k == 0:
        return ResponsePeak(float(size[0]), 0.0)
    left, right = f[max(k - 1, first)], f[min(k + 1, len(f) - 1)]
    while right > left * (1 + NARROW):
        near = np.linspace(left, right, LOCAL)
        best = int(np.argmax(magnitude(near)))
        left, right = near[max(best - 1, 0)], near[min(best + 1, LOCAL - 1)]
    tried = np.array([f[k], 0.5 * (left + right)])
    size = magnitude(tried)
    return ResponsePeak(float(size.max()), float(tried[size.argmax()]))


def whole_end(system: StateSpace) -> float:
    """Return the frequency (Hz) up to which peaks are searched: half the sampling rate.

    In continuous time, it is a frequency above which |S - 1| stays below DECAYED: with the poles p and the zeros q of
    S, |log S| <= sum |p/s| + sum |q/s| + ..., and the sums are below log(1 + DECAYED) there.
    """
    if system.period is not None:
        return 0.5 / float(system.period)
    scaled = system.scaled()
    zeros = np.linalg.eigvals(scaled.A - scaled.B[:, :1] @ scaled.C[:1])
    total = float(np.abs(scaled.poles()).sum() + np.abs(zeros).sum())
    return (1 + DECAYED) * total / math.log1p(DECAYED) / (2 * math.pi)


def decayed_end(system: StateSpace, low: float) -> float:
    """Return the end (Hz) of the band that pictures show: BAND of the sampling rate.

    In continuous time, it is the part of `whole_end` with |S - 1| above DECAYED.
    """
    if system.period is not None:
        return BAND / float(system.period)
    end = whole_end(system)
    f = scan(system, low, max(end, 2 * low))[1:]
    above = np.flatnonzero(np.abs(np.asarray(system.sensitivity(f)) - 1) > DECAYED)
    return float(f[min(above[-1] + 1, len(f) - 1)]) if above.size else float(f[-1])


def scan(system: StateSpace, low: float, high: float) -> np.ndarray:
    """Return frequencies (Hz): STATIC * low, which stands for 0, then `low` to `high`, dense near poles."""
    grid = np.geomspace(low, high, POINTS)
    s = poles_in_s(system)
    own = np.abs(np.imag(s)) / (2 * np.pi)
    widths = np.maximum(np.abs(np.real(s)) / (2 * np.pi), 1e-9 * own)
    near = (own[:, None] + widths[:, None] * np.linspace(-3, 3, 13)).ravel()
    near = near[(near > low) & (near < high)]
    return np.concatenate([[STATIC * low], np.unique(np.concatenate([grid, near]))])


def poles_in_s(system: StateSpace) -> np.ndarray:
    """Return the poles in 1/s, in the order of decreasing real part.

    On a processor s = log(z)/T, and poles at z = 0, which are pure delays, are left out.
    """
    poles = system.poles()
    if system.period is not None:
        poles = np.log(poles[np.abs(poles) > 1e-9] + 0j) / float(system.period)
    return poles[np.argsort(-np.real(poles))]


def margins_of(system: StateSpace) -> LoopMargins:
    """Return the margins of a stable loop, broken at the reading and at the command."""
    return LoopMargins(margins_at(system, "reading"), margins_at(system, "command"))


def margins_at(system: StateSpace, place: Place) -> Margins:
    """Return the margins of a stable loop, broken at the command, or at the reading: output 0, of input 0."""
    fastest = float(np.max(np.abs(poles_in_s(system)), initial=1.0)) / (2 * math.pi)
    high = 100 * fastest if system.period is None else 0.5 / float(system.period)
    scanned = scan(system, min(1e-3, 1e-6 * high), high)  # the first frequency stands for 0

    def L(f: np.ndarray) -> np.ndarray:
        return np.asarray(system.loop_transfer(f, place))

    f = scanned[1:]
    along = L(f)
    # L is real at half the sampling rate, and at 0, which the lowest frequency stands for here
    real = [*np.real(L(_crossings(lambda x: np.imag(L(x)), f, np.imag(along)))), along[0].real]
    real += [along[-1].real] if system.period is not None else []
    # L is exactly 0 at half the sampling rate if the controller has a zero there, as after a bilinear transform
    gains = [float(-1 / x) for x in real if x and math.isfinite(x) and -1 / x > 1e-9]
    crossings = _crossings(lambda x: _log(L(x)), f, _log(along))
    lags = math.pi + np.angle(L(crossings))
    delay = command_delay(system, f) if place == "command" else np.min(lags / (2 * np.pi * crossings), initial=np.inf)
    disk = _peak(lambda f: np.abs(1 / (1 + L(f)) - 0.5), scanned).height
    return Margins(
        min(gains, key=lambda x: abs(math.log(x)), default=math.inf),
        max((x for x in gains if x < 1), default=0.0),
        min((x for x in gains if x >= 1), default=math.inf),
        float(np.min(np.degrees(np.minimum(lags, 2 * np.pi - lags)), initial=np.inf)),
        float(delay),
        1 / disk,
    )


def _log(response: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(np.abs(response), np.finfo(float).tiny))


def _crossings(function: Magnitude, f: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the frequencies (Hz) at which a function crosses 0, by the Illinois method. `values`: at the scan f."""
    k = np.flatnonzero(values[:-1] * values[1:] < 0)
    # the sign of a rounding error at one end may be another one in the scan, which solves for all frequencies together
    k = k[function(f[k]) * function(f[k + 1]) < 0]
    a, x = f[k], f[k + 1]
    at_a, at_x = function(a), function(x)
    for _ in range(ROUNDS if k.size else 0):
        b, at_b = x, at_x
        x = b - at_b * (b - a) / (at_b - at_a)
        at_x = function(x)
        a, at_a = np.where(at_x * at_b < 0, (b, at_b), (a, at_a / 2))
        if np.all(np.abs(x - b) <= 1e-15 * x):
            break
    # at a pole of the function its sign changes, but its value does not cross 0
    return x[np.abs(at_x) <= 1e-3 * np.maximum(np.abs(values[k]), 1e-30)]


def noise_gain(system: StateSpace, period: float) -> float:
    """Return the rms of z per rms of white noise on the reading of z, for a stable loop.

    Each noise value is held for `period` (s); on a processor, for the system's own sample period. The covariance is the
    sum over the values so far, whose number is doubled until the variance of z settles (Smith, SIAM J. Appl. Math. 16
    (1968) 198-201). A linear solver is not accurate here: a pole close to 1, as that of an integral with a negligible
    gain, makes the Lyapunov equation singular.
    """
    from scipy.linalg import expm

    scaled = system.scaled()
    A, b, c = np.asarray(scaled.A), np.asarray(scaled.B)[:, :1], np.asarray(scaled.C)[3]
    if system.period is None:
        A, b = held(A, b, period, expm)
    covariance, variance, before = b @ b.T, float((c @ b)[0] ** 2), -1.0
    for _ in range(DOUBLINGS):
        if variance > 0 and variance - before <= SETTLED * variance:
            break
        covariance, A = covariance + A @ covariance @ A.T, A @ A
        before, variance = variance, float(c @ covariance @ c)
    return math.sqrt(variance)
