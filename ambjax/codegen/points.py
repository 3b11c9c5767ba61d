"""The points at which the exported step is compared with JAX, and its results there, computed operation by operation.

`verification_points` keeps the case's parameters; `varied` sets each of them to its `Number.ends`.

If XLA compiles a whole step, it may round a product and a sum only once. If it compiles one operation at a time, it
rounds each result, so two programs with the same operations in the same order agree to the last bits. Functions of
<math.h> come from the C library, because XLA's own functions differ: its log1p is off by 1e2 units in the last place.
"""

import ctypes
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn
from jax.typing import ArrayLike

from ambjax.codegen.block import UNREAD
from ambjax.codegen.primitives import OPS, SAME, called_by, dtype_of, split_scan, walked
from ambjax.codegen.program import PRECISIONS, Ref
from ambjax.codegen.trace import Trace, arguments
from ambjax.compiler.members_last import CALLS
from ambjax.compiler.short_compilation import precision

# DECADES: range of the random numbers, in decades around the scale of each. EDGY: probability that a number is zero,
# tiny, or at or near a limit. FIRST: probability that a point is a first step.
DECADES, EDGY, FIRST = (-7.0, 1.7), 0.02, 0.05
# POOL: number of random points between which thresholds are searched. DRAWS: random points per selected point. CALM:
# least share of points that set no bit of `Block.crowded`, if there are enough.
POOL, DRAWS, CALM = 3000, 4, 0.4
# PAIRS: pairs of points on both sides of the threshold of each comparison. HALVINGS: bisections of each pair.
PAIRS, HALVINGS = 4, 64
# ALONE: share of the varied points in which one parameter is changed; in the others, all are drawn at random.
ALONE = 0.7
# AT_LIMIT: share of the points with a changed limit at which the limited input is set near this limit. BESIDE: relative
# distances from the limit.
AT_LIMIT, BESIDE = 0.5, (-1e-6, 1e-6)


class Points(NamedTuple):
    """Parameters, states and inputs, [numbers, points], and the flag `started` [points]: False for a first step."""

    parameters: np.ndarray
    state: np.ndarray
    started: np.ndarray
    inputs: np.ndarray


