"""Records: frozen dataclasses that are JAX pytrees and whose fields declare their unit, bounds and meaning.

The leaves of a record are numbers that may be traced, batched and differentiated. Its type and its static fields are
part of the tree structure. The case-file reader, the template, the reference and `validate` use the declarations.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.core import Tracer

T = TypeVar("T")

# A real number of one member, traced or not, or an array of numbers for an ensemble. NumPy arrays work too, but are not
# in the type, because type checkers take the product of a NumPy array and a JAX array for a NumPy array.
Scalar: TypeAlias = Array | float


def leaf(
    default: object = dataclasses.MISSING,
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
    """Declare a numeric field of a record.

    - `default`: default value; without it the field is required.
    - `unit`: unit of the value.
    - `doc`: meaning of the value.
    - `above`, `at_least`: exclusive and inclusive lower bound.
    - `at_most`: inclusive upper bound.
    - `infinite`: whether +inf is also allowed.
    - `whole`: whether only whole numbers are allowed.
    - `optional`: whether None is allowed.

    Bounds are decades beyond practical values. They ensure that a product of a few numbers neither overflows nor
    underflows to 0. Returns the dataclass field.
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


# Lower (exclusive) and upper bound of all gains. They are wide, because the unit and the size of a gain depend on the
# law and the plant.
GAINS = 1e-30, 1e30


def gain(*, default: object, unit: str, doc: str, steepness: bool = False) -> Any:
    """Declare a gain: a positive numeric field of a law, which the tuner varies on a logarithmic scale.

    `default`, `unit` and `doc` are those of `leaf`. `steepness`: whether the gain is the steepness of a smoothed sign.
    The default of a steepness is scaled to the plant, and the tuner varies it only on request. On a processor it may be
    inf, which selects the set-valued sign. Returns the dataclass field.
    """
    plain = leaf(default=default, unit=unit, doc=doc, above=GAINS[0], at_most=GAINS[1], infinite=steepness)
    return dataclasses.field(default=default, metadata={**plain.metadata, "steepness": steepness})


