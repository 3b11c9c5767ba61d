"""The tuning tasks on a processor, as in tasks.py in continuous time, each with the error that it must reach.

A bar is the error that CMA-ES reached for the same loop on an independent simulator. A task without a bar, such as that
of the ledger's reading `sampled`, must lose no rotor. If the same task exists in tasks.py in continuous time, it is run
too, and the table gives its processor seconds.
Run: python benchmarks/sampled_tasks.py [--out DIR] [TASK ...]
"""

import argparse
import math
import pathlib

import _measure
import tasks

SAMPLED = tasks.TASKS / "sampled"
# Settled rms error, m. "-signs": with set-valued signs.
BARS = {
    "A10": 9e-7,
    "A10-signs": 1.1e-6,
    "A10L": 2.5e-6,
    "C10": 1.25e-6,
    "C10-signs": 1.3e-6,
    "F10": 7.8e-7,
    "F10-signs": 9.5e-7,
    "F20": 5e-7,
    "F20-signs": 5.3e-7,
    "G20": 1.3e-6,
}
COUNTERPARTS = {"A10": "A", "C10": "C"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=tasks.names(SAMPLED))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "tasks"))
    given = parser.parse_args()
    rows = tasks.kept("sampled_tasks")
    for name in given.tasks:
        row = tasks.tuned(SAMPLED / f"{name}.toml", given.out / name)
        bar = BARS.get(name, math.inf)
        rows[name] = row | {"bar_m": bar if math.isfinite(bar) else None}
        reached = row["settled_rms_error_m"] <= bar and row["lost"] == 0
        print(f"{tasks.row_text(row)}; {'reaches' if reached else 'misses'} {bar:.3g} m", flush=True)
        if other := COUNTERPARTS.get(name):
            continuous = tasks.tuned(tasks.TASKS / f"{other}.toml", given.out / other)
            rows[name]["continuous"] = {key: continuous[key] for key in ("seconds", "processor_s", "rollouts")}
    _measure.write("sampled_tasks", {"tasks": dict(sorted(rows.items()))})


if __name__ == "__main__":
    main()
