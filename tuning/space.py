"""Space: which gains may move, and within which bounds; coordinates in which they move freely.

A coordinate is the logarithm of a gain, bent at its bounds: x real, one unit about a factor e. Gains that
are not in the space are not touched: decode returns the very leaves it was given.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade

# How sharply a coordinate bends at a bound: within 1/SHARP of it, in logarithms. A logistic curve over the whole
# interval would put a bound at infinity: a search whose optimum lies there creeps.
SHARP = 4.0
# A gain well within its bounds is away from them by this share of its size, or of the way between them in logarithms.
MARGIN, MARGIN_OF_ZERO, SHARE = 0.02, 1e-12, 0.1
# Bounds that lie closer together than by this share leave a search nothing but rounding.
CLOSEST = 1e-6
ROOT = "controller"
STAGES = ("observer", "position", "inversion", "current")


@dataclasses.dataclass(frozen=True)
class Gain:
    """One gain: its dotted path as in the case file, and the open interval in which it may move.

    low = 0 and high = inf: positive, x = log g. low > 0: above, x = log(g - low). With an upper bound: log g = x well
    within the interval, bent at its ends by softplus functions, so that an end is 1 % away 0.8 beyond it.
    """

    path: str
    low: float = 0.0
    high: float = math.inf

    @property
    def name(self) -> str:
        """The last word of the path."""
        return self.path.rpartition(".")[2]

    def encode(self, gain: Any) -> Any:
        """Coordinate of a gain strictly within the bounds."""
        if math.isinf(self.high):
            return np.log(gain - self.low)
        if self.low == 0.0:
            return np.log(self.high) - np.log(np.expm1(SHARP * np.log(self.high / gain))) / SHARP
        rise, fall = SHARP * np.log(gain / self.low), SHARP * np.log(self.high / gain)
        # expm1(rise) / (1 - exp(-fall)), whose logarithm does not overflow
        return math.log(self.low) + (rise + np.log(-np.expm1(-rise)) - np.log(-np.expm1(-fall))) / SHARP

    def decode(self, x: Array) -> Array:
        """Gain at a coordinate."""
        if math.isinf(self.high):
            return self.low + jnp.exp(x)
        high = math.log(self.high)
        if self.low == 0.0:
            return jnp.minimum(jnp.exp(high - jax.nn.softplus(SHARP * (high - x)) / SHARP), self.high)  # of rounding
        below = jax.nn.softplus(SHARP * (x - math.log(self.low))) / SHARP
        above = jax.nn.softplus(SHARP * (x - high)) / SHARP
        gain = jnp.exp(math.log(self.low) + (below - above))
        return jnp.clip(gain, self.low, self.high)  # of rounding, at either end

    @property
    def inner(self) -> tuple[float, float]:
        """What is well within the bounds."""
        if self.low == 0.0:
            return MARGIN_OF_ZERO * min(self.high, 1.0), self.high / (1 + MARGIN)
        aside = min(1 + MARGIN, (self.high / self.low) ** SHARE)
        return self.low * aside, self.high / aside

    def at_bound(self, gain: float) -> str:
        """'low' or 'high' where the gain is within 1 % of a bound, else ''."""
        if self.low > 0 and gain <= 1.01 * self.low:
            return "low"
        return "high" if math.isfinite(self.high) and gain >= 0.99 * self.high else ""


@dataclasses.dataclass(frozen=True)
class Space:
    """Several gains. Raises ValueError where it is empty, a path is given twice or bounds make no interval."""

    gains: tuple[Gain, ...]

    def __post_init__(self) -> None:
        if not self.gains:
            raise ValueError('tune.gains is empty: name at least one, for example ["controller.position.c"].')
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
        """Dotted paths in order."""
        return [gain.path for gain in self.gains]

    def values(self, cascade: Cascade) -> np.ndarray:
        """The gains of a cascade in order, [m]."""
        return np.array([float(read(cascade, gain.path)) for gain in self.gains])

    def gains_at(self, x: Array) -> Array:
        """Gains [m] at coordinates [m]."""
        return jnp.stack([gain.decode(x[j]) for j, gain in enumerate(self.gains)])

    def encode(self, gains: Sequence[float] | np.ndarray) -> np.ndarray:
        """Coordinates [m] of gains [m]. Raises ValueError for a gain outside its bounds."""
        for gain, value in zip(self.gains, gains, strict=True):
            if not gain.low < value < gain.high:
                raise ValueError(
                    f"{gain.path} = {value:g}: it must lie between tune.bounds {gain.low:g} and {gain.high:g} to start "
                    "from. Change the gain or widen its bounds."
                )
        return np.array([gain.encode(value) for gain, value in zip(self.gains, gains, strict=True)])

    def clip(self, gains: np.ndarray) -> np.ndarray:
        """Gains moved inside their bounds by 2 % at least; by a tenth of the way where these lie closer together."""
        return np.array([float(np.clip(value, *gain.inner)) for gain, value in zip(self.gains, gains, strict=True)])

    def decode(self, x: Array, cascade: Cascade) -> Cascade:
        """The cascade with the gains at coordinates x [m]; everything else the same objects as before."""
        for j, gain in enumerate(self.gains):
            cascade = _write(cascade, gain.path, gain.decode(x[j]))
        return cascade


def tunable(cascade: Cascade, *, steepness: bool = True) -> list[str]:
    """Dotted paths of all gains of a cascade that may be tuned: the positive leaves of its laws.

    `steepness`: those of smoothed signs too, where they are smoothed.
    """
    paths = []
    for stage in STAGES:
        law = getattr(cascade, stage)
        for field in dataclasses.fields(law):
            meta = field.metadata
            positive = meta.get("leaf") and meta["above"] is not None and getattr(law, field.name) is not None
            if positive and (steepness or not meta.get("steepness")):
                paths.append(f"{ROOT}.{stage}.{field.name}")
    return paths


def read(cascade: Cascade, path: str) -> Any:
    """The gain of a cascade at a dotted path."""
    _, stage, name = path.split(".")
    return getattr(getattr(cascade, stage), name)


def _write(cascade: Cascade, path: str, value: Any) -> Cascade:
    _, stage, name = path.split(".")
    law = dataclasses.replace(getattr(cascade, stage), **{name: value})
    return dataclasses.replace(cascade, **{stage: law})
