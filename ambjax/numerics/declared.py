"""What the fields of records declare, as text for messages and docstrings, and as checks of values."""

import contextlib
import dataclasses
import functools
import math
import textwrap
import types
from collections.abc import Mapping
from typing import Any, get_args, get_origin

import numpy as np
import numpy.typing as npt
from jax.core import Tracer


def numbers(field: dataclasses.Field) -> str:
    """Return the allowed values of a numeric field in words, with the unit."""
    meta = field.metadata
    kind = "whole number" if meta["whole"] else "number" if meta["infinite"] else "finite number"
    kind = f"{array} of {kind}s" if (array := _array(meta)) else f"a {kind}"
    unit = f"({meta['unit']})" if meta["unit"] else ""
    return " ".join(filter(None, (kind, _interval(meta), unit))) + (", or inf" if meta["infinite"] else "")


def allowed(field: dataclasses.Field, infinity: str = "or inf") -> str:
    """Return the range of a numeric field in words, without its unit; '' for a field of another kind."""
    meta = field.metadata
    if not meta.get("leaf"):
        return ""
    words = " ".join(filter(None, (_array(meta), "a whole number" if meta["whole"] else "", _interval(meta))))
    return f"{words}, {infinity}" if meta["infinite"] else words


def _array(meta: Mapping[str, Any]) -> str:
    """Return the declared shape in words; '' for a number."""
    axes = meta.get("shape", "").split()
    return f"an array [{', '.join(axes)}]" if axes else ""


def _interval(meta: Mapping[str, Any]) -> str:
    """Return the interval of the allowed numbers in words; '' if it is not bounded from below."""
    above, at_least, at_most = meta["above"], meta["at_least"], meta["at_most"]
    form = "" if meta["whole"] else "g"
    if above is not None:
        return f"above {above:g}" + ("" if at_most is None else f" and at most {at_most:g}")
    if at_least is None:
        return ""
    if at_most is None:
        return f"of at least {at_least:g}"
    return f"from {at_least:{form}} to {at_most:{form}}"


def default_text(default: object) -> str:
    """Return a default as text; '' for none."""
    if default is dataclasses.MISSING or default is None:
        return ""
    if dataclasses.is_dataclass(default):
        return f"{type(default).__name__}()"
    if isinstance(default, bool) or not isinstance(default, (int, float)):
        return str(default)
    return f"{default:g}" if math.isfinite(default) else "inf"


