"""Tune other bearings with a constant reference, and the two templates, by `ambjax tune` with its defaults.

The rows are those of `tasks.py`: no manual intervention, 1,000 held-out members, verification with accurate steps.
Run: python benchmarks/bearings.py [--out DIR] [NAME ...]
"""

import argparse
import pathlib

import _measure
import tasks

from ambjax.cases.template_text import template

CASES = pathlib.Path(__file__).parent.parent / "tests" / "cases"
TEMPLATES = ("regulation", "tracking")
# The objective of the figures: the least error, without regard to voltage and sensitivity.
LEAST_ERROR = '\n[tune]\nobjective = "least_error"\nlimits.sensitivity = inf\n'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*tasks.names(CASES), *TEMPLATES])
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "bearings"))
    given = parser.parse_args()
    rows = tasks.kept("bearings")
    for name in given.names:
        given.out.mkdir(parents=True, exist_ok=True)
        path, own = given.out / f"{name}.toml", CASES / f"{name}.toml"
        text = f"# The template {name}.\n{template(name)}" if name in TEMPLATES else own.read_text()
        path.write_text(text + LEAST_ERROR)
        rows[name] = row = tasks.tuned(path, given.out / name)
        print(f"{tasks.row_text(row)}; {'verified' if row['verified'] else 'NOT verified'}", flush=True)
    _measure.write("bearings", {"tasks": dict(sorted(rows.items()))})


if __name__ == "__main__":
    main()
