"""The benchmark page, from the JSON of the scripts: benchmarks/report.py writes it."""

import sys

from reference.floors import ROOT

FOLDER = ROOT / "benchmarks"


def pages() -> dict[str, str]:
    """The page, with its pictures found from here."""
    sys.path.insert(0, str(FOLDER))
    try:
        import report
    finally:
        sys.path.remove(str(FOLDER))
    return {"benchmarks.md": report.page().replace("](results/", "](../../benchmarks/results/")}
