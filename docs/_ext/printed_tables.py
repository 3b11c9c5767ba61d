"""Tables that cells print as text become HTML tables, which fit a phone.

A printed table has a line of titles, a line of dashes under each column, and rows, with two spaces between columns
(`ambjax.results.outputs.table`).
"""

import html
import re

from docutils import nodes
from sphinx.application import Sphinx

RULE = re.compile(r"-+(  -+)+")
GAP = "  "


def split(text: str) -> list[str | list[list[str]]]:
    """Return the parts of an output: a string for text, a list of rows (titles first) for a table."""
    lines, parts, plain = text.splitlines(), [], []
    n = 0
    while n < len(lines):
        if not (n + 1 < len(lines) and RULE.fullmatch(lines[n + 1])):
            plain.append(lines[n])
            n += 1
            continue
        starts = [0, *(match.end() for match in re.finditer(GAP, lines[n + 1]))]
        rows = [_cells(lines[n], starts)]
        n += 2
        while n < len(lines) and lines[n].strip() and all(lines[n][s - 2 : s].strip() == "" for s in starts[1:]):
            rows.append(_cells(lines[n], starts))
            n += 1
        parts += ["\n".join(plain), rows]
        plain = []
    return [part for part in [*parts, "\n".join(plain)] if not isinstance(part, str) or part.strip()]


def _cells(line: str, starts: list[int]) -> list[str]:
    return [line[a:b].strip() for a, b in zip(starts, [*starts[1:], None], strict=True)]


def as_html(rows: list[list[str]]) -> str:
    """Return rows as an HTML table whose cells know the title of their column."""
    titles = [html.escape(title) for title in rows[0]]
    head = "".join(f"<th>{title}</th>" for title in titles)
    body = "".join(
        "<tr>"
        + "".join(f'<td data-title="{title}">{html.escape(cell)}</td>' for title, cell in zip(titles, row, strict=True))
        + "</tr>"
        for row in rows[1:]
    )
    table = f'<table class="docutils"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f'<div class="printed">{table}</div>'


def convert(app: Sphinx, tree: nodes.document) -> None:
    """Replace the printed tables in the outputs of a page's cells."""
    for block in list(tree.findall(nodes.literal_block)):
        parts = split(block.astext())
        if "output" not in block["classes"] or all(isinstance(part, str) for part in parts):
            continue
        made: list[nodes.Node] = []
        for part in parts:
            if isinstance(part, str):
                text = part.strip("\n")
                made.append(nodes.literal_block(text, text, language="none", classes=list(block["classes"])))
            else:
                made.append(nodes.raw("", as_html(part), format="html"))
        block.replace_self(made)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension."""
    app.connect("doctree-read", convert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
