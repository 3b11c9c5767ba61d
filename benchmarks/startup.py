"""Time of whole commands: new processes of `ambjax` with a warm compilation cache, against `import jax` alone.

The commands run in turn, so that all of them meet the same load. CPU seconds (user and system) depend least on other
load; wall seconds are the waiting time on an idle machine. Run: python benchmarks/startup.py
"""

import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

import _measure

RUNS = 5


def spent(command: list[str]) -> tuple[float, float]:
    """Return the wall and CPU seconds of one process; its output is discarded."""
    before, began = os.times(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - began, os.times()
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
    children = after.children_user - before.children_user + after.children_system - before.children_system
    return wall, children


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        ambjax = [sys.executable, "-m", "ambjax"]
        case = pathlib.Path(folder) / "tracking.toml"
        case.write_text(subprocess.run([*ambjax, "template"], capture_output=True, text=True, check=True).stdout)
        commands = {
            "import jax": [sys.executable, "-c", "import jax"],
            "ambjax --version": [*ambjax, "--version"],
            "ambjax-tune --version": [sys.executable, "-m", "tuning", "--version"],
            "ambjax check": [*ambjax, "check", str(case)],
            "ambjax simulate": [*ambjax, "simulate", str(case), "--out", folder, "--force"],
        }
        found: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
        for turn in range(RUNS + 1):
            for name, command in commands.items():
                times = spent(command)
                if turn:  # the first compiles
                    found[name].append(times)
    rows = {}
    for name, times in found.items():
        wall, cpu = (statistics.median(column) for column in zip(*times, strict=True))
        rows[name] = {"wall_s": wall, "cpu_s": cpu, "least_wall_s": min(w for w, _ in times)}
    base = rows["import jax"]["cpu_s"]
    for name, row in rows.items():
        row["cpu_over_import_jax"] = row["cpu_s"] / base
        print(f"{name:24s} wall {row['wall_s']:.2f} s (least {row['least_wall_s']:.2f}), CPU {row['cpu_s']:.2f} s")
    _measure.write("startup", {"runs": RUNS, "rows": rows})


if __name__ == "__main__":
    main()
