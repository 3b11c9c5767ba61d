"""The C of a traced step: header and source."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ambjax._version import __version__
from ambjax.export.controller import BITS, Number
from ambjax.export.emitter import Node, Operand, Ref
from ambjax.export.primitives import OPS
from ambjax.export.trace import PERIOD, Trace

# Words that C or C++ keep for themselves and Python does not.
RESERVED = set(
    "auto bool case catch char const constexpr default delete do double enum explicit export extern float friend goto "
    "inline int long mutable namespace new operator private protected public register restrict short signed sizeof "
    "static struct switch template this throw typedef typename union unsigned using virtual void volatile".split()
)
HELPERS = {
    "max": "a > b || a != a ? a : b",
    "min": "a < b || a != a ? a : b",
    "sign": "a > 0 ? 1 : a < 0 ? -1 : a",
}
SLACK = 256  # bytes of a stack frame beside its numbers: registers saved, padding


class Origin(NamedTuple):
    """Where a controller is from: name of the case, SHA-256 of its file, and the cascade in words."""

    case: str
    digest: str
    cascade: Sequence[str]


def word(name: str) -> str:
    """A dotted name as C has it: none of its keywords, ASCII."""
    parts = [part + "_" if part in RESERVED else part for part in name.split(".")]
    return ".".join(re.sub(r"[^\x00-\x7f]", lambda found: f"_u{ord(found[0]):04x}", part) for part in parts)


def literal(x: Any, precision: str) -> str:
    """A number as a C constant of a precision: the shortest that reads back as it."""
    suffix, kind = ("f", np.float32) if precision == "float" else ("", np.float64)
    value = kind(x)
    if np.isinf(value):
        return ("-" if value < 0 else "") + ("HUGE_VALF" if suffix else "HUGE_VAL")
    if np.isnan(value):
        return "NAN" if suffix else "(double)NAN"
    text = str(value)
    return text + ("" if "." in text or "e" in text else ".0") + suffix


class Writer:
    """A traced step as text, all names beginning with `prefix`."""

    def __init__(self, trace: Trace, prefix: str, origin: Origin):
        self.trace, self.prefix, self.origin = trace, prefix, origin
        self.order = trace.order()
        self.number = {n: k for k, n in enumerate(self.order)}

    # --- numbers in structs ---

    def struct(self, kind: str, numbers: Iterable[Number], more: Sequence[str] = ()) -> str:
        """A struct of numbers, dotted names as structs within it."""
        lines, open_ = ["typedef struct {"], ""
        for x in numbers:
            outer, _, name = word(x.name).rpartition(".")
            lines += self._opened(open_, outer)
            open_ = outer
            told = ", ".join(filter(None, (x.unit, x.allowed)))
            note = " ".join(filter(None, (f"[{told}]" if told else "", x.doc)))
            lines.append(f"{self._indent(outer)}{self.prefix}_real {name};{f' /* {note} */' if note else ''}")
        lines += [*self._opened(open_, ""), *(f"    {line}" for line in more), f"}} {self.prefix}_{kind};"]
        return "\n".join(lines)

    @staticmethod
    def _indent(outer: str) -> str:
        return "    " * (1 + (outer.count(".") + 1 if outer else 0))

    def _opened(self, now: str, then: str) -> list[str]:
        """Lines that leave the struct `now` and enter `then`."""
        a, b = now.split(".") if now else [], then.split(".") if then else []
        same = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
        closed = ["    " * (k + 1) + f"}} {a[k]};" for k in reversed(range(same, len(a)))]
        return closed + ["    " * (k + 1) + "struct {" for k in range(same, len(b))]

    # --- the step ---

    def operand(self, x: Operand) -> str:
        """An operand as C text."""
        if isinstance(x, Ref):
            node = self.trace.program.nodes[x.node]
            if node.op != "input":
                return f"v{self.number[x.node]}"
            if node.text == PERIOD:
                return f"{self.prefix}_{PERIOD}"
            head, _, name = node.text.partition("->")
            text = f"{head}->{word(name)}"
            return f"({text} != 0u)" if node.dtype.kind == "b" else text
        if x.dtype.kind == "b":
            return str(int(x))
        text = literal(x, "float" if x.dtype == np.float32 else "double")
        return f"({text})" if text.startswith("-") else text

    def kind(self, dtype: np.dtype) -> str:
        """C type of a dtype."""
        if dtype.kind == "b":
            return "int"
        return f"{self.prefix}_real" if dtype == self.real else "float"

    @property
    def real(self) -> np.dtype:
        """Dtype of the numbers."""
        return np.dtype("float32" if self.trace.precision == "float" else "float64")

    def statement(self, number: int) -> str:
        """One node as a declaration."""
        node: Node = self.trace.program.nodes[number]
        single = self.trace.precision == "float" or any(
            self.trace.program.dtype(x) == np.float32 for x in node.args
        )
        text = OPS[node.op].c.format(
            *map(self.operand, node.args),
            name=self.prefix,
            f="f" if single else "",
            to=self.kind(node.dtype),
            one=literal(1, "float" if node.dtype == np.float32 else "double"),
            zero=literal(0, "float" if node.dtype == np.float32 else "double"),
        )
        return f"    const {self.kind(node.dtype)} v{self.number[number]} = {text};"

    def body(self) -> list[str]:
        """All statements, those of a law below its name."""
        lines, law = [], ""
        for number in self.order:
            node = self.trace.program.nodes[number]
            if node.law != law:
                law = node.law
                lines.append(f"    /* {law or 'the cascade'} */")
            lines.append(self.statement(number))
        return lines

    def step(self) -> str:
        """The step as a function."""
        p, trace = self.prefix, self.trace
        lines = [self.signature("step"), "{", f"    uint32_t status = 0u;", *self.body()]
        lines += [f"    state->{word(x.name)} = {self.operand(after)};" for x, after in trace.state]
        lines += [f"    state->started = {self.operand(trace.started)} ? 1u : 0u;"]
        lines += [f"    output->{word(x.name)} = {self.operand(value)};" for x, value in trace.outputs]
        for name, value in trace.bits:
            lines += [f"    if ({self.operand(value)}) {{", f"        status |= {p}_{name.upper()};", "    }"]
        return "\n".join([*lines, "    return status;", "}"])

    def signature(self, function: str) -> str:
        """First line of a function."""
        p = self.prefix
        if function != "step":
            return f"void {p}_{function}({p}_state *state)"
        return (
            f"uint32_t {p}_step(const {p}_params *params, {p}_state *state, const {p}_input *input, "
            f"{p}_output *output)"
        )

    def helpers(self) -> list[str]:
        """Functions that the step uses and C has not: as JAX has them, NaN included."""
        used = {self.trace.program.nodes[n].op for n in self.order}
        real, lines = f"{self.prefix}_real", []
        for name, text in HELPERS.items():
            if name in used:
                taken = f"{real} a" if name == "sign" else f"{real} a, {real} b"
                for digit in ("0", "1"):
                    text = re.sub(rf"(?<![\w.]){digit}(?![\w.])", literal(float(digit), self.trace.precision), text)
                lines += [f"static {real} {self.prefix}_{name}({taken})", "{", f"    return {text};", "}", ""]
        return lines

    def source(self) -> str:
        """NAME.c."""
        p, trace = self.prefix, self.trace
        lines = [self.banner(f"{p}.c"), "", f'#include "{p}.h"', "", "#include <math.h>", ""]
        lines += ["#ifdef __FAST_MATH__", "#error \"NaN must be seen: compile without -ffast-math\"", "#endif", ""]
        lines += [*self.helpers(), f"const {p}_params {p}_default = {p.upper()}_DEFAULT;", ""]
        lines += [self.signature("init"), "{"]
        lines += [f"    state->{word(x.name)} = {literal(0, trace.precision)};" for x, _ in trace.state]
        lines += ["    state->started = 0u;", "}", "", self.signature("reset"), "{", "    state->started = 0u;", "}", ""]
        return "\n".join([*lines, self.step(), ""])

    def banner(self, file: str) -> str:
        """First lines of a file: what it is, and where it is from."""
        lines = [f"{file}: the controller of case '{self.origin.case}' as C99, written by ambjax {__version__}."]
        lines += ["Generated: change the case and export it again.", f"SHA-256 of the case: {self.origin.digest}"]
        return "/* " + "\n * ".join(lines) + " */"

    # --- the header ---

    def header(self) -> str:
        """NAME.h."""
        p, t = self.prefix, self.trace
        guard = f"{p.upper()}_H"
        period = literal(t.controller.period, t.precision)
        bits = [
            f"#define {p}_{name.upper()} {1 << k}u /* {BITS[name]} */" for k, (name, _) in enumerate(t.bits)
        ]
        inputs = [x._replace(allowed="" if x.name in t.read else "not read") for x in t.inputs]
        state = [x for x, _ in t.state]
        lines = [self.banner(f"{p}.h"), "", "/* " + "\n * ".join(self.told()) + "\n */", ""]
        lines += [f"#ifndef {guard}", f"#define {guard}", "", "#include <stdint.h>", ""]
        lines += ["#ifdef __cplusplus", 'extern "C" {', "#endif", "", f"typedef {t.precision} {p}_real;", ""]
        lines += [f"/* s; a step is made for this period and no other */", f"#define {p}_{PERIOD} {period}", ""]
        lines += ["/* bits that a step returns */", *bits, ""]
        lines += ["/* gains, the model's numbers and limits: [unit, what is allowed] meaning */", self.struct("params", t.parameters), ""]
        lines += ["/* what a step keeps for the next */", self.struct("state", state, ["uint32_t started; /* 0: the next good input begins */"]), ""]
        lines += ["/* what a step reads; each within its limit in params->limits */", self.struct("input", inputs), ""]
        lines += ["/* what a step gives */", self.struct("output", [x for x, _ in t.outputs]), ""]
        gains = [f"    .{word(x.name)} = {literal(x.value, t.precision)}" for x in t.parameters]
        lines += ["/* the case's numbers */", f"#define {p.upper()}_DEFAULT {{ \\", ", \\\n".join(gains) + " \\", "}", ""]
        lines += [f"extern const {p}_params {p}_default;", ""]
        lines += ["/* Before the first step: no voltage, laws without a state. */", self.signature("init") + ";", ""]
        lines += ["/* One sample. Returns the bits above. */", self.signature("step") + ";", ""]
        lines += ["/* Laws begin anew with the next good input; the voltages that are on their way stay known. */", self.signature("reset") + ";", ""]
        return "\n".join([*lines, "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""])

    def told(self) -> list[str]:
        """The header's own words: cascade, order of work, cost."""
        t, counts = self.trace, self.trace.counts()
        size = 4 if t.precision == "float" else 8
        reals = len(t.state)
        kept = -(-(reals * size + 4) // size) * size
        order = "\n".join(order_of_work(t)).splitlines()
        cost = ", ".join(f"{counts[name]} {words}" for name, words in COSTS.items() if counts[name])
        stack = len(self.order) * size + SLACK
        return [
            *self.origin.cascade,
            "",
            *order,
            "",
            f"A step: {t.flops()} flops. {cost}.",
            f"State: {kept} bytes. Stack: at most {stack} bytes, were every intermediate kept.",
            "Compile with -ffp-contract=off: a fused product rounds once where the simulator rounds twice.",
        ]


COSTS = {
    "add": "additions",
    "multiply": "multiplications",
    "divide": "divisions",
    "root": "square roots",
    "call": "calls of math.h",
    "comparison": "comparisons and choices",
    "sign": "changes of sign",
    "conversion": "conversions",
    "logic": "logical operations",
}


def order_of_work(trace: Trace) -> list[str]:
    """What is done when, in words."""
    controller = trace.controller
    processor: Any = controller.parameters.controller.processor
    delay = processor.delay
    lines = [
        f"Every {controller.period:g} s: read the sensors, call the step at once, and let output->u act",
        f"{delay:g} samples after the reading, until that of the next sample takes its place; before the first, 0 V.",
    ]
    ahead = f"reading + {delay:g} samples" if processor.predict else "reading"
    lines.append(f"The reference is that of the instant of the {ahead}.")
    return lines
