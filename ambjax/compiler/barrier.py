"""Have XLA's CPU backend compile a function as a loop of its own.

XLA fuses elementwise arithmetic into large loops and repeats divisions in every fusion that uses them. An
iteration of a loop with several divisions in a row is one long chain, of which the processor holds hardly two at
once; shorter loops overlap. No barrier of JAX's survives to that point, but a call that XLA may not inline does.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax import Array

Result = TypeVar("Result")


def compiled_alone(function: Callable[..., Result]) -> Callable[..., Result]:
    """`function` of arrays, neither fused with its surroundings nor repeated in them on CPUs; elsewhere as it is.

    For what lies under a custom_jvp, whose rule may apply it to tangents if it is linear in them: reverse mode then
    transposes it.
    """
    inner = jax.jit(function)

    @functools.wraps(function)
    def call(*args: Any) -> Result:
        if jax.default_backend() != "cpu":
            return function(*args)
        from jax.experimental.xla_metadata import set_xla_metadata

        result: Any = set_xla_metadata(inner(*args), inlineable="false")
        return result

    return call


@jax.custom_jvp
@compiled_alone
def _barrier(x: Array) -> Array:
    return x


@_barrier.defjvp
def _kept_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return _barrier(*primals), _barrier(*tangents)


def materialised(tree: Result, beside: Any = ()) -> Result:
    """The same values, and the same derivatives, stored: whoever uses them reads memory.

    Else XLA computes an intermediate again in every loop that uses it, and its derivatives once more for each. What is
    a leaf of `beside` is there already.
    """
    there = set(map(id, jax.tree.leaves(beside)))
    return jax.tree.map(lambda x: x if id(x) in there else _barrier(x), tree)
