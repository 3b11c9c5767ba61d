"""The traced step of a block: its named inputs, states, outputs and parameters, and its cost."""

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.codegen.block import UNREAD, Block, Number
from ambjax.codegen.emitter import traced
from ambjax.codegen.primitives import COUNTED, OPS
from ambjax.codegen.program import PERIOD, PRECISIONS, STARTED, Location, Operand, Program, Ref
from ambjax.compiler.short_compilation import precision
from ambjax.numerics.records import canonical


def in_jax(block: Block) -> tuple[Any, Callable[[Any, Array], tuple[Any, Any, Any]]]:
    """Return the first memory of a block, and its step as a function of a memory and an array of inputs."""
    parameters, memory, _, period = arguments(block)
    read = frozenset(block.inputs)
    return memory, lambda memory, x: block.step(parameters, memory, block.ports(*x), period, read)


def arguments(block: Block) -> tuple[Any, Any, Any, Array]:
    """Return parameters, memory, inputs and period of `Block.step` as JAX values in the current precision."""
    inputs = block.ports(*[jnp.zeros(())] * len(block.inputs))
    return canonical(block.parameters), block.start(), inputs, jnp.asarray(block.period)


@dataclasses.dataclass(frozen=True)
class Trace:
    """The step of a block as a program of scalar operations.

    - `block`, `precision`: the block, and "float" or "double".
    - `program`: the operations.
    - `parameters`, `inputs`: the parameters and the inputs of the step, with names, units and values.
    - `state`: pairs of a state and the operand of its next value, without the states on which no result depends.
    - `started`: operand of the next value of the flag `started`.
    - `outputs`, `bits`: pairs of an output, or the name of a status bit, and its operand.
    - `read`: names of the inputs that the step uses.
    - `keep`: indices of the memory's leaves that are in `state`.
    - `refs`: operands of the parameters, the memory, the inputs and the period, in this order.
    """

    block: Block
    precision: str
    program: Program
    parameters: list[Number]
    inputs: list[Number]
    state: list[tuple[Number, Operand]]
    started: Operand
    outputs: list[tuple[Number, Operand]]
    bits: list[tuple[str, Operand]]
    read: frozenset[str]
    keep: list[int]
    refs: list[Ref]

    def roots(self) -> list[Operand]:
        return [x for _, x in [*self.state, *self.outputs, *self.bits]] + [self.started]

    def order(self) -> list[int]:
        """Return the numbers of the nodes that become statements, in ascending order."""
        return self.program.order(self.roots())

    def counts(self) -> Counter:
        """Return the number of operations of each kind in a step."""
        order, nodes = self.order(), self.program.nodes
        fixed = self.program.fixed(order, [self.refs[-1].node])
        return Counter(OPS[nodes[n].op].cost for n in order if n not in fixed)

    def state_bytes(self) -> int:
        """Return the size of the C struct of states in bytes, with the flag `started` and the padding after it."""
        size = np.dtype(PRECISIONS[self.precision]).itemsize
        return (len(self.state) + 1) * size

    def flops(self) -> int:
        """Return the number of additions, multiplications, divisions, roots and function calls in a step."""
        counts = self.counts()
        return sum(counts[cost] for cost in COUNTED)


def trace(block: Block, to: str) -> Trace:
    """Trace the step of a block. `to`: the precision, "float" or "double".

    The step is traced twice: the first trace shows which inputs it uses, and the step of the second trace checks only
    these.

    Raises ValueError for a law, a plant or a method that scalar code cannot express.
    """
    with precision(to):
        first = _traced(block, to, frozenset())
        return _traced(block, to, first.read)


def _traced(block: Block, to: str, read: frozenset[str]) -> Trace:
    """Trace the step of a block that checks the inputs `read`, and drop states on which no result depends."""
    given, program, real = arguments(block), Program(), np.dtype(PRECISIONS[to])
    parameters, states, step = block.numbers(), block.states(), block.step
    locations = [Location(group, x.name) for group, xs in (("params", parameters), ("state", states)) for x in xs]
    locations += [STARTED, *(Location("input", name) for name in block.inputs), PERIOD]
    refs = [program.input(location, bool if location == STARTED else real) for location in locations]
    results = traced(program, lambda p, s, x, t: step(p, s, x, t, read), given, refs)
    for x in results:
        if program.dtype(x).kind == "f" and program.dtype(x) != real:
            raise ValueError(
                f"the step returns {program.dtype(x).name}, but must return {real.name}. Do not set a dtype in a law."
            )
    after, started = results[: len(states)], results[len(states)]
    outputs, bits = results[len(states) + 1 : -len(block.bits)], results[-len(block.bits) :]
    at = refs[len(parameters) :]
    keep = program.used(at[: len(states)], after, [*outputs, *bits, started])
    seen = program.needed([*outputs, *bits, started, *(after[k] for k in keep)])
    input_refs = at[len(states) + 1 : -1]
    return Trace(
        block,
        to,
        program,
        [x if ref.node in seen else x._replace(allowed=UNREAD) for x, ref in zip(parameters, refs, strict=False)],
        [Number(name, *port) for name, port in block.inputs.items()],
        [(states[k], after[k]) for k in keep],
        started,
        [(Number(name, *port), x) for (name, port), x in zip(block.outputs.items(), outputs, strict=True)],
        list(zip(block.bits, bits, strict=True)),
        frozenset(name for name, ref in zip(block.inputs, input_refs, strict=True) if ref.node in seen),
        keep,
        refs,
    )
