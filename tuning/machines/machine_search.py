"""The search for the gains of a machine: descents of the largest peak of |S| from several starts.

They are by BFGS with a weak Wolfe line search, for functions that are not smooth at their minima: Lewis and Overton,
Nonsmooth optimization via quasi-Newton methods, Math. Program. 141 (2013), 135-163.
"""

import math
import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ambjax.host.sealed import seal
from tuning.events import Tell
from tuning.machines.machine_gains import LqgSpace, MachineSpace
from tuning.machines.machine_peaks import Peaks, Value
from tuning.solve.checkpoint import restored

Lost = Callable[[np.ndarray], int]
Over = Callable[[Value], bool]
Function = Callable[[np.ndarray], Value]
# Largest change of a coordinate in a step.
LONGEST = 0.5


class Settings(NamedTuple):
    """The table [tune] of a machine."""

    space: MachineSpace | LqgSpace
    limits: dict[str, float]
    minutes: float
    seed: int
    starts: int
    iterations: int
    held_out: int


class Progress(NamedTuple):
    """A search after `number` starts.

    `best`: lowest peak, with the `fewest` members that are lost or beyond a limit. `slowest`: least growth rate of a
    pole. `seconds`: duration so far, s.
    """

    number: int
    best: Value
    fewest: float
    slowest: Value
    seconds: float

    @property
    def answer(self) -> Value:
        """The best point; that of the least growth rate if no start could be made stable."""
        return self.best if np.isfinite(self.best.f) else self.slowest


def save(path: pathlib.Path, facts: dict[str, Any], now: Progress) -> None:
    """Write the checkpoint. `facts`: what a resumed search must match. Raises ValueError if it cannot be written."""
    numbers = np.array([now.number, now.best.f, now.fewest, now.slowest.f, now.seconds])
    seal(path, {"best": now.best.x, "slowest": now.slowest.x, "numbers": numbers}, {"fingerprint": facts})


def saved(path: pathlib.Path, facts: dict[str, Any], tell: Tell) -> Progress | None:
    """Return the checkpoint, as `restored` does."""

    def progress(arrays: dict[str, np.ndarray], _: dict[str, Any]) -> Progress:
        number, best, fewest, slowest, seconds = arrays["numbers"].tolist()
        best, slowest = (Value(arrays[k], f, 0.0 * arrays[k]) for k, f in (("best", best), ("slowest", slowest)))
        return Progress(int(number), best, fewest, slowest, seconds)

    return restored(path, facts, progress, "the search", tell)


def searched(
    peaks: Peaks,
    settings: Settings,
    start: np.ndarray,
    lost: Lost,
    tell: Tell,
    before: Progress | None = None,
    save: Callable[[Progress], None] = lambda now: None,
) -> Progress:
    """Return the result of the search.

    From each start, BFGS reduces the largest growth rate until the machine is stable, then the peak. The first start is
    the case. The logarithms of the gains of the others have a standard deviation of 0.3 around those of the best point
    so far and of 0.7 around those of the case, in turn. `lost`: number of
    members that are lost, or beyond a limit of their simulation, at coordinates [m]. `before`: the search so far, which
    continues. `save`: receives it after each start.
    """
    rng, space, first = np.random.default_rng(settings.seed), settings.space.space, settings.space.space.encode(start)
    none = Value(first, math.inf, np.zeros(len(first)))
    now = before or Progress(0, none, math.inf, none, 0.0)
    began = time.monotonic() - now.seconds
    over: Over = lambda _: time.monotonic() - began > 60 * settings.minutes  # noqa: E731
    rng.normal(size=(now.number, len(first)))  # the draws of the starts before
    for number in range(now.number, settings.starts):
        _, best, fewest, slowest, _ = now
        if number and over(best):
            break
        near = number % 2 == 1 and math.isfinite(best.f)
        centre, size = (best.x, 0.3) if near else (first, 0.7 if number else 0.0)
        held = _stabilised(peaks, space.drawn_back(centre + size * rng.normal(size=len(first))), settings, over)
        slowest = min(slowest, held, key=lambda v: v.f)
        if peaks.stable(held):
            path = _descent(peaks, held.x, settings, over)
            if fewest or path[-1].f < best.f:
                low, count = _kept(peaks, path, settings, lost, over)
                best, fewest = (low, count) if (count, low.f) < (fewest, best.f) else (best, fewest)
        now = Progress(number + 1, best, fewest, slowest, time.monotonic() - began)
        save(now)
        found = f"best peak {math.exp(best.f):.4g}" if math.isfinite(best.f) else f"growth rate {slowest.f:.3g} 1/s"
        found += f", {fewest:g} members lost or beyond the limits" if 0 < fewest < math.inf else ""
        tell(f"start {number + 1} of {settings.starts}: {found}")
    return now


