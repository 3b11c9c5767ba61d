"""Designs of experiments: the points of an ensemble's members in the unit cube.

The point of member k depends on (seed, k), for the Latin hypercube also on the number of members, but never on the
chunk that contains the member. Coordinates lie strictly between 0 and 1, so that every quantile of them is finite.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.world.scenario import DESIGN_STREAM, Scenario

# Bits of a coordinate. Random and Sobol points are centres of cells of that size, so they are never 0 or 1; those
# of a Latin hypercube are clipped. SciPy's Sobol generator cannot fast-forward with more than 32 bits.
BITS = 52
SOBOL_BITS = 32
# Random numbers are generated in blocks of this size, so that the generator is compiled once.
BLOCK = 2**14
# Largest number of entries of a Latin hypercube, which is generated as a whole: 8 bytes each, in three copies.
MOST_LATIN = 30_000_000
# A member's number is a signed 32-bit integer when JAX computes in float32.
MOST_MEMBERS = 2**31
# Combined with the seed, so that a design shares no random numbers with another NumPy generator of the same seed.
DOMAIN = 0x616D626A


def design_points(design: str, seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    """Compute the points [n, dims] of `members` in the open unit cube.

    - `design`: a key of DESIGNS.
    - `members`: integers [n], 0 <= member < total.
    - `total`: number of members of the whole ensemble.

    Raises ValueError for an unknown design, a member outside 0 <= member < total, or a total that is too large.
    """
    members = np.atleast_1d(np.asarray(members, np.int64))
    if design not in DESIGNS:
        raise ValueError(f"design = {design!r}: it must be one of {', '.join(map(repr, DESIGNS))}.")
    if not 1 <= total <= MOST_MEMBERS:
        raise ValueError(f"members = {total}: there must be 1 to {MOST_MEMBERS:,} of them.")
    if members.size and not 0 <= members.min() <= members.max() < total:
        wrong = members.max() if members.min() >= 0 else members.min()
        raise ValueError(f"member {wrong}: it must be from 0 to {total - 1}.")
    if not members.size or not dims:
        return np.empty((members.size, dims))
    return DESIGNS[design](int(seed), dims, members, int(total))


def _random(seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    """Return independent points, from a random key for each member and dimension."""
    pairs = np.stack([np.repeat(members, dims), np.tile(np.arange(dims), len(members))]).astype(np.uint32)
    columns = np.pad(pairs, ((0, 0), (0, -pairs.shape[1] % BLOCK)))
    blocks = np.split(columns, columns.shape[1] // BLOCK, axis=1)
    words = np.concatenate([np.asarray(_words(np.uint32(seed), *block), np.uint64) for block in blocks])
    whole = (words[:, 0] << np.uint64(32) | words[:, 1]) >> np.uint64(64 - BITS)
    return ((whole + 0.5) * 2.0**-BITS)[: pairs.shape[1]].reshape(-1, dims)


@jax.jit
def _words(seed: Array, members: Array, dims: Array) -> Array:
    """Return two words of 32 random bits for each pair of a member and a dimension; equal in float32 and float64."""

    def one(member: Array, dim: Array) -> Array:
        key = jax.random.fold_in(Scenario(seed=seed, member=member).key(), DESIGN_STREAM)
        return jax.random.bits(jax.random.fold_in(key, dim), (2,), jnp.uint32)

    return jax.vmap(one)(members, dims)


def _sobol(seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    """Return points of SciPy's scrambled Sobol sequence; member k is its k-th point."""
    from scipy.stats import qmc

    engine = qmc.Sobol(dims, scramble=True, bits=SOBOL_BITS, rng=np.random.default_rng([DOMAIN, seed]))
    indices, where = np.unique(members, return_inverse=True)
    parts = []
    for run in np.split(indices, np.flatnonzero(np.diff(indices) != 1) + 1):
        ahead = int(run[0]) - engine.num_generated
        if ahead:
            engine.fast_forward(ahead)
        elif run[0] == 0:  # SciPy warns if the first draw is not a power of 2, so the first point is drawn alone
            parts.append(engine.random(1))
            run = run[1:]
        parts.append(engine.random(len(run)))
    return np.concatenate(parts)[where] + 2.0 ** -(SOBOL_BITS + 1)


def _latin_hypercube(seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    if total * dims > MOST_LATIN:
        raise ValueError(
            f'design = "latin-hypercube": {total:,} members of {dims} quantities exceed the {MOST_LATIN:,} '
            'numbers that it can hold in memory. Use design = "sobol", which does not hold them.'
        )
    return _latin_table(seed, dims, total)[members]


@functools.lru_cache(maxsize=1)
def _latin_table(seed: int, dims: int, total: int) -> np.ndarray:
    from scipy.stats import qmc

    table = qmc.LatinHypercube(dims, rng=np.random.default_rng([DOMAIN, seed])).random(total)
    return np.clip(table, 2.0**-BITS / 2, 1 - 2.0**-BITS / 2)


DESIGNS: dict[str, Callable[[int, int, np.ndarray, int], np.ndarray]] = {
    "random": _random,
    "latin-hypercube": _latin_hypercube,
    "sobol": _sobol,
}
