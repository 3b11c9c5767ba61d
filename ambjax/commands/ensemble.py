"""`ambjax ensemble`: run a study in chunks, in this process or on workers, and write its summary and plots."""

import argparse
import contextlib
import dataclasses
import pickle
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.commands.reading import read_any_with_warnings
from ambjax.commands.study_report import WRITTEN, write_report
from ambjax.ensemble.batching import cores
from ambjax.ensemble.store import Store
from ambjax.ensemble.study import COLUMNS, AnyStudy, Study
from ambjax.ensemble.worker import CALL, chunk, ignore_sigint, processes, work
from ambjax.host.extensions import extra
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.host.interrupts import reporting, uninterrupted
from ambjax.host.lock import locked
from ambjax.results.machine_study import MachineStudy
from ambjax.results.outputs import check_places, make, target
from ambjax.results.spread_runs import study_of
from ambjax.simulation.method import TOLERANCE
from ambjax.simulation.rosenbrock import AdaptiveRodas3
from ambjax.simulation.sliding import Slide, slides
from ambjax.text.words import duration

# Largest number of worker processes that --processes accepts.
MOST_PROCESSES = 1024
# Chunks submitted per worker: one runs, one waits.
AHEAD = 2
# Timeout for the connection to the scheduler of a cluster.
PATIENCE = "10s"
CONTINUE = "Finished chunks are kept: repeat the command with --out and --resume to continue."

# Target duration of a chunk, s. It is the largest time lost by an interruption, and the interval of the progress bar.
CHUNK_SECONDS = 2.0
# Largest number of members per chunk.
MOST_CHUNK = 65_536
# Members per chunk, and members that `_pilot` times, on an accelerator.
ACCELERATOR_CHUNK = 1024
# The expected duration is printed above SHORT, and a faster method suggested above LONG, both in s.
SHORT, LONG = 3.0, 60.0
# Number of members, and metrics, in the comparison of the sliding step with adaptive steps.
COMPARISON, COMPARED = 16, ("settled_rms_error_m", "rms_u_V", "chatter_V")

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
    """Time the simulation of the first members, CALL on each core, and write the chunks that they fill."""
    first = min(CALL * cores() if jax.default_backend() == "cpu" else ACCELERATOR_CHUNK, study.members)
    with doing(f"simulating the first members; {FIRST_RUN}"):
        chunk(study, 0, first, first, lost=True)
        if first < study.members:
            say(f"timing the first {first} members ...")
        began = time.perf_counter()
        columns = {name: np.asarray(x) for name, x in chunk(study, 0, first, first).items()}
        seconds = time.perf_counter() - began
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
        distributed = extra("distributed", "cluster")
        try:
            client = distributed.Client(args.cluster, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            advice = "Check the address."
            raise ValueError(f"--cluster {args.cluster}: no scheduler answers there ({error}). {advice}") from None
        try:
            with client:
                yield client.get_executor(), AHEAD * max(len(client.scheduler_info()["workers"]), 1)
        except (distributed.KilledWorker, CancelledError):
            why = f"the cluster died, or its workers died repeatedly. {CONTINUE}"
            raise ValueError(f"--cluster {args.cluster}: {why}") from None
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


class Pace(NamedTuple):
    """Members per second of this process on all its cores, and the number of worker processes (None: no workers)."""

    rate: float
    workers: int | None

    @property
    def whole(self) -> float:
        """Members per second of the whole study, if each worker is as fast as one core of this machine."""
        return self.rate if self.workers is None else self.rate / cores() * self.workers

    def chunk(self, members: int) -> int:
        """Return the members per chunk: about CHUNK_SECONDS of work, at most half of a worker's members.

        The number is rounded up to a multiple of CALL per core, and is at most `members`.
        """
        if jax.default_backend() != "cpu":
            return min(ACCELERATOR_CHUNK, members)
        unit, rate = (CALL * cores(), self.rate) if self.workers is None else (CALL, self.rate / cores())
        fair = members if self.workers is None else -(-members // (2 * self.workers))
        count = min(round(CHUNK_SECONDS * rate), fair, MOST_CHUNK)
        return min(max(-(-count // unit), 1) * unit, members)


def print_estimate(study: AnyStudy, pace: Pace) -> None:
    """Print a duration of at least SHORT. Above LONG, suggest the sliding step if it applies."""
    seconds = study.members / pace.whole
    if seconds < SHORT:
        return
    rate = f"{pace.whole:.2g}" if pace.whole < 10 else f"{pace.whole:,.0f}"
    words = f"about {duration(seconds)} for {study.members:,} members ({rate} a second)"
    adaptive = isinstance(study.clock.method, AdaptiveRodas3)
    if seconds > LONG and adaptive and isinstance(study, Study) and slides(study.cascade, study.scenario):
        words += '; clock.method = "sliding" would be faster; its error is measured and printed'
    say(words)


def sliding_error(study: Study) -> dict[str, Any]:
    """Compute the largest relative difference of each metric in COMPARED between this study's steps and adaptive steps.

    The comparison uses the first COMPARISON members, without those that are lost or stalled with either kind of steps.
    """
    tolerance = max(TOLERANCE, 1e3 * float(jnp.finfo(jnp.result_type(float)).eps))
    accurate = dataclasses.replace(study, clock=study.clock.with_method(AdaptiveRodas3(tolerance)))
    count = min(COMPARISON, study.members)
    ours, theirs = (chunk(one, 0, count, count) for one in (study, accurate))
    ends = [~np.isfinite(columns["lost_at"]) for columns in (ours, theirs)]
    both = ends[0] & ends[1]
    error: dict[str, Any] = {"members": count, "lost_by_one": int((ends[0] != ends[1]).sum())}
    for name in COMPARED:
        a, b = (np.asarray(columns[name])[both] for columns in (ours, theirs))
        size = np.maximum(np.abs(b), np.finfo(float).tiny)  # avoids 0 / 0
        error[name] = float(np.max(np.abs(a - b) / size)) if both.any() else None
    return error


def error_words(error: dict[str, Any]) -> str:
    """Return the error of the sliding step as text."""
    words = f"sliding step against adaptive steps, {error['members']} members: "
    if error[COMPARED[0]] is None:
        words += "no member survives with both"
    else:
        words += ", ".join(f"{name} off by {100 * error[name]:.2g} %" for name in COMPARED) + " at most"
    return f"{words}; {error['lost_by_one']} survive with only one"
