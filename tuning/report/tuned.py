"""tuned.toml: the user's case file, with its comments, and the tuned gains."""

import dataclasses
import pathlib
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.cases.own_laws import relocated
from ambjax.cases.reader import Case, case_from, is_as_written
from ambjax.cases.recordings import relocated_files
from ambjax.results.gains import gains_of

FIRST = "Tuned by ambjax tune from the case"
AUTO = "auto"
# First lines of tuned.toml. They are removed when the file is tuned again.
HEAD = re.compile(rf"\A# {FIRST} [^\n]*\n(#[^\n]*\n)?\n?")
# Numbers of a controller that are no gains, or follow from them.
NO_GAINS = ("controller.model.", "controller.notch.gains.", "processor.")
# Characters that a comment must not contain; surrogates come from file names that are not UTF-8.
CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def tuned_case(case: Case, gains: Mapping[str, float], verdict: str, out: pathlib.Path) -> tuple[str, Case]:
    """Return the text of tuned.toml for the folder `out`, and its case. Raises ValueError if the text is no valid case.

    If the integration step of the case is too coarse for the tuned gains, "auto" replaces clock.dt and clock.method,
    and the first lines of the text say so.

    The custom laws, the linear controller and the recorded signals are those of `case`: a change of their files during
    the search has no effect.
    """
    moved = relocated(case.own_laws, out) | relocated_files(case.recorded, out)
    moved |= case.controller_file.relocated(out) if case.controller_file else {}
    values = {**gains, **moved}
    text = tuned(case.text, values, case.name, verdict)
    try:
        return text, case_from(tomllib.loads(text), case.name, known=case)
    except ValueError as error:
        steps = [key for key in ("dt", "method") if tomllib.loads(case.text).get("clock", {}).get(key, AUTO) != AUTO]
        if not steps:
            raise
        words = f'{verdict} In [clock], "{AUTO}" replaces {" and ".join(steps)} of the case: {error}'
        text = tuned(case.text, {**values, **{f"clock.{key}": AUTO for key in steps}}, case.name, words)
        return text, case_from(tomllib.loads(text), case.name, known=case)


def tuned(text: str, gains: Mapping[str, float | str], case: str, verdict: str) -> str:
    """Return the text of a case file with each value of `gains` at its dotted path. Missing tables are added.

    A value is a gain, the kind of a law, or the path of a file.

    The text begins with a comment: the name of the case and the verdict. Raises ValueError if the text cannot be
    changed in this way.
    """
    body = with_numbers(HEAD.sub("", text.replace("\r\n", "\n")), gains)
    head = [f"# {CONTROL.sub(_escaped, line)}" for line in (f"{FIRST} '{case}'.", verdict)]
    return "\n".join([*head, "", body.strip()]) + "\n"


def with_numbers(text: str, gains: Mapping[str, float | str]) -> str:
    """Return the text of a case file with the values of `tuned`, without its comment. Raises ValueError as it does."""
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


def text_with_gains(case: Case | MachineCase) -> str:
    """Return the text of a case with its gains. Raises ValueError if more than gains was changed after it was read."""
    if not case.text:
        raise ValueError("case: it was made of parts, and has no tables. Give a path, or a dict of tables.")
    if isinstance(case, MachineCase):
        read = machine_from(tomllib.loads(case.text), case.name, case.text, case.folder)
        same = all(map(np.array_equal, *(jax.tree.leaves((one.machine, one.clock)) for one in (read, case))))
    elif not (same := is_as_written(case)):
        gains = {path: float(x) for path, x in gains_of(case).items() if not path.startswith(NO_GAINS)}
        text = with_numbers(case.text, gains)
        case = dataclasses.replace(case, text=text)
        same = is_as_written(case)
    if not same:
        raise ValueError("case: more than its gains was changed after it was read. Change its tables, and read them.")
    return case.text


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


def _escaped(character: re.Match[str]) -> str:
    return f"\\u{ord(character[0]):04x}"


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
