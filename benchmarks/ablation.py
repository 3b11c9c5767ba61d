"""What each mechanism of the tuner contributes: each is switched off alone, and the tuner runs by its defaults.

Every run minimises the error (objective = "least_error") within the limits of its task, on one core, in a process of
its own. The figures are those of the held-out members. Results that exist are not computed again.
Run: python benchmarks/ablation.py [--tasks TASK ...] [--off MECHANISM ...] [--seeds SEED ...] [--out DIR]
"""

import argparse
import json
import math
import pathlib
import subprocess
import sys
import tomllib
from collections.abc import Callable
from typing import Any

import _measure
import default_gains
import fleet
import numpy as np
import tasks
import tomlkit

from ambjax.cases.template_text import template
from tuning import validate
from tuning.__main__ import main as tune
from tuning.problem import limits
from tuning.solve import course, descent, evolution, multipliers, refine

NEVER = 10**9
FIRST_KINDS = {
    "blower-pid": ("pid", "linearised", "pi"),
    "blower-cascade": ("sliding-mode", "adaptive", "sliding-mode"),
}


def setting(**values: Any) -> Callable[[dict[str, Any]], None]:
    """Return the mechanism's switch: these keys of [tune]."""
    return lambda raw: raw["tune"].update(values)


def constant(module: Any, **values: Any) -> Callable[[dict[str, Any]], None]:
    """Return the mechanism's switch: these values of names of the module."""

    def switch(raw: dict[str, Any]) -> None:
        for name, value in values.items():
            setattr(module, name, value)

    return switch


def by_values(raw: dict[str, Any]) -> None:
    """Refine each start with CMA-ES from its first point on."""
    constant(refine, _slopes=lambda starts: np.full(len(starts.value), math.inf))(raw)


def patient(raw: dict[str, Any]) -> None:
    """Judge progress over six iterations instead of five."""
    for module in (refine, evolution):
        constant(module, PATIENCE=6)(raw)


# What is switched off, and how.
MECHANISMS: dict[str, Callable[[dict[str, Any]], None]] = {
    "nothing": lambda raw: None,
    "screen: the first points are refined": constant(
        refine, screen=lambda engine, members, x, goal: (x, np.zeros(len(x)))
    ),
    "starting points: only the case's gains": setting(screen=0),
    "several starts: only the best of the screen": setting(starts=1),
    "halvings: after five steps the best continues alone": constant(refine, FEW=NEVER),
    "CMA-ES": constant(refine, _slopes=lambda starts: np.zeros(len(starts.value))),
    "large populations of CMA-ES": constant(evolution, POPULATION=1),
    "descent: CMA-ES only": by_values,
    "patience: six iterations instead of five": patient,
    "jumps known to the BFGS": constant(descent, JUMP=math.inf),
    "stressed members": setting(stressed=0),
    "validation": setting(validation=0),
    "members of large errors join": constant(validate, LARGER=math.inf),
    "search around the optimum": constant(course, around=lambda x, count, seed: x[None]),
    "extrapolation of the multipliers": constant(limits, MOST_STEPS=0.0),
    "updates of the multipliers": constant(multipliers, MOST_UPDATES=0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="*", default=list(cases()))
    parser.add_argument("--off", nargs="*", default=list(MECHANISMS))
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "ablation"))
    parser.add_argument("--run", action="store_true", help="run one task here; used by this script itself")
    given = parser.parse_args()
    if given.run:
        sys.exit(run(given.tasks[0], given.off[0], given.seeds[0], given.out))
    for seed in given.seeds:
        for off in given.off:
            for task in given.tasks:
                measure(task, off, seed, given.out / f"{task}-{list(MECHANISMS).index(off)}-{seed}")


def measure(task: str, off: str, seed: int, out: pathlib.Path) -> None:
    """Run one task in a process of its own, and add its row to the results."""
    path = _measure.RESULTS / "ablation.json"
    rows = json.loads(path.read_text())["rows"] if path.exists() else {}
    key = f"{off}/{task}/{seed}"
    if key in rows:
        return
    words = ["--run", "--tasks", task, "--off", off, "--seeds", str(seed), "--out", str(out)]
    done = subprocess.run([sys.executable, __file__, *words], check=False, capture_output=True, text=True)
    report = json.loads((out / "report.json").read_text()) if (out / "report.json").exists() else None
    rows[key] = row(report) if report else {"failed": done.stderr.strip().splitlines()[-1:]}
    print(key, rows[key], flush=True)
    _measure.write("ablation", {"rows": rows})


def run(task: str, off: str, seed: int, out: pathlib.Path) -> int:
    """Tune a task with one mechanism switched off."""
    raw = cases()[task]
    raw["tune"] = raw.get("tune", {}) | {"objective": "least_error", "seed": seed}
    MECHANISMS[off](raw)
    out.parent.mkdir(parents=True, exist_ok=True)
    path = out.with_suffix(".toml")
    path.write_text(tomlkit.dumps(raw))
    return tune([str(path), "--out", str(out), "--force", "--json"])


def cases() -> dict[str, dict[str, Any]]:
    """Return the raw cases of the tasks by name."""
    files = [*tasks.TASKS.glob("*.toml"), *tasks.TASKS.glob("sampled/*.toml")]
    found = {path.stem: tomllib.loads(path.read_text()) for path in sorted(files)}
    found |= {name: tomllib.loads(template(name)) for name in ("bearing", "rig")}
    found |= {f"bearing {number}": fleet.bearing(number) for number in (5, 7)}
    for name, laws in FIRST_KINDS.items():
        raw = default_gains.machine("blower")
        stages = zip(("position", "inversion", "current"), laws, strict=True)
        raw["controller"] |= {stage: {"kind": kind} for stage, kind in stages}
        found[name] = raw
    return found


def row(report: dict[str, Any]) -> dict[str, Any]:
    """Return what a report says of the answer."""
    after, search = report["after"], report["search"]
    return {
        "good": report["outcome"]["good"],
        "broken": [one["name"] for one in report["limits"] if one["verdict"] == "broken"],
        "against": report["outcome"]["against"],
        **{key: after.get(key) for key in ("members", "lost", "settled_rms_error_m", "settled_max_abs_error_m")},
        "settled_rms_u_V": after.get("settled_rms_u_V.mean"),
        "sensitivity": next((one["reached"] for one in report["limits"] if one["name"] == "sensitivity"), None),
        **{key: search[key] for key in ("rollouts", "iterations", "seconds")},
    }


if __name__ == "__main__":
    main()
