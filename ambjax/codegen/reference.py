"""Results of a step computed with JAX operation by operation: the reference of the exported code.

If XLA compiles a whole step, it may round a product and a sum only once. If it compiles one operation at a time, it
rounds each result, so two programs with the same operations in the same order agree to the last bits. Functions of
<math.h> come from the C library, because XLA's own functions differ: its log1p is off by 1e2 units in the last place.
"""

import ctypes
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal
from jax.typing import ArrayLike

from ambjax.codegen.points import Points
from ambjax.codegen.primitives import CALLS, OPS, SAME, Atom, dtype_of, live, split_scan
from ambjax.codegen.trace import Trace, arguments
from ambjax.compiler.short_compilation import precision


class Results(NamedTuple):
    """Results of a step at some points: next states and flag `started`, outputs, and status bits."""

    state: np.ndarray
    started: np.ndarray
    outputs: np.ndarray
    bits: np.ndarray


def results(trace: Trace, at: Points) -> Results:
    """Return the results of the step at these points, computed with JAX operation by operation."""
    count = at.started.size
    with precision(trace.precision):
        given = arguments(trace.block)
        closed = jax.make_jaxpr(lambda p, m, x, t: trace.block.step(p, m, x, t, trace.read))(*given)
        rows: list[Any] = [np.zeros(count, at.state.dtype)] * (len(jax.tree.leaves(given[1])) - 1) + [at.started]
        for row, k in zip(at.state, trace.keep, strict=True):
            rows[k] = row
        found = one_by_one(closed, [*at.parameters, *rows, *at.inputs, given[3]], count)
    spread = [np.broadcast_to(x, count) for x in found]
    begun, bits = len(rows), sum(np.where(x, 1 << k, 0) for k, x in enumerate(spread[-len(trace.bits) :]))
    kept = np.array([spread[k] for k in trace.keep]).reshape(len(trace.keep), count)
    return Results(kept, spread[begun - 1], np.array(spread[begun : -len(trace.bits)]), np.asarray(bits))


def one_by_one(closed: ClosedJaxpr, args: list[ArrayLike], count: int) -> list[ArrayLike]:
    """Evaluate a trace for scalars or rows of `count`, one primitive at a time."""
    jaxpr = closed.jaxpr
    known: dict[Any, ArrayLike] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *args], strict=True))

    def value(x: Atom) -> ArrayLike:
        return np.asarray(x.val, dtype_of(x)) if isinstance(x, Literal) else known[x]

    for eqn in live(jaxpr):
        results = _one(eqn, [value(x) for x in eqn.invars], count)
        known.update(zip(eqn.outvars, results, strict=True))
    return [value(x) for x in jaxpr.outvars]


def _one(eqn: JaxprEqn, args: list[ArrayLike], count: int) -> list[ArrayLike]:
    name, params = eqn.primitive.name, eqn.params
    whole = lambda closed: closed if isinstance(closed, ClosedJaxpr) else ClosedJaxpr(closed, [])  # noqa: E731
    if name in SAME:
        return args
    if name in CALLS:
        inner = next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in params)
        return one_by_one(whole(inner), args, count)
    if name == "cond":
        sides = [one_by_one(branch, args[1:], count) for branch in params["branches"]]
        at = np.asarray(args[0], int)
        return [np.choose(at, [np.broadcast_to(x, count) for x in xs]) for xs in zip(*sides, strict=True)]
    if name == "scan":
        fixed, carry = split_scan(params, args)
        for _ in range(params["length"]):
            carry = one_by_one(params["jaxpr"], fixed + carry, count)
        return carry
    if name == "while":
        at, to = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        asked, fixed, carry = args[:at], args[at:to], args[to:]
        while np.any(more := one_by_one(params["cond_jaxpr"], asked + carry, count)[0]):
            after = one_by_one(params["body_jaxpr"], fixed + carry, count)
            carry = list[ArrayLike](jnp.where(more, a, b) for a, b in zip(after, carry, strict=True))
        return carry
    if name in OPS and OPS[name].cost == "call":
        return [_of_library(OPS[name].c99.partition("{f}")[0], args, dtype_of(eqn.outvars[0]), count)]
    rows = [jnp.broadcast_to(jnp.asarray(x, dtype_of(v)), (count,)) for x, v in zip(args, eqn.invars, strict=True)]
    return [eqn.primitive.bind(*rows, **params)]


def _of_library(name: str, args: list[ArrayLike], dtype: np.dtype, count: int) -> np.ndarray:
    """Evaluate a function of this machine's <math.h> on rows."""
    single = dtype == np.float32
    function, kind = getattr(ctypes.CDLL(None), name + "f" * single), ctypes.c_float if single else ctypes.c_double
    function.restype, function.argtypes = kind, [kind] * len(args)
    rows = [np.broadcast_to(np.asarray(x, dtype), count).tolist() for x in args]
    return np.array([function(*point) for point in zip(*rows, strict=True)], dtype)
