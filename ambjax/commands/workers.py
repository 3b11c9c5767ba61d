"""The computation of a study's chunks: in this process, on worker processes or on a cluster."""

import argparse
import contextlib
import pickle
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from typing import Any

from tqdm import tqdm

from ambjax.ensemble.store import Store
from ambjax.ensemble.study import AnyStudy
from ambjax.ensemble.worker import chunk, ignore_sigint, processes, work
from ambjax.host.heartbeat import say
from ambjax.host.interrupts import uninterrupted

# Chunks submitted per worker: one runs, one waits.
AHEAD = 2
# Timeout for the connection to the scheduler of a cluster.
PATIENCE = "10s"
CONTINUE = "Finished chunks are kept: repeat the command with --out and --resume to continue."


@contextlib.contextmanager
def executor_of(args: argparse.Namespace) -> Iterator[tuple[Executor, int] | None]:
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


def compute(study: AnyStudy, store: Store, executor: tuple[Executor, int] | None) -> None:
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


Results = Iterator[tuple[tuple[int, int], dict[str, Any]]]


def _run_on(study: AnyStudy, store: Store, missing: list[tuple[int, int]], pool: Executor, ahead: int) -> Results:
    queue, running, sent = list(reversed(missing)), dict[Future, tuple[int, int]](), pickle.dumps(study)
    while queue or running:
        while queue and len(running) < ahead:
            span = queue.pop()
            with ignore_sigint():
                running[pool.submit(work, sent, *span, store.chunk)] = span
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            yield running.pop(future), future.result()
