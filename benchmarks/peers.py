"""One ensemble by ambjax and by other libraries, on one core: time per member and 10 us simulated, and error in z.

The workload is that of workload.py without noise. Error: the largest |z - reference| over eight members at ten
instants; reference: SciPy's DOP853 at rtol 1e-12. Fixed-step peers take RK4 steps of 10 us and are compared with the
same steps of ambjax. Adaptive peers have a relative tolerance of 1e-6. They are compared with the cheapest step of
ambjax whose error is at most 1.1 times theirs, and with the cheapest whose error is below 1e-6 of the largest z. Peers
that take seconds per member simulate fewer members. Peers that are not installed are skipped.
Run: python benchmarks/peers.py
"""

import argparse
import functools
import importlib.util
import itertools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import limit
import numpy as np
import workload
from scipy.integrate import solve_ivp
from workload import PERIOD, Workload

from ambjax.ensemble import run_ensemble
from ambjax.solvers import DOP853, RK4

MEMBERS, SAMPLES, INSTANTS, CHECKED = 1024, 500, 10, 8
TOLERANCE = 1e-6
PLAIN = "ambjax, plain scan"
# Methods, and the number of samples of the workload per sample of the method.
OURS = (
    (RK4(10), 1), (RK4(5), 1), (DOP853(1), 1), (RK4(2), 1), (DOP853(16), 25), (RK4(7), 5), (DOP853(2), 5), (RK4(1), 1),
    (DOP853(8), 25), (DOP853(7), 25),
)  # fmt: skip
# z of every member at each instant, [instants, N]
Run = Callable[[Workload], Any]


def spans(work: Workload) -> list[tuple[float, float, float]]:
    """Return the intervals between jumps of the force: begin, end, force."""
    start, stop = work.pulse
    edges = [0.0, start * PERIOD, stop * PERIOD, work.clock.samples * PERIOD]
    return [(*pair, force) for pair, force in zip(itertools.pairwise(edges), (0.0, 1.0, 0.0), strict=True)]


def instants(work: Workload) -> np.ndarray:
    """Return the sample numbers at which z is compared; the last is the end."""
    return work.clock.samples // INSTANTS * np.arange(1, INSTANTS + 1)


def by_ambjax(work: Workload) -> Any:
    every = work.clock.samples // INSTANTS
    found = run_ensemble(*work.lasting(work.clock.samples + 1), fold=None, record_every=every, threads=1)
    return found.trajectory.rows.z[:, 1:].T


def c_program(work: Workload) -> Any:
    return np.stack([limit.run(work.lasting(int(n)))[1] for n in instants(work)])


def scipy_run(work: Workload, method: str, rtol: float) -> Any:
    f = workload.right_side(workload.GAMMA, workload.P_V, math)
    times, columns = instants(work) * PERIOD, []
    for z in np.asarray(work.scenario.initial.z):
        y, column = [float(z), 0.0, 0.0, 0.0], []
        for begin, end, force in spans(work):
            at = np.append(times[(times > begin + 1e-9) & (times < end - 1e-9)], end)
            solved = solve_ivp(f, (begin, end), y, method, at, rtol=rtol, atol=rtol * 1e-3, args=(force,))
            column += [*solved.y[0, :-1], *([solved.y[0, -1]] if np.isclose(times, end).any() else [])]
            y = solved.y[:, -1]
        columns.append(column)
    return np.transpose(columns)


def numpy_run(work: Workload) -> Any:
    f = workload.right_side(workload.GAMMA, workload.P_V, np)
    zeros, outputs, h = np.zeros(work.members), [], PERIOD / workload.SUBSTEPS
    y = np.stack([work.scenario.initial.z, zeros, zeros, zeros])
    start, stop = work.pulse
    at = set(instants(work).tolist())
    for sample in range(work.clock.samples):
        force = 1.0 if start <= sample < stop else 0.0
        for step in range(workload.SUBSTEPS):
            t = sample * PERIOD + step * h
            k_1 = np.stack(f(t, y, force))
            k_2 = np.stack(f(t + h / 2, y + h / 2 * k_1, force))
            k_3 = np.stack(f(t + h / 2, y + h / 2 * k_2, force))
            k_4 = np.stack(f(t + h, y + h * k_3, force))
            y = y + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4)
        if sample + 1 in at:
            outputs.append(y[0])
    return np.stack(outputs)


