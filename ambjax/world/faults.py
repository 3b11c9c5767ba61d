"""Faults of a position sensor on a processor: outliers and dropouts."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from ambjax.numerics.gaussian import threefry
from ambjax.numerics.records import Scalar, bounded, record, static

# Random streams of a member's key, in addition to those of `numerics.gaussian`.
OUTLIERS, DROPOUTS = 3, 4
VALUES = ("hold", "nan", "zero", "full-scale")


class FaultOnsets(NamedTuple):
    """Faults that begin at a sample: the number added to its reading (m), and whether a dropout begins."""

    outlier: Array
    drops: Array


class Sensed(NamedTuple):
    """State of a faulty sensor: its last reading of z (m), and the remaining samples of a dropout."""

    z: Array
    left: Array


def _rate() -> Any:
    return bounded(0.0, "1/s", 0, 1e9, "mean number per second, equally likely at every sample")


def _at() -> Any:
    return bounded(None, "s", 0, 1e6, "time of one more fault, rounded to the nearest sample; none: no other fault")


@record
class Outliers:
    """Single readings of z with an error of +-`size`, each sign with probability 1/2, after the converter.

    Use it to test the guard against single wrong readings: `sensors.Sensor(outliers=sensors.Outliers(10.0, 1e-4))`.
    """

    rate: Scalar = _rate()
    size: Scalar = bounded(1e-3, "m", 0, 1.0, "error of a reading")
    at: Scalar | None = _at()

    def onset(self, key: tuple[Scalar, Scalar], sample: Scalar, period: Scalar) -> Array:
        """Return the number added to the reading of a sample, m."""
        begins, sign = _begins(self, OUTLIERS, key, sample, period)
        return jnp.where(begins, sign * self.size, 0.0)


@record
class Dropouts:
    """Intervals without a reading of z. `value` selects what is read instead.

    "hold": the last reading; "nan": NaN; "zero": 0 m; "full-scale": the end of the converter's range.

    Use it to test the guard against a lost connection: `sensors.Sensor(dropouts=sensors.Dropouts(1.0, 1e-3))`.
    """

    rate: Scalar = _rate()
    duration: Scalar = bounded(5e-4, "s", 0, 1e6, "duration, rounded to whole samples, at least one")
    at: Scalar | None = _at()
    value: str = static(default=VALUES[0], choices=VALUES, doc="reading during a dropout")

    def onset(self, key: tuple[Scalar, Scalar], sample: Scalar, period: Scalar) -> Array:
        return _begins(self, DROPOUTS, key, sample, period)[0]

    def samples(self, period: Scalar) -> Array:
        return jnp.maximum(jnp.round(self.duration / period), 1.0)

    def read(self, last: Array, end: Scalar) -> Array:
        """Return the reading (m) during a dropout; `end` is the end of the converter's range, m."""
        values = {"hold": last, "nan": jnp.nan, "zero": 0.0, "full-scale": end}
        return jnp.asarray(values[self.value], last.dtype)


def _begins(
    fault: Outliers | Dropouts, stream: int, key: tuple[Scalar, Scalar], sample: Scalar, period: Scalar
) -> tuple[Array, Array]:
    """Return whether a fault begins at a sample (with probability rate x period, or at `at`), and a random sign."""
    first, second = threefry(key, (stream, sample))
    dtype = jnp.result_type(float)
    begins = first.astype(dtype) * 2.0**-32 < fault.rate * period
    if fault.at is not None:
        begins = begins | (jnp.round(fault.at / period) == jnp.asarray(sample).astype(dtype))
    return begins, jnp.where(second >> jnp.uint32(31) == 0, 1.0, -1.0)
