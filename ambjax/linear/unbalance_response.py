"""Response of a whole machine to the unbalance of its rotor against speed, with all loops closed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ambjax.linear.linear_machine import TurningMachine, turning_machines
from ambjax.linear.margins import poles_in_s
from ambjax.numerics.records import Scalar
from ambjax.numerics.small_matrices import held
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotation import GRAM_MM
from ambjax.world.rotor import Rotor

# Speeds of the first scan, and those that are added at each critical speed, within WIDTH damping ratios of it.
SCAN, NEAR, WIDTH = 121, 33, 4.0
# Poles with a larger damping ratio are no critical speeds: their amplification factor is below 1.5.
DAMPED = 0.35
HALF_POWER = np.sqrt(0.5)
# API 684 and API 617: a critical speed with a smaller amplification factor needs no separation margin.
CRITICALLY_DAMPED = 2.5
# Above this amplification factor, the damping of a mode is a rounding error.
UNDAMPED = 1e6


class UnbalanceResponse(NamedTuple):
    """Complex amplitudes against speed: a signal is Re(a exp(j W t)), with the rotor angle W t.

    They are NaN at speeds at which the machine is not stable, because no motion there is periodic.
    - `speeds` [S]: rpm, without sign. `magnets`, `sensors` [S, c]: displacements at the magnets and at the sensors, m.
    - `current` [S, c]: A. `command` [S, c]: commands of the laws, V, or A for commanded currents.
    """

    speeds: np.ndarray
    magnets: np.ndarray
    sensors: np.ndarray
    current: np.ndarray
    command: np.ndarray


class CriticalSpeed(NamedTuple):
    """A peak of the response to unbalance, by API 684.

    - `speed`: N_c, rpm. `axis`: number of the axis whose sensor moves most. `peak_to_peak`: there, m.
    - `amplification`: N_c/(N_2 - N_1), with the speeds at which the response is 0.707 of the peak. It is inf for an
      undamped mode, as `peak_to_peak` is.
    - `required`, `present`: separation margin from the operating speeds, %; None: no margin is required.
    """

    speed: float
    axis: int
    peak_to_peak: float
    amplification: float
    required: float | None
    present: float

    @property
    def separated(self) -> bool:
        """Whether the separation margin is large enough."""
        return self.required is None or self.present >= self.required


def a1_limit(speed: np.ndarray | float) -> np.ndarray:
    """Return the limit A1 of API 684 at a speed (rpm): 25.4 sqrt(12000/speed) um, peak to peak, in m."""
    return 25.4e-6 * np.sqrt(12000 / np.maximum(speed, 1e-9))


def unbalance_response(machine: Machine, period: Scalar, end: float) -> UnbalanceResponse:
    """Return the response to the unbalances of the rotor from 0 to `end` (rpm, with sign), dense near criticals.

    `period`: sample period, s. On a processor the amplitudes are those at the samples. Raises ValueError as
    `linearise_machine` does.
    """
    speeds = np.linspace(0.0, end, SCAN)
    points = list(turning_machines(machine, period, speeds))
    added = np.array([x for x in _near_crossings(speeds, points) if 0 < x / end < 1])
    points += turning_machines(machine, period, added)
    speeds = np.abs(np.concatenate([speeds, added]))
    found = np.array([_amplitudes(point, machine.rotor) for point in points])
    order, c = np.argsort(speeds), machine.count
    _, command, current, q = np.split(found[order], [c, 2 * c, 3 * c], axis=1)
    magnets, sensors = (q @ np.asarray(rows).T for rows in (machine.rotor.at_magnets, machine.rotor.at_sensors))
    return UnbalanceResponse(speeds[order], magnets, sensors, current, command)


def _near_crossings(speeds: np.ndarray, points: Sequence[TurningMachine]) -> np.ndarray:
    """Return speeds (rpm) near those at which the frequency of a lightly damped pole is the speed."""
    way, speeds, lines, found = np.sign(speeds[-1]), np.abs(speeds), [], []
    for point in points:
        poles = poles_in_s(point.system.without_idle())
        lines.append(poles[(np.imag(poles) > 0) & (np.abs(np.real(poles)) < DAMPED * np.abs(poles))] * 30 / np.pi)
    for k in range(len(points) - 1):
        for pole in lines[k] if len(lines[k + 1]) else ():
            after = lines[k + 1][np.argmin(np.abs(lines[k + 1] - pole))]
            above, below = pole.imag - speeds[k], speeds[k + 1] - after.imag
            if above > 0 and below >= 0:
                speed = speeds[k] + (speeds[k + 1] - speeds[k]) * above / (above + below)
                width = max(WIDTH * abs(after.real / abs(after)), 1e-3)
                found.append(speed * (1 + width * np.linspace(-1, 1, NEAR)))
    # both directions of a mode may have nearly the same frequency: their speeds are merged
    near = np.unique(np.concatenate([[], *found]))
    return way * near[np.concatenate([[True], np.diff(near) > 1e-5 * near[1:]])] if near.size else near


def _amplitudes(point: TurningMachine, rotor: Rotor) -> np.ndarray:
    """Return the complex amplitudes of the outputs at one speed, NaN if the machine is not stable there."""
    from scipy.linalg import expm

    system, W = point.system, point.W
    if not system.without_idle().stable:
        return np.full(len(system.C), np.nan, complex)
    force = sum(
        GRAM_MM * float(one.amount) * W**2 * np.exp(1j * np.radians(float(one.phase)))
        * (np.asarray(one.along_x) - 1j * np.asarray(one.along_y))
        for one in rotor.unbalances
    )  # fmt: skip
    n, b = len(np.asarray(rotor.gravity)), np.zeros(len(system.A), complex)
    b[n : 2 * n] = np.linalg.solve(np.asarray(rotor.M), force)
    s: complex = 1j * W
    if system.period is not None:
        # the effect of the force b exp(s t) over one sample on x' = A x + b exp(s t), with x = y exp(s t)
        A, period = point.free - s * np.eye(len(point.free)), float(system.period)
        s = np.exp(s * period)
        b[: len(A)] = s * held(A, b[: len(A), None], period, expm)[1][:, 0]
    scale = np.asarray(system.sizes)
    A = np.asarray(system.A) * scale / scale[:, None]
    # the rotor is free along axes without a magnet: their poles are at W = 0
    x = np.linalg.solve(s * np.eye(len(b)) - A, b / scale) if W else 0 * b
    return np.asarray(system.C) * scale @ x


def critical_speeds(found: UnbalanceResponse, operating: tuple[float, float]) -> list[CriticalSpeed]:
    """Return the peaks of the response at the sensors, ascending. `operating`: lowest and highest speed, rpm."""
    peaks = [one for axis in range(found.sensors.shape[1]) for one in _peaks(found, axis, operating)]
    peaks, kept = sorted(peaks, key=lambda one: -one.peak_to_peak), list[CriticalSpeed]()
    for one in peaks:  # the axes show the same critical speed, each with its own size
        if all(abs(one.speed - other.speed) * min(other.amplification, UNDAMPED) > other.speed for other in kept):
            kept.append(one)
    return sorted(kept, key=lambda one: one.speed)


def _peaks(found: UnbalanceResponse, axis: int, operating: tuple[float, float]) -> list[CriticalSpeed]:
    speeds, size, peaks = found.speeds, np.abs(found.sensors[:, axis]), []
    for k in np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1:
        N = float(speeds[k])
        ends = [_half_power(speeds, size, int(k), step) for step in (-1, 1)]
        sides = [abs(end - N) for end in ends if end is not None]
        if not sides:
            continue  # a shoulder of a larger peak
        width = sum(sides) * 2 / len(sides)  # a side that another peak hides has the width of the other one
        AF, height = (N / width, 2 * float(size[k])) if UNDAMPED * width > N else (np.inf, np.inf)
        peaks.append(CriticalSpeed(N, axis, height, AF, *separation(N, AF, operating)))
    return peaks


def _half_power(speeds: np.ndarray, size: np.ndarray, k: int, step: int) -> float | None:
    """Return the speed on one side of a peak at which the response is 0.707 of it; None if a larger peak is nearer."""
    level, m = HALF_POWER * size[k], k
    while 0 <= m + step < len(size) and size[m + step] <= size[k]:
        m += step
        if size[m] < level:
            # near a peak, 1/size^2 is a parabola of the speed
            a, b, at = (x**-2 for x in (size[m - step], size[m], level))
            return float(speeds[m - step] + (speeds[m] - speeds[m - step]) * (at - a) / (b - a))
    return None


def separation(speed: float, amplification: float, operating: tuple[float, float]) -> tuple[float | None, float]:
    """Return the separation margin that API 684 requires for a critical speed (rpm), and the present one, in %.

    `operating`: lowest and highest operating speed, rpm. None: the speed is critically damped.
    """
    low, high = operating
    below = speed < low
    present = 100 * (1 - speed / low if below else max(speed / high - 1, 0.0) if high else np.inf)
    if amplification < CRITICALLY_DAMPED:
        return None, present
    margin = 17 * (1 - 1 / (amplification - 1.5))
    return (min(margin, 16.0) if below else min(10 + margin, 26.0)), present
