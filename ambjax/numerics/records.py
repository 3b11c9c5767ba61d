"""Records: frozen dataclasses that are JAX pytrees, and the checks that their fields declare.

A record's type says what it is; its leaves are numbers that may be traced, batched and
differentiated. Fields declare unit, bounds and meaning once, and the case-file reader, the
template and `validate` all read them from there.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

T = TypeVar("T")

# A real number, or an array of them: one member's scalar, traced or not.
Scalar = Any


def leaf(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    doc: str = "",
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
    infinite: bool = False,
    whole: bool = False,
    optional: bool = False,
) -> Any:
    """A numeric field: its unit, its bounds and what it means.

    `above` and `at_least` bound it from below, `at_most` from above; `infinite` admits +inf beside what they
    allow; `whole` admits whole numbers only; `optional` admits None. The bounds lie decades beyond what is built, so
    that no product of a few numbers overflows and none of two such numbers is taken for 0.
    """
    metadata = {
        "unit": unit,
        "doc": doc,
        "above": above,
        "at_least": at_least,
        "at_most": at_most,
        "infinite": infinite,
        "whole": whole,
        "optional": optional,
        "leaf": True,
    }
    return dataclasses.field(default=default, metadata=metadata)


# Ends of a gain's range: its unit, and so its size, depends on the law and the plant.
GAINS = 1e-30, 1e30


def gain(*, default: Any, unit: str, doc: str, steepness: bool = False) -> Any:
    """A positive numeric field over all decades, which may be tuned on a scale of logarithms.

    `steepness`: that of a smoothed sign, which is suited to the plant, and tuned only where that is asked for; inf, the
    sign itself, on a processor.
    """
    plain = leaf(default=default, unit=unit, doc=doc, above=GAINS[0], at_most=GAINS[1], infinite=steepness)
    return dataclasses.field(default=default, metadata={**plain.metadata, "steepness": steepness})


def static(default: Any = dataclasses.MISSING, *, doc: str = "") -> Any:
    """A field that is part of the structure (hashable, never traced)."""
    return dataclasses.field(default=default, metadata={"static": True, "doc": doc})


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, gain, static, dataclasses.field))
def record(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and register it as a pytree.

    Not by JAX's own `register_dataclass`: there, tree structures of two types with equal static fields compare
    equal, and one law's compiled program could be taken for another's. Here the type is part of the structure.
    """
    made = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(made)  # pyright: ignore[reportArgumentType]
    fixed = [f.name for f in fields if f.metadata.get("static")]
    names = [f.name for f in fields if not f.metadata.get("static")]
    keys = [jax.tree_util.GetAttrKey(name) for name in names]

    values = _getter(names)
    fixed_values = _getter(fixed)

    def structure(node: Any) -> tuple[Any, ...]:
        return (made, *fixed_values(node))

    def flatten(node: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return values(node), structure(node)

    def with_keys(node: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        return list(zip(keys, values(node), strict=True)), structure(node)

    def unflatten(kept: tuple[Any, ...], leaves: Any) -> Any:
        node = object.__new__(made)
        node.__dict__.update(zip(fixed, kept[1:], strict=True))
        node.__dict__.update(zip(names, leaves, strict=True))
        return node

    jax.tree_util.register_pytree_with_keys(made, with_keys, unflatten, flatten)
    return made


def _getter(names: list[str]) -> Callable[[Any], tuple[Any, ...]]:
    """A function from an object to its attributes of these names: every rollout flattens some twenty records thrice."""
    if len(names) > 1:
        return operator.attrgetter(*names)
    return lambda node: tuple(getattr(node, name) for name in names)


def is_traced(x: Any) -> bool:
    """Whether x has no concrete value, because some JAX transformation is looking at it."""
    return isinstance(x, Tracer)


def numbers(field: dataclasses.Field) -> str:
    """What a field allows, in words."""
    meta = field.metadata
    above, at_least, at_most = meta["above"], meta["at_least"], meta["at_most"]
    unit = f" ({meta['unit']})" if meta["unit"] else ""
    end = f"{unit}, or inf" if meta["infinite"] else unit
    kind = "a number" if meta["infinite"] else "a finite number"
    if meta["whole"]:
        return f"a whole number from {at_least} to {at_most}{end}"
    if above is not None:
        return f"{kind} above {above:g}{'' if at_most is None else f' and at most {at_most:g}'}{end}"
    if at_least is not None:
        return f"{kind} {f'of at least {at_least:g}' if at_most is None else f'from {at_least:g} to {at_most:g}'}{end}"
    return f"{kind}{end}"


def within(meta: Any, value: Any) -> bool:
    """Whether a number, or every number of an array, is what a field with this metadata allows."""
    if isinstance(value, (int, float)):
        if value == math.inf:
            return meta["infinite"]
        above, at_least, at_most = meta["above"], meta["at_least"], meta["at_most"]
        return (  # nothing of this holds for NaN
            -math.inf < value
            and not (meta["whole"] and value % 1)
            and (above is None or value > above)
            and (at_least is None or value >= at_least)
            and (at_most is None or value <= at_most)
        )
    low, high = np.min(value), np.max(value)  # NaN carries through both
    whole = not meta["whole"] or not np.any(np.asarray(value) % 1)
    return whole and all(within(meta, float(x)) for x in (low, high))


def _example(field: dataclasses.Field) -> str:
    default = field.default
    usable = isinstance(default, (int, float)) and math.isfinite(default)
    return f" Use {default:g}, for example." if usable else ""


def check_number(field: dataclasses.Field, name: str, value: Any) -> None:
    """Raise ValueError, with the dotted name, the value and what is allowed, for a number that its field does not."""
    try:
        number = value if isinstance(value, (int, float)) else np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        number = math.nan
    if not within(field.metadata, number):
        shown = f"{value:g}" if isinstance(value, (int, float)) else _worst(value, number)
        raise ValueError(f"{name} = {shown}: it must be {numbers(field)}.{_example(field)}")


def validate(node: Any, path: str = "") -> None:
    """Check every concrete leaf under `node` against its field; traced leaves pass unseen.

    Raises ValueError with the dotted path, the value, what is allowed and an example.
    """
    if isinstance(node, (tuple, list)):
        for index, item in enumerate(node):
            validate(item, f"{path}[{index}]")
        return
    for field, is_leaf in _fields(type(node)):
        value = getattr(node, field.name)
        if not is_leaf:
            validate(value, f"{path}.{field.name}".lstrip("."))
        elif not (
            is_traced(value) or (value is None and (field.metadata["optional"] or field.metadata.get("steepness")))
        ):
            check_number(field, f"{path}.{field.name}".lstrip("."), value)


@functools.cache
def _fields(kind: type) -> tuple[tuple[dataclasses.Field, bool], ...]:
    """Fields of a record, and whether each is a number; none of any other type. Every rollout asks for them."""
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return tuple((field, bool(field.metadata.get("leaf"))) for field in fields)


def _worst(value: Any, number: Any) -> str:
    """What to show of a value that is refused: of an array, its range."""
    return f"{np.min(number):g} to {np.max(number):g}" if np.ndim(number) else repr(value)


# The leaves that are whole numbers; every other number is real, even where somebody wrote 17 for 17.0.
WHOLE = ("seed", "member")


def canonical(node: T) -> T:
    """The same pytree with every number an array of the working precision (seeds: of integers).

    Python numbers, NumPy scalars and arrays then trace alike, so that a change of a value, or of
    the type that carries it, never recompiles.
    """
    leaves, tree = jax.tree.flatten(node)
    kinds = jnp.result_type(float), jnp.result_type(int)
    return jax.tree.unflatten(tree, [_converted(x, kinds[w]) for x, w in zip(leaves, _whole(tree), strict=True)])


def _converted(x: Any, kind: Any) -> Any:
    if not isinstance(x, jax.Array):  # NumPy converts in microseconds what eager JAX takes a dispatch for
        return np.asarray(x, kind)
    return x if x.dtype == kind and not x.weak_type else jax.lax.convert_element_type(x, kind)


@functools.cache
def _whole(tree: Any) -> tuple[bool, ...]:
    """Of each leaf of a tree of this structure, whether it is one of WHOLE."""
    numbered = jax.tree.unflatten(tree, range(tree.num_leaves))
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(numbered)]
    return tuple(bool(path) and getattr(path[-1], "name", "") in WHOLE for path in paths)