@functools.cache
def numba_program() -> Any:
    """Return a plain parallel loop over members with RK4 written out by hand."""
    import numba

    f = numba.njit(workload.right_side(workload.GAMMA, workload.P_V, math))
    period, substeps = PERIOD, workload.SUBSTEPS

    @numba.njit
    def moved(y: Any, h: float, k: Any) -> Any:
        return y[0] + h * k[0], y[1] + h * k[1], y[2] + h * k[2], y[3] + h * k[3]

    @numba.njit(parallel=True)
    def run(z: Any, samples: int, start: int, stop: int, every: int) -> Any:
        out, h = np.empty((samples // every, len(z))), period / substeps
        for n in numba.prange(len(z)):
            y = (z[n], 0.0, 0.0, 0.0)
            for sample in range(samples):
                force = 1.0 if start <= sample < stop else 0.0
                for step in range(substeps):
                    t = sample * period + step * h
                    k_1 = f(t, y, force)
                    k_2 = f(t + h / 2, moved(y, h / 2, k_1), force)
                    k_3 = f(t + h / 2, moved(y, h / 2, k_2), force)
                    k_4 = f(t + h, moved(y, h, k_3), force)
                    y = moved(moved(moved(moved(y, h / 6, k_1), h / 3, k_2), h / 3, k_3), h / 6, k_4)
                if (sample + 1) % every == 0:
                    out[(sample + 1) // every - 1, n] = y[0]
        return out

    return run


def numba_run(work: Workload) -> Any:
    return numba_program()(work.scenario.initial.z, work.clock.samples, *work.pulse, work.clock.samples // INSTANTS)


@functools.cache
def diffrax_program(work_spans: tuple[tuple[float, float, float], ...], times: tuple[float, ...]) -> Any:
    """Return vmap over diffeqsolve, with steps that end on the jumps."""
    import diffrax

    f = workload.right_side(workload.GAMMA, workload.P_V, jnp)
    (_, start, _), (_, stop, _), (_, end, _) = work_spans

    def field(t: Any, y: Any, args: Any) -> Any:
        return jnp.stack(f(t, y, jnp.where((t >= start) & (t < stop), 1.0, 0.0)))

    control = diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE * 1e-3)
    control = diffrax.ClipStepSizeController(control, jump_ts=jnp.array([start, stop]))

    @jax.jit
    @jax.vmap
    def run(z: Any) -> Any:
        y, save = jnp.zeros(4).at[0].set(z), diffrax.SaveAt(ts=jnp.asarray(times))
        term, solver = diffrax.ODETerm(field), diffrax.Tsit5()
        found = diffrax.diffeqsolve(term, solver, 0.0, end, 1e-6, y, saveat=save, stepsize_controller=control)
        assert found.ys is not None
        return found.ys[:, 0]

    return run


def diffrax_run(work: Workload) -> Any:
    times = tuple((instants(work) * PERIOD).tolist())
    return jnp.transpose(diffrax_program(tuple(spans(work)), times)(jnp.asarray(work.scenario.initial.z)))


def per_member(work: Workload) -> float:
    """Return the factor from seconds of a run to nanoseconds per member and 10 us simulated."""
    return 1e9 / work.members / (work.clock.samples * float(work.clock.sample_period) / 1e-5)


def serve() -> None:
    """Run the ensemble once for each line on standard input; answer with z of a few members at the instants."""
    work = workload.workload(MEMBERS, SAMPLES)
    z = json.dumps(by_ambjax(work.few(CHECKED)).tolist())
    for _ in sys.stdin:
        workload.by_ambjax(work)
        print(z, flush=True)


class Plain:
    """ambjax without the compiled fast path, in a process of its own because the choice holds for a whole process."""

    def __init__(self) -> None:
        command, environment = [sys.executable, __file__, "--serve"], os.environ | {"AMBJAX_PLAIN": "1"}
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, text=True)

    def __call__(self, work: Workload) -> Any:
        assert self.process.stdin
        assert self.process.stdout
        print(file=self.process.stdin, flush=True)
        return np.array(json.loads(self.process.stdout.readline()))


def peers() -> dict[str, tuple[Run, int, Run]]:
    """Return for each peer the function of z at the instants, the number of members, and the timed function."""
    fallback = Plain()
    found: dict[str, tuple[Run, int, Run]] = {PLAIN: (fallback, MEMBERS, fallback)}
    if why := limit.missing():
        print(f"{why}: skipped")
    else:
        found["C, SIMD (the limit)"] = (c_program, MEMBERS, limit.run)
    for package, name, run, members in (
        ("numba", "Numba prange, RK4", numba_run, MEMBERS),
        ("diffrax", "diffrax Tsit5, PID 1e-6, vmap", diffrax_run, MEMBERS),
    ):
        if importlib.util.find_spec(package) is None:
            print(f"{package} is not installed: skipped (pip install -e '.[bench]')")
        else:
            found[name] = (run, members, run)
    found["NumPy, vectorised RK4"] = (numpy_run, MEMBERS, numpy_run)
    for method in ("LSODA", "RK45"):
        run = functools.partial(scipy_run, method=method, rtol=TOLERANCE)
        found[f"SciPy {method}, rtol 1e-6"] = (run, CHECKED, run)
    return found


def ours_named(method: Any, samples: int) -> str:
    return f"ambjax, {type(method).__name__} at {1e6 * PERIOD * samples / method.substeps:.3g} us"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serve", action="store_true", help="run our engine for each line on standard input")
    asked = parser.parse_args()
    _measure.one_core()
    if asked.serve:
        serve()
        return
    work = workload.workload(MEMBERS, SAMPLES)
    few = work.few(CHECKED)
    reference = scipy_run(few, "DOP853", 1e-12)

    def error(run: Run, work: Workload) -> float:
        return float(np.abs(np.asarray(run(work)) - reference).max())

    rows, runs, scales = {}, {}, {}
    for each in OURS:
        name = ours_named(*each)
        runs[name] = functools.partial(workload.by_ambjax, work.stepping(*each))
        scales[name] = per_member(work)
        rows[name] = {"members": MEMBERS, "error_m": error(by_ambjax, few.stepping(*each))}
    for name, (run, members, clocked) in peers().items():
        given = work if members == work.members else work.few(members)
        runs[name], scales[name] = functools.partial(clocked, given), per_member(given)
        rows[name] = {"members": members, "error_m": error(run, few)}
    found = _measure.alternating(runs, repeats=7)
    for name, row in rows.items():
        row |= {"ns": found[name].seconds * scales[name], "compile_s": found[name].compile_s}

    def ratio(a: str, b: str) -> float:
        return found[a].over(found[b]) * scales[a] / scales[b]

    compare(rows, float(np.abs(reference).max()), ratio)
    report(rows)
    _measure.write("peers", {"samples": SAMPLES, "largest_z_m": float(np.abs(reference).max()), "rows": rows})


def compare(rows: dict[str, dict[str, Any]], largest: float, ratio: Callable[[str, str], float]) -> None:
    """Add the speed ratio to each row: at the same step, or, for an adaptive peer, at a similar error and at 1e-6."""
    steps = [ours_named(*each) for each in OURS]

    def fastest(error: float) -> str:
        return min((step for step in steps if rows[step]["error_m"] <= error), key=lambda step: rows[step]["ns"])

    for name, row in rows.items():
        row["against"] = steps[0]
        if "1e-6" in name:
            row["against"] = fastest(1.1 * max(row["error_m"], 1e-12))
            row["ratio_at_1e-6"] = ratio(name, fastest(1e-6 * largest))
        row["ratio"] = ratio(name, row["against"])


def report(rows: dict[str, dict[str, Any]]) -> None:
    print(f"{'':<31} {'members':>7} {'ns':>9} {'error (m)':>10} {'ambjax is':>11} {'at 1e-6':>9} {'compile (s)':>11}")
    for name, row in rows.items():
        wanted = f"{row['ratio_at_1e-6']:7.1f} x" if "ratio_at_1e-6" in row else ""
        found = f"{row['members']:7} {row['ns']:9.1f} {row['error_m']:10.1e} {row['ratio']:9.2f} x {wanted:>9}"
        print(f"{name:<31} {found} {row['compile_s']:11.2f}")


if __name__ == "__main__":
    main()
