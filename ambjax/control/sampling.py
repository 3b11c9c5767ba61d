"""The effect of sampling on a sign law: the band around zero in which the signal stays.

A sign law drives x' = -k sgn_p(x) + w with |w| <= W < k. Steps of length T bring x into a band around 0. Explicit steps
of the set-valued sign give |x| <= T (k + W), implicit steps |x| <= T W (V. Acary and B. Brogliato, Syst. Control Lett.
59 (2010) 284-293). A smoothed sign adds to the implicit bound the |x| at which k sgn_p(x) balances W.
"""

import functools
import math
from typing import NamedTuple

import jax
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, canonical
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign


class Sampling(NamedTuple):
    """Sampling of a law: period (s), delay between its input and the effect of its output (samples), implicit signs."""

    period: float
    late: float
    implicit: bool


def non_oscillating(late: float) -> float:
    """Return the largest a = slope T for which x_{n+1} = x_n - a x(n - late), late >= 0, does not oscillate.

    x is interpolated linearly between samples. The limit is 1 without delay, and 1/4 with a delay of one sample.
    """
    if late <= 1:
        return 1 / (1 + math.sqrt(late)) ** 2
    # characteristic polynomial r^whole (r - 1) + a ((1 - rest) r + rest): at the limit its real root r is double
    whole, r = math.ceil(late), np.linspace(1e-6, 1.0, 20_001)
    rest = late - whole + 1
    return float(np.max(r**whole * (1 - r) / ((1 - rest) * r + rest)))


class Relay(NamedTuple):
    """A sign that drives an error, x' = -k sgn_p(x) + w.

    `gain`: k, in the unit of x per s. `steepness`: p, in the inverse unit of x; None: the set-valued sign.
    """

    gain: Scalar
    steepness: Scalar | None


def disturbance(relay: Relay, x: np.ndarray, period: float, implicit: bool) -> float:
    """Return the largest |w| in x_{n+1} = x_n - T k s_n + T w_n for samples x [N], in the unit of x per s.

    s_n in -1..1 is the value of the relay's sign at sample n.
    """
    k, p = relay
    used = _sign(*canonical((x[:-1], period * k, p)), implicit)
    return float(np.max(np.abs(np.diff(x) / period + k * np.asarray(used)), initial=0.0))


@functools.partial(jax.jit, static_argnums=3)
def _sign(x: Array, h: Array, p: Array | None, implicit: bool) -> Array:
    return share(x, h, p) if implicit else smooth_sign(x, p)


def band(relay: Relay, W: float, period: float, implicit: bool) -> float:
    """Return an invariant bound b of |x| (unit of x) under a disturbance of its rate up to W; inf if k <= W.

    Implicit steps: b = T W + x_W with k sgn_p(x_W) = W, because without the disturbance a step from |x| <= b ends at
    |x| <= x_W. Explicit steps: the same if the slope of T k sgn_p is at most 1, so that x does not change sign;
    otherwise the larger of this b and T (k + W). Every larger bound is invariant too.
    """
    k, p = float(relay.gain), math.inf if relay.steepness is None else float(relay.steepness)
    if not k > W:
        return math.inf
    balanced = period * W + math.tan(math.pi / 2 * W / k) / p
    steep = not implicit and period * k * TWO_OVER_PI * p > 1
    return max(balanced, period * (k + W)) if steep else balanced
