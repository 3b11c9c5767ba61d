"""The fast path on CPUs: XLA compiles a whole rollout as one function, with the widest vectors of the machine.

XLA's CPU backend dispatches every fused operation of a loop's body separately, at about 30 ns each. For a loop body of
a few hundred floating-point operations that is nearly all the time. A call with the attributes MARK is compiled into
one function, loops included. On processors with AVX-512 a compiler option also selects vectors of 512 bits.

Neither feature is documented, so both are tested once per process. If an option is not available or changes a
result, the program runs with the mark only. If the mark alone fails too, the program uses neither, is correct but
slower, and logs one line. AMBJAX_PLAIN=1 in the environment disables both.
"""

import functools
import logging
import os
import pathlib
import re
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.compiler.barrier import in_trace
from ambjax.compiler.short_compilation import SHORT, supported
from ambjax.compiler.traced_programs import traced_once

log = logging.getLogger(__name__)

MARK = {"inlineable": "false", "xla_cpu_small_call": "true"}
WIDE = {"xla_cpu_prefer_vector_width": 512}
# XLA's default, level 3, unrolls loops over the members of short blocks, which makes them slower; see
# benchmarks/workarounds.py. Options in XLA_FLAGS have priority.
LEVEL = SHORT | {"xla_backend_optimization_level": 2}
# Members of the shortest block.
SHORTEST = 16

Result = TypeVar("Result")


def _mark(tree: object) -> Any:
    from jax.experimental.xla_metadata import set_xla_metadata

    return set_xla_metadata(tree, **MARK)


def one_kernel(function: Callable[..., Result], static_argnames: tuple[str, ...] = ()) -> Callable[..., Result]:
    """Return jit(`function`), compiled as one kernel if that is possible.

    Only an outermost call is marked. Inside another jit, grad or vmap the function is compiled unmarked, as a part of
    that transformation; reverse mode through a marked call would abort XLA's compiler. Apply `one_kernel` to the
    outermost function: one_kernel(vmap(f)), one_kernel(value_and_grad(f)). Every array must be an argument, because a
    large constant in a marked function can abort the compiler too.

    With many hundred members at once XLA may split an operation over threads, which is not possible inside one
    function. Such a call is compiled in the ordinary way, with a line in the log. jax.lax.map with a batch_size keeps
    blocks small.
    """
    inner, once = jax.jit(function, static_argnames=static_argnames), traced_once(function, static_argnames)
    refused: set[tuple[Any, ...]] = set()
    shapes_of = lambda leaves: tuple(map(jnp.shape, leaves))  # noqa: E731

    @functools.cache
    def outermost() -> Callable[..., Result]:
        def marked(*args: object, **static: object) -> Result:
            return _mark(once(*args, **static))

        return jax.jit(marked, static_argnames=static_argnames, compiler_options=options())

    @functools.wraps(function)
    def call(*args: object, **static: object) -> Result:
        leaves = jax.tree.leaves(args)
        if in_trace(leaves) or options() is None:
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
    """Return Linux's description of the processor; an empty string on other systems."""
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    return cpuinfo.read_text() if cpuinfo.exists() else ""


def has_avx512() -> bool:
    """Return whether the processor has AVX-512 and XLA_FLAGS do not select older instructions."""
    selected = re.search(r"--xla_cpu_max_isa=(\w+)", os.environ.get("XLA_FLAGS", ""))
    return "avx512f" in _cpuinfo() and (selected is None or selected[1].upper().startswith("AVX512"))


def block_length(members: int) -> int:
    """Return the number of members in a block, for `members` members on one core.

    A block must fit the first-level cache, and be large enough to outweigh the start of each loop over it. In float64
    it usually has at most 64 members. Blocks of 128 are slower on Intel's cores with AVX-512. On AMD's they are faster,
    unless much of the last block is padding; they are used from 256 members on. If there are few
    members, the block is shorter, so that little of it is padding: a step of 16 members takes half as long in a block
    of 16 as in a block of 64. Blocks of 8 are hardly faster than blocks of 16. Several blocks have nearly the same
    length, for the same reason.
    """
    number = jnp.result_type(float).itemsize
    longest = (1024 if members >= 256 and has_avx512() and "AuthenticAMD" in _cpuinfo() else 512) // number
    if members <= longest:
        return max(SHORTEST, 1 << (members - 1).bit_length())
    blocks = -(-members // longest)
    return -(-members // (blocks * SHORTEST)) * SHORTEST


@functools.cache
def options() -> dict[str, Any] | None:
    """Return the compiler options of the fast path on this machine; None if there is no fast path."""
    if jax.default_backend() != "cpu":
        return None
    if os.environ.get("AMBJAX_PLAIN", "0") not in ("", "0"):
        log.warning("one-kernel path is off: AMBJAX_PLAIN is set. Results are the same, runs are several times slower.")
        return None
    given, faults = os.environ.get("XLA_FLAGS", ""), []
    wide = WIDE if has_avx512() else {}
    level = {name: value for name, value in supported(LEVEL).items() if name not in given}
    for trial in (wide | level, wide, {}):
        fault = _probe(trial)
        if not fault:
            return trial
        faults.append(fault)
    log.warning("one-kernel path is off, runs are several times slower: %s", "; ".join(faults))
    return None


def _step(y: Any, lib: Any) -> Any:
    turn = y - lib.round(y)
    rational = turn * (1 + 0.7 * turn * turn) / (1 + turn * turn * (0.9 + 0.1 * turn * turn))
    return y + rational + lib.where(y > 1, 1 / y, y) / lib.sqrt(lib.sqrt(y * y + 0.25))


def _probe(trial: dict[str, Any]) -> str:
    """Test the mark with these compiler options. Returns the fault in words; empty if the result is correct.

    The test compiles a small loop with the operations of a rollout (division, root, rounding, selection), with enough
    lanes for vectors and a remainder, and compares the result with NumPy's.
    """

    def body(_: object, y: jax.Array) -> jax.Array:
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
    # An error in a lane changes the first digits; rounding errors grow by a factor of 30 in three iterations.
    return "" if error < 1e4 * jnp.finfo(argument.dtype).eps else f"results are off by {error:.1e} with options {trial}"
