"""Comparison of control structures: each is tuned by `ambjax tune`, then evaluated on the same members.

Cases: F20 and G20 of the tuning tasks on a processor, and the templates `rig` and `bearing`. All structures of a case
have the same members, loss, limits and budget, and each is tuned with every seed for the least error within the limits.
All gains are tuned, the steepnesses p included. The results contain the seeds and the budget of each case. Results
in DIR/CASE-SEED are not computed again, so a benchmark that was stopped continues at the next search. Results of
other cases are kept. `--quick` uses one seed and a tiny budget, to test the script; its results are not written.
Compilation takes most of the time of a search; the searches of a structure with other seeds reuse the programs.
Run: python benchmarks/laws.py [CASE ...] [--out DIR] [--quick] [--seeds N] [--budget full|small] [--only NAME ...]
"""

import argparse
import json
import math
import pathlib
import statistics
import tomllib
from typing import Any

import _measure
import jax
import tasks
import tomlkit

from ambjax.__main__ import main as ambjax
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from tuning.problem.space import Gain, Space, tunable
from tuning.solve.checkpoint import checkpoints

SAMPLED = tasks.TASKS / "sampled"
# Limits of each case: a peak of |S| in zone A, an rms voltage (V) of at most 60 % of the supply, and the chatter (V/s).
# They are so low that each structure loses accuracy by them.
LIMITS: dict[str, dict[str, float]] = {
    "F20": {"sensitivity": 3.0, "rms_u_V": 120.0, "chatter_V_per_s": 1e6},
    "G20": {"sensitivity": 3.0, "rms_u_V": 120.0, "chatter_V_per_s": 1e6},
    "rig": {"sensitivity": 3.0, "rms_u_V": 16.0, "chatter_V_per_s": 1.5e5},
    "bearing": {"sensitivity": 3.0, "rms_u_V": 8.0, "chatter_V_per_s": 5e4},
}
# Budgets of a search. `tiny` only tests the script.
BUDGETS = {
    "full": {
        "members": 16,
        "stressed": 4,
        "validation": 200,
        "held_out": 0,
        "screen": 48,
        "starts": 2,
        "iterations": 15,
    },
    "small": {"members": 8, "stressed": 2, "validation": 0, "held_out": 0, "screen": 32, "starts": 2, "iterations": 10},
    "tiny": {"members": 4, "stressed": 0, "validation": 0, "held_out": 0, "screen": 8, "starts": 1, "iterations": 2},
}
SEEDS, JUDGED, JUDGED_SEED = 5, 500, 1000
# Numbers of compare.json in the results; the median and the range over seeds of each.
SUMMARY_KEYS = (
    "rms_error_median_m",
    "rms_error_worst_m",
    "max_error_m",
    "rms_u_V",
    "chatter_V_per_s",
    "peak",
    "worst_peak",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=list(LIMITS))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "laws"))
    parser.add_argument("--quick", action="store_true", help="one seed, a tiny budget, nothing written to results")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="number of searches of each structure")
    parser.add_argument("--only", nargs="+", metavar="STRUCTURE", help="structures to compare; left out: all")
    parser.add_argument("--budget", choices=["full", "small"], default="full", help="size of each search")
    given = parser.parse_args()
    path = _measure.RESULTS / "laws.json"
    rows = json.loads(path.read_text())["cases"] if path.exists() else {}
    for name in given.names:
        budget, count, members = ("tiny", 1, 20) if given.quick else (given.budget, given.seeds, JUDGED)
        found = compared(name, count, BUDGETS[budget], members, given)
        rows[name] = {
            "title": title(name),
            "limits": LIMITS[name],
            "budget": BUDGETS[budget],
            "seeds": count,
            "members": members,
            "structures": summary(found),
        }
        for law, row in rows[name]["structures"].items():
            print(f"{name}, {law}: {text(row)}", flush=True)
        if not given.quick:
            _measure.write("laws", {"cases": {name: rows[name] for name in LIMITS if name in rows}})


def source(name: str) -> str:
    """Return the text of a case."""
    path = SAMPLED / f"{name}.toml"
    return path.read_text() if path.exists() else template(name)


def title(name: str) -> str:
    """Return the description of a case in its first line."""
    first = source(name).splitlines()[0].removeprefix("# ").removeprefix("A case for ambjax: ")
    return first.removeprefix(f"Tuning task {name}: ").partition(". ")[0].rstrip(".")


