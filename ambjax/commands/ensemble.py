"""`ambjax ensemble`: run a study in chunks, in this process or on workers, and write its summary and plots."""

import argparse
import contextlib
import pathlib
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any

import numpy as np
from tqdm import tqdm

from ambjax.cases.reader import Case
from ambjax.commands.outputs import check_places, files, make, plain, say, table, target, write_json, written
from ambjax.commands.pace import Pace, error_words, pilot, say_how_long, sliding_error
from ambjax.commands.warnings import read_with_warnings, reversal
from ambjax.ensemble import statistics
from ambjax.ensemble.design import MOST_MEMBERS
from ambjax.ensemble.store import Store
from ambjax.ensemble.study import COLUMNS, Study
from ambjax.ensemble.worker import chunk, ignore_sigint, processes, work
from ambjax.host.interrupts import reporting, uninterrupted
from ambjax.host.lock import alone
from ambjax.host.words import one_line
from ambjax.simulation.integrate import Slide

# Files written with members.npz; the last one only if the case has a spread.
WRITTEN = ("summary.json", "fan.png", "histograms.png", "tornado.png")
# Chunks submitted per worker: one runs, one waits.
AHEAD = 2
# Above the core count of any machine; each process needs its own memory.
MOST_PROCESSES = 1024
# Members and instants in the fan chart, for a study of any size.
FAN_MEMBERS, FAN_TIMES = 256, 500
# Timeout for the connection to the scheduler of a cluster.
PATIENCE = "10s"
# If every member is lost, the fan chart ends at this multiple of the last loss time.
BEYOND = 1.15
BANDS = (0.0, 5.0, 25.0, 50.0, 75.0, 95.0, 100.0)
GO_ON = "Finished chunks are kept: repeat the command with --out and --resume to continue."
METRICS = ("settled_max_abs_error_m", "settled_rms_error_m", "max_abs_error_m", "max_abs_u_V", "rms_u_V", "max_abs_i_A")


def study_of(case: Case, seed: int | None, members: int) -> Study:
    """Return the study of a case. Raises ValueError for a member count or seed out of range."""
    if not 1 <= members <= MOST_MEMBERS:
        raise ValueError(f"--members {members}: it must be a whole number from 1 to {MOST_MEMBERS:,}.")
    seed = int(case.scenario.seed) if seed is None else seed
    if not 0 <= seed < 2**32:
        raise ValueError(f"--seed {seed}: it must be a whole number from 0 to 4294967295.")
    return Study(case.cascade, case.scenario, case.clock, case.settle, case.spread, seed, members)


