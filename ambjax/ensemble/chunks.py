"""The chunks of a study: one file with a checksum for each (`host.sealed`), and their merge into one archive."""

import collections
import dataclasses
import hashlib
import pathlib
import zipfile
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

import numpy as np

from ambjax.host.sealed import Arrays, DamagedError, difference, seal, shapes, unseal

# Time stamp of all entries. It is fixed, so that equal results give equal files.
EPOCH = (1980, 1, 1, 0, 0, 0)

Span = tuple[int, int]


class Column(NamedTuple):
    """A column of all members: its dtype in JSON form, and the SHA-256 of its numbers."""

    kind: Any
    digest: str


@dataclasses.dataclass(frozen=True)
class Chunks:
    """The chunks of a study in a directory.

    `members`: number of members of the study. `size`: that of a chunk; 0 if it is not known yet. `study`: checksum of
    the facts of the study, which every chunk records.
    """

    directory: pathlib.Path
    members: int
    size: int
    study: str

    def spans(self) -> list[Span]:
        """Return all chunks in order as (first member, last member + 1); an empty list if the size is not known."""
        if not self.size:
            return []
        return [(n, min(n + self.size, self.members)) for n in range(0, self.members, self.size)]

    def path(self, span: Span) -> pathlib.Path:
        return self.directory / f"{span[0]:012d}-{span[1]:012d}.npz"

    def put(self, span: Span, columns: Arrays) -> None:
        seal(self.path(span), columns, self._facts(span))

    def _facts(self, span: Span) -> dict[str, object]:
        return {"study": self.study, "first": span[0], "stop": span[1]}

    def read(self, span: Span) -> Arrays:
        """Return the columns of a chunk. Raises DamagedError if they are incomplete, or of another chunk or study."""
        columns, facts = unseal(self.path(span))
        differs = difference(facts, self._facts(span))
        if differs:
            raise DamagedError(f"it belongs to another chunk or study: {differs}")
        _check_rows(columns, *span)
        return columns

    def columns(self) -> dict[str, Column]:
        """Return the dtype and checksum of all columns, by name.

        Reads every chunk again, because a file may have changed since it was written. Raises DamagedError if a chunk is
        incomplete, of another study, or has other columns than the first chunk.
        """
        kinds, digests = dict[str, Any](), collections.defaultdict(hashlib.sha256)
        for span in self.spans():
            try:
                part = self.read(span)
            except DamagedError as why:
                raise DamagedError(f"{self.path(span)}: {why}") from None
            kinds = kinds or kinds_of(part)
            if kinds != kinds_of(part):
                raise DamagedError(f"{self.path(span)}: its columns are not those of the other chunks")
            for name, column in part.items():
                digests[name].update(np.ascontiguousarray(column).data)
        return {name: Column(kind, digests[name].hexdigest()) for name, kind in kinds.items()}

    def merge(self, file: IO[bytes], columns: dict[str, Column]) -> None:
        """Write all columns [members] to an .npz archive, chunk by chunk, to bound the memory."""
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, column in columns.items():
                head = {"descr": column.kind, "fortran_order": False, "shape": (self.members,)}
                with archive.open(zipfile.ZipInfo(f"{name}.npy", EPOCH), "w", force_zip64=True) as out:
                    np.lib.format.write_array_header_1_0(out, head)
                    for part in self._column(name):
                        out.write(np.ascontiguousarray(part).tobytes())

    def _column(self, name: str) -> Iterator[np.ndarray]:
        """Yield one column, chunk by chunk. Raises DamagedError for a chunk that cannot be read."""
        for span in self.spans():
            try:
                with self.path(span).open("rb") as file, np.load(file) as chunk:
                    yield chunk[name]
            except Exception as error:  # as in unseal
                raise DamagedError(f"{self.path(span)} cannot be read ({error})") from None


def check_whole(path: pathlib.Path, members: int, columns: dict[str, Column]) -> None:
    """Raise DamagedError unless the archive holds these columns, with one row for each member, in order."""
    there = dict[str, Any]()
    try:
        with path.open("rb") as file, np.load(file) as whole:
            for name in whole.files:  # column by column, to bound the memory
                column = whole[name]
                kind, shape = shapes({name: column})[name]
                there[name] = [kind, hashlib.sha256(np.ascontiguousarray(column).data).hexdigest(), shape]
    except Exception as error:  # as in unseal
        raise DamagedError(f"the written file cannot be read ({error})") from None
    wrong = difference(there, {name: [*column, [members]] for name, column in columns.items()})
    if wrong:
        raise DamagedError(f"the written file differs from the data: {wrong}")


def kinds_of(columns: Arrays) -> dict[str, object]:
    """Return the names and dtypes of columns, in order."""
    return {name: kind for name, (kind, _) in shapes(columns).items()}


def _check_rows(columns: Arrays, start: int, stop: int) -> None:
    short = [name for name, column in columns.items() if column.shape != (stop - start,)]
    if short:
        raise DamagedError(f"its column {short[0]} does not have {stop - start} rows")
    if "index" not in columns or not np.array_equal(columns["index"], np.arange(start, stop)):
        raise DamagedError(f"its rows are not members {start} to {stop - 1}")
