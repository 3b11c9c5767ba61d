"""Write a program as C statements, one per node."""

import re
from typing import SupportsFloat

import numpy as np

from ambjax.codegen.primitives import OPS
from ambjax.codegen.program import PERIOD, PRECISIONS, STARTED, Operand, Program, Ref

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
HELPERS = {"max": "a > b || a != a ? a : b", "min": "a < b || a != a ? a : b", "sign": "a > 0 ? 1 : a < 0 ? -1 : a"}
SAMPLE_PERIOD = "SAMPLE_PERIOD"


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


class Statements:
    """C statements for some nodes of a program. `order`: the numbers of these nodes, in order.

    `precision`: type of the numbers. `prefix`: prefix of the names of types and functions.
    """

    def __init__(self, program: Program, order: list[int], precision: str, prefix: str) -> None:
        self.program, self.order, self.precision, self.prefix = program, order, precision, prefix
        self.number = {n: k for k, n in enumerate(order)}
        self.real = np.dtype(PRECISIONS[precision])

    def operand(self, x: Operand) -> str:
        """Return an operand as C text."""
        if isinstance(x, Ref):
            node = self.program.nodes[x.node]
            if node.op != "input":
                return f"v{self.number[x.node]}"
            location = node.location
            assert location is not None  # of an input
            if location == PERIOD:
                return f"{self.prefix}_{SAMPLE_PERIOD}"
            return "(state->started != 0u)" if location == STARTED else f"{location.group}->{word(location.name)}"
        if x.dtype.kind in "biu":
            return str(int(x))
        text = c_constant(x, "float" if x.dtype == np.float32 else "double")
        return f"({text})" if text.startswith("-") else text

    def kind(self, dtype: np.dtype) -> str:
        """Return the C type of a dtype."""
        if dtype.kind in "biu":
            return "int"
        return f"{self.prefix}_real" if dtype == self.real else "float"

    def statement(self, number: int) -> str:
        """Return one node as a declaration."""
        node = self.program.nodes[number]
        single = self.precision == "float" or any(self.program.dtype(x) == np.float32 for x in node.args)
        text = OPS[node.op].c99.format(
            *map(self.operand, node.args),
            name=self.prefix,
            f="f" if single else "",
            to=self.kind(node.dtype),
            one=c_constant(1, "float" if node.dtype == np.float32 else "double"),
            zero=c_constant(0, "float" if node.dtype == np.float32 else "double"),
        )
        return f"    const {self.kind(node.dtype)} v{self.number[number]} = {text};"

    def body(self) -> list[str]:
        """Return all statements; those of each law follow a comment with its name."""
        lines, law = [], ""
        for number in self.order:
            node = self.program.nodes[number]
            if node.law != law:
                law = node.law
                lines.append(f"    /* {law or 'the cascade'} */")
            lines.append(self.statement(number))
        return lines

    def helpers(self) -> list[str]:
        """Return the functions that the step uses and C lacks. They treat NaN as JAX does."""
        used = {self.program.nodes[n].op for n in self.order}
        real, lines = f"{self.prefix}_real", []
        for name, text in HELPERS.items():
            if name in used:
                taken = f"{real} a" if name == "sign" else f"{real} a, {real} b"
                for digit in ("0", "1"):
                    text = re.sub(rf"(?<![\w.]){digit}(?![\w.])", c_constant(float(digit), self.precision), text)
                lines += [f"static {real} {self.prefix}_{name}({taken})", "{", f"    return {text};", "}", ""]
        return lines
