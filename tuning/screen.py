"""Where to start: the case's own gains, informed ones, and quasi-random points over decades around them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ambjax.ensemble.design import points
from ambjax.method import slopes
from ambjax.smooth import TWO_OVER_PI
from tuning.conditions import Bound
from tuning.objective import Engine, Members, Objective
from tuning.space import Space

# Share of the members that points meet, and share of the points that goes on: 1/4 after an eighth of the members.
ROUNDS = (8, 4), (4, 1)
# How far from a point its neighbourhoods reach, in coordinates: factors of e^1.5 up or down of each gain, and of e^3.
NEAR, FAR = 1.5, 3.0
Score = Callable[[np.ndarray, dict[str, np.ndarray], Members], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Range:
    """Where a gain is looked for first, and the largest value that it may take."""

    low: float
    high: float
    most: float


def ranges(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray) -> list[Range]:
    """A range for each gain of the space, log-uniform: bounds if there are two, else what the theory suggests.

    With w the pole of the unstable plant, 1/s, and T_s the sample period: c from w/30 to 10 w, and to no more than
    1/(5 T_s), for the sampled loop cannot slide faster; slopes 2/pi k p and 2/pi k_i p from w/3 to
    100 w and 200 w, and at least twice the disturbance bounded; gamma from Delta_1 to 100 times that (Eq. 7); an
    observer's corner from w/1000 to w. Any other gain: within a factor 30 of its value. A gain may end at up to
    three times the end of its range or of where it starts, c only at these themselves.
    """
    w = slopes(objective.cascade, objective.scenario)["plant"]
    floor = {bound.path: bound.value for bound in conditions}
    sample_period = float(objective.clock.sample_period)
    found = []
    for gain, value in zip(objective.space.gains, start, strict=True):
        stage, name = gain.path.split(".")[1:]
        law = getattr(objective.cascade, stage)
        below = floor.get(gain.path, 0.0)
        if gain.low > 0 and np.isfinite(gain.high):
            low, high = gain.low, gain.high
        elif name == "c":
            low, high = w / 30, min(10 * w, max(1 / (5 * sample_period), w / 10))
        elif name in ("k", "k_i") and gain.path in floor:
            per = TWO_OVER_PI * float(law.p)
            low, high = w / 3 / per, (100 if name == "k" else 200) * w / per
            low, high = max(low, 2 * below), max(high, 200 * below)
        elif gain.path in floor:
            low, high = below, 100 * below
        elif name == "l":
            low, high = w / 1000, w
        else:
            low, high = value / 30, value * 30
        low, high = max(low, gain.low * 1.05), min(high, gain.high / 1.05)
        most = gain.high if np.isfinite(gain.high) else max(high, value) * (1 if name == "c" else 3)
        found.append(Range(low, high, most) if low < high else Range(gain.low * 1.01, gain.high / 1.01, most))
    return found


def bounded(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray) -> Space:
    """The space with an upper bound for gains that have none.

    Without one, gains along which the loss is flat (gamma, above all) drift to where no step resolves them.
    """
    box = ranges(objective, conditions, start)
    gains = [dataclasses.replace(gain, high=at.most) for gain, at in zip(objective.space.gains, box, strict=True)]
    return Space(tuple(gains))


def everywhere(objective: Objective, conditions: tuple[Bound, ...], start: np.ndarray, count: int, seed: int) -> Any:
    """Coordinates [count + 2, m]: the case's gains, the middle of the ranges, and quasi-random points over them."""
    space = objective.space
    box = ranges(objective, conditions, start)
    low, high = np.log([r.low for r in box]), np.log([r.high for r in box])
    cube = points("sobol", seed, len(space), np.arange(count), count)
    gains = np.concatenate([start[None], np.exp((low + high) / 2)[None], np.exp(low + cube * (high - low))])
    return np.stack([space.encode(space.clip(g)) for g in gains])


def around(x: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Coordinates [count + 1, m]: x, and quasi-random points around it, NEAR and FAR by turns."""
    cube = points("sobol", seed, len(x), np.arange(count), count)
    reach = np.where(np.arange(count) % 2, FAR, NEAR)[:, None]
    return np.concatenate([x[None], x + reach * (2 * cube - 1)])


def screen(engine: Engine, who: Members, x: np.ndarray, keep: int, score: Score) -> np.ndarray:
    """The best of points x [K, m], at least `keep`, best first, by successive halving: on few members, then on more.

    Some of the stressed members are there from the first: to be held is what is asked first.
    """
    for part, left in ROUNDS:
        some = who.part(part)
        values = score(x, engine.terms(x, some), some)
        x = x[np.argsort(values, kind="stable")[: max(len(x) // left, 2 * keep)]]
    return x
