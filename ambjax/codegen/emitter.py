"""Translate a JAX trace to straight-line scalar code: inline calls, unroll loops, turn branches into selections.

The order of operations stays that of the trace.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from ambjax.codegen.primitives import OPS, SAME, called_by, dtype_of, split_scan, walked
from ambjax.codegen.program import Operand, Program, Ref, of
from ambjax.compiler.members_last import CALLS

LOOPS = ("scan", "while")
COMPOSED = ("rsqrt", "exp2", "logistic", "one_minus_square")
# Primitives whose operands may be whole numbers that depend on data.
CODES = ("select_n", "eq", "ne", "lt", "le", "gt", "ge")


def traced(
    program: Program, function: Callable[..., object], arguments: Iterable[object], operands: Sequence[Operand]
) -> list[Operand]:
    """Trace `function(*arguments)` into `program` and return the operands of the leaves of its result."""
    closed = jax.make_jaxpr(function)(*arguments)
    return _Reader(program).closed(closed, list(operands), "")


class _Reader:
    def __init__(self, program: Program) -> None:
        self.program = program

    def closed(self, closed: ClosedJaxpr, operands: list[Operand], law: str) -> list[Operand]:
        for const in closed.consts:
            if np.shape(const) != ():
                raise ValueError(f"{of(law)}a constant of shape {np.shape(const)}: only scalars can be exported.")

        def one(eqn: JaxprEqn, args: list[Operand]) -> list[Operand]:
            name = eqn.primitive.name
            # the innermost law in JAX's name scopes; jvp(...), for example, may wrap a scope
            inner = [law, *re.findall(r"law:([^/()]+)", str(eqn.source_info.name_stack))][-1]
            if any(getattr(x.aval, "shape", None) != () for x in [*eqn.invars, *eqn.outvars]):
                raise ValueError(refusal(name, inner, "on arrays"))
            return self.equation(name, eqn, args, inner)

        return walked(closed, operands, one)

    def equation(self, name: str, eqn: JaxprEqn, args: list[Operand], law: str) -> list[Operand]:
        if name in CALLS:
            return self.closed(called_by(eqn), args, law)
        if name in SAME:
            return args
        if name in LOOPS or name == "cond":
            return getattr(self, f"_{name}")(eqn.params, args, law)
        return [self.scalar(name, eqn, args, law)]

    def scalar(self, name: str, eqn: JaxprEqn, args: list[Operand], law: str) -> Operand:
        apply, dtype, params = self.program.apply, dtype_of(eqn.outvars[0]), eqn.params
        if dtype.kind == "f" and dtype.itemsize not in (4, 8):
            raise ValueError(refusal(name, law, f"of {dtype.name}"))
        if name == "convert_element_type":
            return self._converted(args[0], dtype, law)
        counted = any(self.program.dtype(x).kind in "iu" and isinstance(x, Ref) for x in args)
        if counted and name not in CODES:  # a status code is only compared and selected
            raise ValueError(refusal(name, law, "of whole numbers"))
        if name == "select_n":
            if len(args) != 3:
                raise ValueError(refusal(name, law, f"of {len(args) - 1} choices"))
            return apply("select", (args[0], args[2], args[1]), dtype, law)
        if name == "clamp":
            return apply("min", (apply("max", (args[1], args[0]), dtype, law), args[2]), dtype, law)
        if name in ("square", "integer_pow"):
            return self._power(args[0], params.get("y", 2), dtype, law)
        if name in COMPOSED:
            return self._composed(name, args[0], dtype, law)
        if name == "round":
            name = ("round_away", "round_even")[int(params["rounding_method"])]
        name = {"add_any": "add"}.get(name, name)
        whole = dtype.kind in "iu"  # allowed between constants only
        if name not in OPS or (whole and any(isinstance(x, Ref) for x in args)):
            raise ValueError(refusal(name, law, "of whole numbers" if whole else ""))
        return apply(name, args, dtype, law)

    def _composed(self, name: str, x: Operand, dtype: np.dtype, law: str) -> Operand:
        """Express a primitive that some target languages lack by other primitives, as XLA does."""
        apply, one = self.program.apply, np.ones((), dtype)[()]
        if name == "rsqrt":
            return apply("div", (one, apply("sqrt", (x,), dtype, law)), dtype, law)
        if name == "one_minus_square":
            return apply("mul", (apply("add", (one, x), dtype, law), apply("sub", (one, x), dtype, law)), dtype, law)
        if name == "exp2":
            return apply("exp", (apply("mul", (x, np.log(2 * one)), dtype, law),), dtype, law)
        grown = apply("exp", (apply("neg", (x,), dtype, law),), dtype, law)
        return apply("div", (one, apply("add", (one, grown), dtype, law)), dtype, law)

    def _power(self, x: Operand, y: int, dtype: np.dtype, law: str) -> Operand:
        total, left = None, abs(y)
        while left > 0:
            if left & 1:
                total = x if total is None else self.program.apply("mul", (total, x), dtype, law)
            if left := left >> 1:
                x = self.program.apply("mul", (x, x), dtype, law)
        one = np.ones((), dtype)[()]
        total = one if total is None else total
        return self.program.apply("div", (one, total), dtype, law) if y < 0 else total

    def _converted(self, x: Operand, dtype: np.dtype, law: str) -> Operand:
        before = self.program.dtype(x)
        if not isinstance(x, Ref):
            return x.astype(dtype)
        if before == dtype or (before.kind in "biu" and dtype.kind in "iu"):  # the index of a branch, or a code
            return x
        if "f" not in (before.kind, dtype.kind) or {before.kind, dtype.kind} & set("iu"):
            raise ValueError(refusal("convert_element_type", law, f"from {before.name} to {dtype.name}"))
        if dtype.kind == "b":
            return self.program.apply("ne", (x, np.zeros((), before)[()]), dtype, law)
        return self.program.apply("flag" if before.kind == "b" else "real", (x,), dtype, law)

    def _cond(self, params: Any, args: list[Operand], law: str) -> list[Operand]:
        branches, (index, *rest) = params["branches"], args
        if not isinstance(index, Ref):
            return self.closed(branches[int(np.clip(index, 0, len(branches) - 1))], rest, law)
        if len(branches) != 2 or self.program.dtype(index).kind != "b":
            raise ValueError(refusal("cond", law, f"of {len(branches)} branches"))
        no, yes = (self.closed(branch, rest, law) for branch in branches)
        return self.selected(index, yes, no, law)

    def selected(self, which: Ref, yes: list[Operand], no: list[Operand], law: str) -> list[Operand]:
        apply, dtype = self.program.apply, self.program.dtype
        return [apply("select", (which, a, b), dtype(a), law) for a, b in zip(yes, no, strict=True)]

    def _scan(self, params: Any, args: list[Operand], law: str) -> list[Operand]:
        consts, carry = split_scan(params, args)
        for _ in range(params["length"]):
            carry = self.closed(params["jaxpr"], consts + carry, law)
        return carry

    def _while(self, params: Any, args: list[Operand], law: str) -> list[Operand]:
        at, to = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        asked, consts, carry = args[:at], args[at:to], args[to:]
        while True:
            (more,) = self.closed(params["cond_jaxpr"], asked + carry, law)
            if not isinstance(more, Ref) and not more:
                return carry
            after = self.closed(params["body_jaxpr"], consts + carry, law)
            if isinstance(more, Ref):  # a loop of at most one turn is a selection
                (again,) = self.closed(params["cond_jaxpr"], asked + after, law)
                if isinstance(again, Ref) or again:
                    raise ValueError(refusal("while", law, "whose length depends on data"))
                return self.selected(more, after, carry, law)
            carry = after


def refusal(name: str, law: str, how: str = "") -> str:
    """Return the error message for a primitive that cannot be exported, and the fix."""
    reason = f"the primitive {name!r}{f' {how}' if how else ''} cannot be written as scalar code"
    return f"{law or 'the step'}: {reason}. Write the law with real scalars and loops of a fixed length."
