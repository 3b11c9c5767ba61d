"""An ensemble whose cascade runs on a processor, compared with the machine's limit.

The workload is that of workload.py at 10 kHz with held noise, on a processor with one sample of delay, prediction,
implicit steps and a supply of 200 V. It runs with set-valued signs (p = inf) and with smoothed signs (p = 25).
`agreement` compares sampled.c with `rollout` under the same sensor errors. The script also measures the cost of a
gradient with respect to c, k, gamma and k_i. One core, float64; processor seconds, measured alternately.
Run: python benchmarks/sampled.py
"""

import ctypes
import dataclasses
import functools
import math
import os
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import gradients
import jax
import jax.numpy as jnp
import limit
import numpy as np
import workload
from workload import Workload

from ambjax import Cascade, Clock, Initial, rollout
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble
from ambjax.laws import current, inversion, position
from ambjax.simulation.folds import Rms
from ambjax.simulation.method import with_method
from ambjax.simulation.metrics import Metrics

# c, k, gamma, k_i: they hold the rotor with either sign.
GAINS = np.array([200.0, 25.0, 2e6, 2000.0])
SIGNS = {"inf": math.inf, "25": 25.0}
U_MAX = 200.0
MEMBERS, SAMPLES, REPEATS = 1024, 2000, 15
TANGENTS_OF = 64
SOURCE = limit.SOURCE.with_name("sampled.c")


class Problem(ctypes.Structure):
    """struct problem of sampled.c."""

    _fields_ = [
        *((name, ctypes.c_double) for name in (*limit.DOUBLES.split(), "u_max")),
        *((name, ctypes.c_int64) for name in limit.WHOLES.split()),
    ]


def cascade(gains: Any, p: float) -> Cascade:
    """Return the paper's cascade on a processor."""
    c, k, gamma, k_i = gains
    return Cascade(
        position=position.SlidingMode(c, k, p),
        inversion=inversion.Adaptive(gamma, p),
        current=current.SlidingMode(k_i, p),
        processor=Processor(),
    )


def sampled(members: int, samples: int, p: float) -> Workload:
    """Return the common workload with that cascade and the default number of substeps of `rollout`."""
    work = workload.workload(members, samples, noise=True)
    scenario, loop = dataclasses.replace(work.scenario, u_max=U_MAX), cascade(GAINS.tolist(), p)
    return Workload(loop, scenario, with_method(Clock(samples, workload.PERIOD), loop, scenario))


def run(work: Workload, errors: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest |z - r| of each member over all substeps and its final z, m, by sampled.c.

    `errors`: sensor errors [samples, 3, members]; None: the C program draws them.
    """
    z = np.asarray(work.scenario.initial.z).astype(float)
    peak, problem = np.zeros_like(z), Problem(**limit.numbers(work), u_max=U_MAX)
    pointers = [None if x is None else ctypes.c_void_p(x.ctypes.data) for x in (z, peak, errors)]
    program = limit.library("float64", SOURCE)
    if program.run(ctypes.byref(problem), ctypes.c_long(len(z)), *pointers):
        raise ValueError("sampled.c: too many substeps")
    return peak, z


def errors_of(work: Workload) -> np.ndarray:
    """Return the sensor errors of `rollout`, [samples, 3, members]."""
    sensor: Any = work.scenario.sensor

    def words(member: Any) -> Any:
        return dataclasses.replace(work.scenario, initial=Initial(), member=member).words()

    keys = jax.vmap(words)(jnp.arange(work.members))
    member = jax.vmap(lambda key, n: jnp.stack(sensor.noise(key, n)), (0, None), 1)
    return np.ascontiguousarray(jax.vmap(member, (None, 0))(keys, jnp.arange(work.clock.samples)))


def agreement(p: float) -> float:
    """Return the relative error of sampled.c in the largest |z - r| of 37 members; AssertionError beyond 1e-10."""
    work = sampled(37, 500, p)
    error = float(np.max(np.abs(run(work, errors_of(work))[0] / workload.by_ambjax(work) - 1)))
    assert error <= 1e-10, f"sampled.c is off by {error:.1e}"
    return error


def gradient(p: float) -> float:
    """Return the cost of a gradient of the mean square of e_z, in forward runs."""
    work = sampled(TANGENTS_OF, SAMPLES // 2, p)

    def loss(logs: Any, lanes: Any, in_parts: bool) -> Any:
        assert not in_parts  # only the forward mode is measured
        z, member = lanes
        alone = dataclasses.replace(work.scenario, initial=Initial(z=z), member=member)
        return (
            rollout(cascade(GAINS * jnp.exp(logs), p), alone, work.clock, fold=Rms("e_z"), record_every=0).metrics
        ) ** 2

    lanes = np.asarray(work.scenario.initial.z), np.asarray(work.scenario.member)
    compiled = gradients.programs(loss, TANGENTS_OF, (0, 0))
    runs = {mode: functools.partial(compiled[mode], np.zeros(len(GAINS)), lanes) for mode in ("run", "forward")}
    found = _measure.alternating(runs, REPEATS, clock=_measure.own_seconds)
    return found["forward"].over(found["run"])


def measure(name: str) -> dict[str, Any]:
    """Return one row: one kind of sign."""
    p = SIGNS[name]
    work = sampled(MEMBERS, SAMPLES, p)
    row: dict[str, Any] = {"p": name, "members": MEMBERS, "samples": SAMPLES, "substeps": workload.substeps(work.clock)}
    every = Metrics.of(0.05, work.scenario)
    runs = {
        "ambjax": functools.partial(workload.by_ambjax, work),
        "all_metrics": lambda: run_ensemble(*work, fold=every, threads=1),
        "C": functools.partial(run, work),
    }
    if limit.missing():
        del runs["C"]
    found = _measure.alternating(runs, REPEATS, clock=_measure.own_seconds)
    row |= {name: 1e9 * each.seconds / MEMBERS / SAMPLES for name, each in found.items()}
    if "C" in found:
        row |= {"ratio": found["ambjax"].over(found["C"]), "error": agreement(p)}
    row["gradient"] = gradient(p)
    line = f"p = {name}: {row['ambjax']:.1f} ns a sample, with all metrics {row['all_metrics']:.1f}"
    if "C" in row:
        line += f"; C {row['C']:.1f}, ratio {row['ratio']:.2f}, agreement {row['error']:.0e}"
    print(f"{line}; gradient {row['gradient']:.2f} runs", flush=True)
    return row


def main() -> None:
    _measure.one_core()
    if why := limit.missing():
        print(f"{why}: the limit is skipped")
    _measure.write("sampled", {"tangents_of": TANGENTS_OF, "rows": [measure(name) for name in SIGNS]})


if __name__ == "__main__":
    main()
