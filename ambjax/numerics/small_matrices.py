"""Linear systems and exponentials of many small matrices inside a compiled program, without LAPACK.

`jnp.linalg.solve` and `jax.scipy.linalg.expm` call LAPACK. In a large batch, such a call waits for other threads of the
pool of XLA. Independent calls of one program wait for each other for ever if they occupy all threads of the pool, as on
a machine with two cores. A program may contain several calls of LAPACK only if each needs the result of the one before.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
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


def array_module(x: Array | np.ndarray) -> Any:
    """Return the module that computes with an array: NumPy for its own, else jax.numpy."""
    return np if isinstance(x, np.ndarray) else jnp


def exponential(A: Any) -> Any:
    """Return the exponentials of A [..., n, n], by scaling, a Taylor polynomial and repeated squaring.

    NumPy computes those of its own arrays. SciPy's function takes longer: it starts the threads of its linear algebra.
    """
    np_ = array_module(A)
    norm = np_.max(np_.sum(abs(A), -2))
    squarings = np_.ceil(np_.log2(np_.maximum(norm if np_ is np else lax.stop_gradient(norm), 1e-300) / NORM))
    squarings = np_.clip(squarings, 0, None if np_ is np else MOST_SQUARINGS)
    scaled, one = A * 2.0**-squarings, np_.eye(A.shape[-1], dtype=A.dtype)
    X = one
    for k in range(DEGREE, 0, -1):
        X = one + scaled @ X / k
    if np_ is jnp:
        return lax.fori_loop(0, MOST_SQUARINGS, lambda n, X: jnp.where(n < squarings, X @ X, X), X)
    return functools.reduce(lambda X, _: X @ X, range(int(squarings)), X)


def held(A: Any, B: Any, h: Any, expm: Callable[[Any], Any] = exponential) -> tuple[Any, Any]:
    """Return exp(A h) [..., n, n], and the integral of exp(A t) B over t from 0 to h, [..., n, m].

    They are the transition of x' = A x + B w and the effect of a constant w over the time h [..., 1, 1]. SciPy's `expm`
    keeps more digits of a stiff A whose states are not scaled.
    """
    np_, (n, m) = array_module(A), B.shape
    whole = expm(np_.concatenate([np_.concatenate([A, B], 1), np_.zeros((m, n + m), A.dtype)]) * h)
    return whole[..., :n, :n], whole[..., :n, n:]
