"""Docstrings, which are plain text with `names` in backticks, made into what autodoc reads; and fields of records."""

import dataclasses
import re
import sys
from typing import Any

from reference.fields import Facts, facts
from sphinx.application import Sphinx

# Characters that mean something in reStructuredText but nothing in a docstring.
SPECIAL = re.compile(r"([\\*|_])")
# What NamedTuple says of a field about which nobody else says anything.
NOTHING = re.compile(r"Alias for field number \d+")


def plain(line: str) -> str:
    """A line with its names as literals and everything else as it stands."""
    parts = re.split(r"`+([^`]+)`+", line)
    return "".join(f"``{part}``" if n % 2 else SPECIAL.sub(r"\\\1", part) for n, part in enumerate(parts))


def process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrite the lines in place."""
    if len(lines) and NOTHING.fullmatch(lines[0]):
        lines.clear()
    lines[:] = [plain(line) for line in lines]
    if what == "class" and dataclasses.is_dataclass(obj):
        rows = [facts(field) for field in dataclasses.fields(obj) if field.metadata.get("doc")]
        lines += ["", *map(_item, rows)]
        lines.append("")


def _item(row: Facts) -> str:
    """A field as an item of a list."""
    told = [row.default and f"default {row.default}", row.unit, row.allowed]
    return f"- ``{row.name}``: {plain(row.doc)} ({'; '.join(filter(None, told))})"


def unlinked(app: Sphinx, env: Any, node: Any, text: Any) -> Any:
    """The mere text for a name of ours in a signature that exists but has no page: a type variable, an alias."""
    module, _, name = node.get("reftarget", "").rpartition(".")
    known = getattr(sys.modules.get(module), name, None)
    return None if known is None or hasattr(known, "__qualname__") else text


def setup(app: Sphinx) -> dict[str, bool]:
    """Register it."""
    app.connect("autodoc-process-docstring", process)
    app.connect("missing-reference", unlinked)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
