"""Verification of the C against JAX: compilation without warnings, the test program, single steps, and closed loops."""

import dataclasses
import pathlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ambjax.codegen import closed_loop
from ambjax.codegen.block import SPAN, Block
from ambjax.codegen.c99.machine import EXACT, SANITIZED, SHARED, STRICT, Compiled, build, execute, scratch, short
from ambjax.codegen.c99.package import SHARE, ULPS, files_of_trace, tolerance
from ambjax.codegen.c99.source import Origin, template
from ambjax.codegen.points import Points, Results, results, varied, verification_points
from ambjax.codegen.program import PRECISIONS
from ambjax.codegen.trace import Trace, trace
from ambjax.codegen.twins import LEAST, PARTED, TWINS, LoopCase
from ambjax.text.words import markdown_table

# Number of points (states and inputs) at which one step is compared.
COUNT = 10_000


class Check(NamedTuple):
    """One row of the table: the check, its precision, what was found, what is allowed, and whether the check holds.

    `ok` is None if the check is not decisive.
    """

    name: str
    precision: str
    found: str
    allowed: str
    ok: bool | None

    @property
    def verdict(self) -> str:
        return "not decisive" if self.ok is None else "holds" if self.ok else "FAILS"


@dataclasses.dataclass(frozen=True)
class Draft:
    """The files of a block in one precision, and JAX's results of its step.

    `steps`: points and results by the name of a check. One check uses the case's parameters, the other varied ones.
    """

    trace: Trace
    prefix: str
    files: Mapping[str, str]
    steps: Mapping[str, tuple[Points, Results]]


def draft(block: Block, precision: str, prefix: str, origin: Origin, count: int = COUNT) -> Draft:
    """Return the files of a block and JAX's results. Raises ValueError for a law that scalar code cannot express."""
    traced = trace(block, precision)
    at = {"one step": verification_points(traced, count), "parameters": varied(traced, count)}
    steps = {name: (x, results(traced, x)) for name, x in at.items()}
    return Draft(traced, prefix, files_of_trace(traced, prefix, origin), steps)


def verify(drafts: Mapping[str, Draft], case: LoopCase | None) -> list[Check]:
    """Run and return all checks, in every precision of `drafts`. `case` None: without those of the closed loop.

    If a library cannot be built, the steps in its precision and all closed loops are left out.

    Raises ValueError if there is no compiler, or if this machine cannot run the compiled programs.
    """
    checks, machines = [], {}
    with scratch() as folder:
        for precision, one in drafts.items():
            at = folder / precision
            at.mkdir()
            for name, text in one.files.items():
                (at / name).write_text(text, encoding="utf-8")
            checks += _built(one, precision, at)
            if checks[-1].ok and (library := at / "block.so").exists():
                machines[precision] = Compiled(library, one.trace, one.prefix)
                for name in one.steps:
                    checks += _stepped(name, one, precision, machines[precision])
        if case is not None and len(machines) == len(drafts):
            checks += [_looped(*found) for found in closed_loop.compare(case, machines).items()]
    return checks


def _built(one: Draft, precision: str, at: pathlib.Path) -> Iterator[Check]:
    """Compile with strict warnings, run the test program plain and sanitized, and build the library."""
    source, test = at / f"{one.prefix}.c", at / f"{one.prefix}_test.c"
    for how, flags in (("", []), (", sanitized", SANITIZED)):
        program = at / f"test{len(flags)}"
        messages = build([source, test], program, *flags)
        words = "-fsanitize=address,undefined" if flags else " ".join(STRICT[2:])
        yield Check(f"compiles{how}", precision, short(messages) or "no warning", words, not messages)
        if not messages:
            code, output = execute(program)
            yield Check(f"test program{how}", precision, short(output), "exit code 0", code == 0)
    messages = build([source], at / "block.so", *SHARED)
    yield Check("library", precision, short(messages) or "no warning", EXACT, not messages)


def _stepped(name: str, one: Draft, precision: str, machine: Compiled) -> Iterator[Check]:
    at, should = one.steps[name]
    found, kind = machine.results(at), np.finfo(PRECISIONS[precision])
    is_, as_ = (np.concatenate([x.state, x.outputs]) for x in (found, should))
    off = deviation(is_, as_, float(kind.tiny))
    worst = float(off.max(initial=0.0))
    share = tolerance(precision)[0]
    if precision == "double":
        shown, allowed = f"{worst / share * ULPS:.3g} ULP", f"{ULPS} ULP"
    else:
        shown, allowed = f"{worst:.3g}", f"{SHARE:g}"
    count = at.started.size
    yield Check(f"{name}, numbers", precision, f"{shown} at {count:,} points", allowed, worst <= share)
    other = int(np.sum((found.bits != should.bits) | (found.started != should.started)))
    yield Check(f"{name}, status", precision, f"{other} of {count:,} differ", "0", other == 0)


def deviation(found: np.ndarray, should: np.ndarray, tiny: float) -> np.ndarray:
    """Return the relative deviation of numbers; 0 for two equal infinities or two NaN, inf if only one is NaN."""
    with np.errstate(all="ignore"):
        off = np.abs(found.astype(float) - should) / np.maximum(np.abs(should.astype(float)), 1e4 * tiny)
    same = (found == should) | (np.isnan(found) & np.isnan(should))
    return np.where(same, 0.0, np.where(np.isnan(off), np.inf, off))


def _looped(precision: str, found: closed_loop.LoopComparison) -> Check:
    name, horizon = "closed loop, dz", found.horizon
    count, samples = horizon.samples, horizon.signals["z"].size
    if not horizon.decisive:
        result = f"twins of JAX's loop differ too much after {count} of {samples:,} samples"
        return Check(name, precision, result, f"at least {LEAST} samples", None)
    result = f"{found.times:.2g} times the rounding error, over {count:,} of {samples:,} samples"
    reached, size = float(horizon.parted["z"][count - 1]), horizon.sizes["z"]
    share = f", {reached / size:.1g} of the rms error" if size > 0 else ""
    allowed = f"{closed_loop.TIMES:g} times (rounding reaches {reached:.1g} m{share})"
    return Check(name, precision, result, allowed, found.times <= closed_loop.TIMES)


def checks_page(checks: list[Check], case: str, mark: str, noun: str = "controller") -> str:
    """Return the checks as a Markdown page that ends with the line `mark`."""
    rows = [(*x[:4], x.verdict) for x in checks]
    return template("verify.md").format(
        noun=noun,
        case=case,
        verdict=checks_verdict(checks),
        table="\n".join(markdown_table(("check", "precision", "found", "allowed", "verdict"), rows)),
        exact=EXACT,
        least=1 / SPAN,
        span=SPAN,
        twins=TWINS,
        parted=PARTED,
        times=closed_loop.TIMES,
        samples=LEAST,
        mark=mark,
    )


def holds(checks: list[Check]) -> bool:
    """Return whether no check fails. A check that is not decisive does not fail."""
    return all(x.ok is not False for x in checks)


def checks_verdict(checks: list[Check]) -> str:
    """Return the verdict of all checks in one sentence."""
    open_ = sum(x.ok is None for x in checks)
    if not holds(checks):
        return "Some checks FAIL."
    return f"No check fails; {open_} of {len(checks)} are not decisive." if open_ else "All checks hold."
