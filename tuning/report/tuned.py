"""tuned.toml: the case file as its author wrote it, comments and all, with the tuned gains."""

import re
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table

FIRST = "Tuned by ambjax-tune from the case"
# What such a file begins with: it says nothing of the next search.
HEAD = re.compile(rf"\A# {FIRST} [^\n]*\n(#[^\n]*\n)?\n?")
# What may stand in no comment; halves of characters are names of files that are not UTF-8.
CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def tuned(text: str, gains: Mapping[str, float], case: str, verdict: str) -> str:
    """The text of a case file with the numbers at these dotted paths; tables that lack are added.

    It begins with the name of the case and the verdict as a comment. Raises ValueError where the text cannot be
    changed so.
    """
    try:
        document = tomlkit.parse(HEAD.sub("", text.replace("\r\n", "\n")))
        for path, value in gains.items():
            *tables, name = path.split(".")
            _put(_table(document, tables), name, float(value))
        body = tomlkit.dumps(document)
    except (TOMLKitError, ValueError, TypeError) as why:
        raise ValueError(f"gains cannot be written into it ({why}). Give each law a table [controller.STAGE].") from why
    head = [f"# {CONTROL.sub(_escaped, line)}" for line in (f"{FIRST} '{case}'.", verdict)]
    return "\n".join([*head, "", body.strip()]) + "\n"


def _escaped(character: re.Match[str]) -> str:
    return f"\\u{ord(character[0]):04x}"


def _table(table: Any, path: list[str]) -> Any:
    """The table at this path, added where it lacks: inline in an inline one, else behind the last of its kind."""
    for word in path:
        if word not in table:
            inline = isinstance(table, InlineTable)
            table[word] = tomlkit.inline_table() if inline else _behind(_last(table))
        table = table[word]
    return table


def _put(table: Any, name: str, value: float) -> None:
    """The number under this name; behind the others if it is new, and as it is written if it is that number."""
    if name in table:
        if table[name] != value:
            table[name] = value
    elif isinstance(table, Table):
        rest = _cut(table)
        table[name] = value
        table.value.body.extend(rest)
    else:
        table[name] = value


def _behind(last: Table | None) -> Table:
    """A new table that takes over the comments at the end of the one before: they are about what comes next."""
    table = tomlkit.table()
    rest = [] if last is None else _cut(last)
    table.value.body.extend(rest or [(None, tomlkit.nl())])
    return table


def _last(table: Any) -> Table | None:
    """The innermost table at the end of a table of tables; None where there is none, or its parts lie apart."""
    last = None
    while isinstance(table, Table):
        last = table
        table = next((item for key, item in reversed(table.value.body) if key is not None), None)
    return last


def _cut(table: Table) -> list[Any]:
    """Take off, and return, the comments and empty lines at the end of a table."""
    body = table.value.body
    end = len(body)
    while end and body[end - 1][0] is None:
        end -= 1
    rest = body[end:]
    del body[end:]
    return rest
