"""Storage of a study's results. Studies are resumable.

Each finished chunk is written atomically to a file with a checksum. A run that is killed loses only the chunks in
progress. Damaged chunks are found and computed again. At the end all chunks are merged into members.npz. The file of a
resumed study is the same, byte for byte, as that of an uninterrupted one. The chunks are removed after members.npz has
been read back.
"""

import collections
import hashlib
import json
import os
import pathlib
import shutil

from ambjax.ensemble.chunks import Chunks, Span, check_whole, kinds_of
from ambjax.host.sealed import CHECKSUM, Arrays, DamagedError, checksum_of, difference, write_whole

MANIFEST = "study.json"
RESULT = "members.npz"


class Store:
    """A directory that holds a study of `members` members in chunks of `chunk` members.

    - `facts`: the fingerprint of the study, recorded in the manifest.
    - `chunk`: members per chunk. None: the size recorded in the directory; without a record, the attribute `chunk` is 0
      until `cut` sets it.
    """

    def __init__(self, directory: pathlib.Path, facts: dict[str, object], members: int, chunk: int | None) -> None:
        self.directory, self.members = directory, members
        self.facts, self.chunk, self.result = facts, chunk or 0, ""
        self.requested = chunk
        self.chunks, self.manifest, self.path = directory / "chunks", directory / MANIFEST, directory / RESULT

    def check(self, columns: int, resume: bool) -> None:
        """Check that the directory is unused or holds this study, and read its manifest. The directory is not changed.

        Raises ValueError if the directory holds another study, if it holds a study and `resume` is False, if it holds
        none and `resume` is True, or if the disk has no room for twice `columns` numbers per member.
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
        """Create the directory and write the manifest, so that a run that is killed from now on can be resumed.

        Remove unfinished files of earlier runs. Call `check` first. Raises ValueError if the directory cannot be
        written.
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

    def survey(self) -> tuple[list[Span], list[str]]:
        """Return the chunks that must be computed, in order, and one remark for each damaged file.

        Reads every chunk and verifies its checksum and its columns.
        """
        parts, missing, remarks, layouts = self.parts, [], list[str](), dict[Span, str]()
        if self.result:
            reason = "its checksum is wrong" if self.path.exists() else "the file is missing"
            remarks.append(f"{self.path}: {reason}; members that are not in {self.chunks} are computed again")
        for span in self.spans():
            path = parts.path(span)
            try:
                if path.exists():
                    layouts[span] = json.dumps(kinds_of(parts.read(span)))
                    continue
            except DamagedError as why:
                remarks.append(f"{path}: {why}; members {span[0]} to {span[1] - 1} are computed again")
            missing.append(span)
        usual = collections.Counter(layouts.values()).most_common(1)
        for span, kinds in layouts.items():
            if kinds != usual[0][0]:
                remarks.append(
                    f"{parts.path(span)}: its columns differ from those of the other chunks; members {span[0]} to "
                    f"{span[1] - 1} are computed again"
                )
                missing.append(span)
        return sorted(missing), remarks

    @property
    def parts(self) -> Chunks:
        return Chunks(self.chunks, self.members, self.chunk, checksum_of(self.facts))

    def spans(self) -> list[Span]:
        return self.parts.spans()

    def count(self) -> int:
        if self.path.exists() and not self.chunks.exists():
            return self.members
        parts = self.parts
        return sum(stop - start for start, stop in parts.spans() if parts.path((start, stop)).exists())

    def put(self, span: Span, columns: Arrays) -> None:
        """Write a finished chunk. Raises ValueError if it cannot be written."""
        self.parts.put(span, columns)

    def finish(self) -> pathlib.Path:
        """Merge all chunks into members.npz, column by column, read it back, and then remove the chunks.

        Returns the path of members.npz. Raises ValueError, and keeps the chunks, if a chunk is damaged, if the file
        cannot be written, or if the data read back differ from the data written.
        """
        if not self.finished():
            try:
                parts = self.parts
                columns = parts.columns()
                write_whole(self.path, lambda file: parts.merge(file, columns))
                check_whole(self.path, self.members, columns)
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
        return self.manifest.exists()

    def finished(self) -> bool:
        """Return whether members.npz exists and has the recorded checksum."""
        return bool(self.result) and self.path.is_file() and _digest(self.path) == self.result

    def _write_manifest(self) -> None:
        content = self.facts | {"chunk": self.chunk or None} | ({RESULT: self.result} if self.result else {})
        text = json.dumps(content | {CHECKSUM: checksum_of(content)}, indent=2).encode() + b"\n"
        write_whole(self.manifest, lambda file: file.write(text))

    def _compare(self) -> None:
        """Read the manifest. Raises ValueError if it is damaged or if it belongs to another study."""
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
                f"--members {self.members}: the results need {need / 1e9:.3g} GB, but {where} has "
                f"{free / 1e9:.3g} GB free. At most {most:,} members fit; or choose another --out."
            )


def _digest(path: pathlib.Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
