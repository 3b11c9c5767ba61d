"""Vectorisation over members whose axis is the last of every array.

`jax.vmap` puts the axis of members first. The last axis of an array with one number per axis of a machine is then
short, and XLA's CPU backend, which vectorises over the last axis, compiles such a program slowly into slow code.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

# Primitives that call a jaxpr. Custom derivatives do not change a value.
CALLS = ("checkpoint", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "eval_jaxpr", "jit", "pjit")
CALLS += ("remat2",)
# Primitives whose operands have one shape, or no axes.
NAMES = (
    "abs acos add add_any and asin atan atan2 bitcast_convert_type cbrt ceil clamp complex convert_element_type copy "
    "copy_p cos cosh div eq erf erf_inv exp exp2 expm1 floor ge gt imag integer_pow is_finite le log log1p logistic lt "
    "max min mul ne neg nextafter not or pow real reduce_precision rem round rsqrt select_n shift_left "
    "shift_right_arithmetic shift_right_logical sign sin sinh sqrt square stop_gradient sub tan tanh threefry2x32 "
    "xla_metadata_value xor"
)
ELEMENTWISE = frozenset(NAMES.split())
# Primitives of one operand whose parameters name axes: a further last axis does not change them.
SAME_AXES = frozenset(("argmax", "argmin", "cumsum", "reduce_prod", "rev", "split", "squeeze"))
# Primitives of one operand whose parameters contain shapes: functions of the operand, the parameters and the members.
SHAPED: dict[str, Callable[[Any, dict[str, Any], int], Array]] = {
    "broadcast_in_dim": lambda x, p, size: lax.broadcast_in_dim(
        x, (*p["shape"], size), (*p["broadcast_dimensions"], len(p["shape"]))
    ),
    "reshape": lambda x, p, size: lax.reshape(x, (*p["new_sizes"], size)),
    "slice": lambda x, p, size: lax.slice(
        x, (*p["start_indices"], 0), (*p["limit_indices"], size), p["strides"] and (*p["strides"], 1)
    ),
    "transpose": lambda x, p, size: lax.transpose(x, (*p["permutation"], len(p["permutation"]))),
}
# Reductions, as functions of two terms. XLA compiles a reduction into a loop that is not vectorised.
REDUCTIONS = {
    "reduce_and": lax.bitwise_and,
    "reduce_max": lax.max,
    "reduce_min": lax.min,
    "reduce_or": lax.bitwise_or,
    "reduce_sum": lax.add,
}
# Largest number of terms that are combined one by one.
SHORT = 32


def members_last(function: Callable[..., Any], axes: object) -> Callable[..., Any]:
    """Return `jax.vmap(function, (axes,))`, which computes with the members in the last axis.

    `axes`: 0 for each leaf of the argument that has a leading axis of members, None for a leaf that all members share.
    Derivatives of custom rules are lost. Primitives without a rule here use that of `jax.vmap`.
    """

    def mapped(tree: object) -> Any:
        leaves, structure = jax.tree.flatten(tree)
        moves = [axis is not None for axis in structure.flatten_up_to(axes)]
        size = next(x.shape[0] for x, moving in zip(leaves, moves, strict=True) if moving)
        one = [jax.typeof(x).update(shape=x.shape[1:]) if m else x for x, m in zip(leaves, moves, strict=True)]
        closed, shape = jax.make_jaxpr(lambda *x: function(structure.unflatten(x)), return_shape=True)(*one)
        last = [jnp.moveaxis(x, 0, -1) if moving else x for x, moving in zip(leaves, moves, strict=True)]
        members = _Members(size)
        found = [members.wide(x, m, jnp.shape(x)[: jnp.ndim(x) - m]) for x, m in members.evaluated(closed, last, moves)]
        return jax.tree.unflatten(jax.tree.structure(shape), [jnp.moveaxis(x, -1, 0) for x in found])

    return mapped


# Results with their flags: whether the value has the last axis of members.
Flagged = list[tuple[Any, bool]]


class _Members:
    """Evaluation of a jaxpr of one member for `size` members."""

    def __init__(self, size: int) -> None:
        self.size = size

    def evaluated(self, closed: ClosedJaxpr, values: Sequence[Any], moves: Sequence[bool]) -> Flagged:
        """Return the results of a jaxpr. `moves`: the flags of `values`."""
        jaxpr = closed.jaxpr
        known: dict[Any, Any] = {v: (x, False) for v, x in zip(jaxpr.constvars, closed.consts, strict=True)}
        known |= dict(zip(jaxpr.invars, zip(values, moves, strict=True), strict=True))
        read = lambda x: (x.val, False) if isinstance(x, Literal) else known[x]  # noqa: E731
        for eqn in jaxpr.eqns:
            own = [read(x) for x in eqn.invars]
            results = self.one(eqn, [x for x, _ in own], [m for _, m in own])
            known |= dict(zip(eqn.outvars, results, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def one(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged:
        name, params = eqn.primitive.name, eqn.params
        rule = self.reduced if name in REDUCTIONS else getattr(self, f"rule_{name}", None)
        if name in CALLS and rule is None:
            return self.evaluated(called(eqn), values, moves)
        if not any(moves):
            return _flagged(eqn, eqn.primitive.bind(*values, **params), False)
        if name in ELEMENTWISE:
            return _flagged(eqn, eqn.primitive.bind(*self.together(eqn, values, moves), **params), True)
        if name in SAME_AXES:
            return _flagged(eqn, eqn.primitive.bind(*values, **params), True)
        if name in SHAPED:
            return [(SHAPED[name](values[0], params, self.size), True)]
        if rule is not None and (found := rule(eqn, values, moves)) is not None:  # None: the rule does not apply
            return found
        axes = [-1 if moving else None for moving in moves]
        mapped = jax.vmap(lambda *x: eqn.primitive.bind(*x, **params), axes, -1, axis_size=self.size)
        return _flagged(eqn, mapped(*values), True)

    def wide(self, x: Any, moves: bool, shape: tuple[int, ...]) -> Array:
        """Return a value with the last axis of members. `shape`: that of one member."""
        x = jnp.asarray(x)
        return jnp.broadcast_to(x if moves or not x.ndim else x[..., None], (*shape, self.size))

    def together(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list:
        shape = np.broadcast_shapes(*map(shape_of, eqn.invars))  # equal up to lengths of 1, or ()
        return [self.wide(x, m, shape) for x, m in zip(values, moves, strict=True)]

    def rule_jit(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged:
        def inner(*values: Any) -> list:
            return [x for x, _ in self.evaluated(called(eqn), values, moves)]

        inner.__name__ = eqn.params["name"]
        found = (inner if eqn.params["inline"] else jax.jit(inner))(*values)
        return list(zip(found, moved(called(eqn), moves), strict=True))

    rule_pjit = rule_jit

    def rule_concatenate(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged | None:
        parts = [self.wide(x, m, shape_of(v)) for x, m, v in zip(values, moves, eqn.invars, strict=True)]
        return [(lax.concatenate(parts, eqn.params["dimension"]), True)]

    def rule_dynamic_slice(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged | None:
        if any(moves[1:]):
            return None
        sizes = (*eqn.params["slice_sizes"], self.size)
        return [(lax.dynamic_slice(values[0], (*values[1:], _first(eqn)), sizes), True)]

    def rule_dynamic_update_slice(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged | None:
        if any(moves[2:]):
            return None
        whole, part = (self.wide(x, m, shape_of(v)) for x, m, v in zip(values, moves, eqn.invars[:2], strict=False))
        return [(lax.dynamic_update_slice(whole, part, (*values[2:], _first(eqn))), True)]

    def reduced(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged | None:
        """Reduce one short axis term by term."""
        (x,), (axis, *others) = values, eqn.params["axes"]
        if others or x.shape[axis] > SHORT:
            return None
        parts = [lax.index_in_dim(x, n, axis, False) for n in range(x.shape[axis])]
        return [(functools.reduce(REDUCTIONS[eqn.primitive.name], parts), True)]

    def rule_while(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged:
        goes, body, consts, fixed = while_parts(eqn)
        carried = carried_flags(body, moves[consts:], fixed, ())
        own_end = moved(goes, [*moves[:consts], *carried])[0]  # members end at different turns
        carried = [own_end or moving for moving in carried]
        begin, turn = self.loop(body, values[consts:], moves[consts:], carried)

        def going(x: list) -> Any:
            return self.evaluated(goes, [*values[:consts], *x], [*moves[:consts], *carried])[0][0]

        def turn_of_some(x: list) -> list:
            goes_on = going(x)
            return [jnp.where(goes_on, after, before) for after, before in zip(turn(x)[0], x, strict=True)]

        if own_end:
            end = lax.while_loop(lambda x: jnp.any(going(x)), turn_of_some, begin)
        else:
            end = lax.while_loop(going, lambda x: turn(x)[0], begin)
        return list(zip(end, carried, strict=True))

    def rule_scan(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> Flagged | None:
        p = eqn.params
        fixed, both = scan_parts(eqn)
        carried = carried_flags(p["jaxpr"], moves[:both], fixed, moves[both:])
        begin, turn = self.loop(p["jaxpr"], values[:both], moves[:both], carried, moves[both:])
        end, stacked = lax.scan(turn, begin, values[both:], p["length"], p["reverse"], p["unroll"])
        flags = moved(p["jaxpr"], [*moves[:fixed], *carried, *moves[both:]])
        return list(zip([*end, *stacked], flags, strict=True))

    def loop(
        self, body: ClosedJaxpr, values: list, moves: list[bool], carried: list[bool], each: Sequence[bool] = ()
    ) -> tuple[list, Callable[..., tuple[list, list]]]:
        """Return the initial values of a loop, and one turn of it: turn(carried values, own inputs) -> both results."""
        fixed = len(values) - len(carried)
        shapes = list(map(shape_of, body.jaxpr.invars[fixed : len(values)]))

        def widened(found: Flagged) -> list:
            return [self.wide(*x, shape) if c else x[0] for x, shape, c in zip(found, shapes, carried, strict=True)]

        def turn(x: list, own: Sequence = ()) -> tuple[list, list]:
            found = self.evaluated(body, [*values[:fixed], *x, *own], [*moves[:fixed], *carried, *each])
            return widened(found[: len(carried)]), [y for y, _ in found[len(carried) :]]

        return widened(list(zip(values, moves, strict=True))[fixed:]), turn


def _first(eqn: JaxprEqn) -> Array:
    """Return index 0, with the type of the equation's last operand, an index."""
    return jnp.zeros((), jnp.result_type(eqn.invars[-1].aval))


