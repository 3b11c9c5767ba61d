"""Where each gain is looked for first, and why: ranges from the plant, the clock and what the theorem asks."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ambjax.extend import TWO_OVER_PI
from tuning.objective.conditions import Bound
from tuning.objective.problem import Objective
from tuning.space import Gain, Space

# Displacement that a rotor at rest is at least expected to make, as a share of the clearance.
STIR = 0.01
# How far beyond its range, or beyond where it starts, a gain may end.
BEYOND = 3.0
# Decades that a range spans where only one of its ends is known.
WIDE = 1e3


@dataclasses.dataclass(frozen=True)
class Range:
    """Where a gain is looked for first, the largest value that it may take, and where these come from, in words."""

    low: float
    high: float
    most: float
    source: str


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the ranges are made of: pole w of the model, 1/s, sample period T, s, and what gamma must exceed."""

    model: Any
    w: float
    period: float
    floors: dict[str, float]
    gamma: tuple[float, str]


# Two ends and where they come from, from a law, its gain's path and value.
Rule = Callable[[Asked, Any, str, float], tuple[float, float, str]]


def ranges(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray) -> list[Range]:
    """A range for each gain of the space, log-uniform: bounds if there are two, else what the theory suggests (RULES).

    A gain may end at up to BEYOND times the end of its range or of where it starts, c only at these themselves.
    """
    asked = _asked(objective, conditions)
    return [_range(asked, objective.cascade, *one) for one in zip(objective.space.gains, start, strict=True)]


def bounded(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray) -> tuple[Space, list[Range]]:
    """The space with an upper bound for gains that have none, and the ranges that these come from.

    Without one, gains along which the loss is flat (gamma, above all) drift to where no step resolves them.
    """
    gains, box = objective.space.gains, ranges(objective, conditions, start)
    return Space(tuple(dataclasses.replace(gain, high=at.most) for gain, at in zip(gains, box, strict=True))), box


def _asked(objective: Objective, conditions: tuple[Bound, ...]) -> Asked:
    model, scenario = objective.cascade.model, objective.scenario
    w = float(scenario.plant.pole)
    floors = {bound.path: bound.value for bound in conditions}
    stiffness = 4 * float(model.i_0) ** 2 / float(model.s_0) ** 3
    fall = stiffness * w
    places = [
        (abs(float(scenario.initial.z)), "initial.z"),
        (abs(float(scenario.initial.z_dot)) / w, "initial.z_dot / w"),
        (STIR * float(scenario.touchdown), f"{100 * STIR:g} % of the clearance"),
    ]
    z, where = max(places)
    delta = max((bound.value for bound in conditions if bound.symbol == "Delta_1"), default=0.0)
    if delta >= fall * z:
        needed = delta, f"Delta_1 = {delta:.3g} A^2/m^2/s along the reference, Eq. (7)"
    else:
        needed = fall * z, f"D = dv/dz w z = {fall * z:.3g} A^2/m^2/s, what Eq. (7) asks of a fall from {where}"
    return Asked(model, w, float(objective.clock.sample_period), floors, needed)


def _range(asked: Asked, cascade: Any, gain: Gain, value: float) -> Range:
    if gain.low > 0 and np.isfinite(gain.high):
        return Range(gain.low, gain.high, gain.high, "tune.bounds")
    _, stage, name = gain.path.split(".")
    low, high, source = RULES.get(name, _about)(asked, getattr(cascade, stage), gain.path, value)
    if gain.low > 0 or np.isfinite(gain.high):
        source += "; within tune.bounds"
    low, high = max(low, gain.low * 1.05), min(high, gain.high / 1.05)
    if low >= high and gain.low > 0:
        high = low * WIDE
    elif low >= high:
        low = high / WIDE
    if np.isfinite(gain.high):
        return Range(low, high, gain.high, source)
    most = max(high, value) * (1 if name == "c" else BEYOND)
    return Range(low, high, most, f"{source}; may end at up to {most:.3g}")


def _pole(asked: Asked) -> str:
    return f"w = {asked.w:.3g} 1/s: pole of the unstable plant"


def _c(asked: Asked, law: Any, path: str, value: float) -> tuple[float, float, str]:
    cap = max(1 / (5 * asked.period), asked.w / 10)
    if cap >= 10 * asked.w:
        return asked.w / 30, 10 * asked.w, f"w/30 to 10 w, {_pole(asked)}"
    words = f"w/30 to the cap 1/(5 T), T = {asked.period:g} s: the sampled loop cannot slide faster; {_pole(asked)}"
    return asked.w / 30, cap, words


def _slope(times: float) -> Rule:
    """A switching gain by the slope 2/pi gain p of its smoothed sign."""

    def rule(asked: Asked, law: Any, path: str, value: float) -> tuple[float, float, str]:
        per, below = TWO_OVER_PI * float(law.p), asked.floors.get(path, 0.0)
        low, high = asked.w / 3 / per, times * asked.w / per
        words = f"slope 2/pi {path.rpartition('.')[2]} p from w/3 to {times:g} w, {_pole(asked)}"
        if 2 * below > low:
            words += f"; at least twice the disturbance, {below:.3g}"
        return max(low, 2 * below), max(high, 200 * below), words

    return rule


def _gamma(asked: Asked, law: Any, path: str, value: float) -> tuple[float, float, str]:
    needed, words = asked.gamma
    name = words.partition(" ")[0]
    return needed, 100 * needed, f"{name} to 100 {name}, {words}"


def _rate(low: float, high: float, words: str, power: int, per: Callable[[Asked, Any], float]) -> Rule:
    """A gain whose rate, gain times `per` (of dimension 1/s to this power), lies from `low` to `high` times w."""

    def rule(asked: Asked, law: Any, path: str, value: float) -> tuple[float, float, str]:
        ends = [(share * asked.w) ** power / per(asked, law) for share in (low, high)]
        return *ends, f"{words}, {_pole(asked)}"  # pyright: ignore[reportReturnType]

    return rule


def _about(asked: Asked, law: Any, path: str, value: float) -> tuple[float, float, str]:
    return value / 30, value * 30, "a factor of 30 about the case's value"


# A range by the name of the gain; any other gain: within a factor of 30 of its value.
RULES: dict[str, Rule] = {
    "c": _c,
    "k": _slope(100),
    "k_i": _slope(200),
    "gamma": _gamma,
    "l": _rate(1e-3, 1, "corner from w/1000 to w", 1, lambda asked, law: 1.0),
    "k_1": _rate(1 / 3, 100, "slope k_1 sqrt(p) from w/3 to 100 w", 1, lambda asked, law: float(law.p) ** 0.5),
    "k_2": _rate(
        1e-2, 10, "corner sqrt(2/pi k_2 p) from w/100 to 10 w", 2, lambda asked, law: TWO_OVER_PI * float(law.p)
    ),
    "k_p": _rate(1 / 3, 200, "bandwidth k_p / L from w/3 to 200 w", 1, lambda asked, law: 1 / float(asked.model.L)),
    "k_int": _rate(
        1 / 30, 30, "corner sqrt(k_int / L) from w/30 to 30 w", 2, lambda asked, law: 1 / float(asked.model.L)
    ),
    "k_aw": _rate(1e-2, 10, "rate from w/100 to 10 w", 1, lambda asked, law: 1.0),
}
