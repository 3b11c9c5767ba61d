"""Programs compiled in less time, for calls that the fast path does not support or that run only a few times."""

import functools
from collections.abc import Callable, Mapping
from typing import TypeVar

import jax

Result = TypeVar("Result")

# Options of XLA. The older emitters of fused operations on a CPU compile faster, and their programs take as long.
SHORT = {"xla_cpu_use_fusion_emitters": False}
# For programs that run a few times: most optimisations would cost more time than they save.
SHORTEST = SHORT | {"xla_backend_optimization_level": 0}


def compiled_quickly(
    function: Callable[..., Result], static_argnames: tuple[str, ...] = (), options: Mapping[str, bool | int] = SHORT
) -> Callable[..., Result]:
    """Return jit(`function`), compiled with those of `options` that this version of XLA knows."""

    @functools.cache
    def compiled() -> Callable[..., Result]:
        return jax.jit(function, static_argnames=static_argnames, compiler_options=known(options))

    @functools.wraps(function)
    def call(*args: object, **static: object) -> Result:
        return compiled()(*args, **static)

    return call


def known(options: Mapping[str, bool | int]) -> dict[str, bool | int]:
    """Return those of `options` that this version of XLA knows."""
    return {name: value for name, value in options.items() if _knows(name, value)}


@functools.cache
def _knows(name: str, value: bool | int) -> bool:
    """Return whether a small program can be compiled with an option."""
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
