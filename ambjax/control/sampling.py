"""What sampling makes of a sign law: how steep it may be, and the band that is left where it cannot hold zero.

A sign law drives x' = -k sgn_p(x) + w, |w| <= W < k, in steps of T: into a band about 0, and no closer. Explicit steps
of the sign itself leave |x| <= T (k + W); implicit ones T W (V. Acary and B. Brogliato, Syst. Control Lett. 59 (2010)
284-293); a smoothed sign adds the x at which it balances W. A delay of d samples lets x drift for d T more.
"""

import math
from typing import NamedTuple

import numpy as np


class Sampling(NamedTuple):
    """How a law is sampled: period T (s), delay in samples, whether its sign is implicit, whether the delay is
    predicted."""

    period: float
    delay: float
    implicit: bool
    predict: bool

    @property
    def late(self) -> float:
        """Samples by which the law is behind what it acts on: none where the delay is predicted."""
        return 0.0 if self.predict else self.delay


class Limits(NamedTuple):
    """Largest slope times T of a law that is stepped explicitly: for stability, and without oscillation."""

    stable: float
    quiet: float


def limits(late: float) -> Limits:
    """The limits of x_{n+1} = x_n - a x(n - late), 0 <= late <= 2, x between samples on the straight line: a = slope T.

    2 and 1 without delay, 1 and 1/4 with one sample.
    """
    if late <= 1:
        stable = min(1 / late if late else math.inf, 2 / (1 - 2 * late) if late < 0.5 else math.inf)
        return Limits(stable, 1 / (1 + math.sqrt(late)) ** 2)
    share = late - 1
    # r is a root of r^2 (r - 1) + a ((1 - share) r + share); at the largest a of a real one it is double
    r = np.linspace(1e-6, 1.0, 20_001)
    quiet = float(np.max(r * r * (1 - r) / ((1 - share) * r + share)))
    # Jury: a^2 share^2 + a < 1
    return Limits(2 / (1 + math.sqrt(1 + 4 * share**2)), quiet)


def relay_band(k: float, p: float, W: float, sampling: Sampling) -> float:
    """The band of x under -k sgn_p(x) and a disturbance up to W, in the unit of x; p inf: the sign itself.

    inf where k does not exceed W. Where a delay is not predicted the law pushes on for d T: its band is that of an
    oscillation.
    """
    if not k > W:
        return math.inf
    T, layer = sampling.period, math.tan(math.pi / 2 * W / k) / p
    if sampling.late:
        return layer + (1 + sampling.late) * T * (k + W)
    drift = sampling.delay * T * W
    steep = not sampling.implicit and T * k * 2 / math.pi * p > 1
    return drift + max(T * W + layer, T * (k + W) if steep else 0.0)


def twisting_band(k_1: float, k_2: float, p: float, L: float, sampling: Sampling) -> float | None:
    """The band of x under the super-twisting law and a disturbance whose rate is up to L: T^2 L, p inf.

    R. Seeber and B. Andritsch, Automatica 173 (2025) 112027, for k_2 > L and k_1 > sqrt(k_2 + L). None where nothing is
    proven: for smoothed signs, explicit steps and delays.
    """
    if sampling.delay or not sampling.implicit or math.isfinite(p):
        return None
    return sampling.period**2 * L if k_2 > L and k_1 > math.sqrt(k_2 + L) else math.inf
