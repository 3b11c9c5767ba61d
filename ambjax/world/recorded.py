"""Recorded signals: values at given times, read from a file."""

import dataclasses
import functools
import hashlib
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.world.waveforms import later

# Largest number of rows. The rows are constants of the compiled program.
MOST_ROWS = 200_000


class Knots(NamedTuple):
    """Instants start + times (s) at which a recorded signal or its slope jumps. `times` [n] is sorted."""

    times: np.ndarray
    start: Scalar

    def after(self, t: Scalar) -> Array:
        """Return the first instant after t, s; +inf if there is none."""
        times = jnp.asarray(np.append(self.times, np.inf), jnp.result_type(float))
        return self.start + times[jnp.searchsorted(times, jnp.asarray(t, times.dtype) - self.start, side="right")]


@dataclasses.dataclass(frozen=True, eq=False)
class Samples:
    """Values [n] at increasing times [n] (s), float64, n >= 2. Two `Samples` are equal if their numbers are.

    Lists, and arrays of other types, are converted. Raises ValueError for another shape, a number that is not finite,
    or times not in order.

    Use it for the numbers of a `Recorded` signal: `signals.Samples(np.array([0.0, 0.1]), np.array([0.0, 5.0]))`.
    """

    times: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        times, values = (_numbers(f.name, getattr(self, f.name)) for f in dataclasses.fields(self))
        if times.ndim != 1 or times.shape != values.shape:
            raise ValueError(
                f"times and values must be two lists of equal length; their shapes are {times.shape}, {values.shape}."
            )
        if not 2 <= times.size <= MOST_ROWS:
            raise ValueError(f"times and values have {times.size:,} rows; give 2 to {MOST_ROWS:,}.")
        for what, x in (("time", times), ("value", values)):
            if (wrong := np.flatnonzero(~np.isfinite(x))).size:
                raise ValueError(f"the {what} of row {wrong[0] + 1} is {x[wrong[0]]}; each must be a finite number.")
        if (wrong := np.flatnonzero(np.diff(times) <= 0)).size:
            row = wrong[0] + 1
            raise ValueError(f"times must increase: row {row + 1} has {times[row]:g} s after {times[row - 1]:g} s.")
        self.__dict__.update(times=times, values=values)

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the numbers."""
        return hashlib.sha256(np.stack([self.times, self.values]).tobytes()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Samples) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def _numbers(what: str, given: npt.ArrayLike) -> np.ndarray:
    """Return real numbers as float64. Raises ValueError if they are traced, or not real numbers."""
    try:
        x = np.asarray(given)
        if np.issubdtype(x.dtype, np.number) and not np.iscomplexobj(x):
            return np.asarray(x, float)
    except (TypeError, ValueError):  # traced, or lists of several lengths
        pass
    raise ValueError(f"{what} are not real numbers.")


@record
class Recorded:
    """A recorded signal: scale times value(t - start). Between two times, the value is interpolated linearly or held.

    Before the first time the value is the first one, and after the last time it is the last one. The samples are
    constants of the compiled program, so another file needs another compilation. Steps of the integrator end where the
    value jumps or its slope changes, so a record with many values per sample needs as many steps.

    Use it for a measured load:
    `Scenario(q_f=signals.Recorded(signals.Samples(np.array([0.0, 0.1]), np.array([0.0, 5.0]))))`.
    """

    samples: Samples = static(doc="times and values")
    held: bool = static(default=False, doc="whether a value is held until the next time")
    scale: Scalar = leaf(default=1.0, unit="1", at_least=-1e20, at_most=1e20, doc="factor of the values")
    start: Scalar = leaf(
        default=0.0, unit="s", at_least=-1e9, at_most=1e9, doc="time of the run at which the time of the file is 0"
    )

    def __call__(self, t: Scalar) -> Array:
        dtype = jnp.result_type(float)
        times, values = (jnp.asarray(x, dtype) for x in (self.samples.times, self.samples.values))
        now = jnp.asarray(t, dtype) - self.start
        last = times.size - 1
        if self.held:
            return self.scale * values[jnp.clip(jnp.searchsorted(times, now, side="right") - 1, 0, last)]
        now = jnp.clip(now, times[0], times[-1])
        left = jnp.clip(jnp.searchsorted(times, now, side="right") - 1, 0, last - 1)
        share = (now - times[left]) / (times[left + 1] - times[left])
        return self.scale * (values[left] + share * (values[left + 1] - values[left]))

    def span(self, end: float) -> tuple[float, float]:
        low, high = np.min(self.samples.values), np.max(self.samples.values)
        ends = [np.asarray(self.scale) * x for x in (low, high)]
        return float(np.min(ends)), float(np.max(ends))

    def knots(self) -> tuple[Knots, ...]:
        """Return the instants at which the value (held) or the slope (linear) jumps."""
        times, values = self.samples.times, self.samples.values
        rates = values if self.held else np.concatenate([[0.0], np.diff(values) / np.diff(times), [0.0]])
        # A change within rounding is none: the lines of a record of decimals are straight over many rows.
        changes = np.abs(np.diff(rates)) > 1e-9 * np.max(np.abs(rates), initial=0.0)
        return (Knots(times[1:][changes] if self.held else times[changes], self.start),)

    shifted = later
