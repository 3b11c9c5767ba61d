"""Time of whole commands in new processes, with an empty and with a filled cache of programs, against `import jax`.

The commands run in turn, so that all of them meet the same load. CPU seconds (user and system) depend least on other
load; wall seconds are the waiting time on an idle machine. Run: python benchmarks/startup.py
"""

import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

import _measure

RUNS = 5
FIRST_RUNS = 3


def spent(command: list[str], cache: pathlib.Path) -> tuple[float, float]:
    """Return the wall and CPU seconds of one process; its output is discarded. `cache`: folder for the programs."""
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    before, began = os.times(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    wall, after = time.perf_counter() - began, os.times()
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
    children = after.children_user - before.children_user + after.children_system - before.children_system
    return wall, children


def commands(folder: pathlib.Path) -> dict[str, list[str]]:
    """Return the measured commands by name."""
    ambjax = [sys.executable, "-m", "ambjax"]
    found = {
        "import jax": [sys.executable, "-c", "import jax"],
        "ambjax --version": [*ambjax, "--version"],
        "ambjax-tune --version": [sys.executable, "-m", "tuning", "--version"],
    }
    for name in ("tracking", "rig"):
        case = folder / f"{name}.toml"
        case.write_text(subprocess.run([*ambjax, "template", name], capture_output=True, text=True, check=True).stdout)
        found[f"ambjax check {name}.toml"] = [*ambjax, "check", str(case)]
        out = ["--out", str(folder / name), "--force"]
        found[f"ambjax simulate {name}.toml"] = [*ambjax, "simulate", str(case), *out]
    return found | {"ambjax reproduce": [*ambjax, "reproduce", "--out", str(folder / "reproduce"), "--force"]}


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        tasks, cache = commands(folder), folder / "cache"
        firsts: dict[str, list[float]] = {name: [] for name in tasks}
        found: dict[str, list[tuple[float, float]]] = {name: [] for name in tasks}
        for _ in range(FIRST_RUNS):
            for name, command in tasks.items():
                shutil.rmtree(cache, ignore_errors=True)
                firsts[name].append(spent(command, cache)[0])
        for turn in range(RUNS + 1):
            for name, command in tasks.items():
                times = spent(command, cache)
                if turn:  # the first compiles
                    found[name].append(times)
    rows = {}
    for name, times in found.items():
        wall, cpu = (statistics.median(column) for column in zip(*times, strict=True))
        least, first = min(w for w, _ in times), statistics.median(firsts[name])
        rows[name] = {"first_wall_s": first, "wall_s": wall, "least_wall_s": least, "cpu_s": cpu}
    base = rows["import jax"]["cpu_s"]
    for name, row in rows.items():
        row["cpu_over_import_jax"] = row["cpu_s"] / base
        print(f"{name:30s} first {row['first_wall_s']:.2f} s, later {row['wall_s']:.2f} s, CPU {row['cpu_s']:.2f} s")
    _measure.write("startup", {"runs": RUNS, "first_runs": FIRST_RUNS, "rows": rows})


if __name__ == "__main__":
    main()
