"""Held noise with smooth gains: time of DOP853 relative to RK4, at a relative error in z of at most 1e-6.

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

from ambjax import paper
from ambjax.ensemble import run_ensemble
from ambjax.sensors import Sensor
from ambjax.simulation.folds import Peak
from ambjax.solvers import DOP853, RK4

TARGET = 1e-6
NOISES = {
    "the workload's, 1e-6 m on z": workload.NOISE,
    "10 times that": Sensor(1e-5, 1e-3, 1e-3),
    "100 times that": Sensor(1e-4, 1e-2, 1e-2),
    "the paper's, 3.2e-4 m on z alone": Sensor(paper.TABLE_2.noise_std),
}
METHODS = [RK4(n) for n in (1, 2, 3, 4, 5, 6, 7, 8, 10, 14, 18)] + [DOP853(n) for n in (1, 2, 3, 4)]


def measure(noise: str) -> dict[str, Any]:
    """Return the results of all methods under this noise."""
    work = workload.workload(64, 500, noise=True)
    scenario = dataclasses.replace(work.scenario, sensor=NOISES[noise])

    def run(method: Any, every: int) -> Any:
        clock = dataclasses.replace(work.clock, method=method)
        fold = None if every else Peak("e_z")
        return run_ensemble(work.cascade, scenario, clock, fold=fold, record_every=every, threads=1)

    reference = run(RK4(100), 1).trajectory.rows.z
    rows = []
    for method in METHODS:
        error = np.abs(run(method, 1).trajectory.rows.z - reference).max() / np.abs(reference).max()
        rows.append({"method": str(method), "relative_error": float(error)})
    found = _measure.alternating({str(m): functools.partial(run, m, 0) for m in METHODS}, repeats=7)
    for row in rows:
        row["seconds"] = found[row["method"]].seconds
        print(f"{noise}: {row['method']:<32} {row['relative_error']:.1e} {1e3 * row['seconds']:6.1f} ms")
    best = {}
    for kind in ("RK4", "DOP853"):
        good = [r for r in rows if r["method"].startswith(kind) and r["relative_error"] <= TARGET]
        best[kind] = min(good, key=lambda r: r["seconds"]) if good else None
    ratio = found[best["DOP853"]["method"]].over(found[best["RK4"]["method"]]) if all(best.values()) else None
    print(f"{noise}, at {TARGET:g}: DOP853 takes {ratio or float('nan'):.2f} of RK4's time", flush=True)
    return {"noise": noise, "methods": rows, "best": best, "ratio": ratio}


def main() -> None:
    _measure.one_core()
    _measure.write("held_noise", {"target": TARGET, "cases": [measure(noise) for noise in NOISES]})


if __name__ == "__main__":
    main()
