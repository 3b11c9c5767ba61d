"""The machine's limit: limit.c, built with the system's compiler and called on a workload.

`missing()` returns the reason if there is no C program. `agreement` compares the program with `rollout`. Without noise
they agree to 1e-9 relative in float64. With noise they use different random generators, so it compares the standard
deviation of the rotor's motion. Run: python benchmarks/limit.py
"""

import concurrent.futures
import ctypes
import dataclasses
import functools
import os
import pathlib
import shutil
import subprocess
import tempfile
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import numpy as np
import workload
from workload import Workload, substeps

from ambjax import Clock, rollout
from ambjax.compiler.fast_path import has_avx512

SOURCE = pathlib.Path(__file__).with_name("limit.c")
FLAGS = "-O3 -march=native -mprefer-vector-width=512 -fschedule-insns -fsched-pressure -std=gnu11 -fPIC -shared"
# both programs use the same instructions, also where XLA_FLAGS select older ones than the processor has
FLAGS += "" if has_avx512() else " -mno-avx512f"
# approximate reciprocals with one Newton step make float a fifth faster; double does not use them
PRECISION = {"float64": "-fno-math-errno", "float32": "-DREAL=float -DSINGLE -ffast-math"}
PLANT = "m k_z s_0 i_0 R g kappa a"
DOUBLES = f"""{PLANT} touchdown c k p_sigma gamma p_v k_i p_e amplitude frequency force
    std_z std_z_dot std_i sample_period"""
WHOLES = "substeps samples pulse_start pulse_stop seed first_member"


class Problem(ctypes.Structure):
    """struct problem of limit.c."""

    _fields_ = [
        *((name, ctypes.c_double) for name in DOUBLES.split()),
        *((name, ctypes.c_int64) for name in WHOLES.split()),
    ]


@functools.cache
def missing() -> str:
    """Return the reason why there is no C program; empty if there is one."""
    try:
        for dtype in PRECISION:
            library(dtype)
    except (OSError, subprocess.SubprocessError) as error:
        return f"no C program: {error}"
    return ""


@functools.cache
def library(dtype: str, source: pathlib.Path = SOURCE) -> Any:
    """Return the compiled program."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise OSError("there is no gcc or cc on the PATH")
    with tempfile.TemporaryDirectory() as folder:
        path = str(pathlib.Path(folder, source.stem).with_suffix(".so"))
        command = [compiler, *FLAGS.split(), *PRECISION[dtype].split(), str(source), "-o", path, "-lm"]
        subprocess.run(command, check=True, capture_output=True, text=True)
        return ctypes.CDLL(path)


def numbers(work: Workload) -> dict[str, Any]:
    """Return the numbers of the workload in the order of struct problem."""
    scenario, clock = work.scenario, work.clock
    plant, sensor = scenario.plant, scenario.sensor
    _, position, inversion, current = (vars(law) for law in work.cascade.laws)
    reference, force = vars(scenario.reference), vars(scenario.q_v)
    found: dict[str, Any] = {name: getattr(plant, name) for name in ["m", "k_z", "s_0", "i_0", "R", "g", "kappa", "a"]}
    found |= {"touchdown": scenario.touchdown, "force": force["amplitude"], "sample_period": clock.sample_period}
    found |= {name: reference[name] for name in ("amplitude", "frequency")}
    found |= {"c": position["c"], "k": position["k"], "gamma": inversion["gamma"], "k_i": current["k_i"]}
    found |= {"p_sigma": position["p"], "p_v": inversion["p"], "p_e": current["p"]}
    if sensor is not None:
        found |= {"std_z": sensor.std, "std_z_dot": sensor.std_z_dot, "std_i": sensor.std_i}
    start, stop = work.pulse
    return found | {
        "substeps": substeps(clock),
        "samples": clock.samples,
        "pulse_start": start,
        "pulse_stop": stop,
    }


def run(work: Workload, dtype: str = "float64", threads: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest |z - r| of each member and its final z, m. Threads share the members evenly."""
    program, z = library(dtype), np.asarray(work.scenario.initial.z).astype(dtype)
    peak = np.zeros_like(z)

    def part(begin: int, end: int) -> None:
        problem = Problem(**numbers(work))
        problem.first_member = begin
        pointers = [ctypes.c_void_p(x[begin:end].ctypes.data) for x in (z, peak)]
        if program.run(ctypes.byref(problem), ctypes.c_long(end - begin), *pointers):
            raise ValueError("limit.c: too many substeps")

    if threads == 1:
        part(0, len(z))
        return peak, z
    edges = [len(z) * n // threads for n in range(threads + 1)]
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        list(pool.map(part, edges[:-1], edges[1:]))
    return peak, z


def by_ambjax(work: Workload) -> tuple[np.ndarray, np.ndarray]:
    """Return the same from jit(vmap(rollout)); the row of one additional sample contains the final z."""
    clock = Clock(work.clock.samples + 1, work.clock.sample_period, work.clock.method)

    @jax.jit
    @jax.vmap
    def one(z: Any, member: Any) -> Any:
        initial = dataclasses.replace(work.scenario.initial, z=z)
        alone = dataclasses.replace(work.scenario, initial=initial, member=member)
        rows = rollout(work.cascade, alone, clock).trajectory.rows
        return jnp.abs(rows.e_z[:-1]).max(), rows.z[-1]

    peak, z = one(work.scenario.initial.z, work.scenario.member)
    return np.asarray(peak), np.asarray(z)


def agreement() -> dict[str, float]:
    """Return the agreement of the C program with `rollout`; raise AssertionError beyond the stated tolerances."""
    odd, quiet, noisy = workload.workload(37, 300), workload.workload(256, 60), workload.workload(256, 60, noise=True)
    expected, moved = by_ambjax(odd), np.std(by_ambjax(noisy)[1] - by_ambjax(quiet)[1])
    found = {}
    # float32: each of 6000 steps is rounded to 6e-8 of the largest state, and z is a hundredth of that state
    for dtype, allowed in (("float64", 1e-9), ("float32", 1e-3)):
        error = max(np.abs(a / b - 1).max() for a, b in zip(run(odd, dtype), expected, strict=True))
        assert error <= allowed, f"limit.c in {dtype} is off by {error:.1e}"
        ratio = np.std(run(noisy, dtype)[1] - run(quiet, dtype)[1]) / moved
        # The relative error of a standard deviation of 256 values is 1/sqrt(512) = 4.4 %, and that of a ratio of two
        # is 6.3 %. The tolerance is four times as large.
        assert abs(ratio - 1) <= 0.25, (
            f"limit.c in {dtype}: its noise moves the rotor {ratio:.2f} times as far as that of ambjax"
        )
        found |= {f"{dtype}_error": float(error), f"{dtype}_noise_ratio": float(ratio)}
    return found


def main() -> None:
    if why := missing():
        print(why)
        return
    print("agreement with rollout:", {name: f"{value:.2g}" for name, value in agreement().items()})
    for noise in (False, True):
        work = workload.workload(1024, 100, noise=noise)
        for dtype in PRECISION:
            for threads in (1, 2):
                seconds = _measure.median_time(functools.partial(run, work, dtype, threads))
                each = 1e9 * seconds / work.members / work.steps
                named = f"{dtype}, {threads} threads, {'held' if noise else 'no'} noise"
                print(f"{named}: {each:.2f} ns a member-step")


if __name__ == "__main__":
    main()
