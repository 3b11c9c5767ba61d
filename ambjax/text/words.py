"""Text for messages."""

import shlex
from collections.abc import Sequence


def one_line(text: str) -> str:
    """Return the text with escapes for line breaks and other characters that do not print, so that it is one line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def number(x: float | None, digits: int = 4) -> str:
    """Return a number for a table, with a number of digits; "-" for None."""
    return "-" if x is None else f"{x:.{digits}g}"


def command(*words: str) -> str:
    """Return a command for a message, between backticks, with words quoted as a shell requires."""
    return f"`{shlex.join(words)}`"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a Markdown table. Cells are Markdown; `|` is escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(cell.replace("\\|", "|").replace("|", "\\|") for cell in line) + " |" for line in lines]
