"""Markdown that says what a text says, whatever characters are in it."""

import inspect
import re
from collections.abc import Iterable, Sequence
from typing import Any

SPECIAL = re.compile(r"([\\|*<$\[\]])")


def escaped(text: str) -> str:
    """The text, its `names` as code and nothing else taken for markup."""
    parts = re.split(r"`+([^`]+)`+", text)
    return "".join(code(part) if n % 2 else SPECIAL.sub(r"\\\1", part) for n, part in enumerate(parts))


def code(text: str) -> str:
    """The text as code, also within a table."""
    bars = text.replace("|", "\\|")
    return f"`{bars}`" if text else ""


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> list[str]:
    """A table of finished cells, and an empty line; `kind`: its class, for the style sheet."""
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles), *(f"| {' | '.join(row)} |" for row in rows)]
    return [f":::{{container}} {kind}", "", *lines, "", ":::", ""] if kind else [*lines, ""]


def first_paragraph(thing: Any) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())


def paragraphs(thing: Any) -> list[str]:
    """A docstring as Markdown, an empty line after each paragraph."""
    found = (inspect.getdoc(thing) or "").split("\n\n")
    return [line for text in found for line in (escaped(" ".join(text.split())), "")]
