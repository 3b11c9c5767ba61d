"""Operations on states, which are pytrees of a few scalars: linear algebra, a choice, and a Runge-Kutta step.

The systems are 3x3 to 8x8 and occur in the innermost loop. Each entry of a matrix is a separate scalar (under vmap, one
vector lane per member). A library call would take longer than the arithmetic.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import away_from_zero

S = TypeVar("S")


def axpy(state: S, *terms: tuple[Scalar, S]) -> S:
    """Return state + sum of factor * direction over the terms, leaf by leaf."""
    for factor, direction in terms:
        state = jax.tree.map(lambda x, d, factor=factor: x + factor * d, state, direction)
    return state


def choose(condition: Array | bool, yes: S, no: S) -> S:
    """Apply jnp.where to every leaf of two states."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


# The factors L and U of I - g J in one table, and the inverse pivots. Elimination goes from the last component on.
Factors = tuple[list[list[Array]], list[Array]]


def jacobian(function: Callable[[S], object], state: S) -> list[list[Array]]:
    """Return d function_i / d state_j as nested lists [i][j], by one forward derivative per component.

    The other components are constants in each derivative, so that structural zeros are not computed.
    """
    leaves, tree = jax.tree.flatten(state)

    def column(j: int) -> list[Array]:
        def along(x: Array) -> list[Array]:
            varied = [*leaves[:j], x, *leaves[j + 1 :]]
            return jax.tree.leaves(function(jax.tree.unflatten(tree, varied)))

        x = jnp.asarray(leaves[j])
        return jax.jvp(along, (x,), (jnp.ones_like(x),))[1]

    columns = [column(j) for j in range(len(leaves))]
    return [list(row) for row in zip(*columns, strict=True)]


def factor(jac: list[list[Array]], g: Scalar) -> Factors:
    """Factor I - g J without row exchanges.

    Controller states are last in a state and eliminated first. Their diagonal entries 1 + g slope are large if the loop
    is stiff, and the remaining system is the slow closed-loop motion of the rotor. A pivot near 0 is moved away from 0,
    so that an inaccurate trial step stays finite and is rejected.
    """
    n = len(jac)
    order = range(n - 1, -1, -1)
    m = [[(1.0 if i == j else 0.0) - g * jac[i][j] for j in order] for i in order]
    inverses: list[Array] = []
    for k in range(n):
        inverses.append(1.0 / away_from_zero(m[k][k], 1e-12))
        for i in range(k + 1, n):
            m[i][k] = m[i][k] * inverses[k]
            for j in range(k + 1, n):
                m[i][j] = m[i][j] - m[i][k] * m[k][j]
    return m, inverses


def solve(factors: Factors, right: S) -> S:
    """Return the state x with (I - g J) x = right."""
    m, inverses = factors
    leaves, tree = jax.tree.flatten(right)
    y = list(reversed(leaves))
    n = len(y)
    for i in range(n):
        for j in range(i):
            y[i] = y[i] - m[i][j] * y[j]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            y[i] = y[i] - m[i][j] * y[j]
        y[i] = y[i] * inverses[i]
    return jax.tree.unflatten(tree, list(reversed(y)))


def rk4_step(rates: Callable[[S], S], x: S, h: Scalar) -> S:
    """Return the state after a step of length h (s) from x, with an error of order h^5. `rates(x)`: rates of x."""

    def moved(h: Scalar, k: S) -> S:
        return jax.tree.map(lambda a, b: a + h * b, x, k)

    def at(y: S) -> S:
        return materialised(rates(y), y)

    k_1 = at(x)
    k_2 = at(moved(h / 2, k_1))
    k_3 = at(moved(h / 2, k_2))
    k_4 = at(moved(h, k_3))
    return materialised(moved(h / 6, jax.tree.map(lambda a, b, c, d: a + 2 * (b + c) + d, k_1, k_2, k_3, k_4)))
