"""Default gains of the laws with a sign, from the nominal plant and the sampling.

They follow from the unstable pole w of the magnets, the gap s_0 and the bias current i_0. The paper's cascade with the
plant of Table 1 has the gains of the paper instead, Table 2 with gamma = 7.5e4 (`base.default_law`). With them the peak
of |S| of that plant is about 40, and they lose a plant of another size.

- Position: c = w and 2/pi k p = w, the slope of the sign at 0. The error then has a double pole at -w. With an exact
  inversion and an ideal current, S = (s^2 - w^2)/(s + w)^2, so that |S| = 1 at every frequency. Slower poles increase
  |S| at 0 Hz, which is w^2/(c 2/pi k p); faster poles increase it near the bandwidth of the current.
- k = w^2 s_0/2, so p = pi/(w s_0). w^2 s_0 is the largest acceleration that the magnets give at z = 0 (i = i_0).
- Inversion: gamma = |dv/dz| w s_0 at the origin, which is Delta_1 of Eq. (7) for a rotor of the speed w s_0.
- Current: 2/pi k_i p = 10 w, the bandwidth of the current loop, but at most a quarter of the sampling rate.
"""

import math
from typing import Any

from ambjax.control.sampling import Sampling
from ambjax.numerics.records import Scalar, gain
from ambjax.world.plant import Plant

# Bandwidth of the current loop as a multiple of w, and its largest product with the sample period.
FASTER, MOST = 10.0, 1 / 4
# Default steepness of the sign of a position law, in words.
SLOPE_W = "pi/(w s_0), or scaled to the nominal plant if k is given"


def sign_steepness(
    sign: str, left_out: str = "scaled to the nominal plant", unit: str = "s/m", default: float = 25.0
) -> Any:
    """Declare the steepness p of a smoothed sign. `sign`, `left_out`: the sign and the default, in words."""
    return gain(default, unit, f"steepness of the smoothed {sign}; left out: {left_out}", steepness=True)


def switching_gain(model: Plant) -> Scalar:
    """Return the default switching gain k of a position law, m/s^2."""
    return model.pole**2 * model.s_0 / 2


def switching_steepness(model: Plant) -> Scalar:
    """Return the steepness p (s/m) for which the sign of the default k has the slope w at 0."""
    return math.pi / model.sigma_size


def adaptation_gain(model: Plant) -> Scalar:
    """Return the default gamma, A^2/m^2/s."""
    return 4 * model.v_size * model.pole  # dv/dz = 4 v_size/s_0 at the origin


def current_rate(model: Plant, sampling: Sampling | None) -> Scalar:
    """Return the default bandwidth of the current loop, 1/s. `sampling`: None in continuous time."""
    rate = FASTER * model.pole
    return rate if sampling is None else min(float(rate), MOST / sampling.period)
