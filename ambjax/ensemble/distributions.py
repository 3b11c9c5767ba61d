"""Distributions of a number of the case that varies between members.

Each is a record with two functions. `quantile(u, nominal)` is the inverse cumulative distribution, which maps the
points u of any design in the unit cube to values. `support(nominal)` is the interval that contains all values. Normal
shapes are truncated at 6 standard deviations, which excludes a probability of 2e-9, so they have finite bounds too.
"""

import math
from typing import Protocol

import numpy as np

from ambjax.numerics.records import part, record, static

# Standard deviations at which normal shapes are truncated.
CUT = 6.0
SHAPES = ("uniform", "normal")


class Distribution(Protocol):
    """Distribution of one number. `str` gives it in the syntax of a case file.

    - `fault`: the reason why the parameters are invalid, in words; None if they are valid.
    - `support`: smallest and largest value.
    - `quantile`: inverse cumulative distribution at u in (0, 1).
    """

    relative: bool
    """whether the values depend on the nominal value"""

    def fault(self) -> str | None: ...
    def support(self, nominal: float) -> tuple[float, float]: ...
    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray: ...


def cut_normal(u: np.ndarray) -> np.ndarray:
    """Return the quantile of the standard normal distribution truncated at +-6."""
    from scipy.special import ndtr, ndtri

    outside = ndtr(-CUT)
    return ndtri(outside + np.asarray(u) * (1 - 2 * outside))


@record
class Normal:
    """Normal distribution: nominal + std x, with x standard normal and truncated at +-6."""

    std: float = part(doc="standard deviation, in the unit of the number")
    relative = True

    def __str__(self) -> str:
        return f"{{ normal = {self.std:g} }}"

    def fault(self) -> str | None:
        fine = 0 <= self.std < math.inf
        return None if fine else "normal, the standard deviation, must be a finite number of at least 0"

    def support(self, nominal: float) -> tuple[float, float]:
        return nominal - CUT * self.std, nominal + CUT * self.std

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        return nominal + self.std * cut_normal(u)


@record
class Percent:
    """Relative distribution: nominal + |nominal| percent/100 x, with x uniform in -1..1, or normal as in `Normal`."""

    percent: float = part(doc="half width, or standard deviation, in per cent of nominal")
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
class _Range:
    low: float = part(doc="smallest value")
    high: float = part(doc="largest value")
    relative = False

    def support(self, nominal: float) -> tuple[float, float]:
        return self.low, self.high


@record
class Uniform(_Range):
    """Uniform distribution from low to high. It does not depend on the nominal value."""

    def __str__(self) -> str:
        return f"{{ uniform = [{self.low:g}, {self.high:g}] }}"

    def fault(self) -> str | None:
        return None if -math.inf < self.low < self.high < math.inf else "uniform must be [low, high] with low < high"

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        return self.low + (self.high - self.low) * np.asarray(u)


@record
class LogUniform(_Range):
    """Log-uniform distribution: the logarithm of the number is uniform from log(low) to log(high)."""

    def __str__(self) -> str:
        return f"{{ log-uniform = [{self.low:g}, {self.high:g}] }}"

    def fault(self) -> str | None:
        return None if 0 < self.low < self.high < math.inf else "log-uniform must be [low, high] with 0 < low < high"

    def quantile(self, u: np.ndarray, nominal: float) -> np.ndarray:
        low, high = math.log(self.low), math.log(self.high)  # logarithms, because high/low may overflow
        return np.clip(np.exp(low + (high - low) * np.asarray(u)), self.low, self.high)  # exp may round outward


@record
class Choice:
    """Discrete distribution: one of several values, all equally likely."""

    values: tuple[float, ...]
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
