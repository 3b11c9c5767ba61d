"""Numbers written into the text of a case file, whose comments stay."""

import tomllib
from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table


def with_numbers(text: str, gains: Mapping[str, float | str]) -> str:
    """Return the text of a case file with each value of `gains` at its dotted path. Missing tables are added.

    A value is a gain, the kind of a law, or the path of a file. Raises ValueError if the text cannot be changed in this
    way.
    """
    try:
        document = tomlkit.parse(text)
        for path, value in gains.items():
            *tables, name = _words(path)
            _put(_table(document, tables), name, value if isinstance(value, str) else float(value))
        body = tomlkit.dumps(document)
        if tomllib.loads(body) != _wanted(text, gains):
            raise ValueError("what is written would be another case")
    except (TOMLKitError, ValueError, TypeError, KeyError) as why:
        raise ValueError(f"gains cannot be written into it ({why}). Give each law a table [controller.STAGE].") from why
    return body


def _words(path: str) -> list[Any]:
    """Return the words of a dotted path; the index of a list is a word, as in disturbance.q_z[1].file.

    A last word that is an index denotes a knot of a schedule: k[2] gives the words k, values, 2.
    """
    *words, last = path.replace("[", ".").replace("]", "").split(".")
    return [*words, "values", int(last)] if last.isdigit() else [*words, last]


def _wanted(text: str, gains: Mapping[str, float | str]) -> dict[str, Any]:
    """Return the data that the changed text must parse to."""
    document = tomllib.loads(text)
    for path, value in gains.items():
        table: Any = document
        *tables, name = _words(path)
        for word in tables:
            table = table[int(word)] if isinstance(table, list) else table.setdefault(word, {})
        table[name] = value
    return document


def _table(table: Any, path: list[str]) -> Any:
    """Return the table at this path. A missing one is added: in an inline table, or at the end of the document.

    A table in the middle would take over the root keys that follow.
    """
    document, nested = table, False
    for depth, word in enumerate(path):
        if isinstance(table, list):
            table, nested = table[int(word)], True
            continue
        if word not in table and nested and isinstance(table, Table):
            table[word] = tomlkit.table()
        if word not in table and isinstance(table, InlineTable):
            table[word] = tomlkit.inline_table()
        elif word not in table:
            _append(document, path[: depth + 1])
            return _table(document, path)
        table = table[word]
    return table


def _append(document: tomlkit.TOMLDocument, path: list[str]) -> None:
    """Add an empty table at this path at the end of the document."""
    table = tomlkit.table().add(tomlkit.nl())
    for name in reversed(path[1:]):
        table = tomlkit.table(is_super_table=True).add(name, table)
    document.append(path[0], table)


def _put(table: Any, name: str | int, value: float | str) -> None:
    """Set the value of this name or index. A missing name is appended; an equal value keeps its text."""
    if isinstance(name, int) or name in table:
        if table[name] != value:
            table[name] = value
    elif isinstance(table, Table):
        rest = _cut(table)
        table[name] = value
        table.value.body.extend(rest)
    else:
        table[name] = value


def _cut(table: Table) -> list[Any]:
    """Remove and return the comments and empty lines at the end of a table."""
    body = table.value.body
    end = len(body)
    while end and body[end - 1][0] is None:
        end -= 1
    rest = body[end:]
    del body[end:]
    return rest
