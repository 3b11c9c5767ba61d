"""`ambjax export`: write controller, plant or loop of a case as C, FMU or JavaScript, and verify the C against JAX."""

import argparse

from ambjax.cases.reader import read_case
from ambjax.codegen import verify
from ambjax.commands.reading import print_warnings
from ambjax.host.heartbeat import doing, say
from ambjax.results.case_export import destination, generated, planned
from ambjax.results.outputs import table, written


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Export a block of a case. Exit code 1 if a check of --verify fails."""
    case = read_case(args.case)
    plan = planned(case, args.what, args.format, args.fmi, args.precision, args.prefix, args.verify)
    with destination(args.out, f"export-{case.name}", plan) as (out, part):
        print_warnings(case, args.case)
        if plan.verified:
            say(
                "verify: in both precisions, one step at 10,000 points, one step at 10,000 points with other "
                "parameters, and the closed loop"
            )
        with doing("generating and verifying the code" if plan.verified else "generating the code"):
            exported = generated(plan)
        exported.put(part)
    checks = exported.checks
    if not args.json:
        if checks:
            rows = [(check.name, check.precision, check.found, check.allowed, check.verdict) for check in checks]
            print(table(("check", "precision", "found", "allowed", "verdict"), rows))
            print(verify.checks_verdict(checks))
        written(out, ", ".join(exported.files))
    summary = {"ok": exported.ok, "checks": [check._asdict() for check in checks], "out": str(out)}
    return int(exported.ok is False), summary
