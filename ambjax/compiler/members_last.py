"""Vectorisation over members whose axis is the last of every array.

`jax.vmap` puts the axis of members first. The last axis of an array with a number for each axis of a machine is then
short, and XLA's CPU backend, which vectorises over the last axis, compiles such a program slowly into slow code.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

# Primitives whose operands have one shape, or no axes.
ELEMENTWISE = frozenset(
    [
        "abs",
        "acos",
        "add",
        "add_any",
        "and",
        "asin",
        "atan",
        "atan2",
        "bitcast_convert_type",
        "cbrt",
        "ceil",
        "complex",
        "clamp",
        "convert_element_type",
        "copy",
        "copy_p",
        "cos",
        "cosh",
        "div",
        "eq",
        "erf",
        "erf_inv",
        "exp",
        "exp2",
        "expm1",
        "floor",
        "ge",
        "gt",
        "imag",
        "integer_pow",
        "is_finite",
        "le",
        "log",
        "log1p",
        "logistic",
        "lt",
        "max",
        "min",
        "mul",
        "ne",
        "neg",
        "nextafter",
        "not",
        "optimization_barrier",
        "or",
        "pow",
        "real",
        "reduce_precision",
        "rem",
        "round",
        "rsqrt",
        "select_n",
        "shift_left",
        "shift_right_arithmetic",
        "shift_right_logical",
        "sign",
        "sin",
        "sinh",
        "sqrt",
        "square",
        "sub",
        "tan",
        "tanh",
        "threefry2x32",
        "xla_metadata_value",
        "xor",
    ]
)
# Primitives whose parameters name axes, which a further last axis does not change.
SAME = frozenset(
    [
        "argmax",
        "argmin",
        "concatenate",
        "cumsum",
        "cumprod",
        "cummax",
        "cummin",
        "reduce_and",
        "reduce_max",
        "reduce_min",
        "reduce_or",
        "reduce_prod",
        "reduce_sum",
        "reduce_xor",
        "rev",
        "split",
        "squeeze",
    ]
)
# Largest number of terms that are added one by one.
SHORT = 32
# Primitives that call one jaxpr, by the name of their parameter.
CALLS = {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "remat2": "jaxpr"}


def members_last(function: Callable[..., Any], axes: object) -> Callable[..., Any]:
    """Return `function` for all members of a block: as jax.vmap(function, (axes,)), with the members last inside.

    `axes`: 0 for a leaf of the argument with a leading axis of members, None for one that all members share. The
    derivatives of custom rules are lost.
    """

    def mapped(tree: object) -> Any:
        leaves, structure = jax.tree.flatten(tree)
        moves = [axis is not None for axis in structure.flatten_up_to(axes)]
        size = next(x.shape[0] for x, moving in zip(leaves, moves, strict=True) if moving)
        one = [jax.typeof(x).update(shape=x.shape[1:]) if m else x for x, m in zip(leaves, moves, strict=True)]
        closed, shape = jax.make_jaxpr(lambda *x: function(jax.tree.unflatten(structure, x)), return_shape=True)(*one)
        last = [jnp.moveaxis(x, 0, -1) if moving else x for x, moving in zip(leaves, moves, strict=True)]
        found, moved = _Members(size).closed(closed, last, moves)
        found = [
            x if m else jnp.broadcast_to(x[..., None], (*x.shape, size)) for x, m in zip(found, moved, strict=True)
        ]
        return jax.tree.unflatten(jax.tree.structure(shape), [jnp.moveaxis(x, -1, 0) for x in found])

    return mapped


class _Members:
    """Evaluation of a jaxpr of one member for `size` members. Values and flags: whether they have the last axis."""

    def __init__(self, size: int) -> None:
        self.size = size

    def closed(self, closed: ClosedJaxpr, values: Sequence[Any], moves: Sequence[bool]) -> tuple[list, list[bool]]:
        return self.evaluated(closed.jaxpr, closed.consts, values, moves)

    def evaluated(
        self, jaxpr: Jaxpr, consts: Sequence[Any], values: Sequence[Any], moves: Sequence[bool]
    ) -> tuple[list, list[bool]]:
        known: dict[Any, tuple[Any, bool]] = dict(zip(jaxpr.constvars, [(x, False) for x in consts], strict=True))
        known |= dict(zip(jaxpr.invars, zip(values, moves, strict=True), strict=True))
        read = lambda x: (x.val, False) if isinstance(x, Literal) else known[x]  # noqa: E731
        for eqn in jaxpr.eqns:
            own = [read(x) for x in eqn.invars]
            results = self.one(eqn, [x for x, _ in own], [m for _, m in own])
            known |= dict(zip(eqn.outvars, results, strict=True))
        results = [read(x) for x in jaxpr.outvars]
        return [x for x, _ in results], [m for _, m in results]

    def one(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list[tuple[Any, bool]]:
        """Return the results of one equation."""
        name, params = eqn.primitive.name, eqn.params
        if not any(moves) and name not in CALLS:
            return self.flagged(eqn, eqn.primitive.bind(*values, **params), False)
        if name in ELEMENTWISE:
            return self.flagged(eqn, eqn.primitive.bind(*self.together(eqn, values, moves), **params), True)
        if name in ("pjit", "jit"):
            return self.jitted(params, values, moves)
        if name in CALLS:
            inner = params[CALLS[name]]
            closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
            return list(zip(*self.closed(closed, values, moves), strict=True))
        if (special := getattr(self, name.removesuffix("_loop"), None)) is not None or name == "while":
            special = special or self.while_
            found = special(eqn, values, moves)
            if found is not None:
                return found
        if name in SAME and all(moves):
            return self.flagged(eqn, eqn.primitive.bind(*values, **params), True)
        axes = [-1 if moving else None for moving in moves]
        mapped = jax.vmap(lambda *x: eqn.primitive.bind(*x, **params), axes, -1, axis_size=self.size)
        return self.flagged(eqn, mapped(*values), True)

    def flagged(self, eqn: JaxprEqn, results: Any, moves: bool) -> list[tuple[Any, bool]]:
        return [(x, moves) for x in (results if eqn.primitive.multiple_results else [results])]

    def wide(self, x: Any, moves: bool, shape: tuple[int, ...]) -> Array:
        """Return a value of one member's `shape` with the last axis of members."""
        x = jnp.asarray(x)
        return jnp.broadcast_to(x if moves or not x.ndim else x[..., None], (*shape, self.size))

    def together(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list:
        shape = max((x.aval.shape for x in eqn.invars), key=len)
        return [self.wide(x, m, shape) for x, m in zip(values, moves, strict=True)]

    def jitted(self, params: dict[str, Any], values: list, moves: list[bool]) -> list[tuple[Any, bool]]:
        flags: list[bool] = []

        def inner(*values: Any) -> list:
            found, moved = self.closed(params["jaxpr"], values, moves)
            flags[:] = moved
            return found

        if params["inline"]:
            return list(zip(inner(*values), flags, strict=True))
        inner.__name__ = params["name"]
        return list(zip(jax.jit(inner)(*values), flags, strict=True))

    def broadcast_in_dim(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        shape, dims = eqn.params["shape"], eqn.params["broadcast_dimensions"]
        if len(values) > 1:
            return None
        return [(lax.broadcast_in_dim(values[0], (*shape, self.size), (*dims, len(shape))), True)]

    def reshape(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        return [(lax.reshape(values[0], (*eqn.params["new_sizes"], self.size)), True)]

    def transpose(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        order = eqn.params["permutation"]
        return [(lax.transpose(values[0], (*order, len(order))), True)]

    def slice(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        begin, end, strides = (eqn.params[x] for x in ("start_indices", "limit_indices", "strides"))
        return [(lax.slice(values[0], (*begin, 0), (*end, self.size), strides and (*strides, 1)), True)]

    def concatenate(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        parts = [self.wide(x, m, v.aval.shape) for x, m, v in zip(values, moves, eqn.invars, strict=True)]
        return [(lax.concatenate(parts, eqn.params["dimension"]), True)]

    def reduce_sum(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        x, axes = values[0], eqn.params["axes"]
        if len(axes) > 1 or x.shape[axes[0]] > SHORT:
            return None
        parts = [lax.index_in_dim(x, n, axes[0], False) for n in range(x.shape[axes[0]])]
        return [(functools.reduce(operator.add, parts), True)]

    def dynamic_slice(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        if any(moves[1:]):
            return None
        return [(lax.dynamic_slice(values[0], (*values[1:], 0), (*eqn.params["slice_sizes"], self.size)), True)]

    def dynamic_update_slice(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        if any(moves[2:]):
            return None
        whole, part = (self.wide(x, m, v.aval.shape) for x, m, v in zip(values[:2], moves, eqn.invars, strict=False))
        return [(lax.dynamic_update_slice(whole, part, (*values[2:], 0)), True)]

    def steady(
        self, jaxpr: ClosedJaxpr, before: list, consts: list, carry: list, carried: list[bool], after: list
    ) -> list[bool]:
        """Return which values carried by a loop have the last axis: those that differ between members at any turn.

        `consts`, `after`: pairs of a value and a flag of the loop's other inputs.
        """
        while True:

            def turn(*values: Any) -> list:
                found, moved = self.closed(jaxpr, values, [m for _, m in consts] + carried + [m for _, m in after])
                result[:] = moved[: len(carry)]
                return found

            result: list[bool] = []
            wide = [
                self.wide(x, False, v.aval.shape) if m and not b else x
                for x, m, b, v in zip(carry, carried, before, jaxpr.jaxpr.invars[len(consts) :], strict=False)
            ]
            jax.eval_shape(turn, *[x for x, _ in consts], *wide, *[x for x, _ in after])
            joined = [a or b for a, b in zip(carried, result, strict=True)]
            if joined == carried:
                return carried
            carried = joined

    def while_(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        p = eqn.params
        a, b = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
        consts = list(zip(values[a:b], moves[a:b], strict=True))
        carry, before = values[b:], moves[b:]
        carried = self.steady(p["body_jaxpr"], before, consts, carry, list(before), [])
        shapes = [v.aval.shape for v in p["body_jaxpr"].in_avals and p["body_jaxpr"].jaxpr.invars[b - a :]]
        flags: list[bool] = []

        def goes(x: list) -> Any:
            found, moved = self.closed(p["cond_jaxpr"], [*values[:a], *x], [*moves[:a], *carried])
            flags[:] = moved
            return found[0]

        begin = [
            self.wide(x, m, s) if c and not m else x for x, m, c, s in zip(carry, before, carried, shapes, strict=True)
        ]
        jax.eval_shape(goes, begin)
        if flags[0]:
            return None

        def turn(x: list) -> list:
            found, moved = self.closed(p["body_jaxpr"], [*values[a:b], *x], [*moves[a:b], *carried])
            return [self.wide(x, m, s) if c else x for x, m, c, s in zip(found, moved, carried, shapes, strict=True)]

        return list(zip(lax.while_loop(goes, turn, begin), carried, strict=True))

    def scan(self, eqn: JaxprEqn, values: list, moves: list[bool]) -> list | None:
        p, (a, b) = eqn.params, (eqn.params["num_consts"], eqn.params["num_consts"] + eqn.params["num_carry"])
        consts, after = list(zip(values[:a], moves[:a], strict=True)), list(zip(values[b:], moves[b:], strict=True))
        one = [(x[0], m) for x, m in after]
        carry, before = values[a:b], moves[a:b]
        carried = self.steady(p["jaxpr"], before, consts, carry, list(before), one)
        shapes = [v.aval.shape for v in p["jaxpr"].jaxpr.invars[a:b]]
        flags: list[bool] = []

        def turn(x: list, each: list) -> tuple[list, list]:
            found, moved = self.closed(p["jaxpr"], [*values[:a], *x, *each], [*moves[:a], *carried, *moves[b:]])
            flags[:] = moved[b - a :]
            head = [self.wide(x, m, s) if c else x for x, m, c, s in zip(found, moved, carried, shapes, strict=False)]
            return head, found[b - a :]

        begin = [
            self.wide(x, m, s) if c and not m else x for x, m, c, s in zip(carry, before, carried, shapes, strict=True)
        ]
        end, stacked = lax.scan(turn, begin, values[b:], p["length"], p["reverse"], p["unroll"])
        return list(zip([*end, *stacked], [*carried, *flags], strict=True))
