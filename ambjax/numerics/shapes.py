"""Declared shapes of the leaves of records, and the axis of the members of an ensemble.

A field declares the shape of one member by letters, one for each axis: "" is a number, "c" a vector, "d d" a square
matrix. A letter has one length in a record. An array with one axis more has one entry per member, on its first axis.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

T = TypeVar("T")


def axes_of(field: dataclasses.Field) -> list[str]:
    """Return the letters of the axes that a field declares; [] for a number."""
    return field.metadata.get("shape", "").split()


def check_shapes(fields: Sequence[dataclasses.Field], values: Mapping[str, Any], path: str = "") -> None:
    """Raise ValueError if the shape of a leaf of a record is neither the declared one nor that of an ensemble."""
    lengths: dict[str, tuple[int, str]] = {}
    for field in fields:
        value, axes = values[field.name], axes_of(field)
        if (not axes and getattr(value, "ndim", 0) < 2) or value is None or dataclasses.is_dataclass(value):
            continue
        shape = np.shape(value)
        own = shape[len(shape) - len(axes) :] if len(axes) <= len(shape) <= len(axes) + 1 else ()
        known = {axis: lengths.setdefault(axis, (n, field.name)) for axis, n in zip(axes, own, strict=False)}
        if len(shape) not in (len(axes), len(axes) + 1) or own != tuple(known[axis][0] for axis in axes):
            given = [f"{axis} = {n} as in {name}" for axis, (n, name) in known.items() if name != field.name]
            wanted = f"[{', '.join(axes)}]{''.join(f' with {words}' for words in given)}" if axes else "a number"
            raise ValueError(
                f"{path}.{field.name} has the shape {list(shape)}: it must be {wanted}, or "
                f"[{', '.join(['N', *axes])}] for N members.".lstrip(".")
            )


def varying(tree: object) -> tuple[bool, ...]:
    """Return, for each leaf of a pytree, whether its first axis is that of the members.

    It is if the leaf has one axis more than its field declares. Outside of a record every array has this axis.
    """
    leaves, structure = jax.tree.flatten(tree)
    return tuple(getattr(x, "ndim", 0) > rank for x, rank in zip(leaves, _ranks(structure), strict=True))


def require_one_member(parts: dict[str, object]) -> None:
    """Raise ValueError if a number of the parts has one value per member of an ensemble."""
    if any(varying(parts)):
        leaves = zip(jax.tree_util.tree_leaves_with_path(parts), varying(parts), strict=True)
        path, value = next(leaf for leaf, varies in leaves if varies)
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        raise ValueError(
            f"{name} has the shape {list(np.shape(value))}: this function takes one member. Give one value, or use "
            "jax.vmap(ambjax.rollout) or ambjax.ensemble.run_ensemble for several members."
        )


def map_varying(function: Callable[[Any], Any], tree: T) -> T:
    """Return the pytree with `function` applied to each leaf that has an axis of members."""
    leaves, structure = jax.tree.flatten(tree)
    pairs = zip(leaves, varying(tree), strict=True)
    return jax.tree.unflatten(structure, [function(x) if varies else x for x, varies in pairs])


@functools.cache
def _ranks(structure: Any) -> tuple[int, ...]:
    """Return the number of declared axes of each leaf of this tree structure, with those of stacked records."""
    numbered = jax.tree.unflatten(structure, range(structure.num_leaves))
    return tuple(_rank(numbered, path) for path, _ in jax.tree_util.tree_leaves_with_path(numbered))


def _rank(node: Any, path: Sequence[Any]) -> int:
    """Return the number of axes that the last record on the path from `node` to a leaf declares for it.

    Each field with `channels` on the path adds one.
    """
    rank = stacked = 0
    for key in path:
        name, fields = getattr(key, "name", None), getattr(node, "__dataclass_fields__", {})
        if fields:
            rank = len(axes_of(fields[name]))
            stacked += fields[name].metadata.get("channels", False)
        node = getattr(node, name) if name is not None else node[getattr(key, "idx", getattr(key, "key", None))]
    return rank + stacked


def with_entry(x: Any, index: tuple[Any, ...], value: Any) -> Any:
    """Return the array with one entry replaced. The leading axes of `x` and of `value` are those of members."""
    at = np.zeros(np.shape(x)[-len(index) :], bool)
    at[index] = True
    wide = jax.numpy.asarray(value)[(..., *[None] * len(index))]
    return jax.numpy.where(at, wide, x)


def stack_axes(axes: Sequence[T]) -> T:
    """Return the pytrees of axes as one, each leaf [c, ...]; [N, c, ...] if it varies between members on any axis."""
    flags = np.any([varying(axis) for axis in axes], 0)
    parts = [jax.tree.leaves(axis) for axis in axes]
    leaves = []
    for k, varies in enumerate(flags):
        own = [np.asarray(one[k]) for one in parts]
        most = max((x.shape for x in own), key=len)
        leaves.append(np.stack([np.broadcast_to(x, most) for x in own], 1) if varies else np.stack(own))
    return jax.tree.unflatten(jax.tree.structure(axes[0]), leaves)
