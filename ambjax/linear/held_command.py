"""A sampled loop that is broken at the command, which is held for a sample and may be delayed by a part of a sample."""

import math

import numpy as np

from ambjax.linear.state_space import StateSpace

# PARTS: number of parts of a sample for which crossings of |L| = 1 are found. TURNS: number of further turns of L.
# STEPS: number of Newton's steps. SLOPE_STEP: step of log f and of the delay in the difference quotients for the slopes
# of L.
PARTS, TURNS, STEPS, SLOPE_STEP = 16, 3, 12, 1e-5


class HeldCommand:
    """The loop transfer L of a sampled loop broken at the command, in NumPy.

    A delay of the held command by a part of a sample changes the phase of L and, near half the sampling rate, also its
    magnitude. All delays are in samples, the delay of the case included, if they are not called late.
    """

    def __init__(self, system: StateSpace):
        own = system.known_path.delay
        self.system, self.period, self.own = system, float(np.asarray(system.period)), float(np.asarray(own))
        self.path = system.scaled().known_path
        self._held = self.path.held(self.own - math.floor(self.own), self.period)

    def transfer(self, f: np.ndarray, delay: float | None = None) -> np.ndarray:
        """Return L [F] at frequencies [F] in Hz. `delay`: of the command; None: that of the case."""
        row, own = self.system.command_row(f), self._effect(f, self.own, self._held)
        effect = own
        if delay is not None:
            effect = self._effect(f, delay, self.path.held(delay - math.floor(delay), self.period))
        return -np.sum(row * effect, -1) / (1 + np.sum(row * own, -1))

    def _effect(self, f: np.ndarray, delay: float, held: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return the effect [F, n] of a unit command on the plant. `held`: result of `CommandPath.held`."""
        back = np.exp(-2j * np.pi * f * self.period)[:, None]
        return back ** math.floor(delay) * (held[0] + held[1] * back)

    def delays(self, f: np.ndarray) -> list[float]:
        """Return additional delays (s) at which a pole of the loop lies on the unit circle, the least among them.

        `f`: frequencies of the scan, Hz, up to half the sampling rate. |L| depends only on the part of a sample by
        which the command is delayed. The crossings of |L| = 1 are therefore found for PARTS parts. At each crossing,
        the phase of L gives the delay that rotates L to -1. If it ends with nearly the same part of a sample, Newton's
        method solves L = -1 for the frequency and the delay.
        """
        parts = (np.arange(PARTS) + 0.5) / PARTS
        new, before = self.path.held(parts, self.period)
        back, row = np.exp(-2j * np.pi * f * self.period)[:, None], self.system.command_row(f)
        row = row / (1 + np.sum(row * self._effect(f, self.own, self._held), -1))[:, None]
        L = -(row @ new.T + back * (row @ before.T))
        size = np.log(np.abs(L))
        at, part = np.nonzero(size[:-1] * size[1:] < 0)
        share = size[at, part] / (size[at, part] - size[at + 1, part])
        cross = f[at] * (f[at + 1] / f[at]) ** share
        lag = np.angle(-L[at, part]) + share * np.angle(L[at + 1, part] / L[at, part])
        turn, starts = cross * self.period, []
        whole = lag / (2 * np.pi * turn)  # the samples of delay that rotate L to -1
        whole += np.ceil((self.own - parts[part] - 1 / PARTS - whole) * turn) / turn
        for more in range(TURNS):
            samples = whole + more / turn
            apart = np.abs(samples - np.round(samples))
            near = apart <= 1 / PARTS
            starts += list(zip(apart[near], cross[near], (parts[part] + samples)[near], strict=True))
        found = [self._solved(f, delay) for f, delay in _distinct(starts)]
        return [x for x in [*found, *self._alternating()] if x is not None and x > 0]

    def _solved(self, f: float, delay: float) -> float | None:
        """Return the additional delay (s) at which L = -1, by Newton's method from this start; None if it fails."""
        start, step = f, SLOPE_STEP
        for _ in range(STEPS):
            L = self.transfer(f * np.exp([-step, 0.0, step]), delay)
            error, along = np.log(-L[1]), np.log(L[2] / L[0]) / (2 * step)
            if abs(error) < 1e-9:
                return float(delay - self.own) * self.period
            across = np.log(self.transfer(np.array([f]), delay + step)[0] / L[1]) / step
            moves = np.linalg.solve([[along.real, across.real], [along.imag, across.imag]], [error.real, error.imag])
            f, delay = f * math.exp(-moves[0]), delay - moves[1]
            if not 0 < f <= 0.5 / self.period or abs(math.log(f / start)) > 0.5 or delay < 0:
                return None
        return None

    def _alternating(self) -> list[float]:
        """Return additional delays (s), up to two samples, at which a pole lies at z = -1, where L is real."""
        from scipy.optimize import brentq

        nyquist = np.array([0.5 / self.period])

        def distance(late: float) -> float:
            return 1.0 + float(self.transfer(nyquist, self.own + late)[0].real)

        late = np.linspace(0.0, 2.0, 2 * PARTS + 1)
        values = [distance(x) for x in late]
        changes = [k for k in range(len(late) - 1) if values[k] * values[k + 1] < 0]
        return [float(brentq(distance, late[k], late[k + 1])) * self.period for k in changes]  # pyright: ignore


def _distinct(starts: list[tuple[float, float, float]]) -> list[tuple[float, float]]:
    """Return the starts (frequency, delay) without those near a better one. `starts`: with their errors, samples."""
    kept: list[tuple[float, float]] = []
    for _, f, delay in sorted(starts):
        if all(abs(delay - other) > 2 / PARTS or abs(math.log(f / at)) > 0.1 for at, other in kept):
            kept.append((float(f), float(delay)))
    return kept
