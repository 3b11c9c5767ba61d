"""Records: frozen dataclasses that are JAX pytrees and whose fields declare their unit, bounds and meaning.

The leaves of a record are numbers that may be traced, batched and differentiated. Its type and its static fields are
part of the tree structure. The case-file reader, the template, the reference pages and `validate` use the declarations.
"""

import dataclasses
import functools
import inspect
import operator
from collections.abc import Callable, Hashable, Iterable
from typing import Any, Literal, TypeAlias, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array
from jax.core import Tracer

from ambjax.compiler.barrier import in_trace
from ambjax.numerics import declared
from ambjax.numerics.shapes import check_shapes

T = TypeVar("T")

# A real number of one member, traced or not, or an array of numbers for an ensemble. NumPy arrays work too, but are not
# in the type, because type checkers infer a NumPy array for the product of a NumPy array and a JAX array.
Scalar: TypeAlias = Array | float


def leaf(
    default: object = dataclasses.MISSING,
    *,
    shape: str = "",
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
    - `shape`: a letter for each axis of the value of one member (`numerics.shapes`); "": a number.
    - `unit`: unit of the value.
    - `doc`: meaning of the value.
    - `above`, `at_least`: exclusive and inclusive lower bound.
    - `at_most`: inclusive upper bound.
    - `infinite`: whether +inf is also allowed.
    - `whole`: whether only whole numbers are allowed.
    - `optional`: whether None is allowed. It is if None is the default.

    Bounds are decades beyond practical values. They ensure that a product of a few numbers neither overflows nor
    underflows to 0. Returns the dataclass field.
    """
    metadata = {
        "shape": shape,
        "unit": unit,
        "doc": doc,
        "above": above,
        "at_least": at_least,
        "at_most": at_most,
        "infinite": infinite,
        "whole": whole,
        "optional": optional or default is None,
        "leaf": True,
    }
    return dataclasses.field(default=default, metadata=metadata)


def bounded(default: object, unit: str, at_least: float, at_most: float, doc: str, **more: Any) -> Any:
    """Declare a numeric field with a default and inclusive bounds. The arguments are those of `leaf`."""
    return leaf(default, unit=unit, at_least=at_least, at_most=at_most, doc=doc, **more)


def positive(default: object, unit: str, at_most: float, doc: str, **more: Any) -> Any:
    """Declare a numeric field with a default and values above 0. The arguments are those of `leaf`."""
    return leaf(default, unit=unit, above=0, at_most=at_most, doc=doc, **more)


def matrix(shape: str, doc: str, **more: Any) -> Any:
    """Declare a field with a matrix or a vector of any size. The arguments are those of `leaf`."""
    return leaf(shape=shape, at_least=-1e30, at_most=1e30, doc=doc, **more)


# Lower (exclusive) and upper bound of all gains; 0 is allowed where it switches a term off. The bounds are wide,
# because the unit and the size of a gain depend on the law and the plant.
GAINS = 1e-30, 1e30


def gain(
    default: object, unit: str, doc: str, *, steepness: bool = False, zero: bool = False, optional: bool = False
) -> Any:
    """Declare a gain: a positive numeric field of a law, which the tuner varies on a logarithmic scale.

    `default`, `unit`, `doc` and `optional` are those of `leaf`. `steepness`: whether the gain is the steepness of a
    smoothed sign. The default of a steepness is scaled to the plant, and the tuner varies it only on request. On a
    processor it may be inf, which selects the set-valued sign. `zero`: whether 0 is allowed, which switches the term of
    the gain off. Returns the dataclass field.
    """
    above, at_least = (None, 0.0) if zero else (GAINS[0], None)
    plain = leaf(default, unit=unit, doc=doc, above=above, at_least=at_least, at_most=GAINS[1], infinite=steepness)
    metadata = {**plain.metadata, "steepness": steepness, "optional": optional}
    return dataclasses.field(default=default, metadata=metadata)


def static(default: object = dataclasses.MISSING, *, doc: str = "", choices: tuple[str, ...] = ()) -> Any:
    """Declare a field that is part of the tree structure. Its value is hashable and never traced.

    `choices`: the allowed values; (): every value of the annotated type.
    """
    return dataclasses.field(default=default, metadata={"static": True, "doc": doc, "choices": choices})


def derived(*, init: Literal[False] = False) -> Any:
    """Declare a static field that a function computes, None until then. The constructor does not take it.

    `dataclasses.replace` resets it; `replaced` keeps it. `init`: for type checkers.
    """
    return dataclasses.field(default=None, init=init, repr=False, metadata={"static": True})


def replaced(node: T, **fields: object) -> T:
    """Return the record with other values of these fields, of which some may be declared by `derived`."""
    kinds = dataclasses.fields(node)  # pyright: ignore[reportArgumentType]
    computed = {kind.name: fields.pop(kind.name, getattr(node, kind.name)) for kind in kinds if not kind.init}
    other = dataclasses.replace(node, **fields)  # pyright: ignore[reportArgumentType]
    other.__dict__.update(computed)
    return other


def part(*, default: object = dataclasses.MISSING, doc: str, channels: bool = False) -> Any:
    """Declare a field that is itself a record, or another pytree of numbers. `doc`: its meaning.

    `channels`: whether the leaves are stacked, so that each has one axis more than it declares.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "channels": channels})


