"""Write traced code as JavaScript: the step of a block, a function of arrays, a step inside a loop over samples."""

import importlib.resources
import json
import re
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple, SupportsFloat

import jax
import numpy as np

from ambjax.codegen.block import Number
from ambjax.codegen.emitter import traced as traced_into
from ambjax.codegen.primitives import OPS
from ambjax.codegen.program import PERIOD, STARTED, Location, Operand, Program, Ref, Statements
from ambjax.codegen.trace import Trace

# Functions that the rows of OPS use, and that `Math` lacks or defines differently. They treat NaN and the sign of 0 as
# JAX does. erf is a series whose terms have one sign, for |x| < 3; erfc a continued fraction, for x >= 1.
PRELUDE = (importlib.resources.files("ambjax.codegen.javascript") / "helpers.js").read_text(encoding="utf-8").strip()
# The definition of each by its name.
HELPERS = {text.split()[1]: text for text in re.split(r"\n(?=const )", PRELUDE)}
# For each helper, the other helpers that it calls.
NEEDS = {"erf": ("erfc",), "erfc": ("erf",)}


def script(traced: Trace, name: str) -> str:
    """Return JavaScript that defines the constant `name`, an object with the step of a block.

    `traced`: its trace in double precision.
    """
    block = traced.block
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
            *_helpers(traced),
            *_step(traced),
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


class ScriptStatements(Statements):
    """Nodes of a program as JavaScript."""

    def constant(self, x: Any) -> str:
        return ("true" if x else "false") if x.dtype.kind == "b" else js_constant(x)

    def statement(self, n: int) -> str:
        node = self.program.nodes[n]
        text = OPS[node.op].javascript.format(*map(self.operand, node.args))
        return f"const {self.names[n]} = {f'Math.fround({text})' if node.dtype == np.float32 else text};"


def _step(traced: Trace) -> list[str]:
    """Return the lines of the function `step`.

    It reads the parameters from the array `p` and the inputs from `x`, updates the states and the flag `started` in
    `s`, and writes the outputs into `y`.
    """
    count = len(traced.state)
    groups = [("params", "p", traced.parameters), ("input", "x", traced.inputs)]
    groups += [("state", "s", [x for x, _ in traced.state])]
    inputs = {Location(group, x.name): f"{array}[{k}]" for group, array, xs in groups for k, x in enumerate(xs)}
    inputs |= {PERIOD: "period", STARTED: f"(s[{count}] !== 0)"}
    text = ScriptStatements(traced.program, traced.order(), inputs.__getitem__)
    results = [(f"s[{k}]", after) for k, (_, after) in enumerate(traced.state)]
    old, given = text.assigned([*results, *((f"y[{k}]", x) for k, (_, x) in enumerate(traced.outputs))], "s[")
    bits = [f"({text.operand(bit)} ? {1 << k} : 0)" for k, (_, bit) in enumerate(traced.bits)]
    lines = [
        *text.body("// {law}"),
        *(f"const {name} = {value};" for value, name in old.items()),
        f"const started = {text.operand(traced.started)} ? 1 : 0;",
        f"const status = {' | '.join(bits)};",
        *(f"{place} = {value};" for place, value in given.items()),
        f"s[{count}] = started;",
        "return status;",
    ]
    comment = "// Computes one sample: updates s, writes y, returns the status bits."
    return [comment, "function step(p, s, x, y) {", *(f"  {line}" for line in lines), "}"]


def _helpers(traced: Trace) -> list[str]:
    """Return the definitions of the functions in HELPERS that the step uses, and of those that they call."""
    texts = {OPS[traced.program.nodes[n].op].javascript for n in traced.order()}
    used = [name for name in HELPERS if any(re.search(rf"(?<![.\w]){name}\(", text) for text in texts)]
    used += [more for name in used for more in NEEDS.get(name, ()) if more not in used]
    return [HELPERS[name] for name in used]


class Piece(NamedTuple):
    """A traced function: its program, and its arguments and results as pytrees whose leaves are operands."""

    program: Program
    arguments: Any
    results: Any