def _flagged(eqn: JaxprEqn, results: Any, moves: bool) -> Flagged:
    return [(x, moves) for x in (results if eqn.primitive.multiple_results else [results])]


# Flags of the values of a jaxpr: whether a value differs between members, so that it has an axis of members.


def moved(closed: ClosedJaxpr, moves: Sequence[bool]) -> list[bool]:
    """Return the flags of the results of a jaxpr."""
    jaxpr = closed.jaxpr
    known: dict[Any, bool] = dict(zip(jaxpr.invars, moves, strict=True))
    read = lambda x: not isinstance(x, Literal) and known.get(x, False)  # noqa: E731
    for eqn in jaxpr.eqns:
        own, name = [read(x) for x in eqn.invars], eqn.primitive.name
        flags = [any(own)] * len(eqn.outvars)
        if any(own) and name in CALLS:
            flags = moved(called(eqn), own)
        elif any(own) and name == "scan":
            body, (fixed, both) = eqn.params["jaxpr"], scan_parts(eqn)
            flags = moved(body, [*own[:fixed], *carried_flags(body, own[:both], fixed, own[both:]), *own[both:]])
        elif any(own) and name == "while":
            goes, body, consts, fixed = while_parts(eqn)
            carried = carried_flags(body, own[consts:], fixed, ())
            flags = [True] * len(carried) if moved(goes, [*own[:consts], *carried])[0] else carried
        known |= dict(zip(eqn.outvars, flags, strict=True))
    return [read(x) for x in jaxpr.outvars]


