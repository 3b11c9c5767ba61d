"""Designs: where the members of an ensemble lie in the unit cube.

Member k's point depends on (seed, k), for the Latin hypercube also on the total, never on the chunk in
which it is asked for. Coordinates lie strictly between 0 and 1, so that every quantile of them is finite.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.world.scenario import DESIGN_STREAM, Scenario

# Bits of a coordinate; points are the centres of such cells, so never 0 or 1. More than 32 SciPy cannot fast-forward.
BITS = 52
SOBOL_BITS = 32
# Random numbers are made this many at a time, so that their code is compiled once.
BLOCK = 2**14
# A Latin hypercube is made whole; its numbers take 8 bytes each, three times over while it is made.
MOST_LATIN = 30_000_000
# The member's number is a signed integer of 32 bits where JAX computes in float32.
MOST_MEMBERS = 2**31
# So that a design does not share random numbers with a user's own generator of the same seed.
DOMAIN = 0x616D626A


def points(design: str, seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    """Points [n, dims] in the open unit cube of the members (integers [n], 0 <= member < total).

    Raises ValueError for an unknown design, a member outside the total, or a total too large.
    """
    members = np.atleast_1d(np.asarray(members, np.int64))
    if design not in DESIGNS:
        raise ValueError(f"design = {design!r}: it must be one of {', '.join(map(repr, DESIGNS))}.")
    if not 1 <= total <= MOST_MEMBERS:
        raise ValueError(f"members = {total}: there must be 1 to {MOST_MEMBERS:,} of them.")
    if members.size and not 0 <= members.min() <= members.max() < total:
        raise ValueError(f"member {members.max() if members.min() >= 0 else members.min()}: of {total} members.")
    if not members.size or not dims:
        return np.empty((members.size, dims))
    return DESIGNS[design](int(seed), dims, members, int(total))


def _random(seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    pairs = np.stack([np.repeat(members, dims), np.tile(np.arange(dims), len(members))]).astype(np.uint32)
    columns = np.pad(pairs, ((0, 0), (0, -pairs.shape[1] % BLOCK)))
    blocks = np.split(columns, columns.shape[1] // BLOCK, axis=1)
    words = np.concatenate([np.asarray(_words(np.uint32(seed), *block), np.uint64) for block in blocks])
    whole = (words[:, 0] << np.uint64(32) | words[:, 1]) >> np.uint64(64 - BITS)
    return ((whole + 0.5) * 2.0**-BITS)[: pairs.shape[1]].reshape(-1, dims)


@jax.jit
def _words(seed: Array, members: Array, dims: Array) -> Array:
    """Two words of 32 random bits for each pair of a member and a dimension: the same in either precision of JAX."""

    def one(member: Array, dim: Array) -> Array:
        key = jax.random.fold_in(Scenario(seed=seed, member=member).key(), DESIGN_STREAM)
        return jax.random.bits(jax.random.fold_in(key, dim), (2,), jnp.uint32)

    return jax.vmap(one)(members, dims)


def _sobol(seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    from scipy.stats import qmc

    engine = qmc.Sobol(dims, scramble=True, bits=SOBOL_BITS, rng=np.random.default_rng([DOMAIN, seed]))
    indices, where = np.unique(members, return_inverse=True)
    parts = []
    for run in np.split(indices, np.flatnonzero(np.diff(indices) != 1) + 1):
        ahead = int(run[0]) - engine.num_generated
        if ahead:
            engine.fast_forward(ahead)
        elif run[0] == 0:  # the first point apart: SciPy warns where the first draw is no power of 2
            parts.append(engine.random(1))
            run = run[1:]
        parts.append(engine.random(len(run)))
    return np.concatenate(parts)[where] + 2.0 ** -(SOBOL_BITS + 1)


def _latin_hypercube(seed: int, dims: int, members: np.ndarray, total: int) -> np.ndarray:
    if total * dims > MOST_LATIN:
        raise ValueError(
            f'design = "latin-hypercube": {total:,} members of {dims} quantities exceed the {MOST_LATIN:,} '
            'numbers that it holds in memory. Use design = "sobol", which needs none.'
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
