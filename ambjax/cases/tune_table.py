"""The keys of [tune] in a case file, with their defaults and meanings, for the reader and for the template."""

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

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


def _members(default: int, at_least: int, doc: str) -> int:
    return leaf(default, at_least=at_least, at_most=MOST_MEMBERS, whole=True, doc=doc)


def _whole(default: int, at_least: int, doc: str) -> int:
    return leaf(default, at_least=at_least, at_most=MOST_WHOLE, whole=True, doc=doc)


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
    front: int = leaf(
        3,
        at_least=1,
        at_most=6,
        whole=True,
        doc="number of points of the front of error against voltage, without that of least error",
    )


BUDGET: dict[str, dataclasses.Field] = {field.name: field for field in dataclasses.fields(Budget)}


class Line(NamedTuple):
    """A line of the template: the key with its value, and a comment."""

    text: str
    comment: str


def template_lines() -> Iterator[Line]:
    """Yield the lines of [tune] for the template: each key with its default, or with an example and a comment."""
    yield Line(
        f'objective = "{OBJECTIVES[0]}"',
        'least rms voltage within 25 % of the least error; or "least_error"',
    )
    yield Line(
        'gains = ["controller.position.c", "controller.position.k"]',
        "gains to tune; left out: all that are not 0, but p only on a processor and only if it is finite",
    )
    yield Line(
        "bounds.controller.position.c = [1.0, 500.0]",
        "bounds of one gain; left out: from plant and theory, see the report; the upper one is",
    )
    yield Line("", "then 3 times the end of the range or the gain of the case; for c, a fifth of the sampling rate")
    yield from _defaults("weights.", WEIGHTS)
    yield from _limits()
    yield from _defaults("", {name: NUMBERS[name] for name in ("early",)})
    yield Line('risk = "cvar"', f'how the members\' losses are combined: "cvar" or "mean"; left out: "{RISKS[0]}"')
    yield from _defaults("", {"alpha": NUMBERS["alpha"]})
    yield from _defaults("", {name: BUDGET[name] for name in ("members", "stressed")})
    yield from _defaults("", {name: NUMBERS[name] for name in ("stress", "gain_margin")})
    yield from _defaults("", {name: field for name, field in BUDGET.items() if name not in ("members", "stressed")})
    yield from _defaults("", {"minutes": NUMBERS["minutes"]})


def _defaults(prefix: str, fields: dict[str, dataclasses.Field]) -> Iterator[Line]:
    for name, field in fields.items():
        yield Line(f"{prefix}{name} = {field.default!r}", field.metadata["doc"])


def _limits() -> Iterator[Line]:
    """Yield the lines of [tune.limits]."""
    shares = (100 * VOLTAGE_SHARE, MEAN_MARGIN, WORST_MARGIN, LOOP_MARGIN)
    voltage, means, worst, loops = (f"{x:g}" for x in shares)
    examples = [
        (
            "rms_u_V = 120.0",
            f"V; root mean square voltage after run.settle, over members (left out: {voltage} % of u_max)",
        ),
        ("max_u_V = 150.0", "V; largest voltage of any member; inf, here and below: no limit (left out: none)"),
        ("max_abs_i_A = 5.0", "A; largest |i|, without the bias, of any member (left out: none)"),
        (
            "rms_coil_A = 0.4",
            "A; root mean square current of a coil after run.settle, bias included, of any member (left out: none)",
        ),
        ("chatter_V_per_s = 1e5", "V/s; variation of the voltage after run.settle, mean over members (left out: none)"),
        ("rms_error_m = 1e-6", "m; root mean square error after run.settle, over members (left out: none)"),
        ("largest_error_m = 1e-5", "m; largest error after run.settle, of any member (left out: none)"),
        (
            "settling_s = 0.2",
            "s; time of the run after which every error stays within the band (left out: none)",
        ),
        (
            "settling_band_m = 45e-6",
            f"m; half-width of the settling band (left out: {100 * SETTLING_BAND:g} % of the clearance)",
        ),
        (
            "overshoot_m = 1e-4",
            "m; largest distance of z beyond its initial value and the range of r so far (left out: none)",
        ),
        ("clearance_used = 0.8", "largest |z| of any member as a share of the clearance (left out: none)"),
        ("z_1x_m = inf", "m; amplitude of z at the speed of [rotor], which it needs, of any member (left out: none)"),
        ("i_1x_A = inf", "A; amplitude of the current at this speed, of any member (left out: none)"),
        ("sensitivity_1x = inf", "|S| at this speed, of any member, at r = 0 (left out: none)"),
        (
            "sensitivity = 3.0",
            "peak of |S| of any member, at r = 0; inf: no limit (left out: sensitivity.zone_a)",
        ),
        ("complementary = 3.0", "peak of |T| of any member (left out: none)"),
        ("control_sensitivity = 1e8", "V/m; peak of |KS| of any member (left out: none)"),
        ("delay_margin_s = 2e-4", "s; least delay margin of any member (left out: none)"),
        (f"survival = {SURVIVAL.default}", SURVIVAL.metadata["doc"]),
        (
            "margin = 0.01",
            f"distance that the search keeps from a limit, as a share of it; left out: {means} for means, {worst} for "
            f"maxima, {loops} for loops",
        ),
    ]
    return (Line(f"limits.{text}", comment) for text, comment in examples)
