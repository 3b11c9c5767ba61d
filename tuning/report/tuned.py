"""tuned.toml: the case file as its author wrote it, comments and all, with the tuned gains."""

import re
import tomllib
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Table

FIRST = "Tuned by ambjax tune from the case"
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
        if tomllib.loads(body) != _wanted(text, gains):
            raise ValueError("what is written would be another case")
    except (TOMLKitError, ValueError, TypeError, KeyError) as why:
        raise ValueError(f"gains cannot be written into it ({why}). Give each law a table [controller.STAGE].") from why
    head = [f"# {CONTROL.sub(_escaped, line)}" for line in (f"{FIRST} '{case}'.", verdict)]
    return "\n".join([*head, "", body.strip()]) + "\n"


def _wanted(text: str, gains: Mapping[str, float]) -> dict[str, Any]:
    """What the changed text must say."""
    document = tomllib.loads(text)
    for path, value in gains.items():
        table = document
        *tables, name = path.split(".")
        for word in tables:
            table = table.setdefault(word, {})
        table[name] = value
    return document


def _escaped(character: re.Match[str]) -> str:
    return f"\\u{ord(character[0]):04x}"


def _table(table: Any, path: list[str]) -> Any:
    """The table at this path, added where it lacks: inline in an inline one, else behind the last of its kind; at the
    end where keys of the root come after that, which would be the new table's."""
    document = table
    for depth, word in enumerate(path):
        if word not in table:
            if isinstance(table, InlineTable):
                table[word] = tomlkit.inline_table()
            elif depth and _followed(document, path[0]):
                _append(document, path[:depth], word)
                return _table(document, path)
            else:
                table[word] = _behind(_last(table))
        table = table[word]
    return table


def _followed(document: tomlkit.TOMLDocument, name: str) -> bool:
    """Whether keys of the root come after the root's first item of this name."""
    keys = [(key, item) for key, item in document.body if key is not None]
    first = next(n for n, (key, _) in enumerate(keys) if key.key == name)
    return any(key.is_dotted() or not isinstance(item, (Table, AoT)) for key, item in keys[first + 1 :])


def _append(document: tomlkit.TOMLDocument, path: list[str], word: str) -> None:
    """Add an empty table [path.word] at the end of the document."""
    table = tomlkit.table().add(tomlkit.nl())
    for name in [word, *reversed(path[1:])]:
        table = tomlkit.table(is_super_table=True).add(name, table)
    document.append(path[0], table)


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
