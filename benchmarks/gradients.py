"""Cost of a gradient: time relative to a forward run of the same engine and step, and memory against the horizon.

Two loops, float64, one core: the tuner's loop on task A (sliding steps, held noise, the whole loss), and the common
workload without noise (smooth gains, RK4, 10 us a step, mean square of e_z). The gradient is with respect to c, k,
gamma and k_i. Forward mode carries one tangent for each gain. Reverse mode recomputes parts of the run, as the tuner
does. Memory is the peak of a separate process. Run: python benchmarks/gradients.py
"""

import argparse
import dataclasses
import functools
import json
import os
import pathlib
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import numpy as np
import workload

from ambjax import Cascade, Initial, rollout
from ambjax.compiler.fast_path import one_kernel
from ambjax.laws import current, inversion, position
from ambjax.simulation.folds import Rms
from ambjax.simulation.rollout import prepare, rolled_in_parts
from tuning.problem.config import read_tune
from tuning.problem.loss import weigh
from tuning.problem.tuning_problem import problem_of

GAINS = np.array([17.0, 25.0, workload.GAMMA, 152.0])
MEMBERS, SAMPLES = (1, 64), 1_000
TASK = pathlib.Path(__file__).parent / "tasks" / "A.toml"
# Gains that hold task A's rotor.
HELD = np.array([500.0, 100.0, 1e6, 150.0])
# Steps of the runs for the memory, ten per sample.
HORIZONS = (20_000, 200_000)


def loss_of(work: workload.Workload) -> Callable[..., Any]:
    """Return the mean square of e_z over s_0^2 as a function of (log gains, initial position, whether in parts)."""

    def loss(logs: Any, z: Any, in_parts: bool) -> Any:
        c, k, gamma, k_i = GAINS * jnp.exp(logs)
        cascade = Cascade(
            position=position.SlidingMode(c, k),
            inversion=inversion.Adaptive(gamma, workload.P_V),
            current=current.SlidingMode(k_i),
        )
        alone = dataclasses.replace(work.scenario, initial=Initial(z=z), member=0)
        if in_parts:
            done = rolled_in_parts(*prepare(cascade, alone, work.clock), Rms("e_z"))
        else:
            done = rollout(cascade, alone, work.clock, fold=Rms("e_z"), record_every=0)
        return (done.metrics / 5e-3) ** 2

    return loss


def programs(loss: Callable[..., Any], members: int, axes: Any) -> dict[str, Callable[..., Any]]:
    """Return the forward run and its derivatives over all members, compiled as in the tuner."""
    run, in_parts = (functools.partial(loss, in_parts=given) for given in (False, True))
    over = jax.vmap(run, (None, axes)) if members > 1 else run

    def forward(logs: Any, member: Any) -> Any:
        along = lambda d: jax.jvp(lambda x: over(x, member), (logs,), (d,))  # noqa: E731
        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(GAINS)))

    reverse = jax.value_and_grad(in_parts)
    return {
        "run": one_kernel(over),
        "forward": one_kernel(forward),
        "reverse": one_kernel(jax.vmap(reverse, (None, axes)) if members > 1 else reverse),
    }


def rk4(members: int, samples: int) -> tuple[Callable[..., Any], Any, Any, int]:
    """Return the loss, members, axes, and steps of one member, for the common workload."""
    work = workload.workload(members, samples)
    z = np.asarray(work.scenario.initial.z)
    return loss_of(work), z if members > 1 else float(z[0]), 0, work.steps


def tuner(members: int, samples: int) -> tuple[Callable[..., Any], Any, Any, int]:
    """Return the same for the tuner's lanes, at gains that hold the rotor."""
    case, tune, _ = read_tune(TASK)
    clock = dataclasses.replace(case.clock, samples=samples)
    case = dataclasses.replace(case, clock=clock, settle=float(clock.duration) / 5)
    objective = problem_of(case, tune).objective
    lanes, x_0 = objective.members(1, members), objective.space.encode(HELD)

    def loss(logs: Any, member: Any, in_parts: bool) -> Any:
        terms = objective.run(x_0 + logs, member, objective.loss, in_parts=in_parts)
        return weigh(tune.weights, terms, member.stressed)

    one = jax.tree.map(lambda a: a[0], lanes)
    return (
        loss,
        lanes if members > 1 else one,
        jax.tree.map(lambda _: 0, one),
        samples * workload.substeps(objective.clock),
    )


def point(mode: str, steps: int) -> dict[str, Any]:
    """Return the peak memory of this process after one call over this many steps of one member."""
    loss, member, axes, _ = rk4(1, steps // workload.SUBSTEPS)
    jax.block_until_ready(programs(loss, 1, axes)[mode](np.zeros(len(GAINS)), member))
    return {"steps": steps, "peak_bytes": _measure.peak_memory()}


def measure(name: str, build: Callable[..., Any], members: int) -> dict[str, Any]:
    """Return one row: a loop and a number of members."""
    loss, member, axes, steps = build(members, SAMPLES)
    compiled = programs(loss, members, axes)
    runs = {mode: functools.partial(f, np.zeros(len(GAINS)), member) for mode, f in compiled.items()}
    found = _measure.alternating(runs, repeats=9)
    row: dict[str, Any] = {"step": name, "members": members, "steps": steps, "run_s": found["run"].seconds}
    for mode in ("forward", "reverse"):
        row[mode] = found[mode].over(found["run"])
    slopes = [np.asarray(runs[mode]()[1]) for mode in ("forward", "reverse")]
    slopes[0] = slopes[0].T if members > 1 else slopes[0]
    row["modes_differ"] = float(np.max(np.abs(slopes[0] - slopes[1])) / np.max(np.abs(slopes[0])))
    each = 1e9 * row["run_s"] / members / steps
    print(
        f"{name}, {members} members: run {each:.0f} ns a step; gradient in forward mode {row['forward']:.2f}, "
        f"in reverse {row['reverse']:.2f} runs; they differ by {row['modes_differ']:.0e}",
        flush=True,
    )
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--point", nargs=2, help="mode and steps: measure one peak and print JSON")
    given = parser.parse_args()
    _measure.one_core()
    if given.point:
        print(json.dumps(point(given.point[0], int(given.point[1]))))
        return
    loops = {"sliding steps, the tuner's": tuner, "RK4": rk4}
    rows = [measure(name, build, n) for name, build in loops.items() for n in MEMBERS]
    memory: dict[str, Any] = {}
    for mode in ("run", "forward", "reverse"):
        memory[mode] = [_measure.child(__file__, "--point", mode, steps) for steps in HORIZONS]
        line = ", ".join(f"{r['steps']:,} steps {r['peak_bytes'] / 2**20:.0f} MiB" for r in memory[mode])
        print(f"peak memory, {mode}: {line}", flush=True)
    _measure.write("gradients", {"samples": SAMPLES, "rows": rows, "memory": memory})


if __name__ == "__main__":
    main()
