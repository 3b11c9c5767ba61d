"""The five tuning tasks, each by `ambjax-tune` with its defaults from the gains as printed, which lose the rotor.

Every task is a case file in tasks/; its report stays in DIR/TASK, and a task whose report is there is not run
again. The numbers are those of 1,000 held-out members. Run: python benchmarks/tasks.py [--out DIR] [TASK ...]
"""

import argparse
import json
import pathlib
import subprocess
import sys

import _measure

TASKS = pathlib.Path(__file__).parent / "tasks"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=sorted(path.stem for path in TASKS.glob("*.toml")))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "tasks"))
    given = parser.parse_args()
    rows = {}
    for name in given.tasks:
        path, out = TASKS / f"{name}.toml", given.out / name
        if not (out / "report.json").exists():
            subprocess.run([sys.executable, "-m", "tuning", str(path), "--out", str(out)], check=False)
        told = json.loads((out / "report.json").read_text())
        after = told["after"]
        rows[name] = {
            "title": path.read_text().splitlines()[0].removeprefix("# Tuning task ").partition(". ")[0],
            "gains": {row["path"]: row["after"] for row in told["gains"]},
            "at_bound": [row["path"] for row in told["gains"] if row["at_bound"]],
            "lost_before": told["before"]["lost"],
            "step_error": told["step_error"]["relative"],
            "conditions": {row["name"]: row["margin"] for row in told["conditions"]},
            **{key: after[key] for key in ("members", "lost", "settled_rms_error_m", "settled_max_abs_error_m")},
            "settled_rms_u_V": after["settled_rms_u_V.mean"],
            **{key: told["search"][key] for key in ("rollouts", "iterations", "seconds")},
        }
        row = rows[name]
        print(
            f"{row['title']}: settled rms {row['settled_rms_error_m']:.2e} m, largest "
            f"{row['settled_max_abs_error_m']:.2e} m, {row['lost']} of {row['members']} lost, steps off by "
            f"{100 * row['step_error']:.1g} %, {row['seconds']:.0f} s",
            flush=True,
        )
    _measure.write("tasks", {"tasks": rows})


if __name__ == "__main__":
    main()
