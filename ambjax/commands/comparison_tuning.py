"""The tunings of `ambjax compare --tune`: one case after the other, each in a folder of its own."""

import argparse
import contextlib
import dataclasses
import pathlib
import sys
import time
from collections.abc import Sequence

from ambjax.cases.machine_case import AnyCase, MachineCase, machine_from
from ambjax.cases.reader import read_case
from ambjax.cases.table import load
from ambjax.host.command_line import message
from ambjax.host.extensions import NothingToTuneError, extension
from ambjax.host.heartbeat import say
from ambjax.host.interrupts import raise_if_interrupted, reporting
from ambjax.text.words import duration

# In the folder of a case: the file by which the tuner marks a search that has begun, and the case with the tuned gains.
BEGUN, TUNED = "checkpoints/search.json", "tuned.toml"


def check_options(args: argparse.Namespace) -> None:
    """Raise ValueError if --resume is given without --tune or without an existing --out, or if the tuner is missing."""
    if args.tune:
        extension("tune")
    if not args.resume:
        return
    if not args.tune:
        raise ValueError("--resume: it continues the tunings of --tune. Add --tune, or leave out --resume.")
    if args.out is None:
        raise ValueError("--resume: the directory of the comparison is missing. Give it as --out.")
    if not pathlib.Path(args.out).is_dir():
        raise ValueError(f"--resume: --out {args.out} does not exist. Check --out, or leave out --resume.")


def tuned_cases(cases: Sequence[AnyCase], out: pathlib.Path, args: argparse.Namespace) -> list[AnyCase]:
    """Tune each case with the settings of the first, and return the tuned cases under the same names.

    A case without gains to tune is returned as it is. If one case cannot be tuned, the others still are. Raises
    ValueError after them, and before any search if `out` has earlier tunings, without --resume and --force.
    """
    folders = [_folder(out, case) for case in cases]
    old = [folder.name for folder in folders if (folder / BEGUN).exists()]
    if old and not (args.resume or args.force):
        advice = "Continue them with --resume, discard them with --force, or choose another directory."
        raise ValueError(f"--out {out}: it has tunings of an earlier run ({', '.join(old)}). {advice}")
    found, failed, times = list[AnyCase](), list[str](), list[float]()
    kept = f"the tunings so far are saved. To continue, repeat the command with --out {out} --resume"
    with reporting(lambda: kept):
        for n, (path, case) in enumerate(zip(args.cases, cases, strict=True)):
            say(_progress(case.name, n, len(cases), times))
            try:
                found.append(_tuned(path, case, out, args, times))
                raise_if_interrupted()
            except KeyboardInterrupt:
                raise KeyboardInterrupt(kept) from None
            except Exception as error:
                failed.append(f"{path}: {message(error).removeprefix(f'{path}: ')}")
                say(f"not tuned: {failed[-1]}")
    if failed:
        raise ValueError(
            f"--tune: {len(failed)} of {len(cases)} cases could not be tuned: {' '.join(failed)} The tunings of the "
            f"others are saved. Correct this, and repeat the command with --out {out} --resume. To tune a case from "
            "the start, remove its folder tuned-NAME before."
        )
    return found


def _folder(out: pathlib.Path, case: AnyCase) -> pathlib.Path:
    return out / f"tuned-{case.name}"


def _progress(name: str, n: int, count: int, times: Sequence[float]) -> str:
    """Return the line before case n of `count`, from 0. `times`: durations (s) of the tunings of this run."""
    words = f"case {n + 1} of {count}: tuning {name}"
    if not times:
        return words
    taken = sum(times)
    return f"{words} ({len(times)} tuned in {duration(taken)}, about {duration(taken / len(times) * (count - n))} left)"


def _tuned(path: str, case: AnyCase, out: pathlib.Path, args: argparse.Namespace, times: list[float]) -> AnyCase:
    """Return the tuned case. Append the duration of its tuning to `times`, unless it had ended in an earlier run."""
    folder, began = _folder(out, case), time.perf_counter()
    tuned, options = folder / TUNED, ["--force"] * args.force
    before = _modified(tuned)
    if args.resume:
        options = ["--resume"] * (folder / BEGUN).exists()
    with contextlib.redirect_stdout(sys.stderr):
        try:
            extension("tune")(
                [path, "--settings-of", args.cases[0], "--out", str(folder), *options], "ambjax compare", nested=True
            )
        except NothingToTuneError:
            say(f"{case.name} has no gains to tune; it is compared as it is")
            return case
    if _modified(tuned) != before:
        times.append(time.perf_counter() - began)
    if isinstance(case, MachineCase):  # its files are beside the case
        raw, text = load(tuned)
        return machine_from(raw, case.name, text, case.folder)
    return dataclasses.replace(read_case(tuned), name=case.name)


def _modified(path: pathlib.Path) -> int | None:
    return path.stat().st_mtime_ns if path.exists() else None
