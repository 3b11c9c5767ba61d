"""`ambjax export`: write the controller, plant or loop of a case as C or as an FMU, and verify the C against JAX."""

import argparse
import dataclasses
import hashlib
import pathlib
import re
from typing import NamedTuple

import jax
import numpy as np

from ambjax.cases.reader import Case, read_case
from ambjax.commands.outputs import directory, files, say, spare, table, write_json, written
from ambjax.commands.warnings import print_warnings
from ambjax.control.cascade import Cascade
from ambjax.control.guard import guarded
from ambjax.ensemble.spread import ends
from ambjax.export import verify
from ambjax.export.block import Block
from ambjax.export.c99 import machine, package, texts
from ambjax.export.c99.source import Origin
from ambjax.export.c99.statements import RESERVED
from ambjax.export.fmi import archive, cross_check
from ambjax.export.of_case import block_of
from ambjax.export.program import PRECISIONS
from ambjax.export.trace import trace
from ambjax.export.twins import LoopCase

Summary = dict[str, object]
# Files that --verify adds.
VERIFIED = ("verify.md", "verify.json")
# Names of the files of an FMU export, with the prefix p: the FMU, and its reference input, output and options.
FMU_NAMES = ("{p}.fmu", "{p}_in.csv", "{p}_ref.csv", "{p}_ref.opt")
# Names of the standard C headers, which a prefix must not repeat: the package contains PREFIX.h.
HEADER_NAMES = {
    *("assert", "complex", "ctype", "errno", "fenv", "inttypes", "iso646", "limits", "locale", "math", "setjmp"),
    *("signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time", "wchar"),
    "wctype",
}


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """Export a block of a case. Exit code 1 if --verify finds a difference between the C and JAX."""
    case = read_case(args.case)
    plan = _plan(case, args)
    print_warnings(case, args.case)
    with files(plan.out) as part:
        sources, checks = _verified(case, plan) if args.verify else (_built(case, plan), [])
        _write(part, plan, case.name, sources, checks)
    if not checks:
        _remove_verification(plan.out)
    if not args.json:
        _print(plan.out, sources, checks)
    ok = verify.holds(checks) if checks else None
    return int(ok is False), {"ok": ok, "checks": [check._asdict() for check in checks], "out": str(plan.out)}


class Plan(NamedTuple):
    """A checked export.

    - `block`: what is exported.
    - `fmi`: version of FMI, 2 or 3; 0 for a C package.
    - `precision`: C type of a C package, "float" or "double".
    - `prefix`: prefix of all C names.
    - `origin`: name and checksum of the case, and the description of the block.
    - `mark`: line by which a later export recognises the files.
    - `out`: output directory.
    """

    block: Block
    fmi: int
    precision: str
    prefix: str
    origin: Origin
    mark: str
    out: pathlib.Path


def _plan(case: Case, args: argparse.Namespace) -> Plan:
    """Build the block and make the output directory. Raises ValueError if the case or an option does not allow it."""
    block = block_of(args.what, guarded_for(case), case.scenario, case.clock)
    prefix = _prefix(args.prefix, case.name)
    if args.fmi is not None and args.format != "fmu":
        raise ValueError(f"--fmi {args.fmi}: it is for --format fmu. Add --format fmu, or omit --fmi.")
    if args.precision == "float" and args.format == "fmu":
        raise ValueError("--precision float: an FMU computes in double. Omit --precision, or use --format c.")
    fmi = (args.fmi or 3) if args.format == "fmu" else 0
    if args.verify:
        machine.check()
    digest = hashlib.sha256(case.text.encode()).hexdigest()
    origin = Origin(case.name, digest, block.described())
    out = directory(args.out, f"export-{case.name}")
    mark = texts.MARK.format(p=prefix)
    names = FMU_NAMES[: 1 if _holds_fmu(out, prefix, mark) else None] if fmi else package.NAMES
    spare(out, [*(name.format(p=prefix) for name in names), *VERIFIED], mark)
    return Plan(block, fmi, args.precision or "float", prefix, origin, mark, out)