def static(default: object = dataclasses.MISSING, *, doc: str = "") -> Any:
    """Declare a field that is part of the tree structure. Its value is hashable and never traced."""
    return dataclasses.field(default=default, metadata={"static": True, "doc": doc})


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, gain, static, dataclasses.field))
def record(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and register it as a pytree.

    The type becomes part of the tree structure. With JAX's `register_dataclass`, the structures of two types with equal
    static fields compare equal, so that JAX could run the compiled program of one law for another.
    """
    record_type = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(record_type)  # pyright: ignore[reportArgumentType]
    fixed = [f.name for f in fields if f.metadata.get("static")]
    names = [f.name for f in fields if not f.metadata.get("static")]
    keys = [jax.tree_util.GetAttrKey(name) for name in names]

    values = _getter(names)
    fixed_values = _getter(fixed)

    def structure(node: T) -> tuple[object, ...]:
        return (record_type, *fixed_values(node))

    def flatten(node: T) -> tuple[tuple[object, ...], tuple[object, ...]]:
        return values(node), structure(node)

    def with_keys(node: T) -> tuple[list[tuple[Hashable, object]], tuple[object, ...]]:
        return list(zip(keys, values(node), strict=True)), structure(node)

    def unflatten(kept: tuple[object, ...], leaves: Iterable[object]) -> T:
        node = object.__new__(record_type)
        node.__dict__.update(zip(fixed, kept[1:], strict=True))
        node.__dict__.update(zip(names, leaves, strict=True))
        return node

    jax.tree_util.register_pytree_with_keys(record_type, with_keys, unflatten, flatten)
    return record_type


def _getter(names: list[str]) -> Callable[[object], tuple[object, ...]]:
    """Return a fast function from an object to the tuple of its attributes `names`.

    Speed matters because a rollout flattens about twenty records three times.
    """
    if len(names) > 1:
        return operator.attrgetter(*names)
    return lambda node: tuple(getattr(node, name) for name in names)


class GainFunction:
    """Base class of a record that stands in a law in the place of a gain, as a function of a signal."""

    def check(self, field: dataclasses.Field, path: str) -> None:
        """Raise ValueError unless the record may stand in the place of the number `field`, at a dotted path."""
        raise NotImplementedError


def is_traced(x: object) -> bool:
    """Return whether a JAX transformation traces x, so that x has no concrete value."""
    return isinstance(x, Tracer)


def numbers(field: dataclasses.Field) -> str:
    """Return the allowed values of a numeric field in words, with the unit."""
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


def _example(field: dataclasses.Field) -> str:
    """Return a sentence that proposes the default of a field; empty if the default is not a finite number."""
    default = field.default
    usable = isinstance(default, (int, float)) and math.isfinite(default)
    return f" Use {default:g}, for example." if usable else ""


def check_number(field: dataclasses.Field, name: str, value: object) -> None:
    """Raise ValueError if `field` does not allow `value`, a number or an array.

    The message contains the dotted name, the value, the allowed range and, if there is one, the default.
    """
    try:
        number = value if isinstance(value, (int, float)) else np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        number = math.nan
    if not within(field.metadata, number):
        shown = f"{value:g}" if isinstance(value, (int, float)) else _shown(value, number)
        raise ValueError(f"{name} = {shown}: it must be {numbers(field)}.{_example(field)}")


def validate(node: object, path: str = "") -> None:
    """Check every leaf of the records in `node` against the bounds of its field. Traced leaves are not checked.

    `path`: dotted path of `node`, for messages. Raises ValueError as `check_number` does.
    """
    if isinstance(node, (tuple, list)):
        for index, item in enumerate(node):
            validate(item, f"{path}[{index}]")
        return
    for field, is_leaf in _fields(type(node)):
        value = getattr(node, field.name)
        if not is_leaf:
            validate(value, f"{path}.{field.name}".lstrip("."))
        elif isinstance(value, GainFunction):
            value.check(field, f"{path}.{field.name}".lstrip("."))
        elif not (
            is_traced(value) or (value is None and (field.metadata["optional"] or field.metadata.get("steepness")))
        ):
            check_number(field, f"{path}.{field.name}".lstrip("."), value)


@functools.cache
def _fields(kind: type) -> tuple[tuple[dataclasses.Field, bool], ...]:
    """Return the fields of a record type, and whether each is a leaf; () for a type that is no record. Cached."""
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return tuple((field, bool(field.metadata.get("leaf"))) for field in fields)


def _shown(value: object, number: npt.ArrayLike) -> str:
    """Return the text of an invalid value for a message: the range of an array, or the value as Python shows it."""
    return f"{np.min(number):g} to {np.max(number):g}" if np.ndim(number) else repr(value)


# Names of the leaves that are integers. All other leaves become floating-point numbers, even if given as integers.
WHOLE = ("seed", "member")


def canonical(node: T) -> T:
    """Return the pytree with every leaf as an array of JAX's default floating-point type, or integer type for WHOLE.

    Python numbers, NumPy scalars and arrays then have the same JAX type, so that a change of a value or of its Python
    type does not cause a recompilation.
    """
    leaves, tree = jax.tree.flatten(node)
    kinds = jnp.result_type(float), jnp.result_type(int)
    return jax.tree.unflatten(tree, [_converted(x, kinds[w]) for x, w in zip(leaves, _whole(tree), strict=True)])


def _converted(x: Array | npt.ArrayLike, kind: np.dtype) -> Array | np.ndarray:
    if not isinstance(x, jax.Array):  # NumPy is faster than a dispatch of eager JAX
        return np.asarray(x, kind)
    return x if x.dtype == kind and not x.weak_type else jax.lax.convert_element_type(x, kind)


@functools.cache
def _whole(tree: Any) -> tuple[bool, ...]:
    """Return, for each leaf of this tree structure, whether its name is in WHOLE."""
    numbered = jax.tree.unflatten(tree, range(tree.num_leaves))
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(numbered)]
    return tuple(bool(path) and getattr(path[-1], "name", "") in WHOLE for path in paths)
