"""Unit, default, bounds and meaning that the fields of a record declare."""

import ast
import dataclasses
import inspect
import math
import re
import textwrap
from typing import Any, NamedTuple

from ambjax.numerics.records import numbers


class Facts(NamedTuple):
    """One key with its texts; '' for each text that is not available."""

    name: str
    unit: str
    default: str
    allowed: str
    doc: str


def facts(field: dataclasses.Field, default: Any = None) -> Facts:
    """Return the declaration of a numeric field; `default` replaces its default if that of the case file differs."""
    meta = field.metadata
    unit, allowed = "", ""
    if meta.get("leaf"):
        unit = meta["unit"]
        allowed = re.sub(r"^a (finite )?number ", "", numbers(field).replace(f" ({unit})", ""))
    shown = field.default if default is None else default
    return Facts(field.name, "" if unit == "1" else unit, value(shown), allowed, meta["doc"])


def value(default: Any) -> str:
    """Return a default as text; '' for none."""
    if default is dataclasses.MISSING or default is None:
        return ""
    if isinstance(default, (str, bool)) or dataclasses.is_dataclass(default):
        return str(default)
    number = float(default)
    return f"{number:g}" if math.isfinite(number) else "inf"


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
