"""What the commands write: directories, files, JSON, tables, and remarks on stderr.

Every file goes through `files`: all that a command writes is in its directory at once, or nothing of it is.
"""

import contextlib
import itertools
import json
import math
import os
import pathlib
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ambjax.ensemble.store import MANIFEST, RESULT
from ambjax.host.interrupts import uninterrupted
from ambjax.host.words import one_line


def directory(out: str | None, name: str, names: Iterable[str] = ()) -> pathlib.Path:
    """The directory to write to: as asked, or a new one under ./out. Made, and seen to be writable.

    Raises ValueError if it cannot be made or written, holds a study, whose files are not to be mixed with others, or
    folders of these names, which files will have.
    """
    path = target(out, name)
    while out is None and not _made(path):  # another run was quicker
        path = target(out, name)
    for file in (MANIFEST, RESULT):
        with _refusal(path):
            there = (path / file).exists()
        if there:
            raise ValueError(f"--out {path}: it holds the study of an ensemble ({file}). Choose another directory.")
    make(path)
    check_places(path, names)
    return path


def check_places(out: pathlib.Path, names: Iterable[str | pathlib.PurePath]) -> None:
    """Raises ValueError where files of these names, below `out`, cannot be put: a folder, or no folder, is there."""
    for name in map(pathlib.PurePath, names):
        there = [
            parent for parent in name.parents[:-1] if os.path.lexists(out / parent) and not (out / parent).is_dir()
        ]
        if there:
            raise ValueError(f"--out {out}: {there[0]} is no folder there. Move it away, or choose another directory.")
        if (out / name).is_dir() and not (out / name).is_symlink():
            raise ValueError(f"--out {out}: {name} is a folder there. Move it away, or choose another directory.")


def spare(out: pathlib.Path, names: Iterable[str], mark: str) -> None:
    """Raise ValueError where what has one of these names in `out` is not a file with this mark: it would be lost."""
    for name in names:
        if os.path.lexists(out / name) and not _holds(out / name, mark):
            raise ValueError(
                f"--out {out}: {name} is there already, not from an export of the same prefix, and would be lost. "
                "Choose another directory, or move it away."
            )


def _holds(path: pathlib.Path, mark: str) -> bool:
    try:
        return path.is_file() and mark.encode() in path.read_bytes()
    except OSError:
        return False


def target(out: str | None, name: str) -> pathlib.Path:
    """The directory to write to, which need not exist yet: as asked, or a new one under ./out.

    Raises ValueError for one without a name.
    """
    if out is not None:
        if not out.strip():
            raise ValueError(
                "--out: the name of the directory is empty. Give one, '.' for this folder, or leave it out."
            )
        return pathlib.Path(out)
    candidates = (pathlib.Path("out") / (name if n == 1 else f"{name}-{n}") for n in itertools.count(1))
    return next(p for p in candidates if not os.path.lexists(p))


def _made(path: pathlib.Path) -> bool:
    """Make a new directory; False: it is there already. Raises ValueError if it cannot be made."""
    with _refusal(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            path.mkdir()
        except FileExistsError:
            return False
        return True


def make(path: pathlib.Path) -> None:
    """Make a directory and see that it can be written. Raises ValueError if not."""
    with _refusal(path):
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass


@contextlib.contextmanager
def files(out: pathlib.Path) -> Iterator[pathlib.Path]:
    """A folder to write in: what it holds at the end of the block moves into `out`, and nothing does if that fails.

    A directory that is empty then goes too. Raises ValueError where the disk is full or `out` cannot be written.
    """
    with _refusal(out):
        try:
            with tempfile.TemporaryDirectory(prefix=".ambjax-", dir=out, ignore_cleanup_errors=True) as folder:
                part = pathlib.Path(folder)
                yield part
                names = sorted(p.relative_to(part) for p in part.rglob("*") if p.is_file())
                check_places(out, names)
                with uninterrupted():
                    for name in names:
                        (out / name).parent.mkdir(parents=True, exist_ok=True)
                        (part / name).replace(out / name)
        except BaseException:
            with contextlib.suppress(OSError):
                out.rmdir()
            raise


@contextlib.contextmanager
def _refusal(out: pathlib.Path) -> Iterator[None]:
    """What the system has against writing, as a ValueError that names --out."""
    try:
        yield
    except OSError as error:
        why = error.strerror or str(error)
        raise ValueError(f"--out {out}: cannot write there ({why}). Make room, or choose another directory.") from None


def plain(value: Any) -> Any:
    """Numbers as JSON has them: arrays as lists, infinities and NaN as null."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: pathlib.Path, value: Any) -> None:
    """Write a JSON file."""
    path.write_text(json.dumps(plain(value), indent=2) + "\n", encoding="utf-8")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns aligned by spaces."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[c]) for line in lines) for c in range(len(header))]
    ruled = [lines[0], ["-" * w for w in widths], *lines[1:]]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in ruled)


def written(out: pathlib.Path, names: str) -> None:
    """The last line of a command's answer: what is where."""
    print(one_line(f"written: {out}/{names}"))


def say(text: str) -> None:
    """Progress and remarks, a line each, go to stderr: stdout is the answer alone. None of them stops anything."""
    with contextlib.suppress(OSError, ValueError):
        print(one_line(text), file=sys.stderr, flush=True)
