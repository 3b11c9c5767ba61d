"""Limits that cannot be broken: no held member can exceed them, whatever its gains."""

import math
from typing import NamedTuple

import numpy as np

from ambjax.cases.reach import reach
from ambjax.cases.reader import Case
from ambjax.ensemble.spread import ends
from ambjax.world.scenario import Scenario

# Prefixes of the paths on which the bounds depend.
PATHS = ("actuator.u_max", "actuator.coil.u_max", "reference.", "plant.s_0", "run.clearance")


class Ceiling(NamedTuple):
    """Number that a limited quantity of a held member cannot exceed (in the unit of the quantity), and the reason."""

    most: float
    why: str


def bounds_of(case: Case) -> dict[str, Ceiling]:
    """Return the bounds of the quantities that have one, by the name of the limit.

    A current has none: the supply may be too weak to keep it within `actuator.i_max`.
    """
    scenario = ends(case.spread, case.cascade, case.scenario, PATHS)[1]
    volts, key = _voltage(scenario)
    near, far = float(np.max(scenario.limit)), reach(scenario, case.clock)
    voltage = Ceiling(volts, f"|u| is at most {volts:g} V ({key})")
    error = Ceiling(near + far, f"|z| of a held rotor is below {near:g} m, and |r| is at most {far:g} m")
    found = {"max_u_V": voltage, "rms_u_V": voltage}
    found["chatter_V_per_s"] = Ceiling(2 * volts / float(case.clock.sample_period), f"{voltage.why} in each sample")
    found |= dict.fromkeys(("rms_error_m", "largest_error_m", "overshoot_m"), error)
    # with an elastic stop, |z| may exceed the clearance
    used = near / float(np.max(case.scenario.touchdown))
    return found | {"clearance_used": Ceiling(used, "a rotor that reaches the clearance is lost")}


def _voltage(scenario: Scenario) -> tuple[float, str]:
    """Return the largest |u| (V) that the drive can apply, inf if it has no limit, and the key that sets it."""
    supply, coil = float(np.max(scenario.u_max)), scenario.actuator.coil
    if coil is None:
        return supply, "actuator.u_max"
    each = math.inf if coil.u_max is None else float(np.max(coil.u_max))
    # to hold the current of a coil, its amplifier may apply more than the commanded voltage
    if each < supply or coil.i_max is not None or coil.unidirectional:
        return each, "actuator.coil.u_max"
    return supply, "actuator.u_max"
