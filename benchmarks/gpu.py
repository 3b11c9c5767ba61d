"""Throughput on a GPU: the whole rollout as one kernel, a scan, and the processor; float32 and float64.

The workload is that of workload.py, without and with held noise, in one process per precision and device. The results
of the kernel are compared with those of the scan. Without a GPU, the script prints a message and ends. Run: python
benchmarks/gpu.py
"""

import argparse
import functools
import itertools
import json
import os
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")
# This process only asks for the device; those that measure need its memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import _measure
import jax
import numpy as np
import workload

from ambjax.ensemble import run_on_gpu
from ambjax.ensemble.gpu_kernel import BLOCK

MEMBERS = (4_096, 65_536, 1_048_576)
# Members of one program, compared for the largest ensemble without noise.
BLOCKS = (32, 64, 256)
SAMPLES = 100
# Largest relative difference due to rounding over 1,000 steps. z is a hundredth of the largest state, and the noise is
# rounded differently, too.
ALLOWED = {"float64": 1e-9, "float32": 1e-2}
KERNEL, SCAN, PROCESSOR = "kernel", "scan", "processor"


def measure(dtype: str, members: tuple[int, ...], samples: int) -> list[dict[str, Any]]:
    """Return the rows of one precision, on the device of this process."""
    on_gpu, rows = jax.default_backend() == "gpu", []
    for noise, n in itertools.product((False, True), members):
        work = workload.workload(n, samples, noise=noise)
        runs: dict[str, Any] = {}
        if on_gpu:
            # one call of the engine: the scan launches as many kernels per step for one member as for all of them
            runs[SCAN] = functools.partial(workload.by_ambjax, work, call=n)
            blocks = BLOCKS if n == max(members) and not noise else ()
            for name, block in {KERNEL: BLOCK, **{f"{KERNEL}, block = {block}": block for block in blocks}}.items():
                kernel = functools.partial(run_on_gpu, *work, fold=workload.FOLD, block=block)
                runs[name] = lambda kernel=kernel: kernel().metrics
        else:
            runs[PROCESSOR] = functools.partial(workload.by_ambjax, work, os.cpu_count() or 1)
        times, error = _measure.alternating(runs, repeats=3), 0.0
        if on_gpu:
            error = float(np.abs(np.asarray(runs[KERNEL]()) / np.asarray(runs[SCAN]()) - 1).max())
            assert error <= ALLOWED[dtype], f"the kernel in {dtype} differs from the scan by {error:.1e}"
        for name, found in times.items():
            rate = n * work.steps / found.seconds
            row = {"dtype": dtype, "noise": noise, "members": n, "run": name, "steps_per_s": rate, "error": error}
            rows.append(row | {"seconds": found.seconds, "compile_s": found.compile_s})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, nargs="+", default=MEMBERS)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--dtype", choices=tuple(ALLOWED), help="measure one precision on one device and print JSON")
    given = parser.parse_args()
    if given.dtype:
        print(json.dumps(measure(given.dtype, given.members, given.samples)))
        return
    if not any(device.platform == "gpu" for device in jax.devices()):
        print(f"no GPU here, JAX runs on {jax.default_backend()}: nothing measured")
        return
    rows, device = [], jax.devices()[0].device_kind
    for (dtype, x64), on_gpu in itertools.product((("float32", "0"), ("float64", "1")), (True, False)):
        arguments = ("--dtype", dtype, "--samples", given.samples, "--members", *given.members)
        where = {"JAX_PLATFORMS": "cuda,cpu" if on_gpu else "cpu"}
        found = _measure.child(__file__, *arguments, JAX_ENABLE_X64=x64, **where)
        rows += found
        for row in found:
            named = f"{dtype} {'held' if row['noise'] else 'no  '} noise {row['members']:>8} {row['run']:<20}"
            print(f"{named} {row['steps_per_s']:9.3e} member-steps/s, error {row['error']:.1e}", flush=True)
    _measure.write("gpu", {"device": device, "samples": given.samples, "rows": rows})


if __name__ == "__main__":
    main()
