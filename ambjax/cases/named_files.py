"""The files that a case names: recorded signals, and the matrices of linear controllers."""

import contextlib
import csv
import dataclasses
import math
import pathlib
import zipfile
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.own_laws import OwnLaw
from ambjax.cases.table import Table, file_to_write, quoted, show
from ambjax.control.linear_controller import state_space_of
from ambjax.control.realisation import realisation
from ambjax.host.extensions import extra
from ambjax.world.recorded import Recorded, Samples

INTERPOLATIONS = ["linear", "held"]
KEYS = ["file", "columns", "interpolation", "scale", "start"]
FIELDS = {field.name: field for field in dataclasses.fields(Recorded)}


# Arrays of a linear controller, and endings of its file.
NAMES, OPTIONAL = ("A", "B", "C", "D"), "dt"
NEEDED = "the arrays A, B, C, D and, for a discrete controller, dt in s"
ENDINGS = (".npz", ".mat")


class NamedFile(NamedTuple):
    """A file that a case names: the dotted path of its key, the path as written, the absolute path, its contents."""

    key: str
    written: str
    file: pathlib.Path
    contents: Any


class CaseFiles:
    """The files that a case names, as they are read: custom laws; a linear controller and recorded signals.

    `folder`: that of the case file. `known`: a `Case` that names the same files; they are not opened again.
    """

    def __init__(self, folder: pathlib.Path = pathlib.Path(), known: Any = None) -> None:
        self.folder, self.known = folder, known
        self.own_laws: list[OwnLaw] = []
        self.files: list[NamedFile] = []

    def contents(self, key: str, opened: Callable[[], NamedFile]) -> Any:
        """Return the contents of the file of a key. `opened`: opens it, unless it is known."""
        known = [one for one in self.known.files if one.key == key] if self.known else []
        self.files += known or [opened()]
        return self.files[-1].contents

    def signal(self, table: Table, extra: tuple[str, ...] = ()) -> Recorded:
        """Return the signal of a table with `kind = "table"`. `extra`: further keys that the table may have."""
        table.only(["kind", *KEYS, *extra])
        held = table.choice("interpolation", INTERPOLATIONS, INTERPOLATIONS[0]) == "held"
        scale, start = (table.leaf(name, FIELDS[name], FIELDS[name].default) for name in ("scale", "start"))
        columns = _columns(table)
        samples = self.contents(table.at("file"), lambda: _recording(table, self.folder, columns))
        return Recorded(samples, held, scale, start)


def _recording(table: Table, folder: pathlib.Path, columns: tuple[str, str] | None) -> NamedFile:
    written, words = table.raw.get("file"), f"the path of a file, {quoted(list(READERS))}"
    if not isinstance(written, str) or pathlib.PurePath(written).suffix.lower() not in READERS:
        raise table.refuse("file", f"it must be {words}, relative to the case file.")
    convert = lambda file: Samples(*_chosen(READERS[file.suffix.lower()](file), columns))  # noqa: E731
    return _opened(table.at("file"), written, folder, convert)


def _opened(key: str, written: str, folder: pathlib.Path, read: Callable[[pathlib.Path], Any]) -> NamedFile:
    named = folder / written  # the file that a link leads to may have another ending
    try:
        return NamedFile(key, written, named.resolve(), read(named))
    except OSError as error:
        unread = f"{named.resolve()} cannot be read ({error.strerror or error})"
        why = f"{unread}. A path is relative to the folder of the case file."
    except ValueError as error:
        why = str(error)
    raise ValueError(f"{key} = {show(written)}: {why}")


def _columns(table: Table) -> tuple[str, str] | None:
    """Return the names of the columns of time and value; None if the table does not give them."""
    names = table.raw.get("columns")
    if names is None:
        return None
    if not isinstance(names, list) or len(names) != 2 or not all(isinstance(one, str) for one in names):
        raise table.refuse("columns", 'it must be two names, ["t", "force"] for example.')
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
    lib, parquet = (extra(f"pyarrow.{name}") for name in ("lib", "parquet"))
    try:
        table = parquet.read_table(file)
    except lib.ArrowInvalid:
        raise ValueError("it is not a Parquet file.") from None
    return {name: table[name].to_numpy() for name in table.column_names}