def run(args: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Run or resume a study and report it. Exit code 1 if a member does not survive."""
    case = read_with_warnings(args.case)
    study, store = _study_and_store(case, args)
    out = store.directory
    with reporting(lambda: _state_words(store)), contextlib.ExitStack() as held:
        error = None
        with contextlib.nullcontext() if store.finished() else _executor(args) as executor:
            make(out)  # only after all options are checked
            held.enter_context(alone(out))
            _check(study, store, args)  # again, under the lock: another run may have changed the directory
            fresh = not store.begun()
            store.begin()
            say(f"method: {case.clock.method}; writing to {out}")
            if isinstance(case.clock.method, Slide):
                error = sliding_error(study)
                say(error_words(error))
            if not store.finished():
                if fresh or not store.chunk:
                    _pilot(study, store, executor)
                _run(study, store, executor)
        store.finish()
        return _report(case, study, args, out, error)


def _study_and_store(case: Case, args: argparse.Namespace) -> tuple[Study, Store]:
    """Return the study and its store without writing anything. Raises ValueError for options that cannot be met."""
    study = study_of(case, args.seed, args.members)
    if args.chunk is not None and args.chunk < 1:
        raise ValueError(f"--chunk {args.chunk}: it must be a whole number of members, at least 1.")
    if args.processes is not None and not 1 <= args.processes <= MOST_PROCESSES:
        raise ValueError(f"--processes {args.processes}: it must be a whole number from 1 to {MOST_PROCESSES}.")
    if args.resume and args.out is None:
        raise ValueError("--resume: add --out DIR, the directory of the study that was interrupted.")
    study.drawn(np.array([0]))  # raises ValueError if the design cannot draw this many members
    out = target(args.out, f"ensemble-{case.name}")
    chunk = None if args.chunk is None else min(args.chunk, study.members)
    store = Store(out, study.fingerprint(), study.members, chunk)
    _check(study, store, args)
    return study, store


def _check(study: Study, store: Store, args: argparse.Namespace) -> None:
    store.check(COLUMNS + len(study.spread.entries), args.resume)
    check_places(store.directory, WRITTEN)


def _pilot(study: Study, store: Store, executor: tuple[Executor, int] | None) -> None:
    """Time the first members, print how long the study may take, choose the chunk size if none is set, and keep the
    chunks that the timing has computed."""
    columns, seconds = pilot(study)
    first = len(columns["index"])
    pace = Pace(first / seconds, None if executor is None else executor[1] // AHEAD)
    say_how_long(study, pace)
    with uninterrupted():
        store.cut(store.chunk or pace.chunk(study.members))
        for start, stop in store.spans()[: first // store.chunk]:
            store.put((start, stop), {name: column[start:stop] for name, column in columns.items()})


def _state_words(store: Store) -> str:
    """Return the message of an interruption: how many members are kept, and how to resume."""
    if not store.begun():
        return "nothing is kept"
    again = f"repeat the command with --out {store.directory} --resume"
    return f"{store.count()} of {store.members} members are kept. To continue, {again}"


def _report(
    case: Case, study: Study, args: argparse.Namespace, out: pathlib.Path, error: dict[str, Any] | None
) -> tuple[int, dict[str, Any]]:
    """Write and print the results of a finished study. `error`: result of `sliding_error`, or None."""
    with np.load(out / "members.npz") as file:
        columns = {name: file[name] for name in file.files}
    summary = _summary(case, study, columns, str(args.case))
    if error is not None:
        summary["sliding_step_error"] = error
    with files(out) as part:
        write_json(part / "summary.json", summary)
        _pictures(case, study, columns, summary, part)
    if not args.json:
        print(_text(summary))
        written(out, ", ".join(["members.npz", *WRITTEN[: None if study.spread.entries else -1]]))
    held = ~np.isfinite(columns["lost_at"])
    for warning in reversal(case, float(np.max(columns["max_abs_i_A"], initial=0.0, where=held))):
        say(warning)
    return int(summary["survivors"] < study.members), plain(summary) | {"out": str(out)}


@contextlib.contextmanager
def _executor(args: argparse.Namespace) -> Iterator[tuple[Executor, int] | None]:
    """Yield an executor and the number of chunks to submit at a time, or None to run in this process."""
    if args.cluster is not None:
        try:
            from distributed import Client, KilledWorker
        except ImportError:
            raise ValueError("--cluster: Dask is not installed. Run: pip install 'ambjax[cluster]'.") from None
        try:
            client = Client(args.cluster, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            raise ValueError(
                f"--cluster {args.cluster}: no scheduler answers there ({error}). Check the address."
            ) from None
        try:
            with client:
                yield client.get_executor(), AHEAD * max(len(client.scheduler_info()["workers"]), 1)
        except (KilledWorker, CancelledError):
            raise ValueError(
                f"--cluster {args.cluster}: the cluster, or its workers repeatedly, died. {GO_ON}"
            ) from None
    elif args.processes is not None:
        try:
            with processes(args.processes) as pool:
                yield pool, AHEAD * args.processes
        except BrokenExecutor:
            why = "a worker process died, perhaps because memory ran out; fewer processes need less"
            raise ValueError(f"--processes {args.processes}: {why}. {GO_ON}") from None
    else:
        yield None


def _run(study: Study, store: Store, executor: tuple[Executor, int] | None) -> None:
    """Compute the missing chunks and write each to disk as soon as it is finished."""
    missing, remarks = store.survey()
    for remark in remarks:
        say(remark)
    before = study.members - sum(stop - start for start, stop in missing)
    with tqdm(total=study.members, initial=before, unit="member", unit_scale=True, delay=2, desc="ensemble") as bar:
        results = _here(study, store, missing) if executor is None else _elsewhere(study, store, missing, *executor)
        for span, columns in results:
            with uninterrupted():
                store.put(span, columns)
            bar.update(span[1] - span[0])


Results = Iterator[tuple[tuple[int, int], dict[str, Any]]]


def _here(study: Study, store: Store, missing: list[tuple[int, int]]) -> Results:
    for span in missing:
        yield span, chunk(study, *span, store.chunk)


def _elsewhere(study: Study, store: Store, missing: list[tuple[int, int]], pool: Executor, ahead: int) -> Results:
    queue, running = list(reversed(missing)), dict[Future, tuple[int, int]]()
    while queue or running:
        while queue and len(running) < ahead:
            span = queue.pop()
            with ignore_sigint():
                running[pool.submit(work, study, *span, store.chunk)] = span
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()


def _summary(case: Case, study: Study, columns: dict[str, np.ndarray], path: str) -> dict[str, Any]:
    facts = {
        "case": case.name,
        "method": str(case.clock.method),
        "settle_s": case.settle,
        "design": study.spread.design,
    }
    numbers = statistics.summary(columns, study.spread.paths, study.seed)
    for worst in numbers["worst"]:
        worst["replay"] = study.command(path, worst["index"])
    return facts | numbers


def _pictures(
    case: Case, study: Study, columns: dict[str, np.ndarray], summary: dict[str, Any], out: pathlib.Path
) -> None:
    from ambjax.pictures import ensembles as pictures
    from ambjax.pictures import tornado

    lost_at = columns["lost_at"]
    # End the fan chart soon after the last loss if every member is lost.
    bands = study.bands(FAN_MEMBERS, FAN_TIMES, BEYOND * float(np.max(lost_at)))
    shown = {name: _quantiles(x, bands.extremes.get(name)) for name, x in bands.signals.items()}
    few = len(bands.trajectory.lost_at)
    title = case.name if few == study.members else f"{case.name}: bands of {few} of {study.members} members"
    limits = {"z - r": float(np.min(study.scenario.touchdown)), "u": float(np.min(study.scenario.u_max))}
    pictures.fan(bands.t, shown, limits, title, out / "fan.png", lost_at=lost_at, stalled=columns["stalled"])
    pictures.histograms(columns, out / "histograms.png")
    if study.spread.entries:
        deciding = statistics.DECIDING
        bars = [tornado.Bar(*(d[k] for k in tornado.Bar._fields)) for d in summary["drivers"][deciding]]
        tornado.tornado(bars, deciding, summary["explained"][deciding]["says"], out / "tornado.png")


def _quantiles(x: np.ndarray, extremes: tuple[np.ndarray, np.ndarray] | None) -> dict[float, np.ndarray]:
    """Compute quantiles [T] of x [members, T] over the surviving members at each instant, keyed by per cent.

    NaN where no member survives. `extremes`, if given, replace the 0 and 100 % quantiles: minimum and maximum between
    neighbouring instants.
    """
    left = np.isfinite(x).any(axis=0)
    quantiles = np.full((len(BANDS), x.shape[1]), np.nan)
    quantiles[:, left] = np.nanquantile(x[:, left], np.array(BANDS) / 100, axis=0)
    if extremes is not None:
        quantiles[[0, -1]] = extremes
    return dict(zip(BANDS, quantiles, strict=True))


def _text(summary: dict[str, Any]) -> str:
    share, low, high = (100 * summary["survival"][key] for key in ("estimate", "low", "high"))
    sure = f"{100 * summary['confidence']:g} % interval"
    held = f"{summary['survivors']} of {summary['members']} members survive"
    lines = [f"{held}: {share:.4g} % ({sure} {low:.4g} to {high:.4g} %)"]
    if summary["stalled"]:
        why = "the integrator stalled, so whether the rotor survives is not known"
        lines += [f"{summary['lost']} lost, {summary['stalled']} not decided: {why}"]
    lines += [f"note: {note}" for note in summary["notes"]]

    def number(x: float | None) -> str:
        return "-" if x is None else f"{x:.4g}"

    rows = []
    for name in METRICS:
        metric = summary["metrics"][name]
        rows.append(
            (name, *(number(metric[key]["estimate"]) for key in ("median", "q95", "cvar_95")), number(metric["max"]))
        )
    head = f"metric over the {summary['survivors']} {summary['metrics_of']}"
    lines += ["", table((head, "median", "95 % quantile", "mean of worst 5 %", "largest"), rows)]
    drivers, account = summary["drivers"][statistics.DECIDING][:5], summary["explained"][statistics.DECIDING]
    if drivers:
        lines += ["", f"Quantities that drive {statistics.DECIDING} of the {summary['metrics_of']}: {account['says']}."]
    if account["alone"]:
        bars = [
            (
                d["path"],
                f"{100 * d['share']:.1f} %",
                f"{100 * d['low']:.1f} to {100 * d['high']:.1f} %",
                f"{d['rho']:+.2f}",
            )
            for d in drivers
        ]
        lines += [table(("quantity", "share explained alone", sure, "rank correlation"), bars)]
    worst = summary["worst"][0]
    return "\n".join([*lines, "", f"To simulate the worst member: {one_line(worst['replay'])}"])
