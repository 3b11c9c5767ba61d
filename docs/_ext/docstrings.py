"""Convert plain-text docstrings with `names` in backticks and indented code for autodoc, and resolve links."""

import operator
import re
import sys
from typing import Any

from sphinx.application import Sphinx

# Characters that mean something in reStructuredText but nothing in a docstring.
SPECIAL = re.compile(r"([\\*|_])")
# Text that NamedTuple gives an undocumented field.
NOTHING = re.compile(r"Alias for field number \d+")


def plain(line: str) -> str:
    """Return a line with its names as literals and all other text escaped."""
    parts = re.split(r"`+([^`]+)`+", line)
    return "".join(f"``{part}``" if n % 2 else SPECIAL.sub(r"\\\1", part) for n, part in enumerate(parts))


def process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Rewrite the lines in place."""
    if len(lines) and NOTHING.fullmatch(lines[0]):
        lines.clear()
    lines[:] = restructured(lines)


def restructured(lines: list[str]) -> list[str]:
    """Return the lines of a docstring as reStructuredText. A block indented by four spaces is code."""
    found, inside = [], False
    for before, line in zip(["", *lines], lines, strict=False):
        begins = line.startswith("    ") and not before.strip() and not inside
        inside = begins or (inside and (not line.strip() or line.startswith("    ")))
        found += ["::", ""] if begins else []
        found.append(line if inside else plain(line))
    return found


def elsewhere(app: Sphinx, env: Any, node: Any, text: Any) -> Any:
    """Return the target of a name without its own entry: the base class of an inherited method, or plain text.

    Plain text for a name without a page, such as a type variable in a signature. None for an
    unknown name; the build stops.
    """
    thing, target = _named(node.get("reftarget", "")), node.get("reftarget")
    if thing is None:
        return None
    written = getattr(thing, "fget", thing)
    place = f"{getattr(written, '__module__', '')}.{getattr(written, '__qualname__', '')}"
    if not hasattr(written, "__qualname__"):
        return text
    if place == target:
        return None
    return env.get_domain("py").resolve_xref(env, node["refdoc"], app.builder, node["reftype"], place, node, text)


def _named(dotted: str) -> Any:
    """Return the object with a dotted name among the loaded modules, or None."""
    module, rest = dotted, ""
    while module and module not in sys.modules:
        module, _, last = module.rpartition(".")
        rest = f"{last}.{rest}".rstrip(".")
    try:
        return operator.attrgetter(rest)(sys.modules[module]) if module and rest else None
    except AttributeError:
        return None


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("autodoc-process-docstring", process)
    app.connect("missing-reference", elsewhere)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
