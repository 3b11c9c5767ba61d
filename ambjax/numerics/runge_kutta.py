"""One step of the classical Runge-Kutta method on a pytree."""

from collections.abc import Callable
from typing import TypeVar

import jax

from ambjax.compiler.barrier import materialised
from ambjax.numerics.records import Scalar

State = TypeVar("State")


def rk4_step(rates: Callable[[State], State], x: State, h: Scalar) -> State:
    """Return the state after a step of length h (s) from x, with an error of order h^5. `rates(x)`: rates of x."""

    def moved(h: Scalar, k: State) -> State:
        return jax.tree.map(lambda a, b: a + h * b, x, k)

    def at(y: State) -> State:
        return materialised(rates(y), y)

    k_1 = at(x)
    k_2 = at(moved(h / 2, k_1))
    k_3 = at(moved(h / 2, k_2))
    k_4 = at(moved(h, k_3))
    return materialised(moved(h / 6, jax.tree.map(lambda a, b, c, d: a + 2 * (b + c) + d, k_1, k_2, k_3, k_4)))
