"""Signals that are not formulas: values read from a file, and band-limited noise drawn for each member."""

import dataclasses
import functools
import hashlib
import math
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from ambjax.numerics.records import Scalar, bounded, leaf, record, static
from ambjax.numerics.smooth import TWO_PI, sine
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
    scale: Scalar = bounded(1.0, "1", -1e20, 1e20, "factor of the values")
    start: Scalar = bounded(0.0, "s", -1e9, 1e9, "time of the run at which the time of the file is 0")

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


# Number of sines in one realisation of band-limited noise. Its fourth moment is less than that of a Gaussian signal by
# (1.5/LINES) std^4.
LINES = 32


@record
class Lines:
    """Sum of n sines: std sqrt(2/n) sum(sin(2 pi frequencies t + phases)), with frequencies in Hz and phases in rad."""

    std: Scalar
    frequencies: Array
    phases: Array

    def __call__(self, t: Scalar) -> Array:
        turns = self.frequencies * jnp.asarray(t)[..., None] + self.phases / TWO_PI
        return self.std * math.sqrt(2 / self.phases.size) * jnp.sum(sine(turns), axis=-1)


@record
class BandNoise:
    """Stationary band-limited noise: constant power density over f_low..f_high (Hz), standard deviation `std`.

    The signal of a member is a sum of LINES sines. Each sine has a random phase, and a random frequency in one of LINES
    equal parts of the band (after Shinozuka and Deodatis, Appl. Mech. Rev. 44, 1991). The autocovariance over members
    is exactly std^2 times the mean of cos(2 pi f tau) over the frequencies f of the band. The signal is smooth, so
    integrators keep their order.

    Use it for a random load, such as that of a flow or a floor: `Scenario(q_f=signals.BandNoise(2.0, 10.0, 500.0))`.
    """

    std: Scalar = leaf(at_least=0, at_most=1e20, doc="standard deviation")
    f_low: Scalar = leaf(unit="Hz", at_least=0, at_most=1e9, doc="lower end of the band")
    f_high: Scalar = leaf(unit="Hz", above=0, at_most=1e9, doc="upper end of the band, above f_low")
    ordered: ClassVar = ("f_low", "f_high")

    def realised(self, key: Array) -> Lines:
        place, turn = jax.random.uniform(key, (2, LINES))
        share = (jnp.arange(LINES) + place) / LINES
        return Lines(self.std, self.f_low + (self.f_high - self.f_low) * share, 2 * jnp.pi * turn)

    def __call__(self, t: Scalar) -> Array:
        raise ValueError(
            "band-noise: the signal of one member is a function of time, but it is not drawn yet. Call "
            "scenario.realised() first, as a rollout does."
        )

    def span(self, end: float) -> tuple[float, float]:
        crest = math.sqrt(2 * LINES) * float(np.max(self.std))  # all sines at their crests at once: 8 std
        return -crest, crest
