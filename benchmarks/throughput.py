"""Member-steps per second of an ensemble against the number of members, compared with the machine's limit.

The workload is that of workload.py (RK4, 10 us a step), without and with held noise, in float64 and float32 (one
process per precision), on one core and on two. ambjax and limit.c are timed alternately in the same process. Ratios are
medians over the rounds, without compilation. One member alone is a `rollout`.
Run: python benchmarks/throughput.py
With the instructions of a processor without AVX-512 (throughput_avx2.json):
XLA_FLAGS=--xla_cpu_max_isa=AVX2 python benchmarks/throughput.py
"""

import argparse
import functools
import itertools
import json
import os
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import limit
import workload

from ambjax.compiler.fast_path import has_avx512

MEMBERS = (1, 16, 64, 256, 1024, 4096)
THREADS = (1, 2)
# Samples of a run, and of a run of fewer than 256 members. A call takes 1 to 2 ms besides the simulation, which would
# be a large part of a short run.
SAMPLES, LONG = 500, 5_000
REPEATS = 15


def measure(dtype: str, members: tuple[int, ...], samples: int) -> list[dict[str, Any]]:
    """Return one row per number of members, threads and kind of noise."""
    rows = []
    for noise, n in itertools.product((False, True), members):
        work, runs = workload.workload(n, samples if n >= 256 else samples * LONG // SAMPLES, noise=noise), {}
        for threads in (t for t in THREADS if t <= n):
            runs["ambjax", threads] = functools.partial(workload.by_ambjax, work, threads)
            if not limit.missing():
                runs["C", threads] = functools.partial(limit.run, work, dtype, threads)
        found = _measure.alternating(runs, REPEATS)
        for threads in (t for t in THREADS if t <= n):
            ours = found["ambjax", threads]
            row: dict[str, Any] = {"dtype": dtype, "noise": noise, "members": n, "threads": threads}
            row |= {name: 1e9 * each.seconds / n / work.steps for (name, t), each in found.items() if t == threads}
            row |= {"compile_s": ours.compile_s, "times_one_core": found["ambjax", 1].over(ours)}
            if "C" in row:
                limit_s = found["C", threads]
                row |= {"ratio": ours.over(limit_s), "C_times_one_core": found["C", 1].over(limit_s)}
            rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, nargs="+", default=MEMBERS)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--dtype", choices=("float64", "float32"), help="measure one precision and print JSON")
    given = parser.parse_args()
    if given.dtype:
        print(json.dumps(measure(given.dtype, given.members, given.samples)))
        return
    if why := limit.missing():
        print(f"{why}: the limit is skipped")
    print(f"{'dtype':<8} {'noise':<6} {'members':>7} {'cores':>5} {'ns/step':>8} {'C':>7} {'ratio':>6} {'steps/s':>9}")
    rows = []
    for dtype, x64 in (("float64", "1"), ("float32", "0")):
        arguments = ("--dtype", dtype, "--samples", given.samples, "--members", *given.members)
        found = _measure.child(__file__, *arguments, JAX_ENABLE_X64=x64)
        rows += found
        for row in found:
            named = f"{dtype:<8} {'held' if row['noise'] else 'none':<6} {row['members']:>7} {row['threads']:>5}"
            limits = f"{row.get('C', float('nan')):7.2f} {row.get('ratio', float('nan')):6.2f}"
            print(f"{named} {row['ambjax']:8.2f} {limits} {1e9 / row['ambjax']:9.2e}", flush=True)
    agreement = None if limit.missing() else limit.agreement()
    _measure.write(
        "throughput" if has_avx512() else "throughput_avx2",
        {
            "samples": given.samples,
            "samples_of_few": given.samples * LONG // SAMPLES,
            "agreement": agreement,
            "rows": rows,
        },
    )


if __name__ == "__main__":
    main()
