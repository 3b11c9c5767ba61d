"""What the commands write: directories, JSON, tables."""

import itertools
import json
import math
import pathlib
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np


def directory(asked: str | None, name: str) -> pathlib.Path:
    """The directory to write to: as asked, or a new one under ./out. Made, and seen to be writable.

    Raises ValueError if it cannot be made or written.
    """
    path = chosen(asked, name)
    make(path)
    return path


def chosen(asked: str | None, name: str) -> pathlib.Path:
    """The directory to write to, which need not exist yet: as asked, or a new one under ./out."""
    if asked is not None:
        return pathlib.Path(asked)
    candidates = (pathlib.Path("out") / (name if n == 1 else f"{name}-{n}") for n in itertools.count(1))
    return next(p for p in candidates if not p.exists())


def make(path: pathlib.Path) -> None:
    """Make a directory and see that it can be written. Raises ValueError if not."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".ambjax-write-test"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"--out {path}: cannot write there ({error.strerror}). Choose another directory.") from None


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


def say(text: str) -> None:
    """Progress and remarks go to stderr, so that stdout is the answer alone."""
    print(text, file=sys.stderr, flush=True)
