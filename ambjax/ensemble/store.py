"""Storage of a study's results. Studies are resumable.

Each finished chunk is written atomically to a file with a checksum. A run that is killed loses only the chunks that are
being computed. Damaged chunks are found and computed again. At the end all chunks are merged into members.npz, which is
byte for byte the same after an interruption. The chunks are removed only after members.npz has been read back.
"""

import collections
import hashlib
import json
import os
import pathlib
import shutil
import zipfile
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

import numpy as np

from ambjax.host.sealed import (
    CHECKSUM,
    Arrays,
    DamagedError,
    checksum_of,
    difference,
    seal,
    shapes,
    unseal,
    write_whole,
)

MANIFEST = "study.json"
RESULT = "members.npz"
# Time stamp of all entries. It is fixed, so that equal results give equal files.
EPOCH = (1980, 1, 1, 0, 0, 0)

Span = tuple[int, int]


class Column(NamedTuple):
    """A column of all members: its dtype in JSON form, and the SHA-256 of its numbers."""

    kind: Any
    digest: str


class Survey(NamedTuple):
    """Chunks that must be computed, in order, and one remark for each damaged file."""

    missing: list[Span]
    remarks: list[str]


class Store:
    """A directory that holds a study of `members` members in chunks of `chunk` members.

    - `facts`: the fingerprint of the study, recorded in the manifest.
    - `chunk`: None uses the size that the directory has recorded; it is 0 until `cut` sets it.
    """

    def __init__(self, directory: pathlib.Path, facts: dict[str, object], members: int, chunk: int | None) -> None:
        self.directory, self.members = directory, members
        self.facts, self.chunk, self.result = facts, chunk or 0, ""
        self.requested = chunk
        self.chunks, self.manifest, self.path = directory / "chunks", directory / MANIFEST, directory / RESULT

    def check(self, columns: int, resume: bool) -> None:
        """Check that the directory is free, or holds a part of this study. Does not change the directory.

        Raises ValueError if the directory holds another study, if it holds a study and `resume` is False, if it holds
        none and `resume` is True, or if the disk has no room for `columns` numbers per member.
        """
        if self.begun() and not resume:
            raise ValueError(
                f"--out {self.directory}: it already holds a study. Add --resume to continue it, or choose another "
                "directory."
            )
        if self.begun():
            self._compare()
        elif resume:
            raise ValueError(f"--resume: there is no study in {self.directory}. Check --out, or omit --resume.")
        elif self.path.exists() or self.chunks.exists():
            raise ValueError(f"--out {self.directory}: it holds results, but no {MANIFEST}. Choose another directory.")
        if not self.finished():
            self._check_room(columns)

    def begin(self) -> None:
        """Write the manifest, so that a run that is killed from now on can be resumed.

        Call `check` first. Raises ValueError if the directory cannot be written.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        self._write_manifest()
        self.chunks.mkdir(exist_ok=True)
        for left in (path for name in ("chunks/", RESULT, MANIFEST) for path in self.directory.glob(f"{name}*.part")):
            left.unlink()

    def cut(self, chunk: int) -> None:
        """Record the number of members in a chunk. Raises ValueError if the directory cannot be written."""
        self.chunk = chunk
        self._write_manifest()

    def survey(self) -> Survey:
        """Return the missing and damaged chunks. Reads every chunk and verifies its checksum and its columns."""
        missing, remarks, layouts = [], list[str](), dict[Span, str]()
        if self.result:
            reason = "its checksum is wrong" if self.path.exists() else "the file is missing"
            remarks.append(f"{self.path}: {reason}; members that are not in {self.chunks} are computed again")
        for span in self.spans():
            path = self._path(span)
            try:
                if path.exists():
                    layouts[span] = json.dumps(kinds_of(self._read(span)))
                    continue
            except DamagedError as why:
                remarks.append(f"{path}: {why}; members {span[0]} to {span[1] - 1} are computed again")
            missing.append(span)
        usual = collections.Counter(layouts.values()).most_common(1)
        for span, kinds in layouts.items():
            if kinds != usual[0][0]:
                remarks.append(
                    f"{self._path(span)}: its columns are not those of the others; members {span[0]} to {span[1] - 1} "
                    "are computed again"
                )
                missing.append(span)
        return Survey(sorted(missing), remarks)

    def spans(self) -> list[Span]:
        """Return all chunks in order as (first member, last member + 1); an empty list before `cut`."""
        if not self.chunk:
            return []
        return [(n, min(n + self.chunk, self.members)) for n in range(0, self.members, self.chunk)]

    def count(self) -> int:
        """Return the number of members on disk."""
        if self.path.exists() and not self.chunks.exists():
            return self.members
        return sum(stop - start for start, stop in self.spans() if self._path((start, stop)).exists())

    def put(self, span: Span, columns: Arrays) -> None:
        """Write a finished chunk. Raises ValueError if it cannot be written."""
        seal(self._path(span), columns, self._facts(span))

    def finish(self) -> pathlib.Path:
        """Merge all chunks into members.npz, column by column, read it back, and then remove the chunks.

        Returns the path of members.npz. Raises ValueError, and keeps the chunks, if a chunk is damaged or if the data
        read back differ from the data written.
        """
        if not self.finished():
            try:
                columns = self._columns()
                write_whole(self.path, lambda file: self._merge(file, columns))
                self._read_back(columns)
            except (DamagedError, OSError) as why:
                raise ValueError(
                    f"{self.path}: the chunks could not be merged ({why}). They are kept: repeat the command with "
                    "--resume."
                ) from None
            self.result = _digest(self.path)
            self._write_manifest()
        shutil.rmtree(self.chunks, ignore_errors=True)
        return self.path

    def begun(self) -> bool:
        """Return whether the directory holds a study."""
        return self.manifest.exists()

    def finished(self) -> bool:
        """Return whether members.npz exists and has the recorded checksum."""
        return bool(self.result) and self.path.is_file() and _digest(self.path) == self.result

    def _write_manifest(self) -> None:
        content = self.facts | {"chunk": self.chunk or None} | ({RESULT: self.result} if self.result else {})
        text = json.dumps(content | {CHECKSUM: checksum_of(content)}, indent=2).encode() + b"\n"
        write_whole(self.manifest, lambda file: file.write(text))

    def _compare(self) -> None:
        """Read the manifest, and raise ValueError if it is damaged or of another study."""
        try:
            record = dict(json.loads(self.manifest.read_text(encoding="utf-8")))
            if record.pop(CHECKSUM, None) != checksum_of(record):
                raise ValueError("its checksum is wrong")
            recorded, self.result = int(record.pop("chunk") or 0), str(record.pop(RESULT, ""))
            self.chunk = self.requested or recorded
        except (OSError, TypeError, ValueError, KeyError, RecursionError) as error:
            raise ValueError(f"{self.manifest}: cannot be read ({error}). Choose another --out.") from None
        differs = difference(record | {"chunk": recorded or self.chunk}, self.facts | {"chunk": self.chunk})
        if differs:
            raise ValueError(
                f"--resume: {self.directory} holds another study: {differs}. Restore the case and options, or choose "
                "another --out."
            )

    def _check_room(self, columns: int) -> None:
        """Raise ValueError if the disk has no room for `columns` numbers per member."""
        # Chunks and members.npz exist at the same time at the end, hence the factor 2.
        need = 2 * 8 * columns * self.members
        real = pathlib.Path(os.path.realpath(self.directory))  # Path.resolve raises on a loop of links
        where = next(p for p in (self.directory, *real.parents) if p.exists())
        free = shutil.disk_usage(where).free
        if need > free:
            most = free // (2 * 8 * columns)
            raise ValueError(
                f"--members {self.members}: their results need {need / 1e9:.3g} GB and {where} has "
                f"{free / 1e9:.3g} GB free. At most {most:,} members fit; or choose another --out."
            )

    def _facts(self, span: Span) -> dict[str, object]:
        return {"study": checksum_of(self.facts), "first": span[0], "stop": span[1]}

    def _read(self, span: Span) -> Arrays:
        """Return the columns of a chunk. Raises DamagedError if they are incomplete, or of another chunk or study."""
        columns, facts = unseal(self._path(span))
        differs = difference(facts, self._facts(span))
        if differs:
            raise DamagedError(f"it is of another chunk or study: {differs}")
        _check_rows(columns, *span)
        return columns

    def _columns(self) -> dict[str, Column]:
        """Return the dtype and checksum of all columns, by name.

        Reads every chunk again, because a file may have changed since it was written. Raises DamagedError if a chunk is
        incomplete, of another study, or has other columns than the first chunk.
        """
        kinds, digests = dict[str, Any](), collections.defaultdict(hashlib.sha256)
        for span in self.spans():
            try:
                part = self._read(span)
            except DamagedError as why:
                raise DamagedError(f"{self._path(span)}: {why}") from None
            kinds = kinds or kinds_of(part)
            if kinds != kinds_of(part):
                raise DamagedError(f"{self._path(span)}: its columns are not those of the others")
            for name, column in part.items():
                digests[name].update(np.ascontiguousarray(column).data)
        return {name: Column(kind, digests[name].hexdigest()) for name, kind in kinds.items()}

    def _merge(self, file: IO[bytes], columns: dict[str, Column]) -> None:
        """Write all columns to an .npz archive, chunk by chunk, to bound the memory."""
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
                with self._path(span).open("rb") as file, np.load(file) as chunk:
                    yield chunk[name]
            except Exception as error:  # as in unseal
                raise DamagedError(f"{self._path(span)} cannot be read ({error})") from None

    def _read_back(self, columns: dict[str, Column]) -> None:
        """Raise DamagedError unless members.npz holds these columns, with one row for each member, in order."""
        there = dict[str, Any]()
        try:
            with self.path.open("rb") as file, np.load(file) as whole:
                for name in whole.files:  # column by column, to bound the memory
                    column = whole[name]
                    kind, shape = shapes({name: column})[name]
                    there[name] = [kind, hashlib.sha256(np.ascontiguousarray(column).data).hexdigest(), shape]
        except Exception as error:  # as in unseal
            raise DamagedError(f"the written file cannot be read ({error})") from None
        wrong = difference(there, {name: [*column, [self.members]] for name, column in columns.items()})
        if wrong:
            raise DamagedError(f"the written file differs from the data: {wrong}")

    def _path(self, span: Span) -> pathlib.Path:
        return self.chunks / f"{span[0]:012d}-{span[1]:012d}.npz"


def kinds_of(columns: Arrays) -> dict[str, object]:
    """Return the names and dtypes of columns, in order."""
    return {name: kind for name, (kind, _) in shapes(columns).items()}


def _check_rows(columns: Arrays, start: int, stop: int) -> None:
    short = [name for name, column in columns.items() if column.shape != (stop - start,)]
    if short:
        raise DamagedError(f"its column {short[0]} does not have {stop - start} rows")
    if "index" not in columns or not np.array_equal(columns["index"], np.arange(start, stop)):
        raise DamagedError(f"its rows are not members {start} to {stop - 1}")


def _digest(path: pathlib.Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
