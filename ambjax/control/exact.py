"""Base class of the observers that are robust exact differentiators."""

from typing import ClassVar, Self

import jax.numpy as jnp
from jax import Array

from ambjax.control.sampling import Sampling
from ambjax.control.search import Interval, SearchContext, rate
from ambjax.control.stages import Observer
from ambjax.numerics import differentiator
from ambjax.numerics.records import Scalar
from ambjax.world.plant import Plant
from ambjax.world.sensor import Measurement

# States of a differentiator.
DERIVATIVES = (
    ("z", "m", "position after the last sample"),
    ("z_dot", "m/s", "its rate"),
    ("z_ddot", "m/s^2", "its second derivative"),
)
# Width of the smoothed sign of a differentiator in continuous time, as a share of the gap.
WIDTH = 1e-6


class ExactDifferentiator(Observer[tuple[Array, ...]]):
    """Base class of robust exact differentiators. `L` bounds the derivative of order `order` + 1 of the position."""

    L: Scalar
    order: ClassVar[int]
    estimates_velocity: ClassVar[bool] = True

    def designed(self, model: Plant, sampling: Sampling | None) -> Self:
        return type(self)(model.pole ** (self.order + 1) * model.s_0 / 25)  # pyright: ignore[reportCallIssue]

    def init(self, model: Plant, measured: Measurement) -> tuple[Array, ...]:
        return (jnp.asarray(measured.z), *[jnp.zeros(())] * self.order)

    def scale(self, model: Plant) -> tuple[Scalar, ...]:
        z, z_dot, _ = model.sizes()
        return (z, z_dot, jnp.abs(model.g) / 50 + 1e-3)[: self.order + 1]

    def slope(self, model: Plant) -> Scalar:
        return differentiator.slope(self.order, self.L, _width(model))

    def layer(self, model: Plant) -> tuple[Scalar, ...]:
        return (0.3 * _width(model), *[jnp.inf] * self.order)

    def __call__(
        self, model: Plant, inputs: Measurement, state: tuple[Array, ...]
    ) -> tuple[Measurement, tuple[Array, ...]]:
        return inputs._replace(z_dot=state[1]), differentiator.smooth_rates(state, inputs.z, self.L, _width(model))

    def step(
        self, model: Plant, inputs: Measurement, state: tuple[Array, ...], period: Scalar
    ) -> tuple[Measurement, tuple[Array, ...]]:
        """Update the estimate with this sample."""
        after = differentiator.implicit_step(state, inputs.z, self.L, period)
        return inputs._replace(z_dot=differentiator.velocity(after, period)), after

    def ranges(self, context: SearchContext) -> dict[str, Interval]:
        power = self.order + 1
        words = f"(x w)^{power} s_0, x from 1/10 to 1"
        return {"L": rate(context, 0.1, 1, words, 1 / float(context.model.s_0), power)}


def _width(model: Plant) -> Scalar:
    return WIDTH * model.s_0
