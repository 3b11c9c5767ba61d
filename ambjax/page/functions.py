"""Write traced functions as JavaScript: a function of arrays, or a step inside a loop over samples."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.codegen.emitter import traced
from ambjax.codegen.javascript.script import HELPERS, Statements
from ambjax.codegen.program import Location, Operand, Program, Ref

# JavaScript definitions of the functions that the generated code calls, and that `Math` lacks or defines differently.
PRELUDE = "\n".join(f"const {name} = {text};" for name, text in HELPERS.items())


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
    flat = traced(program, function, arguments, jax.tree.leaves(operands, is_leaf=_is_ref))
    tree = jax.tree.structure(jax.eval_shape(function, *arguments))
    return Piece(program, operands, jax.tree.unflatten(tree, flat))


def _is_ref(x: object) -> bool:
    return isinstance(x, Ref)


def operands_of(tree: object) -> list[Any]:
    """Return the operands in a pytree. A Ref is a pytree itself, but counts as one operand."""
    return jax.tree.leaves(tree, is_leaf=_is_ref)


def _statements(program: Program) -> Statements:
    """Return the nodes of a program as JavaScript. An input has the name of its location; node 7 is `v7` otherwise."""
    locations = [node.location for node in program.nodes if node.location]
    return Statements(program, {n: f"v{n}" for n in range(len(program.nodes))}, {x: x.name for x in locations})


def _fixed(program: Program, order: Sequence[int], given: Sequence[Operand]) -> set[int]:
    """Return the nodes of `order` that depend only on the inputs `given` and on constants."""
    known = {x.node for x in given if isinstance(x, Ref)}
    fixed = set()
    for n in order:
        if all(x.node in known for x in program.nodes[n].args if isinstance(x, Ref)):
            known.add(n)
            fixed.add(n)
    return fixed


def function_source(piece: Piece, name: str, arrays: Sequence[str], results: object) -> str:
    """Return a JavaScript function `name(ARRAYS..., out)` that writes results into the array `out` and returns it.

    - `arrays`: for each argument of the traced function, the name of the JavaScript array that holds its leaves.
    - `results`: pytree of the operands to write.
    """
    script, roots = _statements(piece.program), operands_of(results)
    needed = piece.program.needed(roots)
    lines = [f"function {name}({', '.join(arrays)}, out) {{"]
    for array, argument in zip(arrays, piece.arguments, strict=True):
        lines += _loads(piece.program, array, operands_of(argument), needed)
    lines += map(script.statement, piece.program.order(roots))
    lines += [f"out[{k}] = {script.operand(x)};" for k, x in enumerate(roots)]
    return "\n".join([*lines, "return out;", "}"])


def _loads(program: Program, array: str, refs: Sequence[Ref], needed: set[int]) -> list[str]:
    """Return declarations that read inputs from a JavaScript array: those of `refs` that are in `needed`."""
    lines = []
    for k, ref in enumerate(refs):
        if ref.node in needed:
            lines.append(f"const {_name(program, ref)} = {array}[{k}]{_truth(program, ref)};")
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
    parameters, before = operands_of(piece.arguments[0]), operands_of(piece.arguments[1])
    after = operands_of(piece.results[0])
    kept = program.used(before, after, [*shown, *always])
    roots = [*shown, *(after[k] for k in kept)]
    order, needed = program.order(roots), program.needed(roots)
    fixed = _fixed(program, order, parameters)
    normals = [_name(program, x) for x in piece.arguments[2]]
    lines = [f"function {name}(P) {{", *_loads(program, "P", parameters, needed)]
    lines += [script.statement(n) for n in order if n in fixed]
    lines += ["return function run(S, from, to, W, rows) {"]
    lines += [f"let {_name(program, before[k])} = S[{k}]{_truth(program, before[k])};" for k in kept]
    lines += ["for (let n0 = from; n0 < to; n0++) {"]
    lines += [f"const {text} = W[3 * n0 + {k}];" for k, text in enumerate(normals)]
    lines += [script.statement(n) for n in order if n not in fixed]
    if shown:
        writes = [f"rows[at + {k}] = {script.operand(x)};" for k, x in enumerate(shown)]
        lines += ["if (rows !== null) {", f"const at = {len(shown)} * n0;", *writes, "}"]
    lines += [f"const t{k} = {script.operand(after[k])};" for k in kept]
    lines += [f"{_name(program, before[k])} = t{k};" for k in kept]
    lines += ["}", *(f"S[{k}] = {_name(program, before[k])};" for k in kept), "};", "}"]
    return "\n".join(lines)


def _name(program: Program, x: Ref) -> str:
    """Return the JavaScript name of an input."""
    location = program.nodes[x.node].location
    assert location is not None
    return location.name


def _truth(program: Program, x: Ref) -> str:
    """Return the text that converts a number of an array to a boolean if the input `x` is boolean; else ''."""
    return " !== 0" if program.nodes[x.node].dtype.kind == "b" else ""
