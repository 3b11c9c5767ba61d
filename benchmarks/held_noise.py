"""Held noise on smooth gains: what a higher-order method per hold saves at 1e-6 relative error in z.

The common ensemble workload with held noise (100 us), 64 members, one core. Error: the largest |z - reference|
over all members and samples, relative to the largest |z|; reference: RK4 with 100 substeps.
Run: python benchmarks/held_noise.py
"""

import os

os.environ.setdefault("JAX_ENABLE_X64", "1")

import dataclasses
import functools
from typing import Any

import _measure
import numpy as np
import workload

from ambjax import RK4, DormandPrince
from ambjax.ensemble.engine import run_ensemble
from ambjax.metrics import Peak

TARGET = 1e-6
METHODS = [RK4(n) for n in (2, 3, 4, 5, 6, 8, 10)] + [DormandPrince(n) for n in (1, 2, 3)]


def main() -> None:
    work = workload.workload(64, 500, noise=True)

    def run(method: Any, every: int) -> Any:
        clock = dataclasses.replace(work.clock, method=method)
        fold = None if every else Peak("e_z")
        return run_ensemble(work.cascade, work.scenario, clock, fold=fold, every=every, threads=1)

    reference = run(RK4(100), 1).trajectory.rows.z
    rows = []
    for method in METHODS:
        error = np.abs(run(method, 1).trajectory.rows.z - reference).max() / np.abs(reference).max()
        seconds = _measure.median_time(functools.partial(run, method, 0))
        rows.append({"method": str(method), "relative_error": float(error), "seconds": seconds})
        print(f"{method!s:<32} relative error {error:.1e}   {1e3 * seconds:.1f} ms")
    best = {}
    for kind in ("RK4", "Dormand-Prince 5"):
        good = [r for r in rows if r["method"].startswith(kind) and r["relative_error"] <= TARGET]
        best[kind] = min(good, key=lambda r: r["seconds"]) if good else None
    if all(best.values()):
        ratio = best["Dormand-Prince 5"]["seconds"] / best["RK4"]["seconds"]
        print(
            f"At {TARGET:g}: {best['Dormand-Prince 5']['method']} takes {ratio:.2f} of {best['RK4']['method']}'s time."
        )
    _measure.write("held_noise", {"target": TARGET, "methods": rows, "best": best})


if __name__ == "__main__":
    main()
