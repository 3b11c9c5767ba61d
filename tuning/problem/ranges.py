"""Search ranges of the gains, from the plant, the clock and the theorem's conditions; and starting points in them."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.control.schedule import extremes
from ambjax.control.search import Interval, LowerBound, SearchContext
from ambjax.ensemble.design import design_points
from ambjax.linear.stability import KICK
from ambjax.theorem.conditions import delta_1_on_reference, required
from tuning.problem.members import Objective
from tuning.problem.space import MARGIN, Gain, Space

# Default upper bound of a gain: this factor times the larger of the upper end of its range and its value in the case.
END_FACTOR = 3.0
# Range of a gain for which the law defines none: its value divided and multiplied by this factor.
DEFAULT_FACTOR = 30.0
# Changes at an optimum, in coordinates, to find lower optima: of one gain by up to e^8, of several by up to e^3.
JUMPS, REACH = (-8.0, -6.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 6.0, 8.0), 3.0


@dataclasses.dataclass(frozen=True)
class Range:
    """Initial search range [low, high] of a gain, its upper bound `most`, and a text that describes their source.

    `product`: path of another gain of the space, and the range of the product of both gains. None: no such range.
    """

    low: float
    high: float
    most: float
    source: str
    product: tuple[str, float, float] | None = None


def ranges(objective: Objective, start: np.ndarray) -> list[Range]:
    """Return a range for each gain of the space, from the gains `start` [m] of the case.

    The range is that of [tune.bounds] if both bounds are given. Otherwise it is the range of the law or, if the law
    defines none, the value divided and multiplied by DEFAULT_FACTOR. A single bound limits this range. Without an upper
    bound, the upper bound is END_FACTOR times the larger of the upper end of the range and the value. The factor is 1
    if the interval of the law is firm (`Interval.firm`).
    """
    context, gains = _context(objective), objective.space.gains
    interval = [_interval(context, objective.cascade, *one) for one in zip(gains, start, strict=True)]
    rows = list(zip(gains, start, interval, strict=True))
    found = {gain.path: _range(gain, value, one) for gain, value, one in rows if not one.times}
    for gain, value, one in rows:
        if one.times:
            found[gain.path] = _quotient(gain, value, one, objective.cascade, found)
    return [found[gain.path] for gain in gains]


def initial_points(space: Space, box: list[Range], start: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return coordinates [count + 2, m]: the gains `start` [m], the middle of the ranges `box`, quasi-random points.

    If `count` is 0, the result contains only the gains `start`, [1, m].
    """
    if not count:
        return space.encode(space.clip(start))[None]
    cube = design_points("sobol", seed, len(space), np.arange(count), count)
    middle = np.full((1, len(space)), 0.5)
    gains = np.concatenate([start[None], from_unit_cube(space, box, np.concatenate([middle, cube]))])
    return np.stack([space.encode(space.clip(g)) for g in gains])


