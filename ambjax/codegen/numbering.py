"""The numbers of an exported block: names, units, ranges and values of its parameters and states."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from ambjax.control.schedule import OVER, Schedule, finite
from ambjax.numerics.declared import allowed

# The verification also sets each parameter to its value divided by this factor, and to its value times this factor.
SPAN = 100.0
# Text in place of the allowed values of a number that the step does not use.
UNREAD = "not read"


class Number(NamedTuple):
    """A parameter, a state, an input or an output: dotted name, unit, allowed values, meaning, value.

    - `ends`: further values of a parameter at which exported code is compared with JAX: the lowest and the highest
      first, then values that are not finite or that a step must reject.
    - `among`: values of a state that is a flag or a code, from which the comparison draws; a value that occurs twice is
      drawn twice as often. () for a real number.
    - `least`, `most`: smallest and largest value of a parameter. `infinite`: whether inf is allowed, too. `whole`:
      whether only whole numbers are allowed.
    """

    name: str
    unit: str
    allowed: str
    doc: str
    value: float
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
    return [Number(name, unit, "", doc, 0.0) for name, doc in zip(names, words, strict=True)]


def _number(name: str, field: dataclasses.Field, value: float) -> Number:
    """Return the number of a field, with the unit, range and meaning that the field declares."""
    meta = field.metadata
    unit, doc = meta.get("unit", ""), meta.get("doc", "")
    infinity = "finite: set p = inf in the case and export again" if meta.get("steepness") else "or inf"
    least, most = _bounds(meta)
    unbounded = bool(meta.get("infinite")) and not meta.get("steepness")  # an infinite steepness is another program
    shown = allowed(field, infinity)
    ends, whole = _ends(meta, value), bool(meta.get("whole"))
    return Number(name, unit, shown, doc, value, ends, (), least, most, unbounded, whole)


def _bounds(meta: Mapping[str, Any]) -> tuple[float, float]:
    """Return the smallest and the largest finite value that a field allows; -inf or inf without a bound."""
    floors = [-math.inf if meta.get("at_least") is None else float(meta["at_least"])]
    if meta.get("above") is not None:
        floors.append(math.nextafter(float(meta["above"]), math.inf))
    return max(floors), math.inf if meta.get("at_most") is None else float(meta["at_most"])


def _ends(meta: Mapping[str, Any], value: float) -> tuple[float, ...]:
    """Return the further values of a parameter for the comparison: 1/SPAN and SPAN times `value`, within its bounds."""
    low, high = sorted((value / SPAN, value * SPAN)) if value else (-1.0, 1.0)
    if math.isinf(value):
        low, high = 1.0, SPAN
    floors = [x for x in (meta.get("above"), meta.get("at_least")) if x is not None]
    ceiling = meta.get("at_most")
    low, high = max([low, *floors]), high if ceiling is None else min(high, ceiling)
    return (low, high, math.inf, math.nan) if meta.get("infinite") else (low, high, math.nan)
