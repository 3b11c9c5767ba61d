"""The traced step of a controller: its named inputs, states, outputs and parameters, and its cost."""

import dataclasses
from collections import Counter
from contextlib import AbstractContextManager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.base import memory_of
from ambjax.control.cascade_state import CascadeState
from ambjax.export.controller import Controller, Memory, Number, Parameters, parameters_of
from ambjax.export.emitter import traced
from ambjax.export.interface import BITS, INPUTS, OUTPUTS, StepInputs
from ambjax.export.primitives import COUNTED, OPS
from ambjax.export.program import Operand, Program, Ref
from ambjax.export.statements import PERIOD, PRECISIONS, word
from ambjax.numerics.records import canonical

# Text in place of the allowed values of a number that the step does not use.
UNREAD = "not read"


def precision(name: str) -> AbstractContextManager[object]:
    """Return a context manager in which JAX computes in single ("float") or double ("double") precision."""
    import jax.experimental

    home: Any = jax if hasattr(jax, "enable_x64") else jax.experimental
    return home.enable_x64(name == "double")


def arguments(controller: Controller) -> tuple[Parameters, Memory, StepInputs, Array]:
    """Return parameters, memory, inputs and period of `Controller.step` as JAX values in the current precision."""
    zero = jnp.zeros(())
    inputs = StepInputs(*[zero] * len(StepInputs._fields))
    return (*canonical((controller.parameters,)), controller.start(), inputs, jnp.asarray(controller.period))


@dataclasses.dataclass(frozen=True)
class Trace:
    """The step of a controller as a program of scalar operations.

    - `controller`, `precision`: the controller, and "float" or "double".
    - `program`: the operations.
    - `parameters`, `inputs`: the parameters and the inputs of the step.
    - `state`: pairs of a state and the operand of its next value.
    - `started`: operand of the next value of the flag `started`.
    - `outputs`, `bits`: pairs of an output, or the name of a status bit, and its operand.
    - `read`: names of the inputs that the step uses.
    - `keep`: indices of the leaves of the memory that the C keeps.
    - `refs`: operands of the parameters, the memory, the inputs and the period.
    """

    controller: Controller
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
        """Return the operands of all results of the step."""
        return [x for _, x in [*self.state, *self.outputs, *self.bits]] + [self.started]

    def order(self) -> list[int]:
        """Return the numbers of the nodes that become lines of code, in order."""
        return sorted(n for n in self.program.needed(self.roots()) if self.program.nodes[n].op != "input")

    def counts(self) -> Counter:
        """Return the number of operations of each kind in a step.

        Operations on the period and constants alone are not counted, because a compiler computes them in advance.
        """
        nodes = self.program.nodes
        fixed = {n for n, node in enumerate(nodes) if node.text == PERIOD}
        found: Counter = Counter()
        for n in self.order():
            refs = [x.node for x in nodes[n].args if isinstance(x, Ref)]
            if set(refs) <= fixed:
                fixed.add(n)
            else:
                found[OPS[nodes[n].op].cost] += 1
        return found

    def state_bytes(self) -> int:
        """Return the size of the C's struct of states in bytes, with the flag `started`, aligned."""
        size = np.dtype(PRECISIONS[self.precision]).itemsize
        return (len(self.state) + 1) * size

    def flops(self) -> int:
        """Return the number of additions, multiplications, divisions, roots and function calls in a step."""
        counts = self.counts()
        return sum(counts[cost] for cost in COUNTED)


def trace(controller: Controller, to: str) -> Trace:
    """Trace the step of a controller. `to`: the precision, "float" or "double".

    Raises ValueError for a law that C with scalars cannot express.
    """
    with precision(to):
        first = _traced(controller, to, frozenset())
        return _traced(controller, to, first.read)