def item(field: dataclasses.Field) -> str:
    """Return the meaning, default, unit and range of a field as an item of the list in a docstring."""
    default, unit = default_text(field.default), field.metadata.get("unit", "")
    facts = [default and f"default {default}", "" if unit == "1" else unit, allowed(field)]
    words = "; ".join(filter(None, facts))
    text = f"- `{field.name}`: {field.metadata['doc']}{words and f' ({words})'}"
    return textwrap.fill(text, 100, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def within(meta: Mapping[str, Any], value: npt.ArrayLike) -> bool:
    """Return whether a field with the metadata `meta` allows a number, or every number of an array."""
    if isinstance(value, (int, float)):
        if value == math.inf:
            return meta["infinite"]
        above, at_least, at_most = meta["above"], meta["at_least"], meta["at_most"]
        return (  # False for NaN
            -math.inf < value
            and not (meta["whole"] and value % 1)
            and (above is None or value > above)
            and (at_least is None or value >= at_least)
            and (at_most is None or value <= at_most)
        )
    low, high = np.min(value), np.max(value)  # both are NaN if a value is
    whole = not meta["whole"] or not np.any(np.asarray(value) % 1)
    return whole and all(within(meta, float(x)) for x in (low, high))


def check_number(field: dataclasses.Field, name: str, value: object) -> None:
    """Raise ValueError if `field` does not allow `value`, a number or an array. Booleans and texts are no numbers."""
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    number: Any = value if plain else math.nan
    with contextlib.suppress(TypeError, ValueError):
        if not plain and np.asarray(value).dtype.kind not in "bUS":
            number = np.asarray(value, dtype=float)
    if not ((plain or np.size(number)) and within(field.metadata, number)):
        form = ".10g" if field.metadata["whole"] else "g"
        shown = f"{value:{form}}" if plain else _shown(value, number)
        raise ValueError(f"{name} = {shown}: it must be {numbers(field)}.")


@functools.cache
def kinds(field: dataclasses.Field) -> tuple[type, ...]:
    """Return the classes that a field which is no number allows; () if its values are not checked. Cached.

    Checked are bool, tuples, records and None: a part of another class, such as a signal, needs only its methods.
    """
    given: tuple[Any, ...] = get_args(field.type) if isinstance(field.type, types.UnionType) else (field.type,)
    named = tuple(get_origin(one) or one for one in given)
    known = all(one in (bool, tuple, types.NoneType) or dataclasses.is_dataclass(one) for one in named)
    return named if known else ()


@functools.cache
def fields_of(kind: type) -> tuple[tuple[dataclasses.Field, bool], ...]:
    """Return the fields of a record type, and whether each is a leaf; () for a type that is not a record. Cached."""
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return tuple((field, bool(field.metadata.get("leaf"))) for field in fields)


@functools.cache
def leaves_of(kind: type) -> tuple[dataclasses.Field, ...]:
    """Return the fields of a record type that are leaves. Cached."""
    return tuple(field for field, is_leaf in fields_of(kind) if is_leaf)


@functools.cache
def limited_parts(kind: type) -> tuple[dataclasses.Field, ...]:
    """Return the fields of a record type that are no leaves, and whose values are limited. Cached."""
    fields = [field for field, is_leaf in fields_of(kind) if not is_leaf and field.init]
    return tuple(field for field in fields if field.metadata.get("choices") or kinds(field))


@functools.cache
def bounded_leaves(kind: type) -> tuple[tuple[dataclasses.Field, float, float], ...]:
    """Return the leaves of a record type, each with an open interval of allowed floats, empty if `whole`. Cached."""
    found = []
    for field in leaves_of(kind):
        lows = [x for x in (field.metadata["above"], field.metadata["at_least"]) if x is not None]
        high = field.metadata["at_most"]
        high = -math.inf if field.metadata["whole"] else math.inf if high is None else high
        found.append((field, max(lows, default=-math.inf), high))
    return tuple(found)


# What a class also admits: NumPy's booleans, and a list for a tuple.
ALSO = {bool: (np.bool_,), tuple: (list,)}
WORDS = {bool: "True or False", tuple: "a tuple", types.NoneType: "None"}


def check_fixed(field: dataclasses.Field, name: str, value: object) -> None:
    """Raise ValueError if the static field, or the part, `field` does not allow `value`."""
    choices, named = field.metadata.get("choices"), kinds(field)
    fits = value in choices if choices else isinstance(value, named + sum((ALSO.get(one, ()) for one in named), ()))
    if not fits:
        words = [WORDS.get(one) or f"a record of type {one.__name__}" for one in named]
        allowed = f"one of {', '.join(map(repr, choices))}" if choices else " or ".join(words)
        raise ValueError(f"{name} = {textwrap.shorten(repr(value), 60)}: it must be {allowed}.")


def require_number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    whole: bool = False,
    optional: bool = False,
) -> None:
    """Raise ValueError unless the argument `name` of a function is one real number from `low` to `high`.

    `whole`: whether it must be a whole number. `optional`: whether None is allowed. A traced number may have any value,
    but it is not whole.
    """
    if (isinstance(value, Tracer) and not whole) or (optional and value is None):
        return
    number = not isinstance(value, Tracer) and np.ndim(value) == 0 and np.asarray(value).dtype.kind in "biuf"
    if not (number and low <= value <= high and math.isfinite(value) and not (whole and value % 1)):
        ends = [f"of at least {low:g}"] if math.isfinite(low) else []
        ends = [f"from {low:.10g} to {high:.10g}"] if math.isfinite(high) else ends
        kind = "a whole number" if whole else "a finite number"
        shown = "a traced number" if isinstance(value, Tracer) else repr(value)
        raise ValueError(f"{name} = {shown}: it must be {' '.join([kind, *ends])}.")


def _shown(value: object, number: npt.ArrayLike) -> str:
    """Return the text of an invalid value for a message: the range of an array, or the value as Python shows it."""
    return f"{np.min(number):g} to {np.max(number):g}" if np.ndim(number) and np.size(number) else repr(value)
