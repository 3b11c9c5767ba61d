"""The fold behind the fan chart: extremes of signals and the variation of the voltage, block by block."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Ending
from ambjax.simulation.trajectory import Row, Span

# Initial minimum of a block (its negative: initial maximum), before any value is included.
NO_VALUE = jnp.inf
# Number of blocks of `quarters`; a run whose samples are not a multiple of it has one more.
QUARTERS = 4


class BlockValues(NamedTuple):
    """Result of `Blocks` for one run.

    - `low`, `high`: minimum and maximum of each signal in each block [count]; +inf and -inf in blocks without a sample
      at which the rotor is alive.
    - `variation`: total variation of u_mean over the steps that begin in each block [count], V.
    - `last`: each signal at the last sample; NaN if the rotor is not alive there.
    """

    low: dict[str, Array]
    high: dict[str, Array]
    variation: Array
    last: dict[str, Array]


# State of the fold: the blocks so far, and u_mean (V) and `alive` at the previous sample.
Carry = tuple[BlockValues, Array, Array]


@record
class Blocks:
    """Fold that reduces signals over `count` blocks of `every` samples each."""

    of: tuple[str, ...] = static(doc="names of the signals, which are fields of a Row")
    every: int = static(doc="samples in a block")
    count: int = static(doc="number of blocks")
    period: Scalar = leaf(unit="s", above=0, at_most=1e6, doc="sample period")

    def init(self) -> Carry:
        dtype = jnp.result_type(float)
        low, high = ({name: jnp.full(self.count, x, dtype) for name in self.of} for x in (NO_VALUE, -NO_VALUE))
        last = {name: jnp.asarray(jnp.nan, dtype) for name in self.of}
        folded = BlockValues(low, high, jnp.zeros(self.count, dtype), last)
        return folded, jnp.zeros((), dtype), jnp.asarray(False)

    def update(self, carry: Carry, row: Row, span: Span) -> Carry:
        sample = jnp.floor(row.t / self.period + 0.5).astype(int)
        block, before = sample // self.every, jnp.maximum(sample - 1, 0) // self.every
        values = {name: getattr(row, name) for name in self.of}
        folded, u_mean, alive = carry
        low, high = (
            {k: _combined(old[k], block, combine, jnp.where(row.alive, x, none)) for k, x in values.items()}
            for old, combine, none in ((folded.low, jnp.minimum, NO_VALUE), (folded.high, jnp.maximum, -NO_VALUE))
        )
        step = jnp.where(row.alive & alive, jnp.abs(row.u_mean - u_mean), 0.0)
        last = {k: jnp.where(row.alive, x, jnp.nan) for k, x in values.items()}
        variation = _combined(folded.variation, before, jnp.add, step)
        return BlockValues(low, high, variation, last), row.u_mean, jnp.asarray(row.alive)

    def result(self, carry: Carry, ending: Ending) -> BlockValues:
        return carry[0]


def quarters(clock: Clock) -> Blocks:
    """Return the fold of z and i over the quarters of a run. Runs that use it share their compiled program."""
    every = max(clock.samples // QUARTERS, 1)
    return Blocks(("z", "i"), every, -(-clock.samples // every), clock.sample_period)


def _combined(values: Array, at: Array, combine: Callable[[Array, Array], Array], x: Array) -> Array:
    """Return `values` [count] with entry `at` replaced by combine(values[at], x)."""
    return lax.dynamic_update_index_in_dim(values, combine(lax.dynamic_index_in_dim(values, at, 0, False), x), at, 0)
