"""`ambjax page`: write one HTML file in which the sampled loop of a case runs with sliders."""

import argparse
import pathlib

from ambjax.cases.reader import read_case
from ambjax.commands.reading import print_warnings
from ambjax.page.html_page import NAME, page
from ambjax.results.outputs import directory, files, make, written


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Write the page of a case."""
    case = read_case(args.case)
    print_warnings(case, args.case)
    given = _target(args.out, args.force)
    text = page(case, [read_case(path) for path in args.also or []], args.case)
    out = given or directory(None, f"page-{case.name}") / NAME
    make(out.parent)
    with files(out.parent) as part:
        (part / out.name).write_text(text, encoding="utf-8")
    if not args.json:
        written(out.parent, out.name)
    return 0, {"out": str(out), "bytes": len(text.encode())}


def _target(given: str | None, force: bool) -> pathlib.Path | None:
    """Return the file of --out, or None. Raises ValueError if it is no HTML file, or if it exists and not `force`."""
    if given is None:
        return None
    out = pathlib.Path(given)
    if out.suffix not in (".html", ".htm") or out.is_dir():
        raise ValueError(f"--out {given}: it must be the name of an HTML file. Use --out {NAME}, for example.")
    if out.exists() and not force:
        raise ValueError(f"--out {given}: the file exists. Choose another name, or overwrite it with --force.")
    return out
