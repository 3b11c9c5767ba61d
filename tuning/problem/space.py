"""Search space: the gains to tune, their bounds, and a map from unbounded coordinates to gains.

A coordinate is the logarithm of a gain, bent at its bounds by softplus functions. One unit is about a factor e.
`Space.decode` does not copy gains that are not in the space.
"""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.control.schedule import Schedule
from ambjax.extend import Scalar
from ambjax.host.extensions import NothingToTuneError

# A coordinate bends within 1/SHARP of a bound, in logarithms. A logistic curve over the whole interval would put the
# bound at infinity, so that a search converges slowly to an optimum at the bound.
SHARP = 4.0
# Distance of `Gain.inner` from the bounds: a share of the bound, at most a tenth of the interval in logarithms.
MARGIN = 0.02
# Smallest relative distance of two bounds. Closer bounds leave an interval of the size of the rounding error.
CLOSEST = 1e-6
ROOT = "controller"
STAGES = ("observer", "position", "inversion", "current")


@dataclasses.dataclass(frozen=True)
class Gain:
    """A gain: its dotted path as in the case file, and its open interval (low, high).

    Without an upper bound the coordinate is x = log(g - low). With one, log g = x well within the interval, and
    softplus functions bend it at the bounds: at a coordinate 0.8 beyond a bound the gain is 1 % away from it.
    """

    path: str
    low: float = 0.0
    high: float = math.inf

    @property
    def name(self) -> str:
        """The path within the law: the name of the gain, and the number of its knot if it has a schedule."""
        return self.path.split(".", 2)[2]

    def encode(self, gain: float) -> float:
        """Return the coordinate of a gain strictly within the bounds."""
        if math.isinf(self.high):
            return np.log(gain - self.low)
        if self.low == 0.0:
            return np.log(self.high) - np.log(np.expm1(SHARP * np.log(self.high / gain))) / SHARP
        rise, fall = SHARP * np.log(gain / self.low), SHARP * np.log(self.high / gain)
        # expm1(rise) / (1 - exp(-fall)), whose logarithm does not overflow
        return math.log(self.low) + (rise + np.log(-np.expm1(-rise)) - np.log(-np.expm1(-fall))) / SHARP

    def decode(self, x: Array) -> Array:
        """Return the gain at a coordinate."""
        if math.isinf(self.high):
            return self.low + jnp.exp(x)
        high = math.log(self.high)
        if self.low == 0.0:
            return jnp.minimum(jnp.exp(high - jax.nn.softplus(SHARP * (high - x)) / SHARP), self.high)  # rounding
        below = jax.nn.softplus(SHARP * (x - math.log(self.low))) / SHARP
        above = jax.nn.softplus(SHARP * (x - high)) / SHARP
        gain = jnp.exp(math.log(self.low) + (below - above))
        return jnp.clip(gain, self.low, self.high)  # rounding

    @property
    def inner(self) -> tuple[float, float]:
        """An interval (low, high) well within the bounds."""
        if self.low == 0.0:
            return CLOSEST**2 * min(self.high, 1.0), self.high / (1 + MARGIN)
        aside = min(1 + MARGIN, (self.high / self.low) ** 0.1)
        return self.low * aside, self.high / aside

    def at_bound(self, gain: float) -> str:
        """Return 'low' or 'high' if the gain is within 1 % of that bound, else ''."""
        if self.low > 0 and gain <= 1.01 * self.low:
            return "low"
        return "high" if math.isfinite(self.high) and gain >= 0.99 * self.high else ""


