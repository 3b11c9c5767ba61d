"""The C held to JAX: it compiles without a warning, steps and holds the rotor as JAX does, and tests itself."""

import dataclasses
import pathlib
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from ambjax.export import closed_loop
from ambjax.export.controller import SPAN, Controller
from ambjax.export.machine import EXACT, SANITIZED, SHARED, STRICT, Compiled, build, execute, scratch, short
from ambjax.export.package import SHARE, ULPS, tolerance, written
from ambjax.export.points import Points, points, varied
from ambjax.export.reference import Results, results
from ambjax.export.source import Origin
from ambjax.export.statements import PRECISIONS
from ambjax.export.trace import Trace, trace
from ambjax.export.twins import LEAST, PARTED, TWINS, LoopCase

# Random states and inputs of the comparison of one step.
COUNT = 10_000


class Check(NamedTuple):
    """One line of the table: what is checked, in which precision, what was found and is allowed, whether it holds.

    `ok` is None where the check is not decisive.
    """

    name: str
    precision: str
    found: str
    allowed: str
    ok: bool | None

    @property
    def verdict(self) -> str:
        """`ok` in words."""
        return "not decisive" if self.ok is None else "holds" if self.ok else "FAILS"


@dataclasses.dataclass(frozen=True)
class Draft:
    """A controller as files of a precision, and JAX's results of its step.

    `steps`: by the name of a check, points and results: with the case's parameters, and with others.
    """

    trace: Trace
    prefix: str
    files: Mapping[str, str]
    steps: Mapping[str, tuple[Points, Results]]


def draft(controller: Controller, precision: str, prefix: str, origin: Origin, count: int = COUNT) -> Draft:
    """Files and references of a controller. Raises ValueError for a law that does what scalar C cannot."""
    traced = trace(controller, precision)
    at = {"one step": points(traced, count), "parameters": varied(traced, count)}
    steps = {name: (x, results(traced, x)) for name, x in at.items()}
    return Draft(traced, prefix, written(traced, prefix, origin), steps)


def verify(drafts: Mapping[str, Draft], case: LoopCase | None) -> list[Check]:
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
                for name in one.steps:
                    checks += _stepped(name, one, precision, machines[precision])
        if case is not None and len(machines) == len(drafts):
            for precision, found in closed_loop.beside(case, machines).items():
                checks.append(_looped(precision, found))
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


def _stepped(name: str, one: Draft, precision: str, machine: Compiled) -> Iterator[Check]:
    """One step from each point."""
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
    """How far numbers are off, as a share of what they should be; what is no number is off by 0 or by inf."""
    with np.errstate(all="ignore"):
        off = np.abs(found.astype(float) - should) / np.maximum(np.abs(should.astype(float)), 1e4 * tiny)
    same = (found == should) | (np.isnan(found) & np.isnan(should))
    return np.where(same, 0.0, np.where(np.isnan(off), np.inf, off))


def _looped(precision: str, found: closed_loop.Beside) -> Check:
    """The closed loop over its horizon."""
    name, horizon = "closed loop, dz", found.horizon
    count, samples = horizon.samples, horizon.signals["z"].size
    if not horizon.decisive:
        told = f"rounding alone parts JAX's loop from itself within {count} of {samples:,} samples"
        return Check(name, precision, told, f"at least {LEAST} samples", None)
    told = f"{found.times:.2g} times what rounding does, over {count:,} of {samples:,} samples"
    reached, size = float(horizon.parted["z"][count - 1]), horizon.sizes["z"]
    share = f", {reached / size:.1g} of the rms error" if size > 0 else ""
    allowed = f"{closed_loop.TIMES:g} times (rounding reaches {reached:.1g} m{share})"
    return Check(name, precision, told, allowed, found.times <= closed_loop.TIMES)


def table(checks: list[Check], case: str, mark: str) -> str:
    """The checks as a page of Markdown, which ends with this line."""
    rows = [f"| {x.name} | {x.precision} | {x.found} | {x.allowed} | {x.verdict} |" for x in checks]
    verdict = summary(checks)
    head = "| check | precision | found | allowed | verdict |\n|---|---|---|---|---|"
    return (
        f"# The controller of case '{case}' as C, held to JAX\n\n{verdict}\n\n{head}\n"
        + "\n".join(rows)
        + f"\n\n{TOLD}\n{mark}\n"
    )


def holds(checks: list[Check]) -> bool:
    """Whether no check fails. One that is not decisive does not fail."""
    return all(x.ok is not False for x in checks)


def summary(checks: list[Check]) -> str:
    """The verdict of all checks in one sentence."""
    open_ = sum(x.ok is None for x in checks)
    if not holds(checks):
        return "It does NOT hold."
    return f"No check fails; {open_} of {len(checks)} are not decisive." if open_ else "All of it holds."


TOLD = f"""One step: states and inputs at random over decades, with zeros, limits, NaN and infinities, and the points
next to where each comparison of the step turns, on both sides. The reference is JAX in that precision, each primitive
run alone, with functions of math.h from there: compiled as a whole, XLA rounds a product and a sum once where the C
({EXACT}) rounds twice. A number may be off by a share of its own size. Points at which an intermediate number is
subnormal are left out: XLA takes it for 0.

Parameters: the same at other parameters, so that a gain or a limit that is written into the C as a constant is found.
Every parameter that the step reads goes to {1 / SPAN:g} and {SPAN:g} times the case's value, within what the header
allows, first alone, then with the others at random ends. Alone it also goes to NaN, u_max and a steepness p to inf,
and processor.delay to values outside its range: the C must reject what JAX rejects.

Closed loop: JAX's plant and sensors under the compiled C, beside the whole compiled by JAX in double precision. Signs
and converters amplify rounding, so the loops are compared only while rounding has not grown. {TWINS} twins of JAX's
loop measure that: in each, every state of plant and laws and the voltage is changed by one unit in the last place of
the precision, up or down at random, at every sample. The horizon ends before the first sample at which a twin is off by
more than {PARTED:g} of the rms of z - r, or of that of u, or at which the rotor is lost. Up to there, z of the C's loop
may at no sample be off by more than {closed_loop.TIMES:g} times what the farthest twin is off. With a horizon of
fewer than {LEAST} samples the row is not decisive.
"""
