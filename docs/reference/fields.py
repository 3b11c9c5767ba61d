"""Unit, default, bounds and meaning that the fields of a record declare."""

import ast
import dataclasses
import inspect
import textwrap
from typing import Any, NamedTuple

from ambjax.numerics.declared import allowed, default_text


class Facts(NamedTuple):
    """One key with its texts; '' for each text that is not available."""

    name: str
    unit: str
    default: str
    allowed: str
    doc: str


def facts(field: dataclasses.Field, default: Any = None) -> Facts:
    """Return the declaration of a numeric field; `default` replaces its default if that of the case file differs."""
    unit = field.metadata.get("unit", "")
    shown = default_text(field.default if default is None else default)
    return Facts(field.name, "" if unit == "1" else unit, shown, allowed(field), field.metadata["doc"])


def attribute_docs(kind: type) -> dict[str, str]:
    """Return the docstrings below the fields of a class."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(tree, ast.ClassDef)
    found = {}
    for before, after in zip(tree.body, tree.body[1:], strict=False):
        told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name) and told:
            found[before.target.id] = " ".join(str(after.value.value).split())  # pyright: ignore[reportAttributeAccessIssue]
    return found
