"""What the fan chart shows of a run beside its instants: extremes and the voltage's variation, block by block.

A run of many samples is recorded at few instants. What happens between two of them is folded over the block of
samples that begins at the first.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from ambjax.numerics.records import Scalar, leaf, record, static
from ambjax.simulation.metrics import Ending

# Beyond every value: the extremes of no value at all.
NEVER = jnp.inf


class BlockValues(NamedTuple):
    """Blocks of one run: extremes by signal [count] (+inf and -inf where the rotor is not alive), and more.

    `variation` [count]: the total variation of u_mean over the steps that begin in a block, V. `last`: each signal at
    the last sample, NaN if the rotor is not alive then.
    """

    low: dict[str, Array]
    high: dict[str, Array]
    variation: Array
    last: dict[str, Array]


class Carry(NamedTuple):
    """Blocks so far, and u_mean and whether the rotor was alive at the sample before."""

    folded: BlockValues
    u_mean: Array
    alive: Array


@record
class Blocks:
    """Fold: the signals `of` a row over each of `count` blocks of `every` samples, one `period` (s) each."""

    of: tuple[str, ...] = static()
    every: int = static()
    count: int = static()
    period: Scalar = leaf(unit="s", above=0, at_most=1e6)

    def init(self) -> Carry:
        dtype = jnp.result_type(float)
        low, high = ({name: jnp.full(self.count, x, dtype) for name in self.of} for x in (NEVER, -NEVER))
        last = {name: jnp.asarray(jnp.nan, dtype) for name in self.of}
        folded = BlockValues(low, high, jnp.zeros(self.count, dtype), last)
        return Carry(folded, jnp.zeros((), dtype), jnp.asarray(False))

    def update(self, carry: Carry, row: Any, span: Any) -> Carry:
        sample = jnp.floor(row.t / self.period + 0.5).astype(int)
        block, before = sample // self.every, jnp.maximum(sample - 1, 0) // self.every
        values = {name: getattr(row, name) for name in self.of}
        folded = carry.folded
        low = {k: _with(folded.low[k], block, jnp.minimum, jnp.where(row.alive, x, NEVER)) for k, x in values.items()}
        high = {
            k: _with(folded.high[k], block, jnp.maximum, jnp.where(row.alive, x, -NEVER)) for k, x in values.items()
        }
        step = jnp.where(row.alive & carry.alive, jnp.abs(row.u_mean - carry.u_mean), 0.0)
        last = {k: jnp.where(row.alive, x, jnp.nan) for k, x in values.items()}
        return Carry(
            BlockValues(low, high, _with(folded.variation, before, jnp.add, step), last),
            row.u_mean,
            jnp.asarray(row.alive),
        )

    def result(self, carry: Carry, ending: Ending) -> BlockValues:
        return carry.folded


def _with(values: Array, at: Array, combine: Any, x: Array) -> Array:
    """values [count] with combine(values[at], x) in the place of values[at]."""
    return lax.dynamic_update_index_in_dim(values, combine(lax.dynamic_index_in_dim(values, at, 0, False), x), at, 0)
