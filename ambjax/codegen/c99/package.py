"""All files of an exported block, as text: header, source, test program, its vectors, Makefile and README."""

import numpy as np

from ambjax.codegen.block import Block
from ambjax.codegen.c99.notes import fixed, notes_of, order_of_work
from ambjax.codegen.c99.source import Origin, Writer
from ambjax.codegen.c99.statements import c_constant, word
from ambjax.codegen.c99.texts import MARK, filled
from ambjax.codegen.points import Points, verification_points
from ambjax.codegen.program import PRECISIONS
from ambjax.codegen.reference import Results, results
from ambjax.codegen.trace import Trace, trace
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# Points of the test program.
VECTORS = 100
# Names of the files, by their prefix.
NAMES = ("{p}.h", "{p}.c", "{p}_test.c", "{p}_vectors.h", "Makefile", "README.md")
# Tolerance between the C and JAX: units in the last place (double), relative (float).
ULPS, SHARE = 4, 1e-5


def package_files(block: Block, precision: str, prefix: str, origin: Origin) -> dict[str, str]:
    """Return the text of each file by name. Raises ValueError for a law that scalar code cannot express."""
    traced = trace(block, precision)
    return files_of_trace(traced, prefix, origin)


def files_of_trace(traced: Trace, prefix: str, origin: Origin) -> dict[str, str]:
    """Return the files of a traced block, texts by name."""
    writer, at = Writer(traced, prefix, origin), verification_points(traced, VECTORS, seed=1)
    makefile = filled("Makefile", p=prefix, mark=MARK.format(p=prefix))
    vectors = _vectors(writer, at, results(traced, at))
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
        lines += _initialisers(writer, "input", list(t.block.inputs), at.inputs[:, n])
        lines += _initialisers(writer, "after", [x.name for x, _ in t.state], given.state[:, n])
        lines.append(f".after.started = {int(given.started[n])}u")
        lines += _initialisers(writer, "output", list(t.block.outputs), given.outputs[:, n])
        rows.append("    {" + ", ".join([*lines, f".status = {int(given.bits[n])}u"]) + "}")
    guard = f"{p.upper()}_VECTORS_H"
    return "\n".join(
        [
            writer.banner(f"{p}_vectors.h"),
            "",
            "/* Steps computed by JAX: state and input before, state and output after. Points are random, at limits,",
            " * or on both sides of the threshold of a comparison. */",
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
    texts = [c_constant(v, writer.trace.precision) for v in values]
    return [f".{struct}.{word(name)} = {text}" for name, text in zip(names, texts, strict=True)]


def _test(writer: Writer) -> str:
    p, t = writer.prefix, writer.trace
    share, small = tolerance(t.precision)
    checks = []
    for struct, there, names in (
        ("state", "after", [x.name for x, _ in t.state]),
        ("output", "output", [x.name for x, _ in t.outputs]),
    ):
        checks += [f"        wrong += differs({struct}.{word(x)}, one->{there}.{word(x)});" for x in names]
    inputs = list(t.block.inputs)
    fault = {
        "p": p,
        "faults": "\n".join(f"    faults += refused(&state, {k});" for k, name in enumerate(inputs) if name in t.read),
        "fields": "\n".join(
            f"    case {k}:\n        input.{name} = {c_constant(np.nan, t.precision)};\n        break;"
            for k, name in enumerate(inputs)
        ),
        "zeros": "\n".join(f"    input.{name} = {c_constant(0, t.precision)};" for name in inputs),
    }
    fault["step"] = filled("step_with_nan.c", **fault)
    texts = _controller_faults(writer, fault) if t.block.noun == "controller" else _block_faults(writer, fault)
    return filled(
        "test.c",
        banner=writer.banner(f"{p}_test.c"),
        p=p,
        P=p.upper(),
        abs="fabsf" if t.precision == "float" else "fabs",
        share=c_constant(share, t.precision),
        small=c_constant(small, t.precision),
        checks="\n".join(checks),
        fault_test=texts[0],
        start_test=texts[1],
    )


def _controller_faults(writer: Writer, fault: dict[str, str]) -> tuple[str, str]:
    """Return the parts of the test program for bad inputs and for the start of a controller."""
    p, t = writer.prefix, writer.trace
    guard = any(x.name == "watch.left" for x, _ in t.state)
    unseen = f"(status & {p}_REFUSED) == 0u || isnan(output.u) || ((status & {p}_SAFE) != 0u && differs(output.u, 0))"
    if not guard:
        unseen = f"(status & {p}_FAILED) == 0u || differs(output.u, u) || differs(state->last.u, u)"
    more = {
        "readings": len(Measurement._fields),
        "effect": "refused" if guard else "accepted and make a law fail",
        "unseen": unseen,
    }
    return filled("fault_test.c", **fault, **more), filled("start_test.c", **fault)


def _block_faults(writer: Writer, fault: dict[str, str]) -> tuple[str, str]:
    """Return the parts of the test program for bad inputs and for the start of a plant or a loop."""
    finite = "".join(f" || !isfinite(output.{word(x.name)})" for x, _ in writer.trace.outputs)
    return filled("block_fault_test.c", **fault, finite=finite), filled("block_start_test.c", **fault)


def _readme(writer: Writer) -> str:
    t, p = writer.trace, writer.prefix
    controller = t.block.noun == "controller"
    read = [name for name in t.block.inputs if name in t.read]
    source = _source if controller else "input_{}".format
    command = getattr(t.block, "commands", "voltage")
    written_ = {command: "u"} if controller else {name: name for name in t.block.outputs}
    bits = ("SAFE", "FAILED", "INVALID") if controller else ("INVALID", "TOUCHED", "DIVERGED")
    notes = order_of_work(t) if controller else notes_of(t)
    return filled(
        "README.md",
        p=p,
        P=p.upper(),
        mark=MARK.format(p=p),
        case=writer.origin.case,
        noun=t.block.noun,
        numbers="gains" if controller else "numbers",
        cascade="\n".join(f"- {line}" for line in writer.origin.parts),
        notes="\n".join(notes),
        fixed="\n".join([*fixed(t), "", ""]) if controller else "",
        yours="\n".join(f"{p}_real {source(name)}(void);" for name in read),
        reads="\n".join(f"    input.{name} = {source(name)}();" for name in read),
        writers="\n".join(f"void write_{name}({p}_real {port});" for name, port in written_.items()),
        writes="\n".join(f"    write_{name}(output.{port});" for name, port in written_.items()),
        faults=" | ".join(f"{p}_{bit}" for bit in bits),
        fault_note="SAFE: u is 0; FAILED, INVALID: the last u is held"
        if controller
        else "the rotor is lost, or an input or a parameter is invalid",
        flops=t.flops(),
        precision=t.precision,
        period=f"{t.block.period:g}",
        ulps="a relative difference of 1e-5" if t.precision == "float" else f"{ULPS} units in the last place",
    )


def _source(name: str) -> str:
    """Return the name of the function that reads an input in the README's example: read_z, reference_r_dot."""
    return f"{'reference' if name in Reference._fields else 'read'}_{name}"
