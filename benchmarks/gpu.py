"""Throughput on an accelerator: the whole rollout as one kernel against a scan; float32 and float64, N up to a million.

The workload is that of workload.py, without and with held noise, in one process per precision. The results of the
kernel are compared with those of the scan. Without an accelerator, the script prints a message and ends. Run: python
benchmarks/gpu.py
"""

import argparse
import functools
import itertools
import json
import os
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import numpy as np
import workload

from ambjax.ensemble.gpu_kernel import run_whole

MEMBERS = (4_096, 65_536, 262_144, 1_048_576)
BLOCKS = (32, 64, 128, 256)
SAMPLES = 100
# Largest relative difference due to rounding over 1,000 steps. z is a hundredth of the largest state, and the noise is
# rounded differently, too.
ALLOWED = {"float64": 1e-9, "float32": 1e-2}


def measure(dtype: str, members: tuple[int, ...], samples: int) -> list[dict[str, Any]]:
    rows = []
    for noise, n in itertools.product((False, True), members):
        work = workload.workload(n, samples, noise=noise)
        # one call of the engine: the scan launches as many kernels per step for one member as for all of them
        runs: dict[str, Any] = {"scan": functools.partial(workload.by_ambjax, work, call=n)}
        for block in BLOCKS:
            kernel = functools.partial(run_whole, *work, fold=workload.FOLD, block=block)
            runs[f"kernel, {block} members a program"] = lambda kernel=kernel: kernel().measured
        expected = np.asarray(runs["scan"]())
        for name, run in runs.items():
            error = float(np.abs(np.asarray(run()) / expected - 1).max())
            assert error <= ALLOWED[dtype], f"{name} in {dtype} differs from the scan by {error:.1e}"
        for name, found in _measure.alternating(runs, repeats=3).items():
            rate = n * work.steps / found.seconds
            row = {"dtype": dtype, "noise": noise, "members": n, "run": name, "steps_per_s": rate}
            rows.append(row | {"seconds": found.seconds, "compile_s": found.compile_s})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, nargs="+", default=MEMBERS)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--dtype", choices=tuple(ALLOWED), help="measure one precision and print JSON")
    given = parser.parse_args()
    if jax.default_backend() != "gpu":
        print(f"no GPU here, JAX runs on {jax.default_backend()}: nothing measured")
        return
    if given.dtype:
        print(json.dumps(measure(given.dtype, given.members, given.samples)))
        return
    rows = []
    for dtype, x64 in (("float32", "0"), ("float64", "1")):
        arguments = ("--dtype", dtype, "--samples", given.samples, "--members", *given.members)
        # two processes share the device: limit the memory of each
        found = _measure.child(__file__, *arguments, JAX_ENABLE_X64=x64, XLA_PYTHON_CLIENT_PREALLOCATE="false")
        rows += found
        for row in found:
            named = f"{dtype} {'held' if row['noise'] else 'no  '} noise {row['members']:>8} {row['run']:<30}"
            print(f"{named} {row['steps_per_s']:9.3e} member-steps/s", flush=True)
    device = jax.devices()[0].device_kind
    _measure.write("gpu", {"device": device, "samples": given.samples, "rows": rows})


if __name__ == "__main__":
    main()
