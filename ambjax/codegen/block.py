"""A block: an exported part of the loop. Its step is traced, written in another language, and compared with JAX."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from ambjax.codegen.numbering import Number
from ambjax.control.cascade import Cascade
from ambjax.control.schedule import schedules
from ambjax.numerics.records import Scalar

# Inputs or outputs: unit and meaning by name.
Ports = Mapping[str, tuple[str, str]]


@dataclasses.dataclass(frozen=True)
class Block:
    """Base class of the controller, the plant and the loop.

    - `parameters`: pytree of all numbers that a user of the exported code may change.
    - `period`: sample period, s.
    - `noun`: name of the block in texts.
    - `ports`: type of its inputs, a NamedTuple of scalars.
    - `inputs`, `outputs`: unit and meaning of each input and output, by name.
    - `bits`: meaning of each status bit, by name, the lowest bit first.
    - `crowded`: status bits that most random points set; the comparison adds points without them.
    """

    parameters: Any
    period: float

    noun: ClassVar[str]
    ports: ClassVar[Any]
    inputs: ClassVar[Ports]
    outputs: ClassVar[Ports]
    bits: ClassVar[Mapping[str, str]]
    crowded: ClassVar[tuple[str, ...]]

    def step(self, parameters: Any, memory: Any, inputs: Any, period: Scalar, read: frozenset[str]) -> Any:
        """Compute one sample. Return the memory for the next one, the outputs and the status bits, all scalars.

        - `parameters`: a pytree like the field `parameters`.
        - `memory`: the states before the step, real numbers; its last leaf is the flag `started`.
        - `inputs`: an instance of `ports`, in the units of the class attribute `inputs`.
        - `period`: sample period, s.
        - `read`: names of the inputs that the step uses; the step checks only these.
        """
        raise NotImplementedError

    def start(self) -> Any:
        """Return the memory before the first step."""
        raise NotImplementedError

    def numbers(self) -> list[Number]:
        """Return every number of the parameters, in the order of their leaves. Raises ValueError for an array."""
        raise NotImplementedError

    def states(self) -> list[Number]:
        """Return every state in the order of the memory's leaves, without `started`. Raises ValueError for an array."""
        raise NotImplementedError

    def sizes(self) -> tuple[list[float], list[float]]:
        """Return the characteristic size of each state, in the order of `states`, and of each input, in their units."""
        raise NotImplementedError

    def bounds(self) -> dict[str, int]:
        """Return, for the dotted name of each parameter that limits an input, the index of that input."""
        return {}

    def described(self) -> list[str]:
        """Return a description of the block, one line per part."""
        raise NotImplementedError


def scales(tree: Any) -> list[float]:
    """Return the leaves of a pytree of characteristic sizes as floats, in the units of the leaves."""
    return [float(jnp.asarray(x)) for x in jax.tree.leaves(tree)]


def law_lines(cascade: Cascade) -> list[str]:
    """Return one line per stage, with its law, set-valued signs and schedules, then a line on the processor."""
    laws: tuple[Any, ...] = cascade.laws
    lines = []
    for stage, law in zip(("observer", "position", "inversion", "current"), laws, strict=True):
        hard = [f.name for f in dataclasses.fields(law) if f.metadata.get("steepness") and getattr(law, f.name) is None]
        ends = "".join(f", {name} = inf (a set-valued sign)" for name in hard)
        over = "".join(f", {name} as a function of the {one.over}" for name, one in schedules(law).items())
        lines.append(f"{stage}: {type(law).__name__}{ends}{over}")
    return [*lines, f"processor: {cascade.processor}"]
