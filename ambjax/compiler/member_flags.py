"""Flags of the values of a jaxpr: whether a value differs between members, so that it has an axis of members."""

from collections.abc import Sequence
from typing import Any

from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

# Primitives that call a jaxpr.
CALLS = ("checkpoint", "custom_jvp_call", "custom_vjp_call", "jit", "pjit", "remat2")


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
