"""Functions shared by the benchmarks: timing, machine facts, JSON."""

import contextlib
import json
import math
import os
import pathlib
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.compiler.fast_path import has_avx512

RESULTS = pathlib.Path(__file__).parent / "results"


def median_time(run: Callable[[], Any], repeats: int = 7) -> float:
    """Return the median wall time of `run`, in s, after one warm-up; wait for the results of JAX."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - began)
    return statistics.median(times)


class Timed(NamedTuple):
    """Seconds of a run in each round, and the time of its first call."""

    times: list[float]
    first: float

    @property
    def seconds(self) -> float:
        return statistics.median(self.times)

    @property
    def compile_s(self) -> float:
        """Return the additional time of the first call, in s."""
        return max(self.first - self.seconds, 0.0)

    def over(self, other: "Timed") -> float:
        """Return the median over rounds of the ratio of two times; slow periods of the machine cancel."""
        return statistics.median(a / b for a, b in zip(self.times, other.times, strict=True))


# Processor seconds of this process, which other load changes least.
own_seconds = time.process_time


def alternating(
    runs: dict[Any, Callable[[], Any]],
    repeats: int = 5,
    least: float = 0.02,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Any, Timed]:
    """Return the times of each run by `clock`. The runs alternate, so that all meet the same load.

    A run shorter than `least` seconds is repeated within its turn, as by Python's timeit, because the runs before it
    have displaced its data from the caches.
    """
    first, times, counts = {}, {name: [] for name in runs}, {}

    def clocked(run: Callable[[], Any], count: int = 1) -> float:
        began = clock()
        for _ in range(count):
            jax.block_until_ready(run())
        return (clock() - began) / count

    for name, run in runs.items():
        first[name] = clocked(run)
        counts[name] = max(1, math.ceil(least / clocked(run)))
    for _ in range(repeats):
        for name, run in runs.items():
            times[name].append(clocked(run, counts[name]))
    return {name: Timed(times[name], first[name]) for name in runs}


def child(script: str, *arguments: Any, **environment: str) -> Any:
    """Run a benchmark script in its own process and return the JSON of its last output line."""
    command = [sys.executable, script, *map(str, arguments)]
    done = subprocess.run(command, env=os.environ | environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


@contextlib.contextmanager
def server(script: str, name: str) -> Iterator[Callable[[], Any]]:
    """Start `script --serve NAME` and yield a function that sends it a line and returns its answer, a line of JSON."""
    command = [sys.executable, script, "--serve", name]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        line: Any = process.stdin
        answers: Any = process.stdout

        def ask() -> Any:
            line.write("once\n")
            line.flush()
            return json.loads(answers.readline())

        answers.readline()  # ready
        try:
            yield ask
        finally:
            line.write("\n")
            line.close()


def peak_memory() -> int:
    """Return the peak resident memory of this process, in bytes.

    getrusage includes the parent's memory after vfork, so Linux's VmHWM is used where it exists.
    """
    status = pathlib.Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return 1024 * int(line.split()[1])
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def one_core() -> None:
    """Pin this process to one core, if the system supports it."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def machine() -> dict[str, Any]:
    """Return facts about the machine and the versions."""
    cpuinfo = pathlib.Path("/proc/cpuinfo")
    text = cpuinfo.read_text() if cpuinfo.exists() else ""
    model = next((line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")), "")
    return {
        "cpu": model or platform.processor(),
        "cores": os.cpu_count(),
        "avx512": has_avx512(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
    }


def write(name: str, results: dict[str, Any]) -> None:
    """Write benchmarks/results/NAME.json with the facts about the machine."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps({"machine": machine(), **results}, indent=2) + "\n")
    print(f"written: {path}")
