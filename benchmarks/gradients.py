"""What a gradient costs: time over one forward run of the same engine and step, and memory against the horizon.

The common workload without noise (smooth gains, RK4, 10 us a step), float64, one core. The loss is the mean
square of e_z, differentiated in c, k, gamma and k_i. Forward mode carries one tangent for each; reverse
mode recomputes each sample from its start. Memory is the peak of a process of its own.
Run: python benchmarks/gradients.py
"""

import argparse
import dataclasses
import json
import os
import resource
import sys
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import numpy as np
import workload

from ambjax import Cascade, Initial, current, inversion, position, rollout
from ambjax._kernel import one_kernel
from ambjax.metrics import Rms

GAINS = np.array([17.0, 25.0, workload.GAMMA, 152.0])
MEMBERS, SAMPLES = (1, 64), 2_000
# Steps of the runs whose memory is compared: ten to a sample.
HORIZONS = (20_000, 200_000)


def loss_of(work: workload.Workload) -> Callable[..., Any]:
    """(log gains, where the rotor starts) to the mean square of e_z over s_0^2."""

    def loss(logs: Any, z: Any) -> Any:
        c, k, gamma, k_i = GAINS * jnp.exp(logs)
        cascade = Cascade(
            position=position.SlidingMode(c, k),
            inversion=inversion.Adaptive(gamma, workload.P_V),
            current=current.SlidingMode(k_i),
        )
        alone = dataclasses.replace(work.scenario, initial=Initial(z=z), member=0)
        return (rollout(cascade, alone, work.clock, fold=Rms("e_z"), every=0).measured / 5e-3) ** 2

    return loss


def programs(work: workload.Workload) -> dict[str, Callable[..., Any]]:
    """The forward run and its derivatives over all members, compiled as the tuner compiles them."""
    loss, members = loss_of(work), work.members

    def forward(logs: Any, z: Any) -> Any:
        along = lambda d: jax.jvp(lambda x: loss(x, z), (logs,), (d,))  # noqa: E731
        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(GAINS)))

    def over(f: Callable[..., Any]) -> Callable[..., Any]:
        return jax.vmap(f, (None, 0)) if members > 1 else f

    return {
        "run": one_kernel(over(loss)),
        "forward": one_kernel(over(forward)),
        "reverse": jax.jit(over(jax.value_and_grad(loss))),
    }


def arguments(work: workload.Workload) -> tuple[Any, Any]:
    z = np.asarray(work.scenario.initial.z)
    return np.zeros(len(GAINS)), z if work.members > 1 else float(z[0])


def point(mode: str, steps: int) -> dict[str, Any]:
    """Peak memory of this process after one call over this many steps of one member."""
    work = workload.workload(1, steps // workload.SUBSTEPS)
    jax.block_until_ready(programs(work)[mode](*arguments(work)))
    unit = 1 if sys.platform == "darwin" else 1024
    return {"steps": steps, "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--point", nargs=2, help="mode and steps: measure one peak and print JSON")
    given = parser.parse_args()
    _measure.one_core()
    if given.point:
        print(json.dumps(point(given.point[0], int(given.point[1]))))
        return
    rows = []
    for n in MEMBERS:
        work = workload.workload(n, SAMPLES)
        given_to = arguments(work)
        runs = {name: (lambda f=f, to=given_to: f(*to)) for name, f in programs(work).items()}
        slopes = [np.asarray(runs[mode]()[1]) for mode in ("forward", "reverse")]
        agree = float(np.max(np.abs(slopes[0] - slopes[1])) / np.max(np.abs(slopes[0])))
        found = _measure.alternating(runs)
        row = {"members": n, "modes_differ": agree, **{f"{k}_s": v["seconds"] for k, v in found.items()}}
        row |= {mode: found[mode]["seconds"] / found["run"]["seconds"] for mode in ("forward", "reverse")}
        rows.append(row)
        print(
            f"{n:>3} members: run {1e9 * row['run_s'] / n / work.steps:.1f} ns a step; gradient of {len(GAINS)} gains: "
            f"forward {row['forward']:.2f}, reverse {row['reverse']:.2f} runs; they differ by {agree:.1e}",
            flush=True,
        )
    memory: dict[str, Any] = {}
    for mode in ("run", "forward", "reverse"):
        memory[mode] = [_measure.child(__file__, "--point", mode, steps) for steps in HORIZONS]
        told = ", ".join(f"{r['steps']:,} steps {r['peak_bytes'] / 2**20:.0f} MiB" for r in memory[mode])
        print(f"peak memory, {mode}: {told}", flush=True)
    _measure.write("gradients", {"samples": SAMPLES, "rows": rows, "memory": memory})


if __name__ == "__main__":
    main()
