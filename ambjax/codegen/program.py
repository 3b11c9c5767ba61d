"""Straight-line scalar code, and its statements: a node per operation, equal expressions shared, constants folded.

A node that no other node or result uses is not written. A constant is a NumPy scalar, and so is any expression of
constants.
"""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from ambjax.codegen.primitives import OPS

# Largest number of operations of a step. A longer step comes from an unrolled loop that is too long for a processor.
MOST = 40_000
PRECISIONS = {"float": "float32", "double": "float64"}


@dataclasses.dataclass(frozen=True, slots=True)
class Ref:
    """Operand: the node with this number."""

    node: int


# A node, or a constant: a NumPy scalar, which the types of NumPy take for an array.
Operand: TypeAlias = Ref | np.ndarray | np.number | np.bool_


class Location(NamedTuple):
    """Where an input of a program is read: a group and the dotted name of a number in it.

    The groups are params, state and input; `STARTED` is the flag of the state and `PERIOD` the sample period.
    """

    group: str
    name: str = ""


STARTED, PERIOD = Location("started"), Location("period")


class Node(NamedTuple):
    """One operation: its name in OPS, or `input` with the location that it reads; its dtype and its law."""

    op: str
    args: tuple[Operand, ...]
    dtype: np.dtype
    law: str = ""
    location: Location | None = None


class Program:
    """Nodes in order of computation."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[Any, Ref] = {}

    def input(self, location: Location, dtype: npt.DTypeLike) -> Ref:
        """Add an input node, which reads `location`."""
        self.nodes.append(Node("input", (), np.dtype(dtype), location=location))
        return Ref(len(self.nodes) - 1)

    def dtype(self, x: Operand) -> np.dtype:
        return self.nodes[x.node].dtype if isinstance(x, Ref) else x.dtype

    def apply(self, op: str, args: Sequence[Operand], dtype: npt.DTypeLike, law: str) -> Operand:
        """Return the result of an operation: one of `args`, a constant, an existing equal node, or a new node.

        Raises ValueError if the program would have more than MOST nodes.
        """
        dtype, args = np.dtype(dtype), tuple(args)
        if (known := _simpler(op, args)) is not None:
            return known
        if not any(isinstance(x, Ref) for x in args):
            with np.errstate(all="ignore"):
                return np.asarray(OPS[op].numpy(*args)).astype(dtype)[()]
        order = sorted(map(_key, args)) if OPS[op].commutes else list(map(_key, args))
        key = (op, dtype, *order)
        if key not in self._known:
            if len(self.nodes) >= MOST:
                raise ValueError(f"{of(law)}the step has more than {MOST:,} operations: a loop too long to unroll.")
            self.nodes.append(Node(op, args, dtype, law))
            self._known[key] = Ref(len(self.nodes) - 1)
        return self._known[key]

    def needed(self, outputs: Sequence[Operand]) -> set[int]:
        """Return the numbers of the nodes on which these operands depend."""
        seen: set[int] = set()
        stack = [x.node for x in outputs if isinstance(x, Ref)]
        while stack:
            if (node := stack.pop()) not in seen:
                seen.add(node)
                stack += [x.node for x in self.nodes[node].args if isinstance(x, Ref)]
        return seen

    def order(self, outputs: Sequence[Operand]) -> list[int]:
        """Return the numbers of the nodes on which these operands depend, without inputs, in order of computation."""
        return sorted(n for n in self.needed(outputs) if self.nodes[n].op != "input")

    def fixed(self, order: Sequence[int], inputs: Iterable[int]) -> set[int]:
        """Return the nodes of `order` that depend only on these input nodes and on constants."""
        known = set(inputs)
        for n in order:
            if all(x.node in known for x in self.nodes[n].args if isinstance(x, Ref)):
                known.add(n)
        return known.intersection(order)

    def used(self, before: Sequence[Ref], after: Sequence[Operand], outputs: Sequence[Operand]) -> list[int]:
        """Return the indices of the states on which `outputs` depend, in this step or in a later one."""
        used: list[int] = []
        while True:
            needed = self.needed([*outputs, *(after[k] for k in used)])
            more = [k for k, ref in enumerate(before) if ref.node in needed]
            if more == used:
                return used
            used = more

    def evaluate(self, inputs: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Return the value of every node, computed with NumPy. `inputs`: values of the input nodes, of one shape."""
        values: list[np.ndarray] = []
        with np.errstate(all="ignore"):
            for number, node in enumerate(self.nodes):
                args = [values[x.node] if isinstance(x, Ref) else x for x in node.args]
                value = inputs[number] if node.op == "input" else OPS[node.op].numpy(*args)
                values.append(np.asarray(value).astype(node.dtype))
        return values


