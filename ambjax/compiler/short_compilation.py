"""Faster compilation, for functions that run only a few times or that the fast path refuses; precision of JAX."""

import functools
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import Any, TypeVar

import jax

from ambjax.compiler.barrier import in_trace
from ambjax.compiler.traced_programs import traced_once

Result = TypeVar("Result")
Option = bool | int | str

# Options of XLA that shorten compilation for a CPU. The programs are as fast. One thread compiles all parts of a
# program, and no operations are moved out of loops, which takes many passes.
SHORT = {
    "xla_cpu_parallel_codegen_split_count": 1,
    "xla_disable_hlo_passes": "while-loop-invariant-code-motion",
}
# The older emitters of fused operations compile faster.
QUICK = SHORT | {"xla_cpu_use_fusion_emitters": False}
# For programs that run only a few times: most optimisations would cost more time than they save.
QUICKEST = QUICK | {"xla_backend_optimization_level": 0}


def compiled_quickly(
    function: Callable[..., Result], static_argnames: tuple[str, ...] = (), options: Mapping[str, Option] = QUICK
) -> Callable[..., Result]:
    """Return jit(`function`), compiled with those of `options` that this version of XLA supports.

    Inside a transformation it is `function` itself.
    """

    @functools.cache
    def compiled() -> Callable[..., Result]:
        once = traced_once(function, static_argnames)
        return jax.jit(once, static_argnames=static_argnames, compiler_options=supported(options))

    @functools.wraps(function)
    def call(*args: object, **static: object) -> Result:
        return (function if in_trace(args) else compiled())(*args, **static)

    return call


def compiled_quickest(function: Callable[..., Result], static_argnames: tuple[str, ...] = ()) -> Callable[..., Result]:
    """Return `compiled_quickly` with QUICKEST. Such programs run one at a time."""
    compiled = compiled_quickly(function, static_argnames, QUICKEST)

    @functools.wraps(function)
    def call(*args: object, **static: object) -> Result:
        with _ONE_AT_A_TIME:
            return jax.block_until_ready(compiled(*args, **static))

    return call


# XLA runs LAPACK on its own threads, and two programs with it may deadlock.
_ONE_AT_A_TIME = threading.RLock()


def precision(name: str) -> AbstractContextManager[object]:
    """Return a context manager in which JAX computes in single ("float") or double ("double") precision."""
    import jax.experimental

    home: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    return home.enable_x64(name == "double")


def supported(options: Mapping[str, Option]) -> dict[str, Option]:
    """Return those of `options` that this version of XLA supports."""
    return {name: value for name, value in options.items() if _supports(name, value)}


@functools.cache
def _supports(name: str, value: Option) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
