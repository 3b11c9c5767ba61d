"""`ambjax ensemble`: run a study in chunks, in this process or on workers, and write its summary and plots."""

import argparse
import contextlib
from concurrent.futures import Executor

import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.commands.pace import Pace, error_words, pilot, print_estimate, sliding_error
from ambjax.commands.reading import read_any_with_warnings
from ambjax.commands.study_report import WRITTEN, write_report
from ambjax.commands.workers import AHEAD, compute, executor_of
from ambjax.ensemble.store import Store
from ambjax.ensemble.study import COLUMNS, AnyStudy, Study
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.host.interrupts import reporting, uninterrupted
from ambjax.host.lock import locked
from ambjax.results.machine_study import MachineStudy
from ambjax.results.outputs import check_places, make, target
from ambjax.results.spread_runs import study_of
from ambjax.simulation.sliding import Slide

# Largest number of worker processes that --processes accepts.
MOST_PROCESSES = 1024


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Run or resume a study and report it. The exit code is 1 if a member is lost, stalled or not stable."""
    case = read_any_with_warnings(args.case)
    study, store = _study_and_store(case, args)
    out = store.directory
    with reporting(lambda: _state_words(store)), contextlib.ExitStack() as stack:
        error = None
        with contextlib.nullcontext() if store.finished() else executor_of(args) as executor:
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
                    compute(study, store, executor)
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
    chunk = None if args.chunk is None else min(args.chunk, study.members)
    store = Store(out, study.fingerprint(), study.members, chunk)
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
