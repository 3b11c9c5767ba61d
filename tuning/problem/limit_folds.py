"""Folds that measure limited quantities in the search."""

import functools
from typing import Any

import jax.numpy as jnp
from jax import Array

from ambjax.extend import Scalar, leaf, record, static
from ambjax.simulation.folds import Ending, Fold
from ambjax.simulation.span import Span
from ambjax.simulation.trajectory import Row

# Exponent of the norms that approximate maxima. Over 1e4 samples of noise, the maximum is 1.2 to 1.6 times the norm.
NORM = 16
# Lower bound of the argument of a logarithm.
TINY = 1e-30


@record
class Typical:
    """Fold: the power mean with exponent 16 of |row.`of`| over the samples with the rotor held, a smooth maximum.

    `size`: unit of the signal in the powers. The derivative of a saturated voltage is 0. The power mean also depends on
    unsaturated samples, whose derivatives are not 0.
    """

    of: str = static()
    size: Scalar = leaf(above=0, at_most=1e30)

    def init(self) -> tuple[Array, Array]:
        zero = jnp.zeros((), jnp.result_type(float))
        return zero, zero

    def update(self, carry: tuple[Array, Array], row: Row, span: Span) -> tuple[Array, Array]:
        total, count = carry
        return total + (jnp.abs(getattr(row, self.of)) / self.size) ** NORM, count + row.alive

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array:
        total, count = carry
        mean = total / jnp.maximum(count, 1.0)
        some = mean > TINY
        return self.size * jnp.where(some, jnp.where(some, mean, 1.0) ** (1 / NORM), 0.0)


@record
class Scaled:
    """Fold: the result of another fold, divided by `by`."""

    fold: Fold
    by: Scalar = leaf(default=1.0, above=0, at_most=1e30)

    def init(self) -> Any:
        return self.fold.init()

    def update(self, carry: Any, row: Row, span: Span) -> Any:
        return self.fold.update(carry, row, span)

    def result(self, carry: Any, ending: Ending) -> Array:
        return self._of(self.fold.result(carry, ending)) / self.by

    def _of(self, found: Any) -> Array:
        return found


@record
class OneOf(Scaled):
    """Fold: the result `name` of a fold with several results."""

    name: str = static(default="")

    def _of(self, found: dict[str, Array]) -> Array:
        return found[self.name]


@record
class LargestOf(Scaled):
    """Fold: the largest of the results of a fold with several results."""

    def _of(self, found: dict[str, Array]) -> Array:
        return functools.reduce(lambda a, b: jnp.where(a >= b, a, b), found.values())
