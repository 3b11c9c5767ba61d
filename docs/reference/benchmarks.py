"""The benchmark page, from the JSON of the scripts: benchmarks/report.py writes it."""

import sys

from reference.floors import ROOT

FOLDER = ROOT / "benchmarks"
# Where the pictures are, seen from the README beside the scripts and from the page.
FROM_THERE, FROM_HERE = "](results/", "](../../benchmarks/results/"


def pages() -> dict[str, str]:
    """The page, with its pictures found from here."""
    sys.path.insert(0, str(FOLDER))
    try:
        import report  # pyright: ignore[reportMissingImports]
    finally:
        sys.path.remove(str(FOLDER))
    return {"benchmarks.md": report.page().replace(FROM_THERE, FROM_HERE)}
