"""Write a traced step as JavaScript: an object with the function `step` and with names, units and values."""

import json
import re
from collections.abc import Mapping
from typing import SupportsFloat

import numpy as np

from ambjax.codegen.block import Block
from ambjax.codegen.numbering import Number
from ambjax.codegen.primitives import OPS
from ambjax.codegen.program import PERIOD, STARTED, Location, Operand, Program, Ref
from ambjax.codegen.trace import Trace, trace

# Functions that the rows of OPS use, and that `Math` lacks or defines differently. They treat NaN and the sign of 0 as
# JAX does.
HELPERS = {
    "max": "(a, b) => a > b || a !== a ? a : b",
    "min": "(a, b) => a < b || a !== a ? a : b",
    "pow": "(a, b) => a === 1 || (a === -1 && (b === Infinity || b === -Infinity)) ? 1 : Math.pow(a, b)",
    "roundAway": "x => {\n  const a = Math.abs(x), f = Math.floor(a), r = a - f >= 0.5 ? f + 1 : f;\n"
    "  return x > 0 ? r : x < 0 ? -r : x;\n}",
    "roundEven": "x => {\n  const big = 4503599627370496, a = Math.abs(x);\n"
    "  return x === 0 || !(a < big) ? x : x > 0 ? a + big - big : -(a + big - big);\n}",
    # erf: a series whose terms have one sign, for |x| < 3; erfc: a continued fraction, for x >= 1
    "erf": "x => {\n  const a = Math.abs(x);\n  if (!(a < 3)) return x !== x ? x : Math.sign(x) * (1 - erfc(a));\n"
    "  let term = x, sum = x;\n"
    "  for (let n = 1; n < 200; n++) { term *= 2 * x * x / (2 * n + 1); sum += term; }\n"
    "  return 2 / Math.sqrt(Math.PI) * Math.exp(-x * x) * sum;\n}",
    "erfc": "x => {\n  if (x !== x) return x;\n  if (x < 1) return 1 - erf(x);\n  if (x > 27) return 0;\n  let f = 0;\n"
    "  for (let n = 300; n > 0; n--) f = n / 2 / (x + f);\n"
    "  return Math.exp(-x * x) / Math.sqrt(Math.PI) / (x + f);\n}",
}
# For each helper, the other helpers that it calls.
NEEDS = {"erf": ("erfc",), "erfc": ("erf",)}


def script_of(block: Block, name: str) -> str:
    """Return JavaScript that defines the constant `name`, an object with the step of a block in double precision."""
    return script(trace(block, "double"), name)


def script(traced: Trace, name: str) -> str:
    """Return JavaScript that defines the constant `name` as in `script_of`. `traced`: a trace in double precision."""
    body, block = Body(traced), traced.block
    lists = {
        "parameters": traced.parameters,
        "states": [x for x, _ in traced.state],
        "inputs": traced.inputs,
        "outputs": [x for x, _ in traced.outputs],
    }
    bits = {bit: 1 << k for k, (bit, _) in enumerate(traced.bits)}
    return "\n".join(
        [
            f"const {name} = (() => {{",
            '"use strict";',
            f"const period = {js_constant(block.period)};",
            *body.helpers(),
            *body.step(),
            "return {",
            f"  noun: {_json(block.noun)}, period, step,",
            *(f"  {kind}: [\n{_entries(xs, kind, traced.read)}\n  ]," for kind, xs in lists.items()),
            f"  bits: {_json(bits)},",
            f"  values: () => Float64Array.of({', '.join(js_constant(x.value) for x in traced.parameters)}),",
            f"  start: () => new Float64Array({len(traced.state) + 1}),",
            "};",
            "})();",
            "",
        ]
    )


def js_constant(x: SupportsFloat) -> str:
    """Return a number as a JavaScript literal with the same value."""
    value = float(x)
    if np.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return "NaN" if np.isnan(value) else repr(value)


def _json(x: object) -> str:
    """Return a string or a mapping as a literal that is also safe inside a script element."""
    return json.dumps(x).replace("<", "\\u003c")


