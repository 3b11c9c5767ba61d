"""The files that a case names, and its recorded signals: `kind = "table"` with a file of times and values."""

import csv
import dataclasses
import math
import pathlib
import zipfile
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.own_laws import OwnLaw
from ambjax.cases.table import Table, quoted, show
from ambjax.world.recorded import Recorded, Samples

INTERPOLATIONS = ["linear", "held"]
KEYS = ["file", "columns", "interpolation", "scale", "start"]
FIELDS = {field.name: field for field in dataclasses.fields(Recorded)}


class RecordedFile(NamedTuple):
    """A file that a case names: the dotted path of its key, the path as written, the absolute path, the samples."""

    key: str
    written: str
    file: pathlib.Path
    samples: Samples


class CaseFiles:
    """The files that a case names, as they are read: custom laws, a linear controller or None, and recorded signals.

    - `folder`: folder of the case file, to which paths are relative.
    - `known`: a `Case` that names the same files; they are not opened again.
    """

    def __init__(self, folder: pathlib.Path = pathlib.Path(), known: Any = None) -> None:
        self.folder, self.known = folder, known
        self.own_laws: list[OwnLaw] = []
        self.controller: Any = None
        self.recorded: list[RecordedFile] = []

    def signal(self, table: Table, extra: tuple[str, ...] = ()) -> Recorded:
        """Return the signal of a table with `kind = "table"`. `extra`: further keys that the table may have."""
        table.only(["kind", *KEYS, *extra])
        held = table.choice("interpolation", INTERPOLATIONS, INTERPOLATIONS[0]) == "held"
        scale, start = (table.leaf(name, FIELDS[name], FIELDS[name].default) for name in ("scale", "start"))
        columns, key = _columns(table), table.at("file")
        known = [one for one in self.known.recorded if one.key == key] if self.known else []
        self.recorded += known or [self._opened(key, table.raw.get("file"), columns)]
        return Recorded(self.recorded[-1].samples, held, scale, start)

    def _opened(self, key: str, written: object, columns: tuple[str, str] | None) -> RecordedFile:
        def refuse(why: str) -> ValueError:
            return ValueError(f"{key} = {show(written)}: {why}")

        if written is None:
            raise ValueError(f"{key} is missing: give the path of a file, {quoted(list(READERS))}.")
        if not isinstance(written, str) or pathlib.PurePath(written).suffix.lower() not in READERS:
            raise refuse(f"it must be the path of a file, {quoted(list(READERS))}, relative to the case file.")
        file = (self.folder / written).resolve()
        try:
            found = READERS[file.suffix.lower()](file)
            return RecordedFile(key, written, file, Samples(*_chosen(found, columns)))
        except OSError as error:
            why = (
                f"{file} cannot be read ({error.strerror or error}). A path is relative to the folder of the case file"
            )
            raise refuse(f"{why}.") from None
        except ValueError as error:
            raise refuse(f"{error}") from None


def _columns(table: Table) -> tuple[str, str] | None:
    """Return the names of the columns of time and value; None if the table does not give them."""
    names = table.raw.get("columns")
    if names is None:
        return None
    if not isinstance(names, list) or len(names) != 2 or not all(isinstance(one, str) for one in names):
        raise ValueError(f'{table.at("columns")} = {show(names)}: it must be two names, ["t", "force"] for example.')
    return names[0], names[1]


def _chosen(found: dict[str, np.ndarray], columns: tuple[str, str] | None) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values. If `columns` is None, the file must have exactly two columns."""
    listed = ", ".join(found) or "none"
    if columns is None:
        if len(found) != 2:
            raise ValueError(f"it has the columns {listed}; name those of time and value with columns = [TIME, VALUE].")
        time, value = found
        columns = time, value
    for name in columns:
        if name not in found:
            raise ValueError(f"it has no column '{name}'. Its columns: {listed}.")
    return found[columns[0]], found[columns[1]]


def _csv(file: pathlib.Path) -> dict[str, np.ndarray]:
    """Read columns separated by semicolons, tabs, commas or spaces.

    The first line decides the separator, and may name the columns; otherwise they are "1", "2" and so on. Unless commas
    separate columns, a number may have a decimal comma. Lines that begin with # are comments.
    """
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError("it is not a text file in UTF-8.") from None
    numbered = [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not numbered:
        raise ValueError("it is empty.")
    between = next((mark for mark in ";\t, " if mark in numbered[0][1].strip()), ",")
    if between == " ":
        numbered, between = [(n, "\t".join(line.split())) for n, line in numbered], "\t"
    comma = between != ","
    try:
        rows = list(csv.reader((line for _, line in numbered), delimiter=between))
    except csv.Error:  # a cell longer than the limit of the module csv
        rows = []
    if len(rows) != len(numbered):
        raise ValueError('a quotation mark " is not closed.')
    named = any(_float(cell, comma) is None for cell in rows[0])
    names = [cell.strip() for cell in rows[0]] if named else [str(n + 1) for n in range(len(rows[0]))]
    if len(set(names)) < len(names):
        raise ValueError(f"two of its columns have the same name: {', '.join(names)}.")
    table = np.empty((len(rows) - named, len(names)))
    for n, (row, (line, _)) in enumerate(zip(rows[named:], numbered[named:], strict=True)):
        if len(row) != len(names):
            raise ValueError(f"line {line} has {len(row)} columns, but the first line has {len(names)}.")
        for k, cell in enumerate(row):
            if not cell.strip():
                raise ValueError(f"line {line}: the cell of column '{names[k]}' is empty. Give a number.")
            if (number := _float(cell, comma)) is None:
                raise ValueError(f"line {line}: {show(cell)} is not a number.")
            table[n, k] = number
    return dict(zip(names, table.T, strict=True))


def _float(cell: str, comma: bool) -> float | None:
    """Return the number in a cell; NaN if the cell is empty, None if its text is not a number."""
    try:
        return float(cell.replace(",", ".") if comma else cell) if cell.strip() else math.nan
    except ValueError:
        return None


def npz_arrays(file: pathlib.Path) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file. Raises ValueError for another one, or for pickled objects."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (ValueError, TypeError, AttributeError, zipfile.BadZipFile, EOFError):  # TypeError: an array of numpy.save
        raise ValueError("it is not an .npz file of plain numbers. Write it with numpy.savez.") from None


def _parquet(file: pathlib.Path) -> dict[str, np.ndarray]:
    try:
        from pyarrow import lib, parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError("a Parquet file needs pyarrow. Install it with: pip install 'ambjax[tables]'.") from None
    try:
        table = parquet.read_table(file)
    except lib.ArrowInvalid:
        raise ValueError("it is not a Parquet file.") from None
    return {name: table[name].to_numpy() for name in table.column_names}


READERS = {".csv": _csv, ".tsv": _csv, ".txt": _csv, ".npz": npz_arrays, ".parquet": _parquet}