def carried_flags(body: ClosedJaxpr, moves: Sequence[bool], fixed: int, each: Sequence[bool]) -> list[bool]:
    """Return which values that a loop carries differ between members after any turn."""
    carried = list(moves[fixed:])
    while True:
        after = moved(body, [*moves[:fixed], *carried, *each])
        joined = [a or b for a, b in zip(carried, after, strict=False)]
        if joined == carried:
            return carried
        carried = joined


def scan_parts(eqn: JaxprEqn) -> tuple[int, int]:
    """Return the number of constants of a scan, and that of constants and carried values together.

    The shapes show them: only inputs and results of a single turn have one axis more outside than inside.
    """
    body = eqn.params["jaxpr"].jaxpr
    both, carried = (
        sum(len(shape_of(outer)) == len(shape_of(inner)) for outer, inner in zip(outside, inside, strict=True))
        for outside, inside in ((eqn.invars, body.invars), (eqn.outvars, body.outvars))
    )
    return both - carried, both


def shape_of(x: Any) -> tuple[int, ...]:
    """Return the shape of a variable of a jaxpr."""
    return x.aval.shape


def while_parts(eqn: JaxprEqn) -> tuple[ClosedJaxpr, ClosedJaxpr, int, int]:
    """Return condition and body of a loop, and the numbers of their constants."""
    p = eqn.params
    return p["cond_jaxpr"], p["body_jaxpr"], p["cond_nconsts"], p["body_nconsts"]


def called(eqn: JaxprEqn) -> ClosedJaxpr:
    """Return the jaxpr that an equation calls."""
    inner = next(eqn.params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr") if key in eqn.params)
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
