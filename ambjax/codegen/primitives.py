"""Scalar primitives: one row each, with its text in every language, its NumPy function and its cost.

The NumPy functions are used to fold constants and to choose the points of the verification. The verification compares
the exported code with JAX, not with NumPy.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

from ambjax.compiler.members_last import called
from ambjax.numerics.smooth import REFINED


class Op(NamedTuple):
    """Texts in C and JavaScript; NumPy function; kind of cost; whether operands commute.

    In both texts `{0}`, `{1}`, `{2}` are the operands. In C, `{f}` is the suffix of float functions, `{name}` the
    prefix of all names, `{to}` the type of the result, `{one}` and `{zero}` are numbers of that type. A function of
    JavaScript that is not of `Math` or `Number` is one of `javascript.script.HELPERS`.
    """

    c99: str
    javascript: str
    numpy: Callable[..., Any]
    cost: str = "call"
    commutes: bool = False


def _erf(name: str) -> Callable[..., Any]:
    import math

    return np.vectorize(getattr(math, name), otypes=[float])


def _function(name: str, numpy: str) -> Op:
    return Op(f"{name}{{f}}({{0}})", f"Math.{name}({{0}})", getattr(np, numpy))


def _compare(sign: str, numpy: Callable[..., object]) -> Op:
    strict = f"{sign}=" if sign in ("==", "!=") else sign
    return Op(f"{{0}} {sign} {{1}}", f"{{0}} {strict} {{1}}", numpy, "comparison", sign in ("==", "!="))


# JAX's `&` and `|` on bools become `&&` and `||`. The result is the same, because both operands are computed already.
OPS: dict[str, Op] = {
    "add": Op("{0} + {1}", "{0} + {1}", np.add, "add", True),
    "sub": Op("{0} - {1}", "{0} - {1}", np.subtract, "add"),
    "mul": Op("{0} * {1}", "{0} * {1}", np.multiply, "multiply", True),
    "div": Op("{0} / {1}", "{0} / {1}", np.divide, "divide"),
    "neg": Op("-{0}", "-{0}", np.negative, "sign"),
    "abs": Op("fabs{f}({0})", "Math.abs({0})", np.abs, "sign"),
    "sign": Op("{name}_sign({0})", "Math.sign({0})", np.sign, "comparison"),
    "max": Op("{name}_max({0}, {1})", "max({0}, {1})", np.maximum, "comparison", True),
    "min": Op("{name}_min({0}, {1})", "min({0}, {1})", np.minimum, "comparison", True),
    "select": Op("{0} ? {1} : {2}", "{0} ? {1} : {2}", np.where, "comparison"),
    "sqrt": Op("sqrt{f}({0})", "Math.sqrt({0})", np.sqrt, "root"),
    "pow": Op("pow{f}({0}, {1})", "pow({0}, {1})", np.power),
    "atan2": Op("atan2{f}({0}, {1})", "Math.atan2({0}, {1})", np.arctan2),
    "rem": Op("fmod{f}({0}, {1})", "{0} % {1}", np.fmod),
    "round_away": Op("round{f}({0})", "roundAway({0})", lambda x: np.copysign(np.floor(np.abs(x) + 0.5), x)),
    "round_even": Op("rint{f}({0})", "roundEven({0})", np.rint),
    **{f"a{name}": _function(f"a{name}", f"arc{name}") for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{name: _function(name, name) for name in ("exp", "expm1", "log", "log1p", "cbrt", "floor", "ceil")},
    **{name: _function(name, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "erf": Op("erf{f}({0})", "erf({0})", _erf("erf")),
    "erfc": Op("erfc{f}({0})", "erfc({0})", _erf("erfc")),
    "eq": _compare("==", np.equal),
    "ne": _compare("!=", np.not_equal),
    "lt": _compare("<", np.less),
    "le": _compare("<=", np.less_equal),
    "gt": _compare(">", np.greater),
    "ge": _compare(">=", np.greater_equal),
    "is_finite": Op("isfinite({0})", "Number.isFinite({0})", np.isfinite, "comparison"),
    "and": Op("{0} && {1}", "{0} && {1}", np.logical_and, "logic", True),
    "or": Op("{0} || {1}", "{0} || {1}", np.logical_or, "logic", True),
    "xor": Op("{0} != {1}", "{0} !== {1}", np.logical_xor, "logic", True),
    "not": Op("!{0}", "!{0}", np.logical_not, "logic"),
    "real": Op("({to}){0}", "{0}", lambda x: x, "conversion"),
    "flag": Op("{0} ? {one} : {zero}", "{0} ? 1 : 0", lambda x: np.where(x, 1.0, 0.0), "conversion"),
}
# Primitives that return a scalar operand unchanged.
SAME = ("broadcast_in_dim", "copy", "copy_p", "optimization_barrier", "reshape", "squeeze", "stop_gradient")
SAME += ("xla_metadata_value", "pvary")

COUNTED = ("add", "multiply", "divide", "root", "call")


# A variable of a trace, or a constant in it.
Atom: TypeAlias = Var | Literal
Argument = TypeVar("Argument")


def dtype_of(x: Atom) -> np.dtype:
    """Return the dtype of a variable or constant of a trace."""
    aval: Any = x.aval
    return np.dtype(aval.dtype)


def called_by(eqn: JaxprEqn) -> ClosedJaxpr:
    """Return the jaxpr that an equation calls. That of `refined_reciprocal` is one division."""
    if eqn.params.get("name") == REFINED:
        return jax.make_jaxpr(lambda x: 1 / x)(eqn.invars[0].aval)
    return called(eqn)


def walked(closed: ClosedJaxpr, args: Sequence[Any], one: Callable[[JaxprEqn, list[Any]], Sequence[Any]]) -> list[Any]:
    """Return the results of a trace. `one`: returns the results of an equation from its operands.

    Equations on which no result depends are left out.
    """
    jaxpr, live = closed.jaxpr, list[JaxprEqn]()
    needed = {x for x in jaxpr.outvars if not isinstance(x, Literal)}
    for eqn in reversed(jaxpr.eqns):
        if not needed.isdisjoint(eqn.outvars):
            needed.update(x for x in eqn.invars if not isinstance(x, Literal))
            live.append(eqn)
    known = dict[Any, Any](zip(jaxpr.constvars, (np.asarray(x)[()] for x in closed.consts), strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))

    def value(x: Atom) -> Any:
        return np.asarray(x.val, dtype_of(x))[()] if isinstance(x, Literal) else known[x]

    for eqn in reversed(live):
        known.update(zip(eqn.outvars, one(eqn, [value(x) for x in eqn.invars]), strict=True))
    return [value(x) for x in jaxpr.outvars]


def split_scan(params: dict[str, Any], args: list[Argument]) -> tuple[list[Argument], list[Argument]]:
    """Return the constants and the carry of a scan over scalars, from all its arguments.

    Such a scan has no inputs or results per step. Its results are therefore the carry, which comes last in `args`.
    """
    first = len(args) - len(params["jaxpr"].out_avals)
    return args[:first], args[first:]