def verification_points(trace: Trace, count: int, seed: int = 0) -> Points:
    """Return points with the case's parameters: random, special values, and both sides of every comparison."""
    random, dtype = np.random.default_rng(seed), PRECISIONS[trace.precision]
    drawn = max(DRAWS * count, POOL)
    own = np.array([x.value for x in trace.parameters])
    parameters = np.broadcast_to(own[:, None], (own.size, drawn))
    x = np.concatenate([parameters, _drawn(trace, random, parameters)]).astype(dtype)
    started = random.random(drawn) >= FIRST
    borders = _borders(trace, x[:, started & np.isfinite(x[own.size :]).all(axis=0)][:, :POOL])
    borders = borders[:, _seen(trace, borders, np.ones(borders.shape[1], bool))[1]]
    borders = borders[:, random.permutation(borders.shape[1])[: count // 2]]
    # most random states saturate the voltage, or lose the rotor: add some that do not
    far, normal = _seen(trace, x, started)
    calm = np.flatnonzero(started & normal & ~far)[: int(CALM * count)]
    rest = np.setdiff1d(np.flatnonzero(normal), calm)[: count - calm.size - borders.shape[1]]
    chosen = np.concatenate([calm, rest])
    x = np.concatenate([x[:, chosen], borders], axis=1)
    return _split(trace, x, np.concatenate([started[chosen], np.ones(borders.shape[1], bool)]))


def varied(trace: Trace, count: int) -> Points:
    """Return points with other parameters: first each alone at each of its `Number.ends`, then all drawn at random.

    The ends include values that a step must reject. A random parameter has its value in the case, or one of its first
    two ends.
    """
    random, dtype = np.random.default_rng(2), PRECISIONS[trace.precision]
    cases = [(k, end) for k, x in enumerate(trace.parameters) if x.allowed != UNREAD for end in x.ends]
    alone = np.arange(int(ALONE * count)) % len(cases)
    parameters = np.array([[x.value] * count for x in trace.parameters])
    which, ends = (np.array(column)[alone] for column in zip(*cases, strict=True))
    parameters[which, np.arange(alone.size)] = ends
    for row, x in zip(parameters, trace.parameters, strict=True):
        row[alone.size :] = random.choice([x.value, *x.ends[:2]], count - alone.size)
    x = _drawn(trace, random, parameters)
    bounds = trace.block.bounds()
    limited = {k: bounds[x.name] for k, x in enumerate(trace.parameters) if x.name in bounds}
    for n in np.flatnonzero(random.random(alone.size) < AT_LIMIT):
        if which[n] in limited:
            side = random.choice([-1.0, 1.0]) * (1 + random.choice(BESIDE))
            x[len(trace.state) + limited[which[n]], n] = side * ends[n]
    x = np.concatenate([parameters, x]).astype(dtype)
    started = random.random(count) >= FIRST
    normal = _seen(trace, x, started)[1]
    return _split(trace, x[:, normal], started[normal])


def _split(trace: Trace, x: np.ndarray, started: np.ndarray) -> Points:
    at = len(trace.parameters), len(trace.parameters) + len(trace.state)
    parameters, state, inputs = np.split(x, at)
    return Points(parameters, state, started, inputs)


def _seen(trace: Trace, x: np.ndarray, started: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whether a bit of `Block.crowded` is set, and whether no intermediate number is subnormal."""
    values, normal = evaluated(trace, x, started), np.ones(x.shape[1], bool)
    for value in values:
        if value.dtype.kind == "f":
            normal &= (value == 0) | ~(np.abs(value) < np.finfo(value.dtype).tiny)
    set_ = [bit for name, bit in trace.bits if name in trace.block.crowded]
    far = [values[bit.node] if isinstance(bit, Ref) else np.full(x.shape[1], bit) for bit in set_]
    return np.any(far, axis=0), normal


def _drawn(trace: Trace, random: np.random.Generator, parameters: np.ndarray) -> np.ndarray:
    """Return random states and inputs of either sign, over decades, with zeros, limits and some non-finite inputs."""
    states, inputs = trace.block.sizes()
    sizes, count = np.array([*(states[k] for k in trace.keep), *inputs]), parameters.shape[1]
    limits = np.ones((sizes.size, count))  # 1 for numbers without a limit: states, and readings without a guard
    bounds = trace.block.bounds()
    for k, x in enumerate(trace.parameters):
        if x.name in bounds:
            limits[len(trace.state) + bounds[x.name]] = parameters[k]
    shape = sizes.size, count
    x = sizes[:, None] * 10.0 ** random.uniform(*DECADES, shape) * random.choice([-1.0, 1.0], shape)
    x *= (np.arange(count) % 7 > 0) | (random.random(shape) < 0.5)  # in every seventh point, half of the numbers are 0
    edges = [0.0 * limits, -0.0 * limits, 1e-30 * sizes[:, None] * np.ones(shape)]
    edges += [sign * limits * (1 + off) for sign in (1, -1) for off in (0, 4e-16, -2e-16, 2e-7, -1e-7)]
    edge = np.take_along_axis(np.array(edges), random.integers(len(edges), size=(1, *shape)), axis=0)[0]
    x = np.where(random.random(shape) < EDGY, edge, x)
    for row, (state, _) in zip(x, trace.state, strict=False):
        if state.among:
            row[:] = random.choice(state.among, count)
    wild = random.choice([np.nan, np.inf, -np.inf], shape)
    given = np.arange(sizes.size)[:, None] >= len(trace.state)
    return np.where(given & (random.random(shape) < EDGY / 10), wild, x)


def _borders(trace: Trace, x: np.ndarray) -> np.ndarray:
    """Return points next to the threshold of each comparison, on both sides of it, found by bisection."""
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
    """Return the value of every node at these parameters, states and inputs, computed with NumPy."""
    count, program, dtype = x.shape[1], trace.program, PRECISIONS[trace.precision]
    rows = iter(x)
    values: list[Any] = [next(rows) for _ in trace.parameters]
    memory = [np.zeros(count, dtype)] * (len(trace.refs) - len(trace.parameters) - len(trace.inputs) - 2)
    for k in trace.keep:
        memory[k] = next(rows)
    values += [*memory, started, *rows, np.full(count, trace.block.period, dtype)]
    given = {ref.node: value for ref, value in zip(trace.refs, values, strict=True)}
    return [np.broadcast_to(v, count) for v in program.evaluate(given)]


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
    return walked(closed, args, lambda eqn, values: _one(eqn, values, count))


def _one(eqn: JaxprEqn, args: list[ArrayLike], count: int) -> list[ArrayLike]:
    name, params = eqn.primitive.name, eqn.params
    if name in SAME:
        return args
    if name in CALLS:
        return one_by_one(called_by(eqn), args, count)
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
    rows = [np.broadcast_to(np.asarray(x, dtype_of(v)), count) for x, v in zip(args, eqn.invars, strict=True)]
    return [eqn.primitive.bind(*rows, **params)]


def _of_library(name: str, args: list[ArrayLike], dtype: np.dtype, count: int) -> np.ndarray:
    single = dtype == np.float32
    function, kind = getattr(ctypes.CDLL(None), name + "f" * single), ctypes.c_float if single else ctypes.c_double
    function.restype, function.argtypes = kind, [kind] * len(args)
    rows = [np.broadcast_to(np.asarray(x, dtype), count).tolist() for x in args]
    return np.array([function(*point) for point in zip(*rows, strict=True)], dtype)
