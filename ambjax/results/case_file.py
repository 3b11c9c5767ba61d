"""Cases written as files: the text of a case that was read, whose comments stay, with its gains."""

import dataclasses
import os
import pathlib
import tomllib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table

from ambjax.cases.machine_case import AnyCase, MachineCase, machine_from
from ambjax.cases.own_laws import key_of
from ambjax.cases.reader import Case, is_as_written
from ambjax.cases.table import file_to_write, put
from ambjax.ensemble.paths import places

# Numbers of a controller that are no gains, or follow from them.
NO_GAINS = ("controller.model.", "controller.notch.gains.")


def save_case(path: str | pathlib.Path, case: Case) -> None:
    """Write a case of one axis, with the gains that `with_gains` gave it, as a file for the commands.

    The file keeps the comments of the file that was read. Raises ValueError if the case was made of parts, if more than
    its gains was changed after it was read, and if the folder of `path` does not exist.

        ambjax.save_case("mine.toml", ambjax.with_gains(case, {"controller.position.c": 20.0}))
    """
    if not isinstance(case, Case):
        raise ValueError(f"save_case: case = {type(case).__name__}: it must be a case of one axis, as of read_case.")
    path = file_to_write("save_case", path)
    path.write_text(with_numbers(text_with_gains(case), files_from(case, path.parent)), encoding="utf-8")


def files_from(case: Case, out: pathlib.Path) -> dict[str, str]:
    """Return the names of the files of a case for a case file in the folder `out`, by dotted path."""
    found = {one.key: _path_from(one.written, one.file, out) for one in case.files}
    for law in case.own_laws:
        source, name = law.kind.rpartition(":")[0], law.law.__name__
        found[key_of(law.stage)] = law.kind if law.file is None else f"{_path_from(source, law.file, out)}:{name}"
    return found


def _path_from(written: str, file: pathlib.Path, folder: pathlib.Path) -> str:
    """Return the path of `file` for a case file in `folder`: `written` if it leads there, else a new one."""
    if (folder / written).resolve() == file:
        return written
    try:
        return pathlib.Path(os.path.relpath(file, folder.resolve())).as_posix()
    except ValueError:  # another drive of Windows
        return file.as_posix()


def text_with_gains(case: AnyCase) -> str:
    """Return the text of a case with its gains. Raises ValueError if more than gains was changed after it was read."""
    if not case.text:
        raise ValueError("case: it was made of parts, and has no tables. Give a path, or a dict of tables.")
    if isinstance(case, MachineCase):
        read = machine_from(tomllib.loads(case.text), case.name, case.text, case.folder)
        same = all(map(np.array_equal, *(jax.tree.leaves((one.machine, one.clock)) for one in (read, case))))
    elif not (same := is_as_written(case)):
        known = places(case.cascade, case.scenario).items()
        own = [(path, one.value) for path, one in known if path.startswith("controller.") and one.value is not None]
        gains = {path: float(x) for path, x in own if not path.startswith(NO_GAINS)}
        text = with_numbers(case.text, gains)
        case = dataclasses.replace(case, text=text)
        same = is_as_written(case)
    if not same:
        raise ValueError("case: more than its gains was changed after it was read. Change its tables, and read them.")
    return case.text


def with_numbers(text: str, gains: Mapping[str, float | str]) -> str:
    """Return the text of a case file with each value of `gains` at its dotted path. Missing tables are added.

    A value is a gain, the kind of a law, or the path of a file. Raises ValueError if the text cannot be changed in this
    way.
    """
    try:
        document, wanted = tomlkit.parse(text), tomllib.loads(text)
        for path, value in gains.items():
            *tables, name = _words(path)
            _put(_table(document, tables), name, value if isinstance(value, str) else float(value))
            put(wanted, [*tables, name], value)
        body = tomlkit.dumps(document)
        if tomllib.loads(body) != wanted:
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