def _traced(controller: Controller, to: str, read: frozenset[str]) -> Trace:
    given, program = arguments(controller), Program()
    parameters, real = parameters_of(controller.parameters), np.dtype(PRECISIONS[to])
    states = _states(controller)
    texts = [f"params->{word(x.name)}" for x in parameters] + [f"state->{word(x.name)}" for x in states]
    texts += ["state->started", *(f"input->{name}" for name in StepInputs._fields), PERIOD]
    kinds = [real] * (len(parameters) + len(states)) + [np.dtype(bool)] + [real] * (len(StepInputs._fields) + 1)
    refs = [program.input(text, kind) for text, kind in zip(texts, kinds, strict=True)]
    step: Any = controller.step
    results = traced(program, lambda *x: step(*x, read), given, refs)
    for x in results:
        if program.dtype(x).kind == "f" and program.dtype(x) != real:
            raise ValueError(
                f"the step returns {program.dtype(x).name}, but must return {real.name}. Do not set a dtype in a law."
            )
    after, started = results[: len(states)], results[len(states)]
    outputs, bits = results[len(states) + 1 : -len(BITS)], results[-len(BITS) :]
    at = refs[len(parameters) :]
    keep = _used(program, at[: len(states)], after, [*outputs, *bits, started])
    roots = [*outputs, *bits, started, *(after[k] for k in keep)]
    seen = program.needed(roots)
    input_refs = at[len(states) + 1 : -1]
    return Trace(
        controller,
        to,
        program,
        [x if ref.node in seen else x._replace(allowed=UNREAD) for x, ref in zip(parameters, refs, strict=False)],
        [Number(name, unit, "", doc, 0.0) for name, (unit, doc) in INPUTS.items()],
        [(states[k], after[k]) for k in keep],
        started,
        [(Number(name, *_output(name), 0.0), x) for name, x in zip(OUTPUTS, outputs, strict=True)],
        list(zip(BITS, bits, strict=True)),
        frozenset(name for name, ref in zip(StepInputs._fields, input_refs, strict=True) if ref.node in seen),
        keep,
        refs,
    )


def _output(name: str) -> tuple[str, str, str]:
    unit, doc = OUTPUTS[name]
    return unit, "", doc


def _used(program: Program, before: list[Ref], after: list[Operand], roots: list[Operand]) -> list[int]:
    """Return the indices of the states on which a result (`roots`), or the next value of another such state, depends.

    `before`, `after`: operands of each state and of its next value.
    """
    keep: set[int] = set()
    while True:
        seen = program.needed([*roots, *(after[k] for k in keep)])
        more = {k for k, ref in enumerate(before) if ref.node in seen}
        if more == keep:
            return sorted(keep)
        keep = more


def _states(controller: Controller) -> list[Number]:
    """Return every state in the order of the memory's leaves, without `started`. Raises ValueError for an array."""
    cascade, memory = controller.parameters.controller, controller.start()
    found = []
    for stage, law, state in zip(CascadeState._fields, cascade.laws, memory.laws, strict=True):
        entries = memory_of(law, state)
        assert len(entries) == len(jax.tree.leaves(state)), f"{type(law).__name__}.memory: one entry for each state"
        if any(jnp.shape(x) != () for x in jax.tree.leaves(state)):
            raise ValueError(
                f"controller.{stage}: a state of {type(law).__name__} is an array; only scalars can be exported."
            )
        words = f"state of {type(law).__name__}"
        found += [Number(f"{stage}.{name}", unit, "", doc or words, 0.0) for name, unit, doc in entries]
    commands = {**OUTPUTS, "i_ref_dot": ("A/s", "rate of i_ref")}
    found += [
        Number(f"last.{name}", commands[name][0], "", f"last {commands[name][1]}", 0.0) for name in memory.last._fields
    ]
    found.append(Number("before.u", "V", "", "voltage of the sample before the last", 0.0))
    if memory.watch:
        names = {**{f"watch.{name}": (INPUTS[name][0], "predicted reading") for name in memory.watch.expected._fields}}
        names["watch.left"] = ("samples", "number of samples for which a reading may still be replaced")
        found += [Number(name, unit, "", doc, 0.0) for name, (unit, doc) in names.items()]
    return found