def _entries(numbers: list[Number], kind: str, read: frozenset[str]) -> str:
    """Return the entries of a list, one object per number. `kind`: name of the list."""
    rows = []
    for x in numbers:
        more = f", value: {js_constant(x.value)}, allowed: {_json(x.allowed)}" if kind == "parameters" else ""
        more += f", read: {_json(x.name in read)}" if kind == "inputs" else ""
        rows.append(f"    {{name: {_json(x.name)}, unit: {_json(x.unit)}, doc: {_json(x.doc)}{more}}},")
    return "\n".join(rows)


class Statements:
    """Nodes of a program as JavaScript. `names`: names of nodes by number. `inputs`: texts that read the inputs."""

    def __init__(self, program: Program, names: Mapping[int, str], inputs: Mapping[Location, str]) -> None:
        self.program, self.names, self.inputs = program, names, inputs

    def operand(self, x: Operand) -> str:
        """Return an operand as a JavaScript expression."""
        if isinstance(x, Ref):
            location = self.program.nodes[x.node].location
            return self.names[x.node] if location is None else self.inputs[location]
        if x.dtype.kind == "b":
            return "true" if x else "false"
        text = js_constant(x)
        return f"({text})" if text.startswith("-") else text

    def statement(self, n: int) -> str:
        """Return the declaration of the value of node `n`."""
        node = self.program.nodes[n]
        text = OPS[node.op].javascript.format(*map(self.operand, node.args))
        rounded = f"Math.fround({text})" if node.dtype == np.float32 else text
        return f"const {self.names[n]} = {rounded};"


class Body(Statements):
    """The step of a trace as JavaScript statements.

    The step reads the parameters from the array `p` and the inputs from `x`, updates the states and the flag `started`
    in `s`, and writes the outputs into `y`.
    """

    def __init__(self, traced: Trace) -> None:
        self.trace, self.order = traced, traced.order()
        groups = [("params", "p", traced.parameters), ("input", "x", traced.inputs)]
        groups += [("state", "s", [x for x, _ in traced.state])]
        inputs = {Location(group, x.name): f"{array}[{k}]" for group, array, xs in groups for k, x in enumerate(xs)}
        inputs |= {PERIOD: "period", STARTED: f"(s[{len(traced.state)}] !== 0)"}
        super().__init__(traced.program, {n: f"v{k}" for k, n in enumerate(self.order)}, inputs)

    def statements(self) -> list[str]:
        """Return all statements. A comment with the name of a law precedes the statements of that law."""
        lines, law = [], ""
        for n in self.order:
            if (node := self.program.nodes[n]).law != law:
                law = node.law
                lines.append(f"  // {re.sub(r'[^ -~]', '?', law) or 'the cascade'}")
            lines.append(f"  {self.statement(n)}")
        return lines

    def step(self) -> list[str]:
        """Return the lines of the function `step`."""
        given = [(f"s[{k}]", self.operand(after)) for k, (_, after) in enumerate(self.trace.state)]
        given += [(f"y[{k}]", self.operand(value)) for k, (_, value) in enumerate(self.trace.outputs)]
        # a state that is copied to another location is read before any state is written
        old = {value: f"old{k}" for k, value in enumerate(dict.fromkeys(v for _, v in given if v.startswith("s[")))}
        bits = [f"({self.operand(bit)} ? {1 << k} : 0)" for k, (_, bit) in enumerate(self.trace.bits)]
        started = f"const started = {self.operand(self.trace.started)} ? 1 : 0;"
        return [
            "// Computes one sample: updates s, writes y, returns the status bits.",
            "function step(p, s, x, y) {",
            *self.statements(),
            *(f"  const {name} = {value};" for value, name in old.items()),
            f"  {started}",
            f"  const status = {' | '.join(bits)};",
            *(f"  {place} = {old.get(value, value)};" for place, value in given),
            f"  s[{len(self.trace.state)}] = started;",
            "  return status;",
            "}",
        ]

    def helpers(self) -> list[str]:
        """Return the definitions of the functions in HELPERS that the step uses, and of those that they call."""
        texts = {OPS[self.program.nodes[n].op].javascript for n in self.order}
        used = [name for name in HELPERS if any(re.search(rf"(?<![.\w]){name}\(", text) for text in texts)]
        used += [more for name in used for more in NEEDS.get(name, ()) if more not in used]
        return [f"const {name} = {HELPERS[name]};" for name in used]
