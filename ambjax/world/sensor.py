"""Sensors: what is measured, and the errors of it."""

from typing import NamedTuple

from jax import Array

from ambjax.numerics.gaussian import normals
from ambjax.numerics.records import Scalar, leaf, record


class Measurement(NamedTuple):
    """What a sensor, or an observer behind it, reports: m, m/s, A."""

    z: Array
    z_dot: Array
    i: Array


@record
class Sensor:
    """Gaussian noise on each measurement, drawn once per sample period and held; the state itself is seen at once."""

    std: Scalar = leaf(default=0.0, unit="m", at_least=0, at_most=1.0, doc="standard deviation on z")
    std_z_dot: Scalar = leaf(default=0.0, unit="m/s", at_least=0, at_most=1e6, doc="standard deviation on z_dot")
    std_i: Scalar = leaf(default=0.0, unit="A", at_least=0, at_most=1e6, doc="standard deviation on i")

    def noise(self, key: tuple[Scalar, Scalar], sample: Scalar) -> Measurement:
        """The errors of sample number `sample` for the member with these words (Scenario.words)."""
        w = normals(key, sample)
        return Measurement(self.std * w[0], self.std_z_dot * w[1], self.std_i * w[2])
