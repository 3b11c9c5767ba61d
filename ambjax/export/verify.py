"""The C held to JAX: it compiles without a warning, steps and holds the rotor as JAX does, and tests itself."""

import dataclasses
import pathlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ambjax.export import loop
from ambjax.export.controller import Controller
from ambjax.export.machine import EXACT, SANITIZED, SHARED, STRICT, Compiled, build, execute, scratch, short
from ambjax.export.package import SHARE, ULPS, tolerance, written
from ambjax.export.reference import Points, Results, points, results
from ambjax.export.source import Origin
from ambjax.export.statements import PRECISIONS
from ambjax.export.trace import Trace, trace

# Random states and inputs of the comparison of one step.
COUNT = 10_000


class Check(NamedTuple):
    """One line of the table: what is looked at, in which precision, what was found and is allowed, whether it holds."""

    name: str
    precision: str
    found: str
    allowed: str
    ok: bool


@dataclasses.dataclass(frozen=True)
class Draft:
    """A controller as files of a precision, and what JAX makes of its step."""

    trace: Trace
    prefix: str
    files: Mapping[str, str]
    points: Points
    results: Results


def draft(controller: Controller, precision: str, prefix: str, origin: Origin, count: int = COUNT) -> Draft:
    """Files and references of a controller. Raises ValueError for a law that does what scalar C cannot."""
    traced = trace(controller, precision)
    at = points(traced, count)
    return Draft(traced, prefix, written(traced, prefix, origin), at, results(traced, at))


def verify(drafts: Mapping[str, Draft], case: loop.Case | None) -> list[Check]:
    """Every check, in both precisions; without a case none of the closed loop.

    Raises ValueError where the machine decides nothing: without a compiler, or where what it makes cannot be run.
    """
    checks, machines = [], {}
    with scratch() as folder:
        for precision, one in drafts.items():
            at = folder / precision
            at.mkdir()
            for name, text in one.files.items():
                (at / name).write_text(text, encoding="utf-8")
            checks += _built(one, precision, at)
            if checks[-1].ok and (library := at / "controller.so").exists():
                machines[precision] = Compiled(library, one.trace, one.prefix)
                checks += _stepped(one, precision, machines[precision])
        if case is not None and len(machines) == len(drafts):
            for precision, found in loop.beside(case, machines).items():
                checks += _looped(precision, found)
    return checks


def _built(one: Draft, precision: str, at: pathlib.Path) -> Iterator[Check]:
    """Compiled strictly; the test program plain and under sanitizers; the library."""
    source, test = at / f"{one.prefix}.c", at / f"{one.prefix}_test.c"
    for how, flags in (("", []), (", sanitized", SANITIZED)):
        program = at / f"test{len(flags)}"
        said = build([source, test], program, *flags)
        words = "-fsanitize=address,undefined" if flags else " ".join(STRICT[2:])
        yield Check(f"compiles{how}", precision, short(said) or "no warning", words, not said)
        if not said:
            code, told = execute(program)
            yield Check(f"test program{how}", precision, short(told), "exit code 0", code == 0)
    said = build([source], at / "controller.so", *SHARED)
    yield Check("library", precision, short(said) or "no warning", EXACT, not said)


def _stepped(one: Draft, precision: str, machine: Compiled) -> Iterator[Check]:
    """One step from each point."""
    found, should, kind = machine.results(one.points), one.results, np.finfo(PRECISIONS[precision])
    is_, as_ = (np.concatenate([x.state, x.outputs]) for x in (found, should))
    off = deviation(is_, as_, float(kind.tiny))
    worst = float(off.max(initial=0.0))
    share = tolerance(precision)[0]
    if precision == "double":
        shown, allowed = f"{worst / share * ULPS:.3g} ULP", f"{ULPS} ULP"
    else:
        shown, allowed = f"{worst:.3g}", f"{SHARE:g}"
    count = one.points.started.size
    yield Check("one step, numbers", precision, f"{shown} at {count:,} points", allowed, worst <= share)
    other = int(np.sum((found.bits != should.bits) | (found.started != should.started)))
    yield Check("one step, status", precision, f"{other} of {count:,} differ", "0", other == 0)


def deviation(found: np.ndarray, should: np.ndarray, tiny: float) -> np.ndarray:
    """How far numbers are off, as a share of what they should be; what is no number is off by 0 or by inf."""
    with np.errstate(all="ignore"):
        off = np.abs(found.astype(float) - should) / np.maximum(np.abs(should.astype(float)), 1e4 * tiny)
    same = (found == should) | (np.isnan(found) & np.isnan(should))
    return np.where(same, 0.0, np.where(np.isnan(off), np.inf, off))


def _looped(precision: str, found: loop.Beside) -> Iterator[Check]:
    told = f"{found.dz:.2g} m (rounding alone moves JAX's by {found.own:.2g} m)"
    yield Check("closed loop, dz", precision, told, f"{found.allowed:.2g} m", found.dz <= found.allowed)
    told = f"{found.metric} off by {found.off:.2g}"
    yield Check("closed loop, metrics", precision, told, f"{found.off_allowed:.2g}", found.off <= found.off_allowed)


def table(checks: list[Check], case: str, mark: str) -> str:
    """The checks as a page of Markdown, which ends with this line."""
    rows = [f"| {x.name} | {x.precision} | {x.found} | {x.allowed} | {'holds' if x.ok else 'FAILS'} |" for x in checks]
    verdict = "All of it holds." if all(x.ok for x in checks) else "It does NOT hold."
    head = "| check | precision | found | allowed | verdict |\n|---|---|---|---|---|"
    return (
        f"# The controller of case '{case}' as C, held to JAX\n\n{verdict}\n\n{head}\n"
        + "\n".join(rows)
        + f"\n\n{TOLD}\n{mark}\n"
    )


DOUBLE, FLOAT = loop.BARS["double"], loop.BARS["float"]
TOLD = f"""One step: states and inputs at random over decades, with zeros, limits, NaN and infinities, and the points
next to where each comparison of the step turns, on both sides. The reference is JAX in that precision, each primitive
run alone, with functions of math.h from there: compiled as a whole, XLA rounds a product and a sum once where the C
({EXACT}) rounds twice. A number is off by a share of its own size. Points at which a number on the way is
subnormal are left out: XLA takes it for 0.

Closed loop: JAX's plant and sensors under the compiled C, beside the whole compiled by JAX in double precision, over
the case's horizon. Allowed is a share of the gap ({DOUBLE[0]:g} in double, {FLOAT[0]:g} in float), of each metric
({DOUBLE[1]:g}, {FLOAT[1]:g}), a sample for a time, and {loop.TIMES:g} times what some rounding units of the gap at
the start make of JAX's own loop: signs and converters multiply rounding. A metric near 0 may be off by
{loop.ROUNDINGS:g} rounding units of what its quantity amounts to.
"""
