"""A block, an exported part of the loop: its step, which is traced and written in another language, and its numbers."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from ambjax.control.schedule import OVER, Schedule, finite
from ambjax.numerics.declared import allowed
from ambjax.numerics.records import Scalar

# The verification also sets each parameter to its value divided by this factor, and to its value times this factor.
SPAN = 100.0
# Text in place of the allowed values of a number that the step does not use.
UNREAD = "not read"


class Number(NamedTuple):
    """A parameter, a state, an input or an output: dotted name, unit, meaning, value, allowed values.

    - `ends`: further values of a parameter at which exported code is compared with JAX: the lowest and the highest
      first, then values that are not finite or that a step must reject.
    - `among`: values of a state that is a flag or a code, from which the comparison draws; a value that occurs twice is
      drawn twice as often. () for a real number.
    - `least`, `most`: smallest and largest value of a parameter. `infinite`: whether inf is allowed, too. `whole`:
      whether only whole numbers are allowed.
    """

    name: str
    unit: str
    doc: str
    value: float = 0.0
    allowed: str = ""
    ends: tuple[float, ...] = ()
    among: tuple[float, ...] = ()
    least: float = -math.inf
    most: float = math.inf
    infinite: bool = False
    whole: bool = False


def numbers_of(node: Any, path: str = "", home: str = "") -> Iterator[Number]:
    """Yield every number of a record, in the order of its leaves.

    - `path`: beginning of each dotted name, such as "position."; the name of a field follows.
    - `home`: text before the name in an error message.

    Raises ValueError for an array.
    """
    for field in dataclasses.fields(node):
        value, name = getattr(node, field.name), f"{path}{field.name}"
        if field.metadata.get("static") or value is None:
            continue
        if isinstance(value, Schedule):
            unit, signal = OVER[value.over]
            for knot, (at, x) in enumerate(zip(value.at, value.values, strict=True)):
                number = _number(f"{name}.knot_{knot}", finite(field), float(x))
                yield number._replace(doc=f"{number.doc}; at {signal} = {at:g} {unit}")
        elif isinstance(value, tuple):
            for k, one in enumerate(value):
                yield from numbers_of(one, f"{name}_{k}.", home)
        elif dataclasses.is_dataclass(value):
            yield from numbers_of(value, f"{name}.", home)
        elif jnp.shape(value) == ():
            yield _number(name, field, float(value))
        else:
            raise ValueError(f"{home}{name} has the shape {jnp.shape(value)}: only scalars can be exported.")


def earlier(before: tuple[Any, ...], unit: str, what: str) -> list[Number]:
    """Return the states `before` of a block: commands of the samples before the last. `what`: name of a command."""
    names = ["before.u"] if len(before) == 1 else [f"before_{k + 1}.u" for k in range(len(before))]
    words = [f"{what}, {k + 1} sample{'s' * (k > 0)} before last.u" for k in range(len(before))]
    return [Number(name, unit, doc) for name, doc in zip(names, words, strict=True)]


def _number(name: str, field: dataclasses.Field, value: float) -> Number:
    """Return the number of a field, with the unit, range and meaning that the field declares."""
    meta = field.metadata
    unit, doc = meta.get("unit", ""), meta.get("doc", "")
    infinity = "finite: set p = inf in the case and export again" if meta.get("steepness") else "or inf"
    least = -math.inf if meta.get("at_least") is None else float(meta["at_least"])
    if meta.get("above") is not None:
        least = max(least, math.nextafter(float(meta["above"]), math.inf))
    most = math.inf if meta.get("at_most") is None else float(meta["at_most"])
    low, high = sorted((value / SPAN, value * SPAN)) if value else (-1.0, 1.0)
    if math.isinf(value):
        low, high = 1.0, SPAN
    ends = max(low, least), min(high, most), *([math.inf] if meta.get("infinite") else []), math.nan
    unbounded = bool(meta.get("infinite")) and not meta.get("steepness")  # an infinite steepness is another program
    text, whole = allowed(field, infinity), bool(meta.get("whole"))
    return Number(name, unit, doc, value, text, ends, (), least, most, unbounded, whole)


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
