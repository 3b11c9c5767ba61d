"""Speed gain of each workaround for XLA's CPU compiler, with the version of jax of the measurement.

Each process turns off one workaround; all run alternately with a process that keeps every workaround, so that both
meet the same load. Four jobs on one core: 1,024 members of the common workload under held noise (RK4), the gradient of
task A's loss (sliding steps, 32 lanes), and two ensembles on a processor with signs (the workload of sampled.py):
1,024 members in long blocks, and 32 members in a short one. The gain is the time without the workaround over the time
with it, a median over the rounds. A workaround whose gain is 1 under a newer jax can be removed.
Run: python benchmarks/workarounds.py [--rounds 5] [NAME ...]
"""

import argparse
import json
import math
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import jax
import jax.numpy as jnp
import numpy as np

from ambjax.compiler import barrier

MEMBERS, SAMPLES, LANES = 1024, 100, 32


def without_mark() -> None:
    """Loops are not compiled as one function."""
    from ambjax.compiler import fast_path

    fast_path._mark = lambda tree: tree
    fast_path.options = lambda: fast_path.WIDE if fast_path.has_avx512() else {}


def without_width() -> None:
    """XLA chooses the vector width."""
    from ambjax.compiler import fast_path

    fast_path.WIDE = {}


def without_level() -> None:
    """XLA compiles at its default level of optimisation."""
    from ambjax.compiler import fast_path

    fast_path.LEVEL = fast_path.SHORT


def without_apart() -> None:
    """Functions are fused with their surroundings."""
    barrier.compiled_alone = lambda function: function


def without_stored() -> None:
    """Intermediates are recomputed at each use."""
    barrier.materialised = lambda tree, beside=(): tree


def without_arctan() -> None:
    """XLA's own arctan."""
    from ambjax.numerics import smooth

    smooth.arctan_per = lambda x, per: jnp.arctan(x) / per


def without_sine() -> None:
    """XLA's own sine and cosine."""
    from ambjax.numerics import smooth

    smooth.sine = lambda x: jnp.sin(smooth.TWO_PI * x)
    smooth.cosine = lambda x: jnp.cos(smooth.TWO_PI * x)


def without_refined() -> None:
    """Float64 divisions are not approximated."""
    from ambjax.numerics import relax, smooth
    from ambjax.world import magnet

    relax.refined_reciprocal = smooth.refined_reciprocal = magnet.refined_reciprocal = lambda x: 1 / x


def without_blocks() -> None:
    """A call simulates all its members at once."""
    from ambjax.compiler import fast_path

    fast_path.block_length = lambda members: members


# Function that turns each workaround off before the modules that use it are imported.
WITHOUT: dict[str, Callable[[], None]] = {
    "none": lambda: None,
    "mark": without_mark,
    "width": without_width,
    "level": without_level,
    "apart": without_apart,
    "stored": without_stored,
    "arctan": without_arctan,
    "sine": without_sine,
    "refined": without_refined,
    "blocks": without_blocks,
}


def jobs() -> dict[str, Callable[[], Any]]:
    """Return the timed runs."""
    import gradients
    import sampled
    import workload

    digital, short = sampled.sampled(MEMBERS, SAMPLES, math.inf), sampled.sampled(LANES, 20 * SAMPLES, math.inf)
    work = workload.workload(MEMBERS, SAMPLES, noise=True)
    loss, lanes, axes, _ = gradients.tuner(LANES, SAMPLES)
    slope = gradients.programs(loss, LANES, axes)["forward"]
    return {
        "ensemble": lambda: workload.by_ambjax(work, threads=1),
        "gradient": lambda: jax.block_until_ready(slope(np.zeros(len(gradients.GAINS)), lanes)),
        "processor": lambda: workload.by_ambjax(digital, threads=1),
        "short": lambda: workload.by_ambjax(short, threads=1),
    }


def serve(name: str) -> None:
    """Time every job once for each input line and print the seconds as a line of JSON."""
    _measure.one_core()
    WITHOUT[name]()
    runs = jobs()
    for run in runs.values():
        run()
    print(json.dumps("ready"), flush=True)
    while input():
        seconds = {}
        for job, run in runs.items():
            began = time.process_time()
            run()
            seconds[job] = time.process_time() - began
        print(json.dumps(seconds), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[name for name in WITHOUT if name != "none"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--serve", choices=WITHOUT, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(given.serve)
        return
    rows = {}
    for name in given.names:
        with _measure.server(__file__, "none") as kept, _measure.server(__file__, name) as dropped:
            pairs = [(kept(), dropped()) for _ in range(given.rounds)]
        rows[name] = {"says": (WITHOUT[name].__doc__ or "").rstrip(".")}
        rows[name] |= {job: statistics.median(b[job] / a[job] for a, b in pairs) for job in pairs[0][0]}
        print(f"without {name:<11} " + ", ".join(f"{job} {rows[name][job]:.2f}" for job in pairs[0][0]), flush=True)
    _measure.write("workarounds", {"rounds": given.rounds, "rows": rows})


if __name__ == "__main__":
    main()