def _stabilised(peaks: Peaks, x: np.ndarray, settings: Settings, over: Over) -> Value:
    """Return the first point of a descent of the growth rate that is stable, or its last one."""
    held = peaks.stability(x)
    if peaks.stable(held):
        return held
    return minimise(peaks.stability, held, settings.iterations, lambda value: peaks.stable(value) or over(value))


def _descent(peaks: Peaks, x: np.ndarray, settings: Settings, over: Over) -> list[Value]:
    path = [peaks.peak(x)]

    def followed(value: Value) -> bool:
        path.append(value)
        return over(value)

    minimise(peaks.peak, path[0], settings.iterations, followed)
    return path


def _kept(peaks: Peaks, path: list[Value], settings: Settings, lost: Lost, over: Over) -> tuple[Value, int]:
    """Return the lowest peak found at which no member is lost, or the lowest of all, and the number of lost members.

    Simulations take longer than peaks, so that a descent comes without. If it loses members, another one, which rejects
    such points, begins at the last point of the first that loses none.
    """
    count = lost(path[-1].x)
    if not count or lost(path[0].x):
        return path[-1], count
    first, last = 0, len(path) - 1
    while last - first > 1:
        middle = (first + last) // 2
        first, last = (first, middle) if lost(path[middle].x) else (middle, last)

    def guarded(x: np.ndarray) -> Value:
        value = peaks.peak(x)
        good = value.f < path[first].f and not over(value) and not lost(x)
        return value if good else Value(x, math.inf, np.zeros(len(x)))

    return minimise(guarded, path[first], settings.iterations, over), 0


def minimise(function: Function, start: Value, iterations: int, stop: Over) -> Value:
    """Return the lowest point that BFGS finds from `start`. `stop`: called after each step, ends the search."""
    now, H = start, 0.01 * np.eye(len(start.x))  # the first step has no estimate of the curvature
    for number in range(iterations):
        after = _line_search(function, now, -H @ now.gradient)
        if after is None:
            break
        s, y = after.x - now.x, after.gradient - now.gradient
        now = after
        if stop(now):
            break
        if s @ y > 0:
            if number == 0:
                H = np.eye(len(s)) * (s @ y) / (y @ y)
            left = np.eye(len(s)) - np.outer(s, y) / (s @ y)
            H = left @ H @ left.T + np.outer(s, s) / (s @ y)
    return now


def _line_search(function: Function, now: Value, direction: np.ndarray) -> Value | None:
    """Return a point that meets the weak Wolfe conditions, or the last one that is low enough; None: there is none.

    The constants of the conditions are 1e-4 and 0.5, as in the paper.
    """
    direction = direction * min(1.0, LONGEST / max(float(np.abs(direction).max()), 1e-300))
    slope, low, high, step, found = float(now.gradient @ direction), 0.0, math.inf, 1.0, None
    if not slope < 0:
        return None
    for _ in range(25):
        trial = function(now.x + step * direction)
        if not trial.f <= now.f + 1e-4 * step * slope:
            high = step
        elif trial.gradient @ direction < 0.5 * slope and step * np.abs(direction).max() < 2 * LONGEST:
            low, found = step, trial
        else:
            return trial
        step = (low + high) / 2 if math.isfinite(high) else 2 * step
    return found
