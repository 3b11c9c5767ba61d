"""The keys of [tune] in a case file, with their defaults and meanings, for the reader and for the template."""

import dataclasses
import math

from ambjax.numerics.records import leaf

# Ways to combine the losses of the members, the default first.
RISKS = ("mean", "cvar")
# Objectives, the default first: least voltage with at most 1.25 times the least error, or the least error itself.
OBJECTIVES = ("knee", "least_error")
# Default limit of the rms voltage, as a share of actuator.u_max.
VOLTAGE_SHARE = 0.6
# Default share of the held-out members that must survive.
SURVIVING = 1.0
# Default band of the settling time, as a share of the clearance.
SETTLING_BAND = 0.01
# Default margins of limits. MEAN_MARGIN, WORST_MARGIN: for means over members, and for worst members; each is the
# relative difference between two ensembles. LOOP_MARGIN: for the sensitivity of the worst member, which an injection
# measures with an error of a few per cent.
MEAN_MARGIN, WORST_MARGIN, LOOP_MARGIN = 0.005, 0.03, 0.05

# The numbers of [tune]. The bounds are decades wider than useful values.
NUMBERS: dict[str, dataclasses.Field] = {
    "early": leaf(0.0, at_least=0, at_most=1e6, doc="weight of errors before run.settle; after it, the weight is 1"),
    "stress": leaf(1.2, above=0, at_most=1e6, doc="factor on the noise of the stressed members"),
    "gain_margin": leaf(
        1.25, above=0, at_most=1e6, doc="each gain of a stressed member is multiplied or divided by this factor"
    ),
    "alpha": leaf(0.9, at_least=0, at_most=0.9999, doc='for "cvar": the mean of the worst 1 - alpha of the losses'),
    "minutes": leaf(
        math.inf, above=0, at_most=1e6, infinite=True, unit="min", doc="min; time of the whole tuning; inf: no limit"
    ),
}


def _weight(default: float, doc: str) -> dataclasses.Field:
    return leaf(default, at_least=0, at_most=1e9, doc=doc)


# The weights of the terms of the loss, in the order of the template.
WEIGHTS: dict[str, dataclasses.Field] = {
    "tracking": _weight(1.0, "mean square error after run.settle; all terms are dimensionless"),
    "peak": _weight(0.0, "largest error after run.settle"),
    "effort": _weight(0.1, "mean square voltage"),
    "chatter": _weight(0.1, "mean square step of the voltage"),
    "clearance": _weight(1e-3, "closeness to the stop"),
    "survival": _weight(1.0, "loss of the rotor; it counts more if it is earlier"),
}
SURVIVAL: dataclasses.Field = leaf(SURVIVING, above=0, at_most=1, doc="share of the held-out members that must survive")
# Largest whole numbers. MOST_MEMBERS, for members and starting points, is smaller, because all of them are in memory
# at once.
MOST_WHOLE, MOST_MEMBERS = 2**31 - 1, 2**20


def _whole(default: int, at_least: int, doc: str, at_most: int = MOST_WHOLE) -> int:
    return leaf(default, at_least=at_least, at_most=at_most, whole=True, doc=doc)


def _members(default: int, at_least: int, doc: str) -> int:
    return _whole(default, at_least, doc, MOST_MEMBERS)


@dataclasses.dataclass(frozen=True)
class Budget:
    """Size of the search."""

    members: int = _members(32, 1, "members of the training ensemble, each with its own noise and [spread]")
    stressed: int = _members(
        8, 0, "members with more noise and changed gains, which must be held but whose error does not count"
    )
    validation: int = _members(2000, 0, "members of the validation; those that fail join the training ensemble")
    held_out: int = _members(1000, 0, "held-out members, on which the tuned gains are judged")
    seed: int = _whole(1, 0, "seed of the training members and of the screen; the other ensembles have other seeds")
    screen: int = _members(128, 0, "number of starting points that are screened; 0: only the gains of the case")
    starts: int = _whole(16, 1, "number of the best of these points that are refined")
    iterations: int = _whole(40, 1, "largest number of iterations of a search")
    substeps: int = _whole(3, 1, "integration steps per sample")
    front: int = _whole(3, 1, "number of points of the front of error against voltage, without that of least error", 6)


BUDGET: dict[str, dataclasses.Field] = {field.name: field for field in dataclasses.fields(Budget)}
