"""Where each gain is looked for first, and why: ranges from the plant, the clock and what the theorem asks."""

import dataclasses
from typing import Any

import numpy as np

from ambjax.control.search import Interval, SearchContext
from tuning.objective.members import Objective
from tuning.objective.shortfalls import Bound
from tuning.space import Gain, Space, read

# Displacement that a rotor at rest is at least expected to make, as a share of the clearance.
STIR = 0.01
# How far beyond its range, or beyond where it starts, a gain may end.
BEYOND = 3.0
# Range of a gain of which its law says nothing: this factor about its value.
ABOUT = 30.0
# Decades that a range spans where only one of its ends is known.
WIDE = 1e3


@dataclasses.dataclass(frozen=True)
class Range:
    """Where a gain is looked for first, the largest value that it may take, and where these come from, in words.

    `product`: the path of another gain of the space, and the range of the product of both.
    """

    low: float
    high: float
    most: float
    source: str
    product: tuple[str, float, float] | None = None


def ranges(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray) -> list[Range]:
    """A range for each gain of the space, log-uniform: bounds if there are two, else what its law suggests, else
    within a factor of ABOUT of its value.

    A gain may end at up to BEYOND times the end of its range or of where it starts, a firm one only at these.
    """
    site, gains = _site(objective, conditions), objective.space.gains
    asked = [_interval(site, objective.cascade, *one) for one in zip(gains, start, strict=True)]
    rows = list(zip(gains, start, asked, strict=True))
    found = {gain.path: _range(gain, value, one) for gain, value, one in rows if not one.times}
    for gain, value, one in rows:
        if one.times:
            found[gain.path] = _quotient(gain, value, one, objective.cascade, found)
    return [found[gain.path] for gain in gains]


def drawn(space: Space, box: list[Range], cube: np.ndarray) -> np.ndarray:
    """Gains [n, m] at points of the unit cube [n, m] of their ranges, log-uniform."""
    ends = np.log([one.product[1:] if one.product else (one.low, one.high) for one in box])
    gains = np.exp(ends[:, 0] + cube * (ends[:, 1] - ends[:, 0]))
    for j, one in enumerate(box):
        if one.product:
            gains[:, j] /= gains[:, space.paths.index(one.product[0])]
    return gains


def bounded(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray) -> tuple[Space, list[Range]]:
    """The space with an upper bound for gains that have none, and the ranges that these come from.

    Without one, gains along which the loss is flat (gamma, above all) drift to where no step resolves them.
    """
    gains, box = objective.space.gains, ranges(objective, conditions, start)
    return Space(tuple(dataclasses.replace(gain, high=at.most) for gain, at in zip(gains, box, strict=True))), box


def _site(objective: Objective, conditions: tuple[Bound, ...]) -> SearchContext:
    model, scenario = objective.cascade.model, objective.scenario
    w = float(scenario.plant.pole)
    bounds = {bound.symbol: bound.value for bound in conditions}
    stiffness = 4 * float(model.i_0) ** 2 / float(model.s_0) ** 3
    fall = stiffness * w
    places = [
        (abs(float(scenario.initial.z)), "initial.z"),
        (abs(float(scenario.initial.z_dot)) / w, "initial.z_dot / w"),
        (STIR * float(scenario.touchdown), f"{100 * STIR:g} % of the clearance"),
    ]
    z, where = max(places)
    delta = bounds.get("Delta_1", 0.0)
    if delta >= fall * z:
        needed = delta, f"Delta_1 = {delta:.3g} A^2/m^2/s along the reference, Eq. (7)"
    else:
        needed = fall * z, f"D = dv/dz w z = {fall * z:.3g} A^2/m^2/s, what Eq. (7) asks of a fall from {where}"
    processor = objective.cascade.processor
    stepped = processor is not None and processor.implicit
    return SearchContext(model, w, float(objective.clock.sample_period), bounds, needed, stepped)


def _interval(site: SearchContext, cascade: Any, gain: Gain, value: float) -> Interval:
    if gain.low > 0 and np.isfinite(gain.high):
        return Interval(gain.low, gain.high, "tune.bounds", True)
    _, stage, name = gain.path.split(".")
    about = Interval(value / ABOUT, value * ABOUT, f"a factor of {ABOUT:g} about the case's value")
    return getattr(cascade, stage).ranges(site).get(name, about)


def _quotient(gain: Gain, value: float, asked: Interval, cascade: Any, found: dict[str, Range]) -> Range:
    """The range of a gain of which that of its product with another is asked."""
    other = f"{gain.path.rpartition('.')[0]}.{asked.times}"
    if other not in found:
        size = float(read(cascade, other))
        return _range(gain, value, asked._replace(low=asked.low / size, high=asked.high / size))
    ends = asked.low / found[other].high, asked.high / found[other].low
    whole = _range(gain, value, asked._replace(low=ends[0], high=ends[1]))
    return dataclasses.replace(whole, product=(other, asked.low, asked.high))


def _range(gain: Gain, value: float, asked: Interval) -> Range:
    if gain.low > 0 and np.isfinite(gain.high):
        return Range(gain.low, gain.high, gain.high, asked.source)
    low, high, source = asked[:3]
    if gain.low > 0 or np.isfinite(gain.high):
        source += "; within tune.bounds"
    low, high = max(low, gain.low * 1.05), min(high, gain.high / 1.05)
    if low >= high and gain.low > 0:
        high = low * WIDE
    elif low >= high:
        low = high / WIDE
    if np.isfinite(gain.high):
        return Range(low, high, gain.high, source)
    most = max(high, value) * (1 if asked.firm else BEYOND)
    return Range(low, high, most, f"{source}; may end at up to {most:.3g}")
