"""Barriers against fusion: XLA's CPU backend compiles a function as a separate loop.

XLA fuses elementwise arithmetic into large loops, and repeats divisions in every fusion that uses them. An iteration
with several divisions in sequence is a long dependency chain, and the processor hardly overlaps two such iterations.
Iterations of shorter loops overlap better. XLA removes JAX's optimisation barriers before fusion, but keeps a call that
it must not inline.
"""

import contextlib
import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.core import Tracer

Result = TypeVar("Result")


def in_trace(node: object) -> bool:
    """Return whether a number of the pytree is traced, or jit traces the caller: then it traces every result."""
    return any(isinstance(x, Tracer) for x in (_nought(), *jax.tree.leaves(node)))


@jax.jit  # a call of a compiled function is ten times faster than an operation of eager JAX
def _nought() -> Array:
    return jnp.zeros(())


def as_outside_jit() -> AbstractContextManager[object]:
    """Return a context manager in which a function computes with numbers, also if jit traces its caller.

    Outside jit it changes nothing: evaluation at compile time would execute the constant operations of each program one
    by one, and the program would differ from that of the same case in a command.
    """
    return jax.ensure_compile_time_eval() if in_trace(()) else contextlib.nullcontext()


def compiled_alone(function: Callable[..., Result]) -> Callable[..., Result]:
    """Return a version of `function` that XLA neither fuses nor repeats on CPUs. On other devices it is unchanged.

    Put custom_jvp above this decorator. The JVP rule may call the result on tangents if `function` is linear; reverse
    mode then transposes the call.
    """
    inner = jax.jit(function)

    @functools.wraps(function)
    def call(*args: object) -> Result:
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


def materialised(tree: Result, beside: object = ()) -> Result:
    """Return the same values, with the same derivatives, stored in memory.

    Otherwise XLA computes an intermediate value and its derivatives again in every loop that uses it. A leaf of
    `tree` that is also a leaf of `beside` is stored already, and is returned unchanged.
    """
    there = set(map(id, jax.tree.leaves(beside)))
    return jax.tree.map(lambda x: x if id(x) in there else _barrier(x), tree)