@dataclass_transform(frozen_default=True, field_specifiers=(leaf, static, derived, part, dataclasses.field))
def record(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and register it as a pytree.

    The type becomes part of the tree structure. With JAX's `register_dataclass`, the structures of two types with equal
    static fields compare equal, so that JAX could run the compiled program of one law for another.

    The constructor checks each leaf that is a plain number or a list, which becomes an array, and the type of other
    fields (`declared.kinds`). It skips traced numbers and arrays; `validate` checks arrays before a rollout. JAX
    rebuilds records without the constructor. `record` appends a list of the fields to the docstring.
    """
    _check_at_construction(cls)
    record_type = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(record_type)  # pyright: ignore[reportArgumentType]
    items = [declared.item(field) for field in fields if field.metadata.get("doc")]
    record_type.__doc__ = "\n".join([inspect.cleandoc(record_type.__doc__ or ""), "", *items]).rstrip()
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


def _check_at_construction(cls: type) -> None:
    """Add a `__post_init__` that checks the plain numbers. Call this before the class becomes a dataclass."""
    own = cls.__dict__.get("__post_init__")

    def check(self: object) -> None:
        """Check the fields. Raise ValueError for a number outside its range, or a value of another type."""
        if own is not None:
            own(self)
        if type(self) is not cls:  # a subclass that is not a record: JAX may construct it with other values
            return
        given = self.__dict__
        for field, low, high in declared.bounded_leaves(type(self)):
            value = given[field.name]
            fine = value is field.default and not isinstance(value, (list, tuple))
            if fine or (type(value) is float and low < value < high):
                continue  # skips `check_leaf`, because tracing constructs many records
            if isinstance(value, (int, float, str, list, tuple, np.number)) or value is None:
                check_leaf(field, f"{type(self).__name__}.{field.name}", value)
            if isinstance(value, (list, tuple)):  # one leaf, not one for each number
                given[field.name] = np.asarray(value, None if field.metadata["whole"] else float)
        for field in declared.limited_parts(type(self)):
            if given[field.name] is not field.default:
                declared.check_fixed(field, f"{type(self).__name__}.{field.name}", given[field.name])

    cls.__post_init__ = check  # pyright: ignore[reportAttributeAccessIssue]


def _getter(names: list[str]) -> Callable[[object], tuple[object, ...]]:
    """Return a fast function from an object to the tuple of its attributes `names`."""
    if len(names) > 1:
        return operator.attrgetter(*names)
    return lambda node: tuple(getattr(node, name) for name in names)


class GainFunction:
    """Base class of records that replace a gain of a law by a function of a signal."""

    def check(self, field: dataclasses.Field, path: str) -> None:
        """Raise ValueError if the record must not replace the number `field`. `path`: dotted path, for the message."""
        raise NotImplementedError


def is_traced(x: object) -> bool:
    """Return whether a JAX transformation traces x, so that x has no concrete value."""
    return isinstance(x, Tracer)


def require_concrete(name: str, node: object) -> None:
    """Raise ValueError if a number of the pytree or the caller is traced. `name`: what it is, for the message."""
    if in_trace(node):
        raise ValueError(
            f"{name}: a number is traced, and this function does not work inside jit, vmap or grad. Use ambjax.rollout "
            "there, or ambjax.linear.loop_matrices for the linearised loop."
        )


def validate(node: object, path: str = "") -> None:
    """Check every leaf of the records in `node` against the bounds and the shape of its field.

    If a record type has the attribute `ordered`, a pair of field names, the first value must not exceed the second.
    Of traced leaves, only the shape is checked. `path`: dotted path of `node`, for messages. Raises ValueError for an
    invalid value.
    """
    if isinstance(node, (tuple, list)):
        for index, item in enumerate(node):
            validate(item, f"{path}[{index}]")
        return
    if not (fields := declared.fields_of(type(node))):
        return
    for field, low, high in declared.bounded_leaves(type(node)):
        value = getattr(node, field.name)
        if not (type(value) is float and low < value < high):  # skips `check_leaf`, because calls are frequent
            check_leaf(field, f"{path}.{field.name}".lstrip("."), value)
    for field, is_leaf in fields:
        if not is_leaf:
            validate(getattr(node, field.name), f"{path}.{field.name}".lstrip("."))
    check_shapes(declared.leaves_of(type(node)), vars(node), path)
    if pair := getattr(type(node), "ordered", None):
        low, high = (getattr(node, name) for name in pair)
        if not (is_traced(low) or is_traced(high)) and np.any(np.greater(low, high)):
            raise ValueError(f"{path}.{pair[1]} = {high}: it must not be less than {pair[0]} = {low}.".lstrip("."))


def check_leaf(field: dataclasses.Field, name: str, value: object) -> None:
    """Raise the ValueError of `check_number` if the leaf `field` does not allow `value`; traced values are allowed."""
    if isinstance(value, GainFunction):
        value.check(field, name)
    elif not (is_traced(value) or (value is None and (field.metadata["optional"] or field.metadata.get("steepness")))):
        declared.check_number(field, name, value)


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
