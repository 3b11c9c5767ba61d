"""All files of an exported controller, as text: header, source, test program, its vectors, Makefile and README."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np

from ambjax.control.schedule import schedules
from ambjax.export.controller import Controller
from ambjax.export.interface import INPUTS, OUTPUTS
from ambjax.export.points import Points, points
from ambjax.export.reference import Results, results
from ambjax.export.source import Origin, Writer, fixed, order_of_work
from ambjax.export.statements import PRECISIONS, literal, word
from ambjax.export.texts import MAKEFILE, MARK, README, TEST
from ambjax.export.trace import Trace, trace
from ambjax.world.sensor import Measurement

# Points of the test program.
VECTORS = 100
# Names of the files, by their prefix.
NAMES = ("{p}.h", "{p}.c", "{p}_test.c", "{p}_vectors.h", "Makefile", "README.md")
# Tolerance between the C and JAX: units in the last place (double), relative (float).
ULPS, SHARE = 4, 1e-5


def files(controller: Controller, precision: str, prefix: str, origin: Origin) -> dict[str, str]:
    """Return the text of each file by name. Raises ValueError for a law that scalar C cannot express."""
    traced = trace(controller, precision)
    return written(traced, prefix, origin)


def written(traced: Trace, prefix: str, origin: Origin) -> dict[str, str]:
    """Return the files of a traced controller, texts by name."""
    writer, at = Writer(traced, prefix, origin), points(traced, VECTORS, seed=1)
    vectors, makefile = _vectors(writer, at, results(traced, at)), MAKEFILE.format(p=prefix)
    texts = (writer.header(), writer.source(), _test(writer), vectors, makefile, _readme(writer))
    return dict(zip((name.format(p=prefix) for name in NAMES), texts, strict=True))


def tolerance(precision: str) -> tuple[float, float]:
    """Return the relative tolerance between the C and JAX, and the absolute one near 0."""
    kind = np.finfo(PRECISIONS[precision])
    share = SHARE if precision == "float" else ULPS * float(kind.eps) / 2
    return share, float(kind.tiny) * 1e4


def _vectors(writer: Writer, at: Points, given: Results) -> str:
    p, t = writer.prefix, writer.trace
    rows = []
    for n in range(at.started.size):
        lines = _initialisers(writer, "before", [x.name for x, _ in t.state], at.state[:, n])
        lines.append(f".before.started = {int(at.started[n])}u")
        lines += _initialisers(writer, "input", list(INPUTS), at.inputs[:, n])
        lines += _initialisers(writer, "after", [x.name for x, _ in t.state], given.state[:, n])
        lines.append(f".after.started = {int(given.started[n])}u")
        lines += _initialisers(writer, "output", list(OUTPUTS), given.outputs[:, n])
        rows.append("    {" + ", ".join([*lines, f".status = {int(given.bits[n])}u"]) + "}")
    guard = f"{p.upper()}_VECTORS_H"
    return "\n".join(
        [
            writer.banner(f"{p}_vectors.h"),
            "",
            "/* Steps computed by JAX: state and input before, state and output after. Points are random, or at limits",
            " * and on both sides of the threshold of a comparison. */",
            "",
            f"#ifndef {guard}",
            f"#define {guard}",
            "",
            "#include <math.h>",
            "",
            f'#include "{p}.h"',
            "",
            "typedef struct {",
            *(f"    {p}_{kind} {name};" for kind, name in (("state", "before"), ("input", "input"))),
            *(f"    {p}_{kind} {name};" for kind, name in (("state", "after"), ("output", "output"))),
            "    uint32_t status;",
            f"}} {p}_vector;",
            "",
            f"static const {p}_vector {p}_vectors[] = {{",
            ",\n".join(rows),
            "};",
            "",
            "#endif",
            "",
        ]
    )


def _initialisers(writer: Writer, struct: str, names: list[str], values: np.ndarray) -> list[str]:
    texts = [literal(v, writer.trace.precision) for v in values]
    return [f".{struct}.{word(name)} = {text}" for name, text in zip(names, texts, strict=True)]


def _test(writer: Writer) -> str:
    p, t = writer.prefix, writer.trace
    share, small = tolerance(t.precision)
    guard = any(x.name == "watch.left" for x, _ in t.state)
    unseen = f"(status & {p}_REFUSED) == 0u || isnan(output.u) || ((status & {p}_SAFE) != 0u && differs(output.u, 0))"
    if not guard:
        unseen = f"(status & {p}_FAILED) == 0u || differs(output.u, u) || differs(state->last.u, u)"
    abs_ = "fabsf" if t.precision == "float" else "fabs"
    checks = []
    for struct, there, names in (
        ("state", "after", [x.name for x, _ in t.state]),
        ("output", "output", [x.name for x, _ in t.outputs]),
    ):
        checks += [f"        wrong += differs({struct}.{word(x)}, one->{there}.{word(x)});" for x in names]
    return TEST.format(
        banner=writer.banner(f"{p}_test.c"),
        p=p,
        P=p.upper(),
        abs=abs_,
        readings=len(Measurement._fields),
        effect="refused" if guard else "accepted and make a law fail",
        unseen=unseen,
        share=literal(share, t.precision),
        small=literal(small, t.precision),
        checks="\n".join(checks),
        faults="\n".join(f"    faults += refused(&state, {k});" for k, name in enumerate(INPUTS) if name in t.read),
        fields="\n".join(
            f"    case {k}:\n        input.{name} = {literal(np.nan, t.precision)};\n        break;"
            for k, name in enumerate(INPUTS)
        ),
        zeros="\n".join(f"    input.{name} = {literal(0, t.precision)};" for name in INPUTS),
    )


def _readme(writer: Writer) -> str:
    t, p = writer.trace, writer.prefix
    return README.format(
        p=p,
        P=p.upper(),
        mark=MARK.format(p=p),
        case=writer.origin.case,
        cascade="\n".join(f"- {line}" for line in writer.origin.cascade),
        order="\n".join(order_of_work(t)),
        fixed="\n".join(fixed(t)),
        yours="\n".join(f"{p}_real {_source(name)}(void);" for name in INPUTS if name in t.read),
        reads="\n".join(f"    input.{name} = {_source(name)}();" for name in INPUTS if name in t.read),
        flops=t.flops(),
        precision=t.precision,
        period=f"{t.controller.period:g}",
        ulps="a relative 1e-5" if t.precision == "float" else f"{ULPS} units in the last place",
    )


def _source(name: str) -> str:
    """Return the name of the function that reads an input in the README's example: read_z, reference_r_dot."""
    return f"{'reference' if name.startswith('r') else 'read'}_{name}"


def described(controller: Controller) -> list[str]:
    """Return the cascade in words: the law of each stage, and its signs without a boundary layer."""
    return list(_described(controller))


def _described(controller: Controller) -> Iterator[str]:
    cascade: Any = controller.parameters.controller
    for stage, law in zip(("observer", "position", "inversion", "current"), cascade.laws, strict=True):
        hard = [f.name for f in dataclasses.fields(law) if f.metadata.get("steepness") and getattr(law, f.name) is None]
        ends = "".join(f", {name} = inf (the sign itself)" for name in hard)
        over = "".join(f", {name} as a function of the {one.over}" for name, one in schedules(law).items())
        yield f"{stage}: {type(law).__name__}{ends}{over}"
    yield f"processor: {cascade.processor}"
