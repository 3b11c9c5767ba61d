"""All files of an exported block, as text: header, source, test program, its vectors, Makefile and README."""

import numpy as np

from ambjax.codegen.c99.source import Origin, Writer, fixed, notes_of, order_of_work
from ambjax.codegen.c99.statements import c_constant, word
from ambjax.codegen.points import Points, Results, results, verification_points
from ambjax.codegen.program import PRECISIONS
from ambjax.codegen.trace import Trace
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference

# Points of the test program.
VECTORS = 100
# Names of the files, by their prefix.
NAMES = ("{p}.h", "{p}.c", "{p}_test.c", "{p}_vectors.h", "Makefile", "README.md")
# Tolerance between the C and JAX: units in the last place (double), relative (float).
ULPS, SHARE = 4, 1e-5


def files_of_trace(traced: Trace, prefix: str, origin: Origin) -> dict[str, str]:
    """Return the text of each file of a traced block by name."""
    writer, at = Writer(traced, prefix, origin), verification_points(traced, VECTORS, seed=1)
    vectors = writer.filled("vectors.h", f"{prefix}_vectors.h", rows=_rows(writer, at, results(traced, at)))
    makefile = writer.filled("Makefile", "Makefile")
    texts = (writer.header(), writer.source(), _test(writer), vectors, makefile, _readme(writer))
    return dict(zip((name.format(p=prefix) for name in NAMES), texts, strict=True))


def tolerance(precision: str) -> tuple[float, float]:
    """Return the relative tolerance between the C and JAX, and the absolute one near 0."""
    kind = np.finfo(PRECISIONS[precision])
    share = SHARE if precision == "float" else ULPS * float(kind.eps) / 2
    return share, float(kind.tiny) * 1e4


def _rows(writer: Writer, at: Points, given: Results) -> str:
    t, rows = writer.trace, []
    states = [x.name for x, _ in t.state]
    for n in range(at.started.size):
        lines = _initialisers(writer, "before", states, at.state[:, n])
        lines.append(f".before.started = {int(at.started[n])}u")
        lines += _initialisers(writer, "input", list(t.block.inputs), at.inputs[:, n])
        lines += _initialisers(writer, "after", states, given.state[:, n])
        lines.append(f".after.started = {int(given.started[n])}u")
        lines += _initialisers(writer, "output", list(t.block.outputs), given.outputs[:, n])
        rows.append("    {" + ", ".join([*lines, f".status = {int(given.bits[n])}u"]) + "}")
    return ",\n".join(rows)


def _initialisers(writer: Writer, struct: str, names: list[str], values: np.ndarray) -> list[str]:
    texts = [c_constant(v, writer.trace.precision) for v in values]
    return [f".{struct}.{word(name)} = {text}" for name, text in zip(names, texts, strict=True)]


def _test(writer: Writer) -> str:
    t, zero, nan = writer.trace, *(c_constant(x, writer.trace.precision) for x in (0, np.nan))
    share, small = (c_constant(x, t.precision) for x in tolerance(t.precision))
    names = [("state", "after", x) for x, _ in t.state] + [("output", "output", x) for x, _ in t.outputs]
    checks = [f"wrong += differs({struct}.{word(x.name)}, one->{there}.{word(x.name)});" for struct, there, x in names]
    inputs = list(enumerate(t.block.inputs))
    fields = "\n".join(f"    case {k}:\n        input.{x} = {nan};\n        break;" for k, x in inputs)
    zeros = "\n".join(f"    input.{name} = {zero};" for _, name in inputs)
    fault = {
        "faults": "\n".join(f"    faults += refused(&state, {k});" for k, name in inputs if name in t.read),
        "step": writer.filled("step_with_nan.c", "", fields=fields, zeros=zeros),
        "finite": "".join(f" || !isfinite(output.{word(x.name)})" for x, _ in t.outputs),
    }
    kind = "block_"
    if t.block.noun == "controller":
        kind, fault = "", fault | _refusal(writer)
    return writer.filled(
        "test.c",
        f"{writer.prefix}_test.c",
        abs="fabsf" if t.precision == "float" else "fabs",
        share=share,
        small=small,
        checks="\n".join(f"        {line}" for line in checks),
        **{name: writer.filled(f"{kind}{name}.c", "", **fault) for name in ("fault_test", "start_test")},
    )


def _refusal(writer: Writer) -> dict[str, object]:
    """Return the texts of the test program that depend on whether a controller has a guard."""
    p, guard = writer.prefix, any(x.name == "watch.left" for x, _ in writer.trace.state)
    unseen = f"(status & {p}_REFUSED) == 0u || isnan(output.u) || ((status & {p}_SAFE) != 0u && differs(output.u, 0))"
    if not guard:
        unseen = f"(status & {p}_FAILED) == 0u || differs(output.u, u) || differs(state->last.u, u)"
    effect = "refused" if guard else "accepted and make a law fail"
    return {"readings": len(Measurement._fields), "effect": effect, "unseen": unseen}


def _readme(writer: Writer) -> str:
    t, p = writer.trace, writer.prefix
    controller = t.block.noun == "controller"
    given = {name: "reference_" if name in Reference._fields else "read_" for name in t.block.inputs if name in t.read}
    read = {name: f"{start if controller else 'input_'}{name}" for name, start in given.items()}
    command = getattr(t.block, "commands", "voltage")
    written_ = {command: "u"} if controller else {name: name for name in t.block.outputs}
    bits = ("SAFE", "FAILED", "INVALID") if controller else ("INVALID", "TOUCHED", "DIVERGED")
    return writer.filled(
        "README.md",
        "README.md",
        case=writer.origin.case,
        noun=t.block.noun,
        numbers="gains" if controller else "numbers",
        cascade="\n".join(f"- {line}" for line in writer.origin.parts),
        notes="\n".join(order_of_work(t) if controller else notes_of(t)),
        fixed="\n".join([*fixed(t), "", ""]) if controller else "",
        yours="\n".join(f"{p}_real {source}(void);" for source in read.values()),
        reads="\n".join(f"    input.{name} = {source}();" for name, source in read.items()),
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
