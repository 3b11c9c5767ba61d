"""What JAX makes of a step, operation by operation, and the points at which the C is held to it.

Compiled as a whole, XLA fuses a product and a sum into one rounding where it likes to; operation by operation it does
not, and two programs of the same operations in the same order agree to the last bits. That is what is compared; what
the compiled simulator makes of the same controller is the business of `loop`. Functions of <math.h> are taken from
there: XLA has its own, of which log1p is off by 1e2 units in the last place.
"""

import ctypes
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

from ambjax.export.controller import BITS, INPUTS
from ambjax.export.primitives import CALLS, OPS, SAME
from ambjax.export.program import Ref
from ambjax.export.statements import PRECISIONS
from ambjax.export.trace import Trace, arguments, precision

# Decades about what matters; the chance of an edge in a number, and that a point is a first step.
DECADES, EDGY, FIRST = (-7.0, 0.5), 0.02, 0.05
# Random points between which borders are sought; draws per point; share of points within the supply's limit, if found.
POOL, DRAWS, CALM = 3000, 4, 0.4
# Pairs of points to either side of a border that are sought for each comparison, and halvings on the way there.
PAIRS, HALVINGS = 4, 64


class Points(NamedTuple):
    """States and inputs, [numbers, points], and whether each point's state was started."""

    state: np.ndarray
    started: np.ndarray
    inputs: np.ndarray


class Results(NamedTuple):
    """What a step makes of points: next states, whether started, outputs, and the bits."""

    state: np.ndarray
    started: np.ndarray
    outputs: np.ndarray
    bits: np.ndarray