class Statements:
    """The nodes `order` of a program as statements, one per node, in the language of a subclass.

    `read`: a function that returns the text that reads an input.
    """

    def __init__(self, program: Program, order: Sequence[int], read: Callable[[Location], str]) -> None:
        self.program, self.order, self.read = program, order, read
        self.names = {n: f"v{k}" for k, n in enumerate(order)}

    def constant(self, x: Any) -> str:
        raise NotImplementedError

    def statement(self, n: int) -> str:
        raise NotImplementedError

    def operand(self, x: Operand) -> str:
        if isinstance(x, Ref):
            location = self.program.nodes[x.node].location
            return self.names[x.node] if location is None else self.read(location)
        text = self.constant(x)
        return f"({text})" if text.startswith("-") else text

    def body(self, comment: str) -> list[str]:
        """Return all statements. `comment`: the line before the statements of a law, with its name for {law}."""
        lines, law = [], ""
        for n in self.order:
            if (node := self.program.nodes[n]).law != law:
                law = node.law
                lines.append(comment.format(law=re.sub(r"[^ -~]", "?", law) or "the cascade"))
            lines.append(self.statement(n))
        return lines

    def assigned(self, results: Sequence[tuple[str, Operand]], state: str) -> tuple[dict[str, str], dict[str, str]]:
        """Return names for the states that a step copies, by their texts, and the new value of each place.

        A state is copied before any is written. Its text begins with `state`.
        """
        given = {place: self.operand(value) for place, value in results}
        copied = dict.fromkeys(text for text in given.values() if text.startswith(state))
        old = {text: f"old{k}" for k, text in enumerate(copied)}
        return old, {place: old.get(text, text) for place, text in given.items()}


def _key(x: Operand) -> tuple[str, str]:
    """Return a key that is equal for equal operands: a node's number, or a constant's bits (-0 differs from 0)."""
    return ("node", f"{x.node:06}") if isinstance(x, Ref) else (x.dtype.str, x.tobytes().hex())


def _is(x: Operand, value: float) -> bool:
    return not isinstance(x, Ref) and bool(x == value)


def _simpler(op: str, args: tuple[Operand, ...]) -> Operand | None:
    """Return the operand that an operation returns unchanged, or None."""
    if op in ("add", "mul"):
        neutral = 0.0 if op == "add" else 1.0
        for one, other in (args, args[::-1]):
            if _is(other, neutral) and isinstance(one, Ref):
                return one
    if (op == "sub" and _is(args[1], 0.0)) or (op == "div" and _is(args[1], 1.0)):
        return args[0]
    if op == "select":
        if not isinstance(args[0], Ref):
            return args[1] if args[0] else args[2]
        if _key(args[1]) == _key(args[2]):
            return args[1]
    if op in ("and", "or"):
        for one, other in (args, args[::-1]):
            if not isinstance(other, Ref):
                return one if bool(other) == (op == "and") else other
    return None


def of(law: str) -> str:
    """Return the name of a law as the beginning of an error message."""
    return f"{law}: " if law else ""
