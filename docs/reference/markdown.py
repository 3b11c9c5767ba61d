"""Convert text to Markdown and escape its special characters."""

import inspect
import re
from collections.abc import Iterable, Sequence
from typing import Any

SPECIAL = re.compile(r"([\\|*<$\[\]])")
# An escaped link, [text](target).
LINK = re.compile(r"\\\[([^\[\]]+)\\\]\(")


def escaped(text: str) -> str:
    """Return the text with its `names` as code, its links as links, and all other markup escaped."""
    parts = re.split(r"`+([^`]+)`+", text)
    return "".join(
        code(part) if n % 2 else LINK.sub(r"[\1](", SPECIAL.sub(r"\\\1", part)) for n, part in enumerate(parts)
    )


def code(text: str) -> str:
    """Return the text as code, valid in a table too."""
    bars = text.replace("|", "\\|")
    return f"`{bars}`" if text else ""


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> list[str]:
    """Return a table of finished cells and an empty line; `kind`: its class in the style sheet."""
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles), *(f"| {' | '.join(row)} |" for row in rows)]
    return [f'<div class="{kind}">', "", *lines, "", "</div>", ""] if kind else [*lines, ""]


def first_paragraph(thing: Any) -> str:
    """Return the first paragraph of a docstring as one line."""
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())


def paragraphs(thing: Any) -> list[str]:
    """Return a docstring as Markdown, with an empty line after each paragraph, without the list of fields."""
    found = [text for text in (inspect.getdoc(thing) or "").split("\n\n") if not text.startswith("- `")]
    return [line for text in found for line in (escaped(" ".join(text.split())), "")]
