"""`ambjax check`: Theorem 1's conditions along a case."""

import argparse
import dataclasses
from typing import Any

from ambjax.commands.doubts import read_aloud
from ambjax.commands.outputs import plain, table
from ambjax.theorem.conditions import Condition, check

Summary = dict[str, Any]
CONTINUOUS = (
    "All of this is about continuous time, for which the theorem is: the case's [processor] is left out, and signs "
    "without a layer have one. 'ambjax simulate' runs the loop on its processor."
)


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """ambjax check."""
    case = read_aloud(args.case)
    report = check(case.cascade, case.scenario, case.clock)
    summary = {
        "holds": report.holds,
        "lost_at_s": report.lost_at,
        "lost_why": report.lost_why,
        "stalled": report.stalled,
        "method": report.method,
        "conditions": [_condition(c) for c in report.conditions],
        "proof": [_condition(c) for c in report.proof],
    }
    if not args.json:
        _print_check(report.conditions, report.proof)
        from ambjax.theorem import verdict

        print("\n" + "\n".join(verdict.answer(report, args.case)))
        if case.cascade.processor is not None:
            print(CONTINUOUS)
    return int(not report.holds), plain(summary)


def _condition(c: Condition) -> Summary:
    return dataclasses.asdict(c) | {"margin": c.margin}


def _print_check(conditions: list[Condition], proof: list[Condition]) -> None:
    verdict = {True: "holds", False: "FAILS", None: "-"}

    def number(x: float | None) -> str:
        return "-" if x is None else f"{x:.5g}"

    rows = [
        (
            c.requires,
            number(c.gain),
            number(c.against),
            number(c.margin),
            c.unit,
            f"{c.at_s:.5g}",
            verdict[c.holds],
            c.note,
        )
        for c in conditions
    ]
    print(table(("condition", "left", "right", "margin", "unit", "at (s)", "verdict", "note"), rows))
    steps = [(c.name, c.requires, f"{c.against:.3g}", c.unit, f"{c.at_s:.5g}", c.note) for c in proof]
    print("\n" + table(("proof", "statement", "worst", "unit", "at (s)", "what"), steps))
