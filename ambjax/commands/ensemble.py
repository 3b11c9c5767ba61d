"""`ambjax ensemble`: run a study in chunks, in this process or on workers, and write its summary and plots."""

import argparse
import contextlib
import pickle
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any

import numpy as np
from tqdm import tqdm

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.commands.pace import Pace, error_words, pilot, print_estimate, sliding_error
from ambjax.commands.reading import read_any_with_warnings
from ambjax.commands.study_report import WRITTEN, write_report
from ambjax.ensemble.store import Store
from ambjax.ensemble.study import COLUMNS, AnyStudy, Study
from ambjax.ensemble.worker import chunk, ignore_sigint, processes, work
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.host.interrupts import reporting, uninterrupted
from ambjax.host.lock import locked
from ambjax.results.machine_study import MachineStudy
from ambjax.results.outputs import check_places, make, target
from ambjax.results.spread_runs import study_of
from ambjax.simulation.sliding import Slide

# Largest number of worker processes that --processes accepts.
MOST_PROCESSES = 1024
# Chunks submitted per worker: one runs, one waits.
AHEAD = 2
# Timeout for the connection to the scheduler of a cluster.
PATIENCE = "10s"
CONTINUE = "Finished chunks are kept: repeat the command with --out and --resume to continue."

# Chunks by their spans.
Results = Iterator[tuple[tuple[int, int], dict[str, Any]]]


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Run or resume a study and report it. The exit code is 1 if a member is lost, stalled or not stable."""
    case = read_any_with_warnings(args.case)
    study, store = _study_and_store(case, args)
    out = store.directory
    with reporting(lambda: _state_words(store)), contextlib.ExitStack() as stack:
        error = None
        with contextlib.nullcontext() if store.finished() else _executor(args) as executor:
            make(out)  # only after all options are checked
            stack.enter_context(locked(out))
            _check(study, store, args)  # again, under the lock: another run may have changed the directory
            fresh = not store.begun()
            store.begin()
            say(f"method: {case.clock.method}; writing to {out}")
            if isinstance(study, Study) and isinstance(case.clock.method, Slide):
                with doing(f"comparing sliding with adaptive steps; {FIRST_RUN}"):
                    error = sliding_error(study)
                say(error_words(error))
            if not store.finished():
                if fresh or not store.chunk:
                    _pilot(study, store, executor)
                with doing(f"simulating the members; {FIRST_RUN}"):
                    _compute(study, store, executor)
        store.finish()
        return write_report(case, study, args, out, error)


def _study_and_store(case: Case | MachineCase, args: argparse.Namespace) -> tuple[Study | MachineStudy, Store]:
    """Return the study and its store without writing anything. Raises ValueError for an invalid option."""
    study = study_of(case, args.seed, args.members)
    if args.chunk is not None and args.chunk < 1:
        raise ValueError(f"--chunk {args.chunk}: it must be a whole number of members, at least 1.")
    if args.processes is not None and not 1 <= args.processes <= MOST_PROCESSES:
        raise ValueError(f"--processes {args.processes}: it must be a whole number from 1 to {MOST_PROCESSES}.")
    if args.resume and args.out is None:
        raise ValueError("--resume: add --out DIR, the directory of the study that was interrupted.")
    study.drawn(np.array([0]))  # raises ValueError if the design cannot draw this many members
    out = target(args.out, f"ensemble-{case.name}")
    size = None if args.chunk is None else min(args.chunk, study.members)
    store = Store(out, study.fingerprint(), study.members, size)
    _check(study, store, args)
    return study, store


def _check(study: AnyStudy, store: Store, args: argparse.Namespace) -> None:
    store.check(COLUMNS + len(study.spread.entries), args.resume)
    check_places(store.directory, WRITTEN)


def _pilot(study: AnyStudy, store: Store, executor: tuple[Executor, int] | None) -> None:
    """Time the simulation of the first members, and write the chunks that they fill."""
    with doing(f"simulating the first members; {FIRST_RUN}"):
        columns, seconds = pilot(study)
    first = len(columns["index"])
    # executor[1]: chunks submitted at a time, AHEAD for each worker
    pace = Pace(first / seconds, None if executor is None else executor[1] // AHEAD)
    print_estimate(study, pace)
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


@contextlib.contextmanager
def _executor(args: argparse.Namespace) -> Iterator[tuple[Executor, int] | None]:
    """Yield an executor and the largest number of its unfinished chunks, or None to run in this process."""
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
                f"--cluster {args.cluster}: the cluster died, or its workers died repeatedly. {CONTINUE}"
            ) from None
    elif args.processes is not None:
        try:
            with processes(args.processes) as pool:
                yield pool, AHEAD * args.processes
        except BrokenExecutor:
            why = "a worker process died, perhaps because memory ran out; fewer processes need less"
            raise ValueError(f"--processes {args.processes}: {why}. {CONTINUE}") from None
    else:
        yield None


def _compute(study: AnyStudy, store: Store, executor: tuple[Executor, int] | None) -> None:
    """Compute the missing chunks and write each to disk as soon as it is finished."""
    missing, remarks = store.survey()
    for remark in remarks:
        say(remark)
    before = study.members - sum(stop - start for start, stop in missing)
    with tqdm(total=study.members, initial=before, unit="member", unit_scale=True, delay=2, desc="ensemble") as bar:
        here: Results = ((span, chunk(study, *span, store.chunk)) for span in missing)
        results = here if executor is None else _run_on(study, store, missing, *executor)
        for span, columns in results:
            with uninterrupted():
                store.put(span, columns)
            bar.update(span[1] - span[0])


def _run_on(study: AnyStudy, store: Store, missing: list[tuple[int, int]], pool: Executor, ahead: int) -> Results:
    queue, running, sent = list(reversed(missing)), dict[Future, tuple[int, int]](), pickle.dumps(study)
    while queue or running:
        while queue and len(running) < ahead:
            span = queue.pop()
            with ignore_sigint():
                running[pool.submit(work, sent, *span, store.chunk)] = span
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()
