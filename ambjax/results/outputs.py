"""Output of the commands: directories, files, JSON, tables, and remarks on stderr.

Commands write their results through `files`. If writing a file fails, no file is moved into the output directory.
"""

import contextlib
import itertools
import json
import math
import os
import pathlib
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

from ambjax.ensemble.store import MANIFEST, RESULT
from ambjax.host.heartbeat import say
from ambjax.host.interrupts import removed_by_interrupt, uninterrupted
from ambjax.text.words import one_line

Described = TypeVar("Described")
# Whether an error in a description ends the command (`described`). The tests set it, so that no defect is overlooked.
STRICT = False


def directory(out: str | None, name: str, names: Iterable[str] = (), force: bool = False) -> pathlib.Path:
    """Make the output directory `out`, or a new one under ./out called `name`, and return it.

    Raises ValueError in these cases: the directory cannot be made or written; it holds the study of an ensemble; it has
    one of `names`, without `force`; `check_places` refuses one of `names`.
    """
    path, names = target(out, name), list(names)
    while out is None:
        with _refusal(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.suppress(FileExistsError):  # another run has made it meanwhile
                path.mkdir()
                break
        path = target(out, name)
    for file in (MANIFEST, RESULT):
        with _refusal(path):
            exists = (path / file).exists()
        if exists:
            raise ValueError(f"--out {path}: it holds the study of an ensemble ({file}). Choose another directory.")
    make(path)
    check_places(path, names)
    if not force:
        check_new(path, names)
    return path


def check_new(out: pathlib.Path, names: Iterable[str]) -> None:
    """Raise ValueError if `out` has a file with one of these names."""
    if old := [name for name in names if (out / name).exists()]:
        advice = "Choose another directory, or overwrite them with --force."
        raise ValueError(f"--out {out}: it has {', '.join(old)} of an earlier run. {advice}")


def check_places(out: pathlib.Path, names: Iterable[str | pathlib.PurePath]) -> None:
    """Raise ValueError if a folder in `out` has one of these file names, or a file has the name of a needed folder."""
    for name in map(pathlib.PurePath, names):
        if blocking := [x for x in name.parents[:-1] if os.path.lexists(out / x) and not (out / x).is_dir()]:
            why = f"{blocking[0]} exists and is not a folder. Move it, or choose another directory."
            raise ValueError(f"--out {out}: {why}")
        if (out / name).is_dir() and not (out / name).is_symlink():
            raise ValueError(f"--out {out}: {name} exists and is a folder. Move it, or choose another directory.")


def spare(out: pathlib.Path, names: Iterable[str], mark: str) -> None:
    """Raise ValueError if a file in `out` has one of these names but lacks `mark`: it is the user's own file."""
    for name in names:
        marked = False
        with contextlib.suppress(OSError):
            marked = (out / name).is_file() and mark.encode() in (out / name).read_bytes()
        if os.path.lexists(out / name) and not marked:
            raise ValueError(
                f"--out {out}: {name} exists, is not from an export with the same prefix, and would be "
                "overwritten. Choose another directory, or move the file."
            )


def target(out: str | None, name: str) -> pathlib.Path:
    """Return the output directory without making it: `out`, or an unused name under ./out.

    Raises ValueError for an empty name.
    """
    if out is not None:
        if not out.strip():
            advice = "Give a name, '.' for this directory, or omit --out."
            raise ValueError(f"--out: the name of the directory is empty. {advice}")
        return pathlib.Path(out)
    candidates = (pathlib.Path("out") / (name if n == 1 else f"{name}-{n}") for n in itertools.count(1))
    return next(p for p in candidates if not os.path.lexists(p))


def make(path: pathlib.Path) -> None:
    """Make a directory if it does not exist. Raises ValueError if it cannot be made or written."""
    with _refusal(path):
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass


@contextlib.contextmanager
def files(out: pathlib.Path) -> Iterator[pathlib.Path]:
    """Yield a temporary folder whose files move into `out` at the end of the block, or not at all if it fails."""
    with _refusal(out):
        try:
            with tempfile.TemporaryDirectory(prefix=".ambjax-", dir=out, ignore_cleanup_errors=True) as folder:
                part = pathlib.Path(folder)
                with removed_by_interrupt(part):
                    yield part
                names = sorted(p.relative_to(part) for p in part.rglob("*") if p.is_file())
                names.sort(key=lambda name: name.suffix == ".json")  # report.json last: it ends a search of the tuner
                check_places(out, names)
                with uninterrupted():
                    for name in names:
                        (out / name).parent.mkdir(parents=True, exist_ok=True)
                        (part / name).replace(out / name)
        except BaseException:
            with contextlib.suppress(OSError):
                out.rmdir()
            raise


def described(name: str, describe: Callable[[], Described]) -> Described | None:
    """Return the result of `describe`, which only describes a result: it makes a report, a picture or a table.

    An error costs this description only: it is reported on one line of stderr, with the `name` of the description and
    the place in the code, and None is returned. Commands write the result itself before its descriptions. An error of
    the file system is raised, because it concerns the result too.
    """
    try:
        return describe()
    except OSError:
        raise
    except Exception as error:
        if STRICT:
            raise
        say(f"{name} is left out: {fault(error)}")
        return None


def drawn(path: pathlib.Path, draw: Callable[[], Any], dpi: int = 130) -> None:
    """Write the Figure that `draw` returns to a file. An error costs this picture only, as in `described`."""

    def write() -> None:
        from ambjax.pictures.scales import save

        save(draw(), path, dpi)

    described(path.name, write)


def fault(error: Exception) -> str:
    """Return an error in one sentence or more. One that is not a ValueError is a defect: its place is added."""
    words = str(error) or type(error).__name__
    if isinstance(error, ValueError):
        return words if words.endswith(".") else f"{words}."
    at = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{pathlib.Path(at.filename).name}, line {at.lineno}"
    return f"{type(error).__name__}: {words.rstrip('.')} ({where}). This is a defect of ambjax: please report it."


@contextlib.contextmanager
def _refusal(out: pathlib.Path) -> Iterator[None]:
    """Convert an OSError of writing to a ValueError that names --out."""
    try:
        yield
    except OSError as error:
        for above in (out, *out.parents):
            if os.path.isfile(above):  # noqa: PTH113 - it never raises an error
                why = f"because {above} is a file. Choose a directory."
                raise ValueError(f"--out {out}: cannot write there, {why}") from None
        why = error.strerror or str(error)
        raise ValueError(f"--out {out}: cannot write there ({why}). Free space, or choose another directory.") from None


def plain(value: object) -> Any:
    """Return a value as JSON can represent it: arrays as lists, infinities and NaN as null."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: pathlib.Path, value: object) -> None:
    """Write a JSON file."""
    path.write_text(json.dumps(plain(value), indent=2) + "\n", encoding="utf-8")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a text table with columns aligned by spaces."""
    lines = [list(header), *map(list, rows)]
    widths = [max(len(line[c]) for line in lines) for c in range(len(header))]
    ruled = [lines[0], ["-" * w for w in widths], *lines[1:]]
    return "\n".join("  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in ruled)


def written(out: pathlib.Path, names: str) -> None:
    """Print which files the command has written, the last line of its output."""
    print(one_line(f"written: {out}/{names}"))