def _holds_fmu(out: pathlib.Path, prefix: str, mark: str) -> bool:
    """Return whether `out` contains an FMU of an earlier export. Its reference data may then be overwritten."""
    path = out / f"{prefix}.fmu"
    return path.is_file() and path.read_bytes().endswith(mark.encode())


def _built(case: Case, plan: Plan) -> dict[str, str | bytes]:
    """Return the content of each file by name, without verification."""
    if not plan.fmi:
        return {**package.files(plan.block, plan.precision, plan.prefix, plan.origin)}
    traced = trace(plan.block, "double")
    fmu = {f"{plan.prefix}.fmu": archive.packed(traced, plan.prefix, plan.origin, plan.fmi)}
    cascade = guarded_for(case)
    return fmu | cross_check.files_of(plan.block, plan.prefix, traced.read, cascade, case.scenario, case.clock)


def _write(
    folder: pathlib.Path, plan: Plan, case_name: str, sources: dict[str, str | bytes], checks: list[verify.Check]
) -> None:
    """Write all files and, if there are checks, their results."""
    for name, content in sources.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    if checks:
        (folder / VERIFIED[0]).write_text(verify.table(checks, case_name, plan.mark, plan.block.noun), encoding="utf-8")
        rows = [check._asdict() for check in checks]
        write_json(folder / VERIFIED[1], {"from": plan.mark, "ok": verify.holds(checks), "checks": rows})


def _remove_verification(out: pathlib.Path) -> None:
    """Remove the verification files of an earlier export, which do not apply to the new files."""
    for name in VERIFIED:
        (out / name).unlink(missing_ok=True)


def _print(out: pathlib.Path, sources: dict[str, str | bytes], checks: list[verify.Check]) -> None:
    if checks:
        rows = [(check.name, check.precision, check.found, check.allowed, check.verdict) for check in checks]
        print(table(("check", "precision", "found", "allowed", "verdict"), rows))
        print(verify.summary(checks))
    written(out, ", ".join([*sources, *(VERIFIED if checks else ())]))


def guarded_for(case: Case) -> Cascade:
    """Return the cascade of a case whose guard limits are wide enough for the sensor at both ends of every spread."""
    widest = ends(case.spread, case.cascade, case.scenario, ("sensor.", "run.clearance", "plant.s_0"))[1]
    cascade = guarded(case.cascade, widest, float(case.clock.sample_period))
    if cascade.processor is None or cascade.processor.guard is None:
        return cascade
    guard = jax.tree.map(lambda x: float(np.max(x)), cascade.processor.guard)
    return dataclasses.replace(cascade, processor=dataclasses.replace(cascade.processor, guard=guard))


def _verified(case: Case, plan: Plan) -> tuple[dict[str, str | bytes], list[verify.Check]]:
    """Return the content of each file by name, and the results of the checks in both precisions."""
    say(
        "verify: in both precisions, one step at 10,000 points, one step at 10,000 points with other parameters, "
        "and the closed loop"
    )
    drafts = {name: verify.draft(plan.block, name, plan.prefix, plan.origin) for name in PRECISIONS}
    checks = verify.verify(drafts, LoopCase(case.cascade, case.scenario, case.clock, case.settle))
    return _built(case, plan) if plan.fmi else {**drafts[plan.precision].files}, checks


def _prefix(option: str | None, name: str) -> str:
    """Return the prefix of all C names: the option, or the case's name. Raises ValueError for an invalid C name."""
    if option is None:
        derived = re.sub(r"\W", "_", name, flags=re.ASCII)
        return derived if _is_name(derived) else f"amb_{derived}"
    if not _is_name(option):
        raise ValueError(
            f"--prefix {option}: it must be a C identifier (a letter, then letters, digits or '_'), and neither a C "
            "keyword nor the name of a C header. Use --prefix controller, for example."
        )
    return option


def _is_name(text: str) -> bool:
    """Return whether a text can be the prefix: a C identifier that is no keyword and no name of a C header."""
    words = RESERVED | HEADER_NAMES | {"break", "continue", "else", "for", "if", "return", "while"}
    return re.fullmatch(r"[A-Za-z]\w{0,60}", text, flags=re.ASCII) is not None and text not in words
