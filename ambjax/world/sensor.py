"""Sensors: what is measured, and the errors of it."""

from typing import NamedTuple

from jax import Array

from ambjax.numerics.gaussian import normals
from ambjax.numerics.records import Scalar, leaf, record


class Errors(NamedTuple):
    """Errors of the sensors, held over one sample: m, m/s, A."""

    z: Array
    z_dot: Array
    i: Array


class Measurement(NamedTuple):
    """What sensors, or an observer behind them, report: m, m/s, A."""

    z: Array
    z_dot: Array
    i: Array

    def off(self, errors: Errors) -> "Measurement":
        """The same, off by these errors."""
        return Measurement(self.z + errors.z, self.z_dot + errors.z_dot, self.i + errors.i)


@record
class Sensor:
    """Gaussian noise on each measurement, drawn once per sample period and held; the state itself is seen at once."""

    std: Scalar = leaf(default=0.0, unit="m", at_least=0, at_most=1.0, doc="standard deviation on z")
    std_z_dot: Scalar = leaf(default=0.0, unit="m/s", at_least=0, at_most=1e6, doc="standard deviation on z_dot")
    std_i: Scalar = leaf(default=0.0, unit="A", at_least=0, at_most=1e6, doc="standard deviation on i")

    def noise(self, key: tuple[Scalar, Scalar], sample: Scalar) -> Errors:
        """The errors of sample number `sample` for the member with these words (Scenario.words)."""
        w = normals(key, sample)
        return Errors(self.std * w[0], self.std_z_dot * w[1], self.std_i * w[2])