def points(trace: Trace, count: int, seed: int = 0) -> Points:
    """Random states and inputs over decades about what matters, edges, and both sides of every border of the step."""
    random, dtype = np.random.default_rng(seed), PRECISIONS[trace.precision]
    x = _drawn(trace, random, max(DRAWS * count, POOL)).astype(dtype)
    started = random.random(x.shape[1]) >= FIRST
    borders = _borders(trace, x[:, started & np.isfinite(x).all(axis=0)][:, :POOL])
    borders = borders[:, _seen(trace, borders, np.ones(borders.shape[1], bool))[1]]
    borders = borders[:, random.permutation(borders.shape[1])[: count // 2]]
    # far states ask for more than the supply has: of those that do not, more
    far, normal = _seen(trace, x, started)
    calm = np.flatnonzero(started & normal & ~far)[: int(CALM * count)]
    rest = np.setdiff1d(np.flatnonzero(normal), calm)[: count - calm.size - borders.shape[1]]
    chosen = np.concatenate([calm, rest])
    x = np.concatenate([x[:, chosen], borders], axis=1)
    started = np.concatenate([started[chosen], np.ones(borders.shape[1], bool)])
    return Points(x[: len(trace.state)], started, x[len(trace.state) :])


def _seen(trace: Trace, x: np.ndarray, started: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of states and inputs: whether the voltage is at its limit or held, and whether no number on the way is so
    small that it lost digits (JAX takes those for 0 on CPUs, C does not)."""
    values, normal = evaluated(trace, x, started), np.ones(x.shape[1], bool)
    for value in values:
        if value.dtype.kind == "f":
            normal &= (value == 0) | ~(np.abs(value) < np.finfo(value.dtype).tiny)
    far = [values[bit.node] if isinstance(bit, Ref) else np.full(x.shape[1], bit) for _, bit in trace.bits[:2]]
    return np.any(far, axis=0), normal


def _drawn(trace: Trace, random: np.random.Generator, count: int) -> np.ndarray:
    """States and inputs: of any sign, over decades, with zeros, limits and what is no number among them."""
    sizes, limits = np.array(_sizes(trace)), np.array(_limits(trace))
    shape = len(sizes), count
    x = sizes[:, None] * 10.0 ** random.uniform(*DECADES, shape) * random.choice([-1.0, 1.0], shape)
    x *= (np.arange(count) % 7 > 0) | (random.random(shape) < 0.5)  # among every seventh half are 0
    edges = [0.0 * limits, -0.0 * limits, 1e-30 * sizes]
    edges += [sign * limits * (1 + off) for sign in (1, -1) for off in (0, 4e-16, -2e-16, 2e-7, -1e-7)]
    rows = np.arange(len(sizes))[:, None]
    x = np.where(random.random(shape) < EDGY, np.array(edges)[random.integers(len(edges), size=shape), rows], x)
    wild = random.choice([np.nan, np.inf, -np.inf], shape)
    inputs = rows >= len(trace.state)
    return np.where(inputs & (random.random(shape) < EDGY / 10), wild, x)


def _limits(trace: Trace) -> list[float]:
    """Largest size of each state, unbounded, and of each input."""
    limits: Any = trace.controller.parameters.limits
    return [1.0] * len(trace.state) + [float(getattr(limits, name)) for name in INPUTS]


def _sizes(trace: Trace) -> list[float]:
    """What matters of each state and input."""
    controller = trace.controller
    cascade, limits = controller.parameters
    model = cascade.model
    z, z_dot, i = (float(x) for x in model.sizes())
    pole, weight = float(model.pole), float(model.R) * float(model.i_0)
    u = float(limits.u_max) if np.isfinite(limits.u_max) else 10 * weight + 1.0
    laws = [float(x) for x in jax.tree.leaves(cascade.scale())]
    v = float(model.v_size)
    states = [*laws, v, v, i, i * pole, u, u]
    return [states[k] for k in trace.keep] + [z, z_dot, i, z, z * pole, z * pole**2, z * pole**3]


def _borders(trace: Trace, x: np.ndarray) -> np.ndarray:
    """Points next to where a comparison of the step turns, on both sides of it: found between points by halving."""
    nodes = trace.program.nodes
    begun = np.ones(x.shape[1], bool)
    outcomes, found = evaluated(trace, x, begun), []
    for n in (n for n in trace.order() if nodes[n].op in ("lt", "le", "gt", "ge")):
        yes, no = (np.flatnonzero(outcomes[n] == side)[:PAIRS] for side in (True, False))
        found += [(n, a, b) for a, b in zip(yes, no, strict=False)]
    if not found:
        return x[:, :0]
    asked, yes, no = map(np.array, zip(*found, strict=True))
    a, b = x[:, yes], x[:, no]
    for _ in range(HALVINGS):
        middle = (a / 2 + b / 2).astype(x.dtype)
        values = evaluated(trace, middle, np.ones(middle.shape[1], bool))
        like = np.array([values[n][lane] for lane, n in enumerate(asked)])
        a, b = np.where(like, middle, a), np.where(like, b, middle)
    return np.concatenate([a, b], axis=1)


def evaluated(trace: Trace, x: np.ndarray, started: np.ndarray) -> list[np.ndarray]:
    """Every node at states and inputs, by NumPy."""
    count, program, dtype = x.shape[1], trace.program, PRECISIONS[trace.precision]
    rows = iter(x)
    given: dict[int, np.ndarray] = {}
    states, all_states = len(trace.state), len(trace.refs) - len(trace.parameters) - len(INPUTS) - 2
    values = [np.full(count, p.value, dtype) for p in trace.parameters]
    memory = [np.zeros(count, dtype)] * all_states
    for k in range(states):
        memory[trace.keep[k]] = next(rows)
    values += [*memory, started, *rows, np.full(count, trace.controller.period, dtype)]
    for ref, value in zip(trace.refs, values, strict=True):
        given[ref.node] = value
    return [np.broadcast_to(v, count) for v in program.evaluate(given)]


def results(trace: Trace, at: Points) -> Results:
    """The step at these points by JAX, operation by operation."""
    count = at.started.size
    with precision(trace.precision):
        given: Any = arguments(trace.controller)
        step: Any = trace.controller.step
        closed = jax.make_jaxpr(lambda *x: step(*x, trace.read))(*given)
        rows: list[Any] = [np.zeros(count, at.state.dtype)] * (len(jax.tree.leaves(given[1])) - 1) + [at.started]
        for row, k in zip(at.state, trace.keep, strict=True):
            rows[k] = row
        found = one_by_one(closed, [*jax.tree.leaves(given[0]), *rows, *at.inputs, given[3]], count)
    spread = [np.broadcast_to(x, count) for x in found]
    begun, bits = len(rows), sum(np.where(x, 1 << k, 0) for k, x in enumerate(spread[-len(BITS) :]))
    kept = np.array([spread[k] for k in trace.keep]).reshape(len(trace.keep), count)
    return Results(kept, spread[begun - 1], np.array(spread[begun : -len(BITS)]), np.asarray(bits))


def one_by_one(closed: ClosedJaxpr, args: list[Any], count: int) -> list[Any]:
    """What a trace gives for scalars or rows of `count`, each primitive run by JAX alone, on rows.

    On rows: dividing a row by a scalar, XLA multiplies by its reciprocal.
    """
    jaxpr = closed.jaxpr
    known: dict[Any, Any] = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *args], strict=True))

    def value(x: Any) -> Any:
        aval: Any = x.aval
        return np.asarray(x.val, aval.dtype) if isinstance(x, Literal) else known[x]

    for eqn in jaxpr.eqns:
        results = _one(eqn, [value(x) for x in eqn.invars], count)
        known.update(zip(eqn.outvars, results, strict=True))
    return [value(x) for x in jaxpr.outvars]


def _one(eqn: Any, args: list[Any], count: int) -> list[Any]:
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
        fixed, carry = args[: params["num_consts"]], args[params["num_consts"] :]
        for _ in range(params["length"]):
            carry = one_by_one(params["jaxpr"], fixed + carry, count)
        return carry
    if name == "while":
        at, to = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        asked, fixed, carry = args[:at], args[at:to], args[to:]
        while np.all(one_by_one(params["cond_jaxpr"], asked + carry, count)[0]):
            carry = one_by_one(params["body_jaxpr"], fixed + carry, count)
        return carry
    if name in OPS and OPS[name].cost == "call":
        return [_of_library(OPS[name].text.partition("{f}")[0], args, np.dtype(eqn.outvars[0].aval.dtype), count)]
    rows = [jnp.broadcast_to(jnp.asarray(x, v.aval.dtype), (count,)) for x, v in zip(args, eqn.invars, strict=True)]
    return [eqn.primitive.bind(*rows, **params)]


def _of_library(name: str, args: list[Any], dtype: np.dtype, count: int) -> np.ndarray:
    """A function of <math.h>, as this machine has it, of rows."""
    single = dtype == np.float32
    function, kind = getattr(ctypes.CDLL(None), name + "f" * single), ctypes.c_float if single else ctypes.c_double
    function.restype, function.argtypes = kind, [kind] * len(args)
    rows = [np.broadcast_to(np.asarray(x, dtype), count).tolist() for x in args]
    return np.array([function(*point) for point in zip(*rows, strict=True)], dtype)
