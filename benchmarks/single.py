"""One closed-loop run of 2 s, against SciPy's LSODA and Radau and diffrax, at equal accuracy.

The workload is the paper's tracking scenario without noise, with smooth gains (gamma = 1e9, p = 25e-6) and repaired
gains (gamma = 7.5e4, p = 25). Output is every 10 ms, and every peer splits the integration at the edges of the pulse.
Each solver is timed at its cheapest tolerance with a largest error in z of at most 1e-8 m against a reference (LSODA,
rtol 1e-12). Times are medians of 9 rounds, without compilation. Run: python benchmarks/single.py
"""

import dataclasses
import importlib.util
import itertools
import math
import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import numpy as np
import workload
from scipy.integrate import solve_ivp

from ambjax import Cascade, Clock, paper, rollout
from ambjax.laws import inversion
from ambjax.plants import Plant
from ambjax.solvers import AdaptiveRodas3

TARGET = 1e-8
PERIOD, SAMPLES = 1e-2, 200
TIMES = PERIOD * np.arange(SAMPLES)
EDGES = (0.0, 0.8, 1.3, TIMES[-1])
GAINS = {"smooth": (1e9, 25e-6), "repaired": (paper.REPAIRED_GAMMA, 25.0)}
TOLERANCES = tuple(share * 10.0**-digit for digit in range(4, 11) for share in (1.0, 0.5, 0.2))


def scipy_run(gains: tuple[float, float], method: str, rtol: float) -> np.ndarray:
    f, y, parts = workload.right_side(*gains, math), [0.0] * 4, []
    for begin, end in itertools.pairwise(EDGES):
        q = 1.0 if begin == 0.8 else 0.0
        inside = TIMES[(begin - 1e-12 <= TIMES) & (end - 1e-12 > TIMES)]
        at = np.append(np.clip(inside, begin, end), end)
        solved = solve_ivp(f, (begin, end), y, method, at, rtol=rtol, atol=rtol * 1e-3, args=(q,))
        parts.append(solved.y[0, :-1])
        y = solved.y[:, -1]
    return np.append(np.concatenate(parts), y[0])


def ours_run(gains: tuple[float, float], tolerance: float) -> Callable[[], Any]:
    cascade = dataclasses.replace(paper.cascade("repaired"), inversion=inversion.Adaptive(*gains))
    scenario = paper.scenario("tracking", "repaired")
    clock = Clock(SAMPLES, PERIOD, AdaptiveRodas3(tolerance))
    return lambda: rollout(cascade, scenario, clock).trajectory.rows.z


def diffrax_run(gains: tuple[float, float], solver: Any, rtol: float) -> Callable[[], Any]:
    import diffrax

    f = workload.right_side(*gains, jnp)

    def field(t: Any, y: Any, args: Any) -> Any:
        return jnp.stack(f(t, y, jnp.where((t >= 0.8) & (t < 1.3), 1.0, 0.0)))

    control = diffrax.PIDController(rtol=rtol, atol=rtol * 1e-3)
    control = diffrax.ClipStepSizeController(control, jump_ts=jnp.array([0.8, 1.3]))

    @jax.jit
    def run(y0: Any) -> Any:
        save = diffrax.SaveAt(ts=jnp.asarray(TIMES))
        term = diffrax.ODETerm(field)
        out = diffrax.diffeqsolve(
            term,
            solver,
            0.0,
            TIMES[-1],
            1e-6,
            y0,
            saveat=save,
            stepsize_controller=control,
            max_steps=20_000,
            throw=False,
        )
        assert out.ys is not None
        return out.ys[:, 0]

    return lambda: run(jnp.zeros(4))


def best(make: Callable[[float], Callable[[], Any]], reference: np.ndarray) -> tuple[Any, dict[str, Any]] | None:
    """Return the run at the cheapest tolerance that reaches the target, its error, and its compile time."""
    compile_s = 0.0
    for rtol in TOLERANCES:
        run = make(rtol)
        began = time.perf_counter()
        z = np.asarray(jax.block_until_ready(run()))
        first = time.perf_counter() - began
        error = float(np.abs(z - reference).max())
        if rtol == TOLERANCES[0]:  # later tolerances may find the program compiled
            jax.block_until_ready(run())
            compile_s = first - _measure.median_time(run, repeats=1)
        if error <= TARGET:
            return run, {"rtol": rtol, "error_m": error, "compile_s": max(compile_s, 0.0)}
    return None


def peers(gains: tuple[float, float]) -> dict[str, Callable[[float], Callable[[], Any]]]:
    made: dict[str, Callable[[float], Callable[[], Any]]] = {
        "ambjax": lambda tol: ours_run(gains, tol),
        "SciPy LSODA": lambda tol: lambda: scipy_run(gains, "LSODA", tol),
        "SciPy Radau": lambda tol: lambda: scipy_run(gains, "Radau", tol),
    }
    if importlib.util.find_spec("diffrax") is None:
        print("diffrax is not installed: skipped (pip install -e '.[bench]')")
        return made
    import diffrax

    made["diffrax Tsit5"] = lambda tol: diffrax_run(gains, diffrax.Tsit5(), tol)
    made["diffrax Kvaerno3"] = lambda tol: diffrax_run(gains, diffrax.Kvaerno3(), tol)
    made["diffrax Kvaerno5"] = lambda tol: diffrax_run(gains, diffrax.Kvaerno5(), tol)
    return made


def main() -> None:
    assert Cascade().model == Plant()
    results: dict[str, Any] = {"target_error_m": TARGET}
    for name, gains in GAINS.items():
        reference = scipy_run(gains, "LSODA", 1e-12)
        rows: dict[str, dict[str, Any] | None] = {}
        runs = {}
        for peer, make in peers(gains).items():
            if name == "repaired" and peer == "diffrax Tsit5":
                continue  # explicit: hundreds of thousands of steps on a loop this stiff
            rows[peer] = None
            if found := best(make, reference):
                runs[peer], rows[peer] = found
        timed = _measure.alternating(runs, repeats=9)
        check = np.asarray(ours_run(gains, 1e-10)())
        print(f"\n{name} gains; two references agree to {np.abs(check - reference).max():.1e} m")
        print(
            f"{'solver':<18} {'tolerance':>9} {'error (m)':>10} {'run (ms)':>9} {'ambjax is':>11} {'compile (s)':>11}"
        )
        for peer, row in rows.items():
            if row is None:
                print(f"{peer:<18} does not reach {TARGET:g} m at any tolerance tried")
                continue
            row |= {"seconds": timed[peer].seconds, "ratio": timed[peer].over(timed["ambjax"])}
            print(
                f"{peer:<18} {row['rtol']:9.0e} {row['error_m']:10.1e} {1e3 * row['seconds']:9.2f} "
                f"{row['ratio']:8.1f} x  {row['compile_s']:11.2f}"
            )
        results[name] = rows
    _measure.write("single", results)


if __name__ == "__main__":
    main()