def structures(laws: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the tables [controller] of all structures. `laws`: the table of the case.

    All structures have the observer of the case, except LQG. LQG is state feedback with a Kalman filter, which is that
    of the case if it has one. The laws that the case does not have start with their default gains for its plant.
    """
    drive = {"kind": "pi"}
    soft = {stage: _without(laws.get(stage, {}), "p") for stage in ("position", "inversion", "current")}
    hard = {stage: law | {"p": math.inf} for stage, law in soft.items()}
    kept = {name: value for name, value in soft["position"].items() if name in ("c", "k")}
    cascade = {"position": {"kind": "sliding-mode"} | kept}
    found = {
        "cascade": soft | cascade,
        "cascade-signs": hard | {"position": cascade["position"] | {"p": math.inf}},
        "cascade-integral": soft | {"position": {"kind": "integral-sliding-mode"} | kept},
        "super-twisting": soft | {"position": {"kind": "super-twisting"}},
        "pid": {"position": {"kind": "pid"}, "inversion": {"kind": "linearised"}, "current": drive},
        "linearisation": {
            "position": {"kind": "feedback-linearisation"},
            "inversion": {"kind": "closed-form"},
            "current": drive,
        },
        "lqg": {"position": {"kind": "state-feedback"}, "inversion": {"kind": "linearised"}, "current": drive},
    }
    observer = laws.get("observer", {})
    kalman = observer if observer.get("kind") == "kalman" else {"kind": "kalman"}
    return {name: {"observer": kalman if name == "lqg" else observer, **found[name]} for name in found}


def _without(table: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in table.items() if name != key}


def written(name: str, seed: int, budget: dict[str, int], folder: pathlib.Path) -> list[pathlib.Path]:
    """Write a case file for each structure of a case and return their paths."""
    raw = tomllib.loads(source(name))
    paths = []
    for law, controller in structures(raw["controller"]).items():
        document = _without(raw, "tune") | {"controller": controller}
        cascade = case_from(document).cascade
        known = tunable(cascade)
        values = Space(tuple(Gain(path) for path in known)).values(cascade)
        gains = [path for path, value in zip(known, values, strict=True) if math.isfinite(value)]
        document["tune"] = {
            "objective": "least_error",
            "gains": gains,
            "seed": seed,
            **budget,
            "limits": LIMITS[name],
        }
        paths.append(folder / f"{law}.toml")
        folder.mkdir(parents=True, exist_ok=True)
        paths[-1].write_text(tomlkit.dumps(document))
    return paths


def compared(
    name: str, seeds: int, budget: dict[str, int], members: int, given: argparse.Namespace
) -> list[list[dict[str, Any]]]:
    """Tune the structures of a case with each seed; return for each seed the rows of `ambjax compare`."""
    folders = [given.out / f"{name}-{seed}" for seed in range(1, seeds + 1)]
    asked = [written(name, seed, budget, folder) for seed, folder in enumerate(folders, 1)]
    cases = [paths for paths in zip(*asked, strict=True) if not given.only or paths[0].stem in given.only]
    answers = [[] for _ in folders]
    for paths in cases:
        for path, folder, found in zip(paths, folders, answers, strict=True):
            found.append(tuned(path, folder / "tuned"))
        jax.clear_caches()
    for folder, found in zip(folders, answers, strict=True):
        if not (folder / "compare.json").exists():
            options = ["--members", str(members), "--seed", str(JUDGED_SEED), "--out", str(folder)]
            command("compare", *map(str, found), *options)
    return [json.loads((folder / "compare.json").read_text())["cases"] for folder in folders]


def tuned(path: pathlib.Path, folder: pathlib.Path) -> pathlib.Path:
    """Tune a case file unless this was done, and return the path of the tuned case, which has the name of the law."""
    answer, search = folder / path.name, folder / path.stem
    if not answer.exists():
        command("tune", str(path), "--out", str(search), *["--resume"] * bool(checkpoints(search)))
        folder.mkdir(exist_ok=True)
        answer.write_text((search / "tuned.toml").read_text())
    return answer


def command(*words: str) -> None:
    """Run a command of ambjax in this process. Exit code 1 is ignored: a limit is missed, or a member is lost."""
    code = ambjax(list(words))
    if code not in (0, 1):
        raise SystemExit(code)


def summary(seeds: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Return for each structure the median, least and largest of each number over seeds.

    The entry of a number is None if one of the seeds does not have it.
    """
    found = {}
    for rows in zip(*seeds, strict=True):
        row: dict[str, Any] = {"lost": [one["lost"] + one["stalled"] for one in rows], "flops": rows[0]["flops"]}
        row["unstable"] = [one["unstable"] for one in rows]
        for key in SUMMARY_KEYS:
            values = [one[key] for one in rows]
            known = None not in values
            row[key] = [statistics.median(values), min(values), max(values)] if known else None
        found[rows[0]["case"]] = row
    return found


def text(row: dict[str, Any]) -> str:
    """Return a row as one line of text."""

    def number(key: str) -> str:
        return "-" if row[key] is None else "{:.3g} ({:.3g} to {:.3g})".format(*row[key])

    return (
        f"rms error {number('rms_error_median_m')} m, worst member {number('rms_error_worst_m')} m, "
        f"lost {row['lost']}, {number('rms_u_V')} V, {number('chatter_V_per_s')} V/s, |S| {number('peak')}, "
        f"{row['flops']} flops"
    )


if __name__ == "__main__":
    main()