def around(x: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return x [m], each point with one coordinate changed by one of the JUMPS, and `count` random points.

    The shape is [1 + J m + count, m] for J jumps. Each coordinate of a random point changes by up to REACH, or two of
    them do, in turn.
    """
    rng, m = np.random.default_rng(seed), len(x)
    one = np.kron(np.eye(m), np.reshape(JUMPS, (-1, 1)))
    two = rng.permuted(np.tile(np.arange(m) < 2, (count, 1)), axis=1)
    two[::2] = True
    return x + np.concatenate([np.zeros((1, m)), one, two * rng.uniform(-REACH, REACH, (count, m))])


def from_unit_cube(space: Space, box: list[Range], cube: np.ndarray) -> np.ndarray:
    """Map points of the unit cube [n, m] to gains [n, m], log-uniform over the ranges `box`.

    All knots of a schedule use the coordinate of the first, so with equal ranges the search begins at constant gains.
    """
    stems = [".".join(path.split(".")[:3]) for path in space.paths]
    cube = cube[:, [stems.index(stem) for stem in stems]]
    ends = np.log([one.product[1:] if one.product else (one.low, one.high) for one in box])
    gains = np.exp(ends[:, 0] + cube * (ends[:, 1] - ends[:, 0]))
    for j, one in enumerate(box):
        if one.product:
            gains[:, j] /= gains[:, space.paths.index(one.product[0])]
    return gains


def bounded(objective: Objective, start: np.ndarray) -> tuple[Space, list[Range]]:
    """Return the space with an upper bound for every gain, and the ranges that the bounds come from.

    The loss hardly depends on some gains, gamma in particular. Without an upper bound, the search moves such a gain to
    values for which the integration step is too large.
    """
    gains, box = objective.space.gains, ranges(objective, start)
    return Space(tuple(dataclasses.replace(gain, high=at.most) for gain, at in zip(gains, box, strict=True))), box


def theorem_bounds(objective: Objective) -> dict[str, float]:
    """Return the lower bounds Q_z, Q_i and Delta_1 (Eq. 7) of the laws' gains, those that apply, by name.

    Delta_1 is evaluated on the ideal motion z = r. Q_z and Q_i are maxima over the samples of the clock.
    """
    cascade, scenario, clock = objective.cascade, objective.scenario.turning(), objective.clock
    t = jnp.arange(clock.samples) * clock.sample_period

    def largest(signal: Callable[[Array], Array]) -> float:
        return float(np.max(np.abs(np.asarray(jax.vmap(signal)(t)))))

    sides = {
        "Q_z": lambda: largest(scenario.acceleration),
        "Q_i": lambda: largest(scenario.q_i),
        "Delta_1": lambda: delta_1_on_reference(cascade, scenario, clock)[0],
    }
    return {one.over: sides[one.over]() for one in required(cascade) if one.value is not None}


def _context(objective: Objective) -> SearchContext:
    model, scenario = objective.cascade.model, objective.scenario
    w = float(scenario.plant.pole)
    bounds = theorem_bounds(objective)
    stiffness = 4 * float(model.i_0) ** 2 / float(model.s_0) ** 3
    growth = stiffness * w
    places = [
        (abs(float(scenario.initial.z)), "initial.z"),
        (abs(float(scenario.initial.z_dot)) / w, "initial.z_dot / w"),
        (KICK * float(scenario.touchdown), f"{100 * KICK:g} % of the clearance"),
    ]
    z, where = max(places)
    delta, fall = bounds.get("Delta_1", 0.0), growth * z
    needed = (
        LowerBound(delta, "Delta_1", f"Delta_1 = {delta:.3g} A^2/m^2/s along the reference, Eq. (7)")
        if delta >= fall
        else LowerBound(
            fall, "D", f"D = dv/dz w z = {fall:.3g} A^2/m^2/s, required by Eq. (7) if the rotor falls from z = {where}"
        )
    )
    stepped = objective.cascade.sampled and objective.cascade.timing.implicit
    return SearchContext(model, w, float(objective.clock.sample_period), bounds, needed, stepped)


def _interval(context: SearchContext, cascade: Cascade, gain: Gain, value: float) -> Interval:
    if gain.low > 0 and np.isfinite(gain.high):
        return Interval(gain.low, gain.high, "tune.bounds", True)
    _, stage, name, *_ = gain.path.split(".")
    about = Interval(
        value / DEFAULT_FACTOR,
        value * DEFAULT_FACTOR,
        f"1/{DEFAULT_FACTOR:g} to {DEFAULT_FACTOR:g} times the case's value",
    )
    return extremes(getattr(cascade, stage))[0].ranges(context).get(name, about)


def _quotient(gain: Gain, value: float, interval: Interval, cascade: Cascade, found: dict[str, Range]) -> Range:
    """Return the range of a gain whose law defines the interval of its product with another gain."""
    root, stage, _, *knot = gain.path.split(".")
    stem = f"{root}.{stage}.{interval.times}"
    # if both gains have schedules: the other gain at the same knot
    other = next((path for path in (".".join([stem, *knot]), stem) if path in found), None)
    if other is None:
        size = float(getattr(extremes(getattr(cascade, stage))[0], interval.times))
        return _range(gain, value, interval._replace(low=interval.low / size, high=interval.high / size))
    ends = interval.low / found[other].high, interval.high / found[other].low
    whole = _range(gain, value, interval._replace(low=ends[0], high=ends[1]))
    return dataclasses.replace(whole, product=(other, interval.low, interval.high))


def _range(gain: Gain, value: float, interval: Interval) -> Range:
    if gain.low > 0 and np.isfinite(gain.high):
        return Range(gain.low, gain.high, gain.high, interval.source)
    low, high, source = interval[:3]
    if gain.low > 0 or np.isfinite(gain.high):
        source += "; within tune.bounds"
    low, high = max(low, gain.low * (1 + MARGIN)), min(high, gain.high / (1 + MARGIN))
    if low >= high and gain.low > 0:
        high = low * DEFAULT_FACTOR**2
    elif low >= high:
        low = high / DEFAULT_FACTOR**2
    if np.isfinite(gain.high):
        return Range(low, high, gain.high, source)
    most = max(high, value) * (1 if interval.firm else END_FACTOR)
    return Range(low, min(high, most / (1 + MARGIN)), most, f"{source}; tuned gain at most {most:.3g}")
