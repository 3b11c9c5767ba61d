"""`ambjax export`: write the controller of a case as C, and verify the C against JAX."""

import argparse
import dataclasses
import hashlib
import re
from typing import Any

import jax
import numpy as np

from ambjax.cases.reader import Case, read_case
from ambjax.commands.outputs import directory, files, say, spare, table, write_json, written
from ambjax.commands.warnings import print_warnings
from ambjax.control.guard import guarded
from ambjax.ensemble.spread import ends
from ambjax.export import machine, package, texts, verify
from ambjax.export.controller import Controller, controller_of
from ambjax.export.source import Origin
from ambjax.export.statements import PRECISIONS, RESERVED
from ambjax.export.twins import LoopCase as Compared

Summary = dict[str, Any]
# Files that --verify adds to the package.
VERIFIED = ("verify.md", "verify.json")
# Names of headers of C.
TAKEN = {
    *("assert", "complex", "ctype", "errno", "fenv", "inttypes", "iso646", "limits", "locale", "math", "setjmp"),
    *("signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time", "wchar"),
    "wctype",
}


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax export."""
    case = read_case(args.case)
    controller = controller_of(guarded_for(case), case.scenario.u_max, float(case.clock.sample_period))
    prefix = _prefix(args.prefix, case.name)
    if args.verify:
        machine.check()
    digest = hashlib.sha256(case.text.encode()).hexdigest()
    origin = Origin(case.name, digest, package.described(controller))
    out = directory(args.out, f"export-{case.name}")
    mark = texts.MARK.format(p=prefix)
    spare(out, [*(name.format(p=prefix) for name in package.NAMES), *VERIFIED], mark)
    print_warnings(case, args.case)
    with files(out) as part:
        if args.verify:
            sources, checks = _verified(case, controller, args.precision, prefix, origin)
        else:
            sources, checks = package.files(controller, args.precision, prefix, origin), []
        ok = verify.holds(checks) if checks else None
        for name, text in sources.items():
            (part / name).write_text(text, encoding="utf-8")
        if checks:
            (part / VERIFIED[0]).write_text(verify.table(checks, case.name, mark), encoding="utf-8")
            write_json(part / VERIFIED[1], {"from": mark, "ok": ok, "checks": [x._asdict() for x in checks]})
    if not checks:  # an earlier run's verification does not hold for the new files
        for name in VERIFIED:
            (out / name).unlink(missing_ok=True)
    if not args.json:
        if checks:
            rows = [(x.name, x.precision, x.found, x.allowed, x.verdict) for x in checks]
            print(table(("check", "precision", "found", "allowed", "verdict"), rows))
            print(verify.summary(checks))
        written(out, ", ".join([*sources, *(VERIFIED if checks else ())]))
    return int(ok is False), {"ok": ok, "checks": [x._asdict() for x in checks], "out": str(out)}


def guarded_for(case: Case) -> Any:
    """Return the cascade of a case with limits of its guard that fit the sensor at both ends of every spread."""
    wide = ends(case.spread, case.cascade, case.scenario, ("sensor.", "run.clearance", "plant.s_0"))[1]
    cascade = guarded(case.cascade, wide, float(case.clock.sample_period))
    if cascade.processor is None or cascade.processor.guard is None:
        return cascade
    guard = jax.tree.map(lambda x: float(np.max(x)), cascade.processor.guard)
    return dataclasses.replace(cascade, processor=dataclasses.replace(cascade.processor, guard=guard))


def _verified(
    case: Case, controller: Controller, precision: str, prefix: str, origin: Origin
) -> tuple[dict[str, str], list[verify.Check]]:
    """Return the files in one precision, and the checks in both precisions."""
    say(
        "verify, in both precisions: a step at 10,000 points, at 10,000 points of other parameters, and the closed loop"
    )
    drafts = {name: verify.draft(controller, name, prefix, origin) for name in PRECISIONS}
    checks = verify.verify(drafts, Compared(case.cascade, case.scenario, case.clock, case.settle))
    return dict(drafts[precision].files), checks


def _prefix(asked: str | None, name: str) -> str:
    """Return the prefix of all names of the C: `asked`, or one made from the case's name.

    Raises ValueError if `asked` is not a valid name in C.
    """
    if asked is None:
        found = re.sub(r"\W", "_", name, flags=re.ASCII)
        return found if _is_name(found) else f"amb_{found}"
    if not _is_name(asked):
        raise ValueError(
            f"--prefix {asked}: it must be a name in C: letters, digits and '_', and neither a keyword nor the name of "
            "a header. Use --prefix controller, for example."
        )
    return asked


def _is_name(text: str) -> bool:
    words = RESERVED | TAKEN | {"break", "continue", "else", "for", "if", "return", "while"}
    return re.fullmatch(r"[A-Za-z]\w{0,60}", text, flags=re.ASCII) is not None and text not in words
