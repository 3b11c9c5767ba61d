"""Solution of many small linear systems inside a compiled program.

`jnp.linalg.solve` calls LAPACK. In a large batch, such a call waits for other threads of the pool of XLA. Independent
calls of one program wait for each other for ever if they occupy all threads of the pool, as on a machine with two
cores.
"""

import jax.numpy as jnp
from jax import Array, lax


def solve(A: Array, B: Array) -> Array:
    """Return X [F, n, k] with A X = B, by Gauss-Jordan elimination with partial pivoting.

    `A` [F, n, n], `B` [F, n, k]. The result is not finite where A is singular. The systems are the last axis of all
    intermediate arrays, so that they are computed together in vector instructions.
    """
    n = A.shape[1]
    rows = jnp.arange(n)[:, None]

    def eliminated(j: Array, M: Array) -> Array:
        column = M[:, j]
        pivot = jnp.argmax(jnp.where(rows < j, -1.0, jnp.abs(lax.stop_gradient(column))), 0)
        first, chosen = M[j], jnp.take_along_axis(M, pivot[None, None], 0)[0]
        chosen = chosen / chosen[j]
        M = jnp.where((rows == pivot)[:, None], first, M)  # the pivot's row has its place at j
        return (M - M[:, j, None] * chosen).at[j].set(chosen)

    both = jnp.concatenate([A, B.astype(A.dtype)], 2)
    return jnp.moveaxis(lax.fori_loop(0, n, eliminated, jnp.moveaxis(both, 0, 2))[:, n:], 2, 0)
