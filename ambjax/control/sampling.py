"""What sampling makes of a sign law: how steep it may be, and the band that is left where it cannot hold zero.

A sign law drives x' = -k sgn_p(x) + w, |w| <= W < k, in steps of T: into a band about 0, and no closer. Explicit steps
of the sign itself leave |x| <= T (k + W); implicit ones T W (V. Acary and B. Brogliato, Syst. Control Lett. 59 (2010)
284-293); a smoothed sign adds the x at which it balances W.
"""

import math
from typing import NamedTuple

import numpy as np

from ambjax.numerics.records import Scalar
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign


class Sampling(NamedTuple):
    """How a law is sampled: period (s), samples by which its output acts later than on what it acts, whether signs are
    implicit."""

    period: float
    late: float
    implicit: bool


class SlopeLimits(NamedTuple):
    """Largest slope times T of a law that is stepped explicitly: for stability, and without oscillation."""

    stable: float
    quiet: float


def slope_limits(late: float) -> SlopeLimits:
    """The limits of x_{n+1} = x_n - a x(n - late), 0 <= late <= 2, x between samples on the straight line: a = slope T.

    2 and 1 without delay, 1 and 1/4 with one sample.
    """
    if late <= 1:
        stable = min(1 / late if late else math.inf, 2 / (1 - 2 * late) if late < 0.5 else math.inf)
        return SlopeLimits(stable, 1 / (1 + math.sqrt(late)) ** 2)
    rest = late - 1
    # r is a root of r^2 (r - 1) + a ((1 - rest) r + rest); at the largest a of a real one it is double
    r = np.linspace(1e-6, 1.0, 20_001)
    quiet = float(np.max(r * r * (1 - r) / ((1 - rest) * r + rest)))
    # Jury: a^2 rest^2 + a < 1
    return SlopeLimits(2 / (1 + math.sqrt(1 + 4 * rest**2)), quiet)


class Relay(NamedTuple):
    """A smoothed sign that drives an error, x' = -k sgn_p(x) + w: its gain k (unit of x per s) and steepness p (inverse
    of that unit; None: the sign itself)."""

    gain: Scalar
    steepness: Scalar | None


def disturbance(relay: Relay, x: np.ndarray, period: float, implicit: bool) -> float:
    """Largest |w| (unit of x per s) of x_{n+1} = x_n - T k s_n + T w_n for the samples x [N], s_n the share of its gain
    that the relay used."""
    k, p = relay
    used = share(x[:-1], period * k, p) if implicit else smooth_sign(x[:-1], p)
    return float(np.max(np.abs(np.diff(x) / period + k * np.asarray(used)), initial=0.0))


def band(relay: Relay, W: float, period: float, implicit: bool) -> float:
    """A b, in the unit of x, that |x| does not exceed again under a disturbance of its rate up to W; inf where k does
    not exceed W.

    The same holds of any larger b. Implicit: b = T W + x_W, k sgn_p(x_W) = W, for from |x| <= b the step ends at no
    more than x_W. Explicit: the same where T k sgn_p is no steeper than 1, so that x does not change sign; else
    also T (k + W).
    """
    k, p = float(relay.gain), math.inf if relay.steepness is None else float(relay.steepness)
    if not k > W:
        return math.inf
    balanced = period * W + math.tan(math.pi / 2 * W / k) / p
    steep = not implicit and period * k * TWO_OVER_PI * p > 1
    return max(balanced, period * (k + W)) if steep else balanced
