"""Run the five tuning tasks by `ambjax tune` with its defaults.

Each task starts from the printed gains of the paper's laws, which lose the rotor.
Every task is a case file in tasks/. Its report is written to DIR/TASK, and a task with an existing report is not run
again. The figures are those of 1,000 held-out members. Results of other tasks are kept.
Run: python benchmarks/tasks.py [--out DIR] [TASK ...]
"""

import argparse
import json
import pathlib
import resource
import subprocess
import sys
from typing import Any

import _measure

TASKS = pathlib.Path(__file__).parent / "tasks"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=names(TASKS))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "tasks"))
    given = parser.parse_args()
    rows = kept("tasks")
    for name in given.tasks:
        rows[name] = row = tuned(TASKS / f"{name}.toml", given.out / name)
        print(row_text(row), flush=True)
    _measure.write("tasks", {"tasks": dict(sorted(rows.items()))})


def names(folder: pathlib.Path) -> list[str]:
    """Return the names of the tasks in a folder of case files."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def kept(results: str) -> dict[str, Any]:
    """Return the rows of the results of this name."""
    path = _measure.RESULTS / f"{results}.json"
    return json.loads(path.read_text())["tasks"] if path.exists() else {}


def tuned(path: pathlib.Path, out: pathlib.Path) -> dict[str, Any]:
    """Tune a case file, whose first line is its title, or read an existing report in `out`; return the row."""
    spent = out / "processor_s"
    if not (out / "report.json").exists():
        began = _processor_seconds()
        subprocess.run([sys.executable, "-m", "tuning", str(path), "--out", str(out)], check=False)
        spent.write_text(str(_processor_seconds() - began))
    report = json.loads((out / "report.json").read_text())
    after = report["after"]
    return {
        "title": path.read_text()
        .splitlines()[0]
        .removeprefix("# ")
        .removeprefix("Tuning task ")
        .partition(". ")[0]
        .rstrip("."),
        "gains": {row["path"]: row["after"] for row in report["gains"]},
        "at_bound": [row["path"] for row in report["gains"] if row["at_bound"]],
        "lost_before": report["before"]["lost"],
        "verified": report["verified"],
        "step_error": report["step_error"]["relative"],
        "conditions": {row["name"]: row["margin"] for row in report["conditions"]},
        **{key: after[key] for key in ("members", "lost", "settled_rms_error_m", "settled_max_abs_error_m")},
        **{key: report["stability"][key] for key in ("tested", "unstable")},
        "settled_rms_u_V": after["settled_rms_u_V.mean"],
        "rms_u_V": after["rms_u_V.mean"],
        "chatter_V": after["chatter_V.mean"],
        **{key: report["search"][key] for key in ("rollouts", "iterations", "seconds")},
        "processor_s": float(spent.read_text()) if spent.exists() else None,
    }


def row_text(row: dict[str, Any]) -> str:
    """Return a row as one line of text."""
    return (
        f"{row['title']}: settled rms {row['settled_rms_error_m']:.2e} m, largest "
        f"{row['settled_max_abs_error_m']:.2e} m, {row['lost']} of {row['members']} lost, steps off by "
        f"{100 * row['step_error']:.1g} %, {row['seconds']:.0f} s"
    )


def _processor_seconds() -> float:
    """Return the processor seconds of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
