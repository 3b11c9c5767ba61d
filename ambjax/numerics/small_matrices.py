"""Linear systems and exponentials of many small matrices inside a compiled program, without LAPACK.

`jnp.linalg.solve` and `jax.scipy.linalg.expm` call LAPACK. In a large batch, such a call waits for other threads of the
pool of XLA. Independent calls of one program wait for each other for ever if they occupy all threads of the pool, as on
a machine with two cores. A program may contain several calls of LAPACK only if each needs the result of the one before.
"""

import jax.numpy as jnp
from jax import Array, lax

# Degree of the Taylor polynomial of `exponential`, and the norm up to which its relative error is below 1e-16.
DEGREE, NORM = 14, 0.5
# Largest number of squarings of `exponential`: norms up to NORM * 2**MOST_SQUARINGS.
MOST_SQUARINGS = 20


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


def times(matrix: Array | None, x: Array) -> Array:
    """Return matrix @ x as a sum of products, which XLA compiles within one kernel."""
    return jnp.sum(jnp.asarray(matrix) * x, -1)


def exponential(A: Array) -> Array:
    """Return the exponentials of A [..., n, n], by scaling, a Taylor polynomial and repeated squaring."""
    size = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(A), -2)))
    squarings = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(size, 1e-300) / NORM)), 0, MOST_SQUARINGS)
    scaled, one = A * 2.0**-squarings, jnp.eye(A.shape[-1], dtype=A.dtype)
    X = one
    for k in range(DEGREE, 0, -1):
        X = one + scaled @ X / k
    return lax.fori_loop(0, MOST_SQUARINGS, lambda n, X: jnp.where(n < squarings, X @ X, X), X)
