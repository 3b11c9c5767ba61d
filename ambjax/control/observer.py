"""Observers: what the laws are told of the rotor's motion."""

import jax.numpy as jnp
from jax import Array

from ambjax.control.search import Interval, Site, rate
from ambjax.numerics.records import Scalar, gain, leaf, record
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement


@record
class Direct:
    """The measurement itself, as in the paper."""

    def init(self, model: Plant, measured: Measurement) -> tuple[()]:
        return ()

    def scale(self, model: Plant) -> tuple[()]:
        return ()

    def slope(self, model: Plant) -> Scalar:
        return 0.0

    def __call__(self, model: Plant, inputs: Measurement, state: tuple[()]) -> tuple[Measurement, tuple[()]]:
        return inputs, ()


@record
class Complementary:
    """z_hat' = z_dot + l (z_measured - z_hat): the velocity integrated, pulled slowly to the position.

    Noise of the position sensor is low-passed at l; noise of the velocity is integrated, with memory 1/l.
    """

    l: Scalar = gain(default=10.0, unit="1/s", doc="corner between velocity and position sensor")
    z_hat: Scalar | None = leaf(
        default=None,
        unit="m",
        at_least=-1.0,
        at_most=1.0,
        optional=True,
        doc="initial estimate; none: first measurement",
    )

    def init(self, model: Plant, measured: Measurement) -> Array:
        return jnp.asarray(measured.z if self.z_hat is None else self.z_hat)

    def scale(self, model: Plant) -> Scalar:
        return model.s_0 / 50

    def slope(self, model: Plant) -> Scalar:
        return self.l

    def __call__(self, model: Plant, inputs: Measurement, state: Array) -> tuple[Measurement, Array]:
        return inputs._replace(z=state), inputs.z_dot + self.l * (inputs.z - state)

    def ranges(self, site: Site) -> dict[str, Interval]:
        return {"l": rate(site, 1e-3, 1, "corner from w/1000 to w")}
