"""Where a study's results are kept: one file per finished chunk, written whole or not at all.

A run that is killed at any instant loses the chunks that were being computed and nothing else. What
is put together at the end is, byte for byte, what an uninterrupted run writes.
"""

import json
import os
import pathlib
import shutil
import zipfile
from collections.abc import Iterator
from typing import IO, Any

import numpy as np

MANIFEST = "study.json"
RESULT = "members.npz"
# Fixed, so that equal results are equal files.
EPOCH = (1980, 1, 1, 0, 0, 0)


class Store:
    """A directory that holds a study of `members` members in chunks of `chunk`."""

    def __init__(self, directory: pathlib.Path, facts: dict[str, Any], members: int, chunk: int):
        self.directory, self.members, self.chunk = directory, members, chunk
        self.facts = facts | {"chunk": chunk}
        self.chunks = directory / "chunks"

    def check(self, columns: int, resume: bool) -> None:
        """Make sure that the directory is free, or holds the beginning of this very study. Changes nothing.

        Raises ValueError if it holds another study, one that nobody asked to resume, none where one is to be
        resumed, or if the disk has no room for `columns` numbers per member.
        """
        kept = self.directory / MANIFEST
        if kept.exists() and not resume:
            raise ValueError(
                f"--out {self.directory}: it holds a study already. Add --resume to go on with it, or choose another."
            )
        if kept.exists():
            self._compare(kept)
        elif resume:
            raise ValueError(f"--resume: there is no study in {self.directory}. Check --out, or leave out --resume.")
        elif self.finished() or self.chunks.exists():
            raise ValueError(f"--out {self.directory}: it holds results, but no {MANIFEST}. Choose another.")
        if not self.finished():
            self._check_room(columns)

    def begin(self) -> None:
        """Make the directory ready for what `check` has let pass."""
        self.directory.mkdir(parents=True, exist_ok=True)
        facts = json.dumps(self.facts, indent=2).encode() + b"\n"
        _write_whole(self.directory / MANIFEST, lambda file: file.write(facts))
        self.chunks.mkdir(exist_ok=True)
        for left in self.chunks.glob("*.part"):
            left.unlink()

    def _compare(self, kept: pathlib.Path) -> None:
        try:
            found = dict(json.loads(kept.read_text(encoding="utf-8")))
        except (OSError, TypeError, ValueError) as error:
            raise ValueError(f"{kept}: cannot be read ({error}). Choose another --out.") from None
        for key in {**found, **self.facts}:
            here, there = self.facts.get(key), found.get(key)
            if here != there:
                raise ValueError(
                    f"--resume: {self.directory} holds another study: {key} is {there} there and {here} here. "
                    "Make them equal, or choose another --out."
                )

    def _check_room(self, columns: int) -> None:
        # Chunks and the result exist side by side at the end.
        needed = 2 * 8 * columns * self.members
        where = next(p for p in (self.directory, *self.directory.resolve().parents) if p.exists())
        free = shutil.disk_usage(where).free
        if needed > free:
            most = free // (2 * 8 * columns)
            raise ValueError(
                f"--members {self.members}: their results need {needed / 1e9:.3g} GB and {where} has "
                f"{free / 1e9:.3g} GB free. At most {most:,} members fit; or choose another --out."
            )

    def spans(self) -> list[tuple[int, int]]:
        """All chunks in order: (first member, one past the last)."""
        return [(n, min(n + self.chunk, self.members)) for n in range(0, self.members, self.chunk)]

    def missing(self) -> list[tuple[int, int]]:
        """Chunks that are not on disk yet."""
        return [span for span in self.spans() if not self._path(span).exists()]

    def put(self, span: tuple[int, int], columns: dict[str, np.ndarray]) -> None:
        """Keep a finished chunk."""
        _write_whole(self._path(span), lambda file: np.savez(file, **columns))  # pyright: ignore[reportArgumentType]

    def finish(self) -> pathlib.Path:
        """Put all chunks together as members.npz, a column at a time, and remove them."""
        path = self.directory / RESULT
        if not path.exists():
            with np.load(self._path(self.spans()[0])) as first:
                kinds = {name: first[name].dtype for name in first.files}
            _write_whole(path, lambda file: self._merge(file, kinds))
        shutil.rmtree(self.chunks, ignore_errors=True)
        return path

    def begun(self) -> bool:
        """Whether there is anything to resume."""
        return (self.directory / MANIFEST).exists()

    def finished(self) -> bool:
        """Whether members.npz is there."""
        return (self.directory / RESULT).exists()

    def _merge(self, file: IO[bytes], kinds: dict[str, np.dtype]) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, kind in kinds.items():
                head = {"descr": np.lib.format.dtype_to_descr(kind), "fortran_order": False, "shape": (self.members,)}
                with archive.open(zipfile.ZipInfo(f"{name}.npy", EPOCH), "w", force_zip64=True) as out:
                    np.lib.format.write_array_header_1_0(out, head)
                    for part in self._column(name):
                        out.write(np.ascontiguousarray(part, kind).tobytes())

    def _column(self, name: str) -> Iterator[np.ndarray]:
        for span in self.spans():
            with np.load(self._path(span)) as chunk:
                yield chunk[name]

    def _path(self, span: tuple[int, int]) -> pathlib.Path:
        return self.chunks / f"{span[0]:012d}-{span[1]:012d}.npz"


def _write_whole(path: pathlib.Path, write: Any) -> None:
    """Write to a file beside `path`, then rename it: `path` holds everything or does not exist."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        write(file)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