@dataclasses.dataclass(frozen=True)
class Space:
    """The gains to tune.

    Raises NothingToTuneError if it is empty, and ValueError if a path occurs twice or not 0 <= low < high for a gain.
    """

    gains: tuple[Gain, ...]

    def __post_init__(self) -> None:
        if not self.gains:
            raise NothingToTuneError("tune.gains is empty: name at least one gain, or leave out tune.gains.")
        for gain in self.gains:
            if not 0 <= gain.low < gain.high:
                raise ValueError(
                    f"tune.bounds: {gain.path} = [{gain.low:g}, {gain.high:g}]: give [low, high] with 0 <= low < high."
                )
            if [g.path for g in self.gains].count(gain.path) > 1:
                raise ValueError(f"tune.gains: {gain.path} is named twice. Name each gain once.")

    def __len__(self) -> int:
        return len(self.gains)

    @property
    def paths(self) -> list[str]:
        """Dotted paths of the gains, in order."""
        return [gain.path for gain in self.gains]

    def values(self, cascade: Cascade) -> np.ndarray:
        """Return the gains [m] of a cascade, in order."""
        return np.array([float(read(cascade, gain.path)) for gain in self.gains])

    @partial(jax.jit, static_argnums=0)
    def gains_at(self, x: Array) -> Array:
        """Return the gains [m] at coordinates x [m]."""
        return jnp.stack([gain.decode(x[j]) for j, gain in enumerate(self.gains)])

    def named(self, x: np.ndarray) -> dict[str, float]:
        """Return the gains by path at coordinates x [m]."""
        return dict(zip(self.paths, np.asarray(self.gains_at(jnp.asarray(x))).tolist(), strict=True))

    def encode(self, gains: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the coordinates [m] of gains [m]. Raises ValueError for a gain outside its bounds."""
        for gain, value in zip(self.gains, gains, strict=True):
            if not gain.low < value < gain.high:
                raise ValueError(
                    f"{gain.path} = {value:g}: it must lie between tune.bounds {gain.low:g} and {gain.high:g}, because "
                    "the search starts at this gain. Change the gain or widen its bounds."
                )
        return np.array([gain.encode(value) for gain, value in zip(self.gains, gains, strict=True)])

    def clip(self, gains: np.ndarray) -> np.ndarray:
        """Return the gains [m], clipped to `Gain.inner`: 2 % inside of the bounds, or less if these are close."""
        return np.array([float(np.clip(value, *gain.inner)) for gain, value in zip(self.gains, gains, strict=True)])

    def drawn_back(self, x: np.ndarray) -> np.ndarray:
        """Return x [m] with no coordinate more than 2/SHARP beyond a bound, so that a search can leave the bound.

        There, the gain is 3 % away from the bound, and a change of the coordinate changes its logarithm by an eighth of
        that. Farther beyond, the gain hardly depends on its coordinate.
        """
        bent = [(gain.low, gain.high) if math.isfinite(gain.high) else (0.0, math.inf) for gain in self.gains]
        with np.errstate(divide="ignore"):
            low, high = np.log(bent).T
        return np.clip(x, low - 2 / SHARP, high + 2 / SHARP)

    def decode(self, x: Array, cascade: Cascade) -> Cascade:
        """Return the cascade with the gains at coordinates x [m]. All other leaves are the same objects."""
        for j, gain in enumerate(self.gains):
            cascade = with_gain(cascade, gain.path, gain.decode(x[j]))
        return cascade


def tunable(cascade: Cascade, *, steepness: bool = True, idle: bool = False) -> list[str]:
    """Return the dotted paths of the gains of a cascade that may be tuned: the fields of its laws declared by `gain`.

    `steepness`: whether to include the steepness of smoothed signs. `idle`: whether to include gains without effect
    under the processor of the cascade, or without one.
    """
    paths, implicit = [], cascade.timing.implicit if cascade.sampled else None
    for stage in STAGES:
        law = getattr(cascade, stage)
        left_out = () if idle else law.idle_gains(implicit)
        for field in dataclasses.fields(law):
            meta = field.metadata
            given = "steepness" in meta and getattr(law, field.name) is not None
            if given and field.name not in left_out and (steepness or not meta["steepness"]):
                paths += knots(cascade, f"{ROOT}.{stage}.{field.name}") or [f"{ROOT}.{stage}.{field.name}"]
    return paths


def knots(cascade: Cascade, path: str) -> list[str]:
    """Return the paths of the knots of the gain at a dotted path: path.0, path.1 and so on; none without a schedule."""
    value = read(cascade, path)
    return [f"{path}.{knot}" for knot in range(len(value.values))] if isinstance(value, Schedule) else []


def read(cascade: Cascade, path: str) -> Any:
    """Return the gain of a cascade at a dotted path, or its schedule."""
    _, stage, name, *knot = path.split(".")
    value = getattr(getattr(cascade, stage), name)
    return value.values[int(knot[0])] if knot else value


def with_gain(cascade: Cascade, path: str, value: Scalar) -> Cascade:
    """Return the cascade with the gain at a dotted path replaced."""
    _, stage, name, *knot = path.split(".")
    law = getattr(cascade, stage)
    law = dataclasses.replace(law, **{name: getattr(law, name).with_knot(int(knot[0]), value) if knot else value})
    return dataclasses.replace(cascade, **{stage: law})
