"""Write the header and the source of a traced step as C."""

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ambjax._version import __version__
from ambjax.codegen.c99.notes import ABOUT, notes_of
from ambjax.codegen.c99.statements import Statements, c_constant, word
from ambjax.codegen.c99.texts import MARK, filled
from ambjax.codegen.numbering import UNREAD, Number
from ambjax.codegen.trace import Trace

SLACK = 256  # bytes of a stack frame in addition to its numbers: saved registers, padding


class Origin(NamedTuple):
    """The origin of a block: name of the case, SHA-256 of its file ('' if it has none), and the block in words."""

    case: str
    digest: str
    parts: Sequence[str]


class Writer:
    """A traced step as C text. All global names begin with `prefix`, some in capitals."""

    def __init__(self, trace: Trace, prefix: str, origin: Origin) -> None:
        self.trace, self.prefix, self.origin = trace, prefix, origin
        self.text = Statements(trace.program, trace.order(), trace.precision, prefix)

    # --- numbers in structs ---

    def struct(self, kind: str, numbers: Iterable[Number], more: Sequence[str] = ()) -> str:
        """Return the definition of a struct of numbers; a dotted name becomes a struct within it."""
        lines, open_ = ["typedef struct {"], ""
        for x in numbers:
            outer, _, name = word(x.name).rpartition(".")
            lines += self._opened(open_, outer)
            open_ = outer
            indent = "    " * (1 + (outer.count(".") + 1 if outer else 0))
            details = ", ".join(filter(None, (x.unit, x.allowed)))
            note = " ".join(filter(None, (f"[{details}]" if details else "", x.doc)))
            lines.append(f"{indent}{self.prefix}_real {name};{f' /* {note} */' if note else ''}")
        lines += [*self._opened(open_, ""), *(f"    {line}" for line in more), f"}} {self.prefix}_{kind};"]
        return "\n".join(lines)

    def _opened(self, now: str, then: str) -> list[str]:
        """Return the lines that close the struct `now` and open `then`."""
        a, b = now.split(".") if now else [], then.split(".") if then else []
        same = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
        closed = ["    " * (k + 1) + f"}} {a[k]};" for k in reversed(range(same, len(a)))]
        return closed + ["    " * (k + 1) + "struct {" for k in range(same, len(b))]

    def values(self, numbers: Sequence[Number]) -> str:
        """Return the numbers as an initialiser of their struct, in the lines of a macro, with names in comments."""
        tree: dict[str, Any] = {}
        for x in numbers:
            *outer, name = word(x.name).split(".")
            functools.reduce(lambda node, key: node.setdefault(key, {}), outer, tree)[name] = x.value

        def lines(node: dict[str, Any], depth: int) -> Iterator[str]:
            yield "{"
            for k, (name, value) in enumerate(node.items()):
                inner = (
                    lines(value, depth + 1) if isinstance(value, dict) else [c_constant(value, self.trace.precision)]
                )
                text = f" \\\n{'    ' * depth}".join(inner)
                yield f"    /* {name} */ {text}{',' if k < len(node) - 1 else ''}"
            yield "}"

        return " \\\n".join(lines(tree, 1))

    # --- the step ---

    def step(self) -> str:
        """Return the step as a C function."""
        p, trace = self.prefix, self.trace
        lines = [self.signature("step"), "{", "    uint32_t status = 0u;", *self.text.body()]
        given = [(f"state->{word(x.name)}", self.text.operand(after)) for x, after in trace.state]
        given += [(f"output->{word(x.name)}", self.text.operand(value)) for x, value in trace.outputs]
        # state that is copied to another place is read before it is written
        read = dict.fromkeys(value for _, value in given if value.startswith("state->"))
        old = {value: f"old{k}" for k, value in enumerate(read)}
        lines += [f"    const {p}_real {name} = {value};" for value, name in old.items()]
        lines += [f"    {name} = {old.get(value, value)};" for name, value in given]
        lines += [f"    state->started = {self.text.operand(trace.started)} ? 1u : 0u;"]
        for name, value in trace.bits:
            lines += [f"    if ({self.text.operand(value)}) {{", f"        status |= {p}_{name.upper()};", "    }"]
        return "\n".join([*lines, "    return status;", "}"])

    def signature(self, function: str) -> str:
        """Return the first line of a function."""
        p = self.prefix
        if function != "step":
            return f"void {p}_{function}({p}_state *state)"
        return (
            f"uint32_t {p}_step(const {p}_params *params, {p}_state *state, const {p}_input *input, {p}_output *output)"
        )

    def source(self) -> str:
        """Return the source file, PREFIX.c."""
        zeros = [f"    state->{word(x.name)} = {c_constant(0, self.trace.precision)};" for x, _ in self.trace.state]
        return filled(
            "source.c",
            p=self.prefix,
            P=self.prefix.upper(),
            banner=self.banner(f"{self.prefix}.c"),
            helpers="".join(f"{line}\n" for line in self.text.helpers()),
            zeros="".join(f"{line}\n" for line in zeros),
            forgotten="".join(f"{line}\n" for line in zeros if line.strip().startswith("state->watch.left")),
            body=self.step(),
            **{name: self.signature(name) for name in ("init", "reset")},
        )

    def banner(self, file: str) -> str:
        """Return the first comment of a file: its contents and its origin."""
        lines = [
            f"{file}: the {self.trace.block.noun} of case '{self.origin.case}' as C99, written by ambjax {__version__}."
        ]
        lines += [MARK.format(p=self.prefix)]
        lines += [f"SHA-256 of the case: {self.origin.digest}"] if self.origin.digest else []
        return "/* " + "\n * ".join(lines) + " */"

    # --- the header ---

    def header(self) -> str:
        """Return the header file, PREFIX.h."""
        p, t = self.prefix, self.trace
        inputs = [x._replace(allowed="" if x.name in t.read else UNREAD) for x in t.inputs]
        return filled(
            "header.h",
            p=p,
            P=p.upper(),
            banner=self.banner(f"{p}.h"),
            notes="\n".join(f" * {line}".rstrip() for line in self.notes()),
            real=t.precision,
            maths="#include <math.h>\n" if any(np.isinf(x.value) for x in t.parameters) else "",
            period=c_constant(t.block.period, t.precision),
            bits="\n".join(
                f"#define {p}_{x.upper()} {1 << k}u /* {t.block.bits[x]} */" for k, (x, _) in enumerate(t.bits)
            ),
            params=self.struct("params", t.parameters),
            state=self.struct(
                "state", [x for x, _ in t.state], [f"uint32_t started; /* {ABOUT[t.block.noun].started} */"]
            ),
            input=self.struct("input", inputs),
            output=self.struct("output", [x for x, _ in t.outputs]),
            gains=self.values(t.parameters),
            about=ABOUT[t.block.noun],
            **{name: self.signature(name) for name in ("init", "step", "reset")},
        )

    def notes(self) -> list[str]:
        """Return the description in the header: parts, order of operations, what the export fixes, cost."""
        t, counts = self.trace, self.trace.counts()
        size = 4 if t.precision == "float" else 8
        cost = ", ".join(f"{counts[name]} {words}" for name, words in COSTS.items() if counts[name])
        stack = len(self.text.order) * size + SLACK
        return [
            *self.origin.parts,
            "",
            *notes_of(t),
            "",
            f"A step: {t.flops()} flops. {cost}.",
            f"State: {t.state_bytes()} bytes. Stack: at most {stack} bytes, if every intermediate number is kept.",
            "Compile with -ffp-contract=off: a fused multiply-add rounds once where the simulator rounds twice.",
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
