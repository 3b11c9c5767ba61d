"""Write a program as C statements, one per node."""

import re
from collections.abc import Sequence
from typing import Any, SupportsFloat

import numpy as np

from ambjax.codegen.primitives import OPS
from ambjax.codegen.program import PERIOD, PRECISIONS, STARTED, Location, Program, Statements

# Keywords of C or C++ that are valid names in Python.
RESERVED = {
    *("auto", "bool", "case", "catch", "char", "const", "constexpr", "default", "delete", "do", "double", "enum"),
    *("explicit", "export", "extern", "float", "friend", "goto", "inline", "int", "long", "mutable", "namespace"),
    *("new", "operator", "private", "protected", "public", "register", "restrict", "short", "signed", "sizeof"),
    *("static", "struct", "switch", "template", "this", "throw", "typedef", "typename", "union", "unsigned", "using"),
    *("virtual", "void", "volatile", "alignas", "alignof", "char8_t", "char16_t", "char32_t", "concept", "consteval"),
    *("constexpr", "constinit", "const_cast", "co_await", "co_return", "co_yield", "decltype", "dynamic_cast"),
    *("noexcept", "nullptr", "reinterpret_cast", "requires", "static_assert", "static_cast", "thread_local", "true"),
    *("false", "typeid", "wchar_t", "asm", "compl", "bitand", "bitor", "and_eq", "or_eq", "xor_eq", "not_eq", "xor"),
}
HELPERS = {
    "max": "a > b || a != a ? a : b",
    "min": "a < b || a != a ? a : b",
    "sign": "a > {zero} ? {one} : a < {zero} ? -{one} : a",
}


def word(name: str) -> str:
    """Return a dotted name whose parts are valid C names: in ASCII, and no keywords. The dots are kept."""
    parts = [part + "_" if part in RESERVED else part for part in name.split(".")]
    return ".".join(re.sub(r"[^\x00-\x7f]", lambda found: f"_u{ord(found[0]):04x}", part) for part in parts)


def c_constant(x: SupportsFloat, precision: str) -> str:
    """Return a number as a C constant of a precision: the shortest text with the same value."""
    suffix, kind = ("f", np.float32) if precision == "float" else ("", np.float64)
    value = kind(x)
    if np.isinf(value):
        return ("-" if value < 0 else "") + ("HUGE_VALF" if suffix else "HUGE_VAL")
    if np.isnan(value):
        return "NAN" if suffix else "(double)NAN"
    text = str(value)
    return text + ("" if "." in text or "e" in text else ".0") + suffix


class CStatements(Statements):
    """Nodes of a program as C.

    `precision`: type of the numbers. `prefix`: prefix of the names of types and functions.
    """

    def __init__(self, program: Program, order: Sequence[int], precision: str, prefix: str) -> None:
        super().__init__(program, order, self._read)
        self.precision, self.prefix, self.real = precision, prefix, np.dtype(PRECISIONS[precision])

    def _read(self, location: Location) -> str:
        if location == PERIOD:
            return f"{self.prefix}_SAMPLE_PERIOD"
        return "(state->started != 0u)" if location == STARTED else f"{location.group}->{word(location.name)}"

    def constant(self, x: Any) -> str:
        return str(int(x)) if x.dtype.kind in "biu" else c_constant(x, _type(x.dtype))

    def kind(self, dtype: np.dtype) -> str:
        if dtype.kind in "biu":
            return "int"
        return f"{self.prefix}_real" if dtype == self.real else "float"

    def statement(self, n: int) -> str:
        node = self.program.nodes[n]
        single = self.precision == "float" or any(self.program.dtype(x) == np.float32 for x in node.args)
        text = OPS[node.op].c99.format(
            *map(self.operand, node.args),
            name=self.prefix,
            f="f" if single else "",
            to=self.kind(node.dtype),
            one=c_constant(1, _type(node.dtype)),
            zero=c_constant(0, _type(node.dtype)),
        )
        return f"    const {self.kind(node.dtype)} {self.names[n]} = {text};"

    def helpers(self) -> list[str]:
        """Return the functions that the step uses and C lacks. They treat NaN as JAX does."""
        used = {self.program.nodes[n].op for n in self.order}
        real, lines = f"{self.prefix}_real", []
        zero, one = (c_constant(x, self.precision) for x in (0, 1))
        for name, text in HELPERS.items():
            if name in used:
                taken = f"{real} a" if name == "sign" else f"{real} a, {real} b"
                text = text.format(zero=zero, one=one)
                lines += [f"static {real} {self.prefix}_{name}({taken})", "{", f"    return {text};", "}", ""]
        return lines


def _type(dtype: np.dtype) -> str:
    return "float" if dtype == np.float32 else "double"
