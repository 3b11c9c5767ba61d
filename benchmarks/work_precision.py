"""Work against precision of the integrators: error in z against cost, as table and plot.

The workload is the repaired tracking scenario for 0.2 s at 10 kHz, with (a) smooth gains gamma = 1e9, p = 25e-6 in the
inversion, (b) the repaired gains, (c) the repaired gains and noise of std 1e-6 m on z, held 100 us. Error: the largest
|z - reference| over all samples; reference: AdaptiveRodas3 at tolerance 1e-10, compared with RK4 at 0.2 us.
Run: python benchmarks/work_precision.py
"""

import dataclasses
import os
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from ambjax import Clock, paper, rollout
from ambjax.laws import inversion
from ambjax.sensors import Sensor
from ambjax.solvers import RK4, AdaptiveRodas3, Euler, Rodas3

SAMPLES = 2_000
CASES = {
    "(a) smooth gains": ((1e9, 25e-6), None),
    "(b) repaired gains": ((paper.REPAIRED_GAMMA, 25.0), None),
    "(c) repaired, noise 1e-6 m": ((paper.REPAIRED_GAMMA, 25.0), Sensor(1e-6)),
}
METHODS: dict[str, list[Any]] = {
    "Euler": [Euler(n) for n in (2, 5, 20, 100, 400)],
    "RK4": [RK4(n) for n in (1, 2, 5, 10, 50, 100)],
    "Rodas3": [Rodas3(n) for n in (1, 2, 5, 10, 20, 50)],
    "Adaptive": [AdaptiveRodas3(10.0**-n) for n in (3, 4, 5, 6, 7, 8)],
}


def run(case: str, method: Any) -> Any:
    gains, sensor = CASES[case]
    cascade = dataclasses.replace(paper.cascade("repaired"), inversion=inversion.Adaptive(*gains))
    scenario = dataclasses.replace(paper.scenario("tracking", "repaired"), sensor=sensor)
    return rollout(cascade, scenario, Clock(SAMPLES, 1e-4, method)).trajectory.rows.z


def measure(case: str, reference: np.ndarray, method: Any) -> dict[str, float] | None:
    """Return the error and the time; None if `rollout` refuses an explicit step beyond its stability limit."""
    try:
        z = np.asarray(jax.block_until_ready(run(case, method)))
    except ValueError:
        return None
    seconds = _measure.median_time(lambda: run(case, method), repeats=3)
    return {"error_m": float(np.abs(z - reference).max()), "seconds": seconds}


def draw(results: dict[str, Any]) -> None:
    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots(1, len(CASES), sharey=True)
    for ax, case in zip(axes, CASES, strict=True):
        for (name, rows), mark in zip(results[case]["methods"].items(), "osD^", strict=True):
            seen = [r for r in rows if r]
            ax.loglog([1e3 * r["seconds"] for r in seen], [r["error_m"] for r in seen], mark + "-", label=name, ms=4)
        ax.axhline(1e-8, color="0.5", lw=0.8, ls=":")
        ax.set_title(case, fontsize=10)
        ax.set_xlabel("time for 0.2 s simulated (ms)")
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 3)))  # an axis shorter than a decade, too
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("largest error in z (m)")
    axes[0].legend(fontsize=8)
    _measure.RESULTS.mkdir(exist_ok=True)
    figure.savefig(_measure.RESULTS / "work_precision.png", dpi=130)


def main() -> None:
    results: dict[str, Any] = {}
    for case in CASES:
        reference = np.asarray(run(case, AdaptiveRodas3(1e-10)))
        agreement = float(np.abs(np.asarray(run(case, RK4(500))) - reference).max())
        print(f"\n{case}: references agree to {agreement:.1e} m")
        rows: dict[str, list[Any]] = {}
        for name, methods in METHODS.items():
            rows[name] = []
            for method in methods:
                row = measure(case, reference, method)
                rows[name].append(row and {"method": str(method), **row})
                seen = "refused: beyond the stability limit"
                if row:
                    seen = f"error {row['error_m']:.1e} m   {1e3 * row['seconds']:8.1f} ms"
                print(f"  {method!s:<62} {seen}", flush=True)
        results[case] = {"reference_agreement_m": agreement, "methods": rows}
    _measure.write("work_precision", {"cases": results})
    draw(results)


if __name__ == "__main__":
    main()