def piece_of(function: Callable[..., object], names: Sequence[str], arguments: Sequence[Any]) -> Piece:
    """Trace a function of pytrees of scalars.

    `names`: for each argument, the prefix of the JavaScript names of its leaves; "p" gives p0, p1, ...

    Raises ValueError for a primitive that is not scalar arithmetic.
    """
    program = Program()
    operands = []
    for name, argument in zip(names, arguments, strict=True):
        leaves, tree = jax.tree.flatten(argument)
        refs = [program.input(Location("page", f"{name}{n}"), np.asarray(x).dtype) for n, x in enumerate(leaves)]
        operands.append(jax.tree.unflatten(tree, refs))
    flat = traced_into(program, function, arguments, jax.tree.leaves(operands))
    tree = jax.tree.structure(jax.eval_shape(function, *arguments))
    return Piece(program, operands, jax.tree.unflatten(tree, flat))


def _statements(program: Program) -> ScriptStatements:
    """Return the nodes of a program as JavaScript. An input has the name of its location; node 7 is `v7` otherwise."""
    return ScriptStatements(program, range(len(program.nodes)), lambda location: location.name)


def function_source(piece: Piece, name: str, arrays: Sequence[str], results: object) -> str:
    """Return a JavaScript function `name(ARRAYS..., out)` that writes results into the array `out` and returns it.

    - `arrays`: for each argument of the traced function, the name of the JavaScript array that holds its leaves.
    - `results`: pytree of the operands to write.
    """
    script, roots = _statements(piece.program), jax.tree.leaves(results)
    needed = piece.program.needed(roots)
    lines = [f"function {name}({', '.join(arrays)}, out) {{"]
    for array, argument in zip(arrays, piece.arguments, strict=True):
        lines += [f"const {line}" for line in _loads(script, array, jax.tree.leaves(argument), needed)]
    lines += map(script.statement, piece.program.order(roots))
    lines += [f"out[{k}] = {script.operand(x)};" for k, x in enumerate(roots)]
    return "\n".join([*lines, "return out;", "}"])


def _loads(script: ScriptStatements, array: str, refs: Sequence[Ref], needed: Collection[int]) -> list[str]:
    """Return texts that read inputs from a JavaScript array: those of `refs` whose nodes are in `needed`."""
    lines = []
    for k, ref in enumerate(refs):
        if ref.node in needed:
            truth = " !== 0" if script.program.dtype(ref).kind == "b" else ""
            lines.append(f"{script.operand(ref)} = {array}[{k}]{truth};")
    return lines


def loop_source(piece: Piece, name: str, shown: Sequence[Operand], always: Sequence[Operand]) -> str:
    """Return a JavaScript function `name(P)` that returns `run(S, from, to, W, rows)`.

    - `piece`: the traced `LoopFunctions.step`.
    - `shown`: the operands that a row contains.
    - `always`: further results of the step, which no row contains. `run` updates a state only if an operand in `shown`
      or `always` depends on it, in the same sample or in a later one.

    `run` computes the samples `from` <= n < `to`. P: parameters. S: the state, which `run` updates. W: three standard
    normal random numbers per sample. `run` writes one row per sample into `rows`, unless `rows` is null. `name(P)`
    computes the values that depend only on parameters, once.
    """
    program, script = piece.program, _statements(piece.program)
    parameters, before = (jax.tree.leaves(x) for x in piece.arguments[:2])
    after = jax.tree.leaves(piece.results[0])
    kept = program.used(before, after, [*shown, *always])
    roots = [*shown, *(after[k] for k in kept)]
    order, needed = program.order(roots), program.needed(roots)
    fixed = program.fixed(order, [x.node for x in parameters])
    state = {k: script.operand(before[k]) for k in kept}
    lines = [f"function {name}(P) {{", *(f"const {line}" for line in _loads(script, "P", parameters, needed))]
    lines += [script.statement(n) for n in order if n in fixed]
    lines += ["return function run(S, from, to, W, rows) {"]
    lines += [f"let {line}" for line in _loads(script, "S", before, {before[k].node for k in kept})]
    lines += ["for (let n0 = from; n0 < to; n0++) {"]
    lines += [f"const {script.operand(x)} = W[3 * n0 + {k}];" for k, x in enumerate(piece.arguments[2])]
    lines += [script.statement(n) for n in order if n not in fixed]
    if shown:
        writes = [f"rows[at + {k}] = {script.operand(x)};" for k, x in enumerate(shown)]
        lines += ["if (rows !== null) {", f"const at = {len(shown)} * n0;", *writes, "}"]
    lines += [f"const t{k} = {script.operand(after[k])};" for k in kept]
    lines += [f"{text} = t{k};" for k, text in state.items()]
    lines += ["}", *(f"S[{k}] = {text};" for k, text in state.items()), "};", "}"]
    return "\n".join(lines)
