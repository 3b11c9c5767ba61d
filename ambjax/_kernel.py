"""The fast path on CPUs: have XLA compile a whole rollout as one function.

XLA's CPU backend dispatches every fused operation of a loop's body on its own, some 30 ns each;
for a loop body of a few hundred flops that is nearly all the time. A call marked as below is compiled,
loops and all, into one function instead, eight to ten times faster here. The mark is XLA's own
and is not documented, so it is probed once per process: where it is unknown or changes the result,
the plain path runs, correct and slower, and one line in the log says so.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from ambjax._pytree import is_traced

log = logging.getLogger(__name__)

MARK = {"inlineable": "false", "xla_cpu_small_call": "true"}


def _mark(tree: Any) -> Any:
    from jax.experimental.xla_metadata import set_xla_metadata

    return set_xla_metadata(tree, **MARK)


def one_kernel(function: Callable[..., Any], static_argnames: tuple[str, ...] = ()) -> Callable[..., Any]:
    """jit(`function`) compiled as one kernel where that works, as usual elsewhere.

    Only an outermost call is marked: inside another jit, grad or vmap the whole belongs to that
    transformation, and reverse mode through a marked call aborts XLA's compiler. So apply this to the
    outermost function: one_kernel(vmap(f)), one_kernel(value_and_grad(f)). Every array must be an
    argument: a large constant in a marked function can abort the compiler too.
    """
    inner = jax.jit(function, static_argnames=static_argnames)

    @functools.partial(jax.jit, static_argnames=static_argnames)
    def outermost(*args: Any, **static: Any) -> Any:
        return _mark(inner(*args, **static))

    @functools.wraps(function)
    def call(*args: Any, **static: Any) -> Any:
        if any(is_traced(x) for x in jax.tree.leaves(args)) or not supported():
            return inner(*args, **static)
        return outermost(*args, **static)

    return call


@functools.cache
def supported() -> bool:
    """Whether the fast path works on this machine: probed by compiling and running a small loop."""
    if jax.default_backend() != "cpu":
        return False

    def loop(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 8, lambda _, y: y + jnp.sin(y) / (1 + y * y), x)

    try:
        with jax.ensure_compile_time_eval():
            x = jnp.linspace(-2.0, 2.0, 5)
            plain = jax.jit(loop)
            fast = jax.jit(lambda x: _mark(plain(x)))
            compiled = fast.lower(x).compile()
            same = bool(jnp.allclose(compiled(x), plain(x), rtol=1e-6))
            works = same and "xla_cpu_small_call" in (compiled.as_text() or "")
    except Exception as error:  # an unknown backend may fail in any way; the plain path always works
        log.info("one-kernel path is off: %s", error)
        return False
    if not works:
        log.info("one-kernel path is off: this version of XLA does not know the mark, or computes otherwise with it")
    return works
