"""Distributions: how one number is spread.

Each is a record with `quantile(u, nominal)`, its inverse cumulative distribution, so that every design of points u in
the unit cube works with each; and `support(nominal)`, the interval that it never leaves. Normal shapes are
cut at 6 standard deviations, beyond which lie 2 in 1e9: so they have bounds too.
"""

import math
from typing import Protocol

import numpy as np

from ambjax.numerics.records import Scalar, leaf, record, static

# Standard deviations at which normal shapes are cut.
CUT = 6.0
SHAPES = ("uniform", "normal")


class Distribution(Protocol):
    """How one number is spread. `str` gives it as it stands in a case file."""

    relative: bool
    """whether the nominal value matters"""

    def fault(self) -> str | None: ...
    def support(self, nominal: float) -> tuple[float, float]: ...
    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray: ...


def cut_normal(u: np.ndarray) -> np.ndarray:
    """Quantile of the standard normal distribution cut at +-6."""
    from scipy.special import ndtr, ndtri

    outside = ndtr(-CUT)
    return ndtri(outside + np.asarray(u) * (1 - 2 * outside))


@record
class Normal:
    """nominal + std z, z standard normal."""

    std: Scalar = leaf(at_least=0, doc="standard deviation, in the unit of the number")
    relative = True

    def __str__(self) -> str:
        return f"{{ normal = {self.std:g} }}"

    def fault(self) -> str | None:
        return (
            None
            if 0 <= self.std < math.inf
            else "normal, the standard deviation, must be a finite number of at least 0"
        )

    def support(self, nominal: float) -> tuple[float, float]:
        return nominal - CUT * self.std, nominal + CUT * self.std

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        return nominal + self.std * cut_normal(u)


@record
class Percent:
    """nominal (1 + percent/100 x): x uniform in -1..1, or standard normal."""

    percent: Scalar = leaf(at_least=0, doc="half width, or standard deviation, in per cent of nominal")
    shape: str = static(default="uniform")
    relative = True

    def __str__(self) -> str:
        shape = "" if self.shape == "uniform" else f', shape = "{self.shape}"'
        return f"{{ percent = {self.percent:g}{shape} }}"

    def fault(self) -> str | None:
        if self.shape not in SHAPES:
            return f"shape must be {' or '.join(map(repr, SHAPES))}"
        return None if 0 <= self.percent < math.inf else "percent must be a finite number of at least 0"

    def support(self, nominal: float) -> tuple[float, float]:
        half = abs(nominal) * self.percent / 100 * (1.0 if self.shape == "uniform" else CUT)
        return nominal - half, nominal + half

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        x = 2 * np.asarray(u) - 1 if self.shape == "uniform" else cut_normal(u)
        return nominal + abs(nominal) * self.percent / 100 * x


@record
class Uniform:
    """Anything from low to high, equally likely. The nominal value does not matter."""

    low: Scalar = leaf(doc="least value")
    high: Scalar = leaf(doc="largest value")
    relative = False

    def __str__(self) -> str:
        return f"{{ uniform = [{self.low:g}, {self.high:g}] }}"

    def fault(self) -> str | None:
        return None if -math.inf < self.low < self.high < math.inf else "uniform must be [low, high] with low < high"

    def support(self, nominal: float) -> tuple[float, float]:
        return self.low, self.high

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        return self.low + (self.high - self.low) * np.asarray(u)


@record
class LogUniform:
    """Its logarithm is uniform: every decade from low to high is equally likely."""

    low: Scalar = leaf(above=0, doc="least value")
    high: Scalar = leaf(above=0, doc="largest value")
    relative = False

    def __str__(self) -> str:
        return f"{{ log-uniform = [{self.low:g}, {self.high:g}] }}"

    def fault(self) -> str | None:
        return None if 0 < self.low < self.high < math.inf else "log-uniform must be [low, high] with 0 < low < high"

    def support(self, nominal: float) -> tuple[float, float]:
        return self.low, self.high

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        low, high = math.log(self.low), math.log(self.high)  # their ratio may overflow
        return np.clip(np.exp(low + (high - low) * np.asarray(u)), self.low, self.high)  # exp may round beyond its ends


@record
class Choice:
    """One of several values, equally likely."""

    values: tuple[Scalar, ...]
    relative = False

    def __str__(self) -> str:
        return f"{{ choices = [{', '.join(f'{x:g}' for x in self.values)}] }}"

    def fault(self) -> str | None:
        sound = len(self.values) > 0 and not any(math.isnan(x) for x in self.values)
        return None if sound else "choices must be a list of at least one number"

    def support(self, nominal: float) -> tuple[float, float]:
        return min(self.values), max(self.values)

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        values = np.sort(np.asarray(self.values, float))
        return values[np.minimum((np.asarray(u) * len(values)).astype(int), len(values) - 1)]
