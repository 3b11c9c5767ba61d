"""The fast path on CPUs: have XLA compile a whole rollout as one function, with the machine's widest vectors.

XLA's CPU backend dispatches every fused operation of a loop's body on its own, some 30 ns each;
for a loop body of a few hundred flops that is nearly all the time. A call marked as below is compiled,
loops and all, into one function instead. Where the processor has AVX-512, XLA is also asked to use all of
it. Neither is documented, so both are probed once per process: where one is unknown or changes the
result, the rest runs, correct and slower, and one line in the log says so. AMBJAX_PLAIN=1 in the
environment turns both off.
"""

import functools
import logging
import os
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

log = logging.getLogger(__name__)

MARK = {"inlineable": "false", "xla_cpu_small_call": "true"}
WIDE = {"xla_cpu_prefer_vector_width": 512}


def _mark(tree: Any) -> Any:
    from jax.experimental.xla_metadata import set_xla_metadata

    return set_xla_metadata(tree, **MARK)


def one_kernel(function: Callable[..., Any], static_argnames: tuple[str, ...] = ()) -> Callable[..., Any]:
    """jit(`function`) compiled as one kernel where that works, as usual elsewhere.

    Only an outermost call is marked: inside another jit, grad or vmap the whole belongs to that
    transformation, and reverse mode through a marked call aborts XLA's compiler. So apply this to the
    outermost function: one_kernel(vmap(f)), one_kernel(value_and_grad(f)). Every array must be an
    argument: a large constant in a marked function can abort the compiler too. Over many hundred members at
    once XLA may split an operation over threads, which it cannot do inside one function: such a call is
    compiled as usual, with a line in the log; jax.lax.map with a batch_size keeps the blocks small.
    """
    inner = jax.jit(function, static_argnames=static_argnames)
    refused: set[tuple[Any, ...]] = set()
    shapes_of = lambda leaves: tuple(map(jnp.shape, leaves))  # noqa: E731

    @functools.cache
    def outermost() -> Callable[..., Any]:
        def marked(*args: Any, **static: Any) -> Any:
            return _mark(inner(*args, **static))

        return jax.jit(marked, static_argnames=static_argnames, compiler_options=options())

    @functools.wraps(function)
    def call(*args: Any, **static: Any) -> Any:
        leaves = jax.tree.leaves(args)
        if any(isinstance(x, Tracer) for x in leaves) or options() is None:
            return inner(*args, **static)
        if not refused or shapes_of(leaves) not in refused:
            try:
                return outermost()(*args, **static)
            except jax.errors.JaxRuntimeError as fault:
                log.warning("compiled without the one-kernel path, which XLA refused: %s", str(fault).splitlines()[0])
                refused.add(shapes_of(leaves))
        return inner(*args, **static)

    return call


@functools.cache
def _cpuinfo() -> str:
    """What Linux tells about the processor; empty elsewhere."""
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    return cpuinfo.read_text() if cpuinfo.exists() else ""


def _has_avx512() -> bool:
    return "avx512f" in _cpuinfo()


def block_bytes(members: int) -> int:
    """Length of the vectors, in bytes, into which this many members that run together are cut.

    Small enough for the first-level cache, large enough to pay for the start of each loop over them. On Intel's
    cores with AVX-512 twice as much is slower; AMD's are faster with it, unless much of the last would be padding.
    """
    return 1024 if members >= 256 and _has_avx512() and "AuthenticAMD" in _cpuinfo() else 512


@functools.cache
def options() -> dict[str, Any] | None:
    """Compiler options of the fast path on this machine; None if there is no fast path."""
    if jax.default_backend() != "cpu":
        return None
    if os.environ.get("AMBJAX_PLAIN", "0") not in ("", "0"):
        log.warning("one-kernel path is off: AMBJAX_PLAIN is set. Results are the same, several times slower.")
        return None
    faults = []
    for trial in [WIDE, {}] if _has_avx512() else [{}]:
        fault = _probe(trial)
        if not fault:
            return trial
        faults.append(fault)
    log.warning("one-kernel path is off, runs are several times slower: %s", "; ".join(faults))
    return None


def _step(y: Any, lib: Any) -> Any:
    """One turn of the probe's loop, computed with the functions of `lib` (numpy or jax.numpy)."""
    turn = y - lib.round(y)
    rational = turn * (1 + 0.7 * turn * turn) / (1 + turn * turn * (0.9 + 0.1 * turn * turn))
    return y + rational + lib.where(y > 1, 1 / y, y) / lib.sqrt(lib.sqrt(y * y + 0.25))


def _probe(trial: dict[str, Any]) -> str:
    """What is wrong with the mark and these options; empty if they work and change no result.

    Compiles a small loop over the operations of a rollout (division, root, rounding, selection), with enough lanes
    for vectors and a remainder, and compares it with NumPy.
    """

    def body(_: Any, y: jax.Array) -> jax.Array:
        return _step(y, jnp)

    def expected(y: np.ndarray) -> np.ndarray:
        for _ in range(3):
            y = _step(y, np)
        return y

    try:
        with jax.ensure_compile_time_eval():
            x = np.linspace(-30.0, 30.0, 78)  # without 0
            argument = jnp.asarray(x)
            plain = jax.jit(lambda y: jax.lax.fori_loop(0, 3, body, y))
            compiled = jax.jit(lambda y: _mark(plain(y)), compiler_options=trial).lower(argument).compile()
            error = np.max(np.abs(np.asarray(compiled(argument), float) / expected(x) - 1))
    except Exception as fault:  # an unknown backend may fail in any way; the plain path always works
        return str(fault).splitlines()[0] if str(fault) else type(fault).__name__
    if "xla_cpu_small_call" not in (compiled.as_text() or ""):
        return "this version of XLA does not know the mark"
    # A wrong lane is wrong in the first digits; rounding grows thirtyfold in three turns of the loop.
    return "" if error < 1e4 * jnp.finfo(argument.dtype).eps else f"results are off by {error:.1e} with options {trial}"
