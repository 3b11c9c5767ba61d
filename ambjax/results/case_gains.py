"""The gains of a case: read and replaced by dotted path, and written into its file, whose comments stay."""

import dataclasses
import os
import pathlib
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tomlkit
from jax import Array
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table

from ambjax.cases.machine_case import AnyCase, MachineCase, machine_from
from ambjax.cases.own_laws import key_of
from ambjax.cases.reader import Case, is_as_written
from ambjax.cases.table import file_to_write, put
from ambjax.control.cascade import Cascade
from ambjax.ensemble.paths import places, with_values
from ambjax.ensemble.spread import no_such_number
from ambjax.linear.analysis import linearisation_inputs
from ambjax.linear.notch_design import redesigned_at_once
from ambjax.world.scenario import Scenario

Loop = TypeVar("Loop", Cascade, Case)
# Numbers of a controller that are no gains, or follow from them.
NO_GAINS = ("controller.model.", "controller.notch.gains.")


def gains_of(loop: Cascade | Case, paths: Iterable[str] | None = None) -> dict[str, Array]:
    """Return the numbers of a controller at dotted paths, such as "controller.position.c", as a dict of scalars.

    - `loop`: a cascade, or a case.
    - `paths`: the paths; None: those of all numbers of the cascade that have a value.

    Use it for derivatives with respect to these gains only: the dict is a pytree. Raises ValueError for a path that
    does not exist, or without a value.

        gains = ambjax.gains_of(case, ["controller.position.c"])
        jax.grad(lambda gains: f(ambjax.with_gains(case, gains)))(gains)
    """
    if isinstance(paths, str):
        raise ValueError(f'paths = "{paths}": it must be a list. Write ["{paths}"].')
    if paths is not None and not isinstance(paths, Iterable):
        raise ValueError(f"paths = {paths!r}: it must be a list of dotted paths, such as controller.position.c.")
    known = _numbers(loop, paths := None if paths is None else list(paths))
    if none := [path for path in paths or () if known[path] is None]:
        raise ValueError(f"{none[0]} = None: it has no value in this loop. Leave it out, or set it by `with_gains`.")
    chosen = [path for path in known if known[path] is not None] if paths is None else paths
    return {path: jnp.asarray(known[path], jnp.result_type(float)) for path in chosen}


def _numbers(loop: Cascade | Case, paths: Iterable[str] | None) -> dict[str, Any]:
    """Return the numbers of a controller by path; None: without a value. Raises ValueError for an unknown path."""
    cascade = loop.cascade if isinstance(loop, Case) else loop
    if not isinstance(cascade, Cascade):
        raise ValueError(f"loop = {type(loop).__name__}: it must be a Case, or a Cascade such as `case.cascade`.")
    known = places(cascade, Scenario())
    own = {path: one.value for path, one in known.items() if path.startswith(("controller.", "processor."))}
    if unknown := [path for path in paths or () if path not in own]:
        raise ValueError(f"{unknown[0]}: {no_such_number(unknown[0], list(own))}")
    return own


def with_gains(loop: Loop, gains: Mapping[str, Any]) -> Loop:
    """Return a cascade or a case with other gains. `gains`: values by dotted path, in the units of the case file.

    The values may be traced. A synchronous notch of a case is designed for its new gains, unless they contain gains of
    the notch; that of a cascade alone is not, because its design needs the scenario. Raises ValueError for a path that
    does not exist, and for a number outside its range; arrays and traced values are not checked.

        ambjax.with_gains(case, {"controller.position.c": 20.0})
    """
    if not isinstance(gains, Mapping):
        raise ValueError(f"gains = {gains!r}: it must be a dict of values by dotted path.")
    _numbers(loop, gains)
    if isinstance(loop, Case):
        cascade = with_gains(loop.cascade, gains)
        if cascade.notch is not None and not any(path.startswith("controller.notch.gains.") for path in gains):
            anew = redesigned_at_once(*linearisation_inputs(cascade, loop.scenario, loop.clock))
            cascade = dataclasses.replace(cascade, notch=dataclasses.replace(cascade.notch, gains=anew))
        return dataclasses.replace(loop, cascade=cascade)
    return with_values(loop, Scenario(), gains)[0]


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