READERS = {".csv": _csv, ".tsv": _csv, ".txt": _csv, ".npz": npz_arrays, ".parquet": _parquet}


def contents_of(table: Table, folder: pathlib.Path, convert: Callable[[dict[str, np.ndarray]], Any]) -> NamedFile:
    """Read the .npz or .mat file that the key `file` names. Its contents are convert(arrays)."""
    written, key = table.raw["file"], table.at("file")
    if not isinstance(written, str) or not written.endswith(ENDINGS):
        raise table.refuse("file", "it must be the path of an .npz or .mat file.")
    return _opened(key, written, folder, lambda file: convert((npz_arrays if file.suffix == ".npz" else _of_mat)(file)))


def controller_file(table: Table, folder: pathlib.Path, convert: Callable[..., Any] = realisation) -> NamedFile:
    """Read the controller that the key `file` names. Its contents are convert(A, B, C, D, dt) of its arrays.

    A relative path starts at `folder`, that of the case file. Raises ValueError, one line, if the key is missing or the
    file does not contain a controller. The message gives the dotted path and, if known, the file and the array.
    """

    def matrices(arrays: dict[str, np.ndarray]) -> Any:
        if missing := [name for name in NAMES if name not in arrays]:
            found = ", ".join(name for name in arrays if not name.startswith("_")) or "none"
            raise ValueError(f"the array {missing[0]} is missing. The file must contain {NEEDED}; it has {found}.")
        return convert(**{name: arrays[name] for name in (*NAMES, OPTIONAL) if name in arrays})

    if "file" not in table.raw:
        raise ValueError(f"{table.at('file')} is missing: give the path of an .npz or .mat file with {NEEDED}.")
    return contents_of(table, folder, matrices)


def _of_mat(path: pathlib.Path) -> dict[str, np.ndarray]:
    import scipy.io

    try:
        arrays = scipy.io.loadmat(path, appendmat=False)
    except NotImplementedError:
        raise ValueError("a .mat file of version 7.3, which is not supported. Save it with the option -v7.") from None
    except OSError as error:
        raise OSError(error.errno, error.strerror or "is it a file?") from None
    except Exception:  # SciPy raises errors of many types for a damaged file
        raise ValueError("not a .mat file. Save the arrays with MATLAB's save and the option -v7.") from None
    with contextlib.suppress(KeyError):  # MATLAB stores a number as a matrix
        arrays[OPTIONAL] = arrays[OPTIONAL].squeeze()
    return arrays


def save_controller(path: str | pathlib.Path, system: Any) -> None:
    """Write a linear controller of python-control or SciPy into an .npz or .mat file, for `kind = "linear"` of a case.

    `system`: a transfer function, or an object with the matrices A, B, C, D; with the period dt (s). Without it, or if
    it is None or 0, the system is continuous. Raises ValueError for another ending of the path, for a directory that
    does not exist, and for matrices that are not those of a controller (`state_space_of`, `realisation`).

        ambjax.save_controller("controller.npz", control.tf([2e4, 5e6], [1.0, 3e4]))
    """
    path = file_to_write("save_controller", path)
    system = state_space_of(system)
    dt = getattr(system, OPTIONAL, None)
    arrays = {name: np.asarray(getattr(system, name)) for name in NAMES}
    realisation(**arrays, dt=dt)
    arrays[OPTIONAL] = np.asarray(0.0 if dt is None else dt)
    if not str(path).endswith(ENDINGS):
        raise ValueError(f"{path}: the file must end in .npz or .mat.")
    if path.suffix == ENDINGS[0]:
        np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]
    else:
        import scipy.io

        scipy.io.savemat(path, arrays)
