"""The model description of an FMU: names, units, start values and value references, as XML of FMI 2.0 or 3.0."""

import hashlib
import importlib.resources
import math
import re
import uuid
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from ambjax._version import __version__
from ambjax.codegen.block import UNREAD, Number
from ambjax.codegen.trace import Trace

STATUS = "status"


class Variable(NamedTuple):
    """A variable of an FMU, with the attributes of the FMI standard.

    - `reference`: its value reference.
    - `start`: its start value; None for a variable that the FMU computes.
    - `least`, `most`: smallest and largest value, which the FMU checks; None: not bounded.
    - `whole`: whether it is an integer.
    """

    name: str
    reference: int
    causality: str
    variability: str
    unit: str
    description: str
    start: float | None = None
    least: float | None = None
    most: float | None = None
    whole: bool = False


def variables(traced: Trace) -> list[Variable]:
    """Return the variables of an exported block, except inputs and parameters that it does not read."""
    outputs, states = ([x for x, _ in group] for group in (traced.outputs, traced.state))
    groups: tuple[tuple[Sequence[Number], str, str], ...] = (
        (traced.inputs, "input", "discrete"),
        (outputs, "output", "discrete"),
        (traced.parameters, "parameter", "tunable"),
        (states, "local", "discrete"),
    )
    found, reference = [Variable("time", 0, "independent", "continuous", "s", "simulation time")], 1
    for numbers, causality, variability in groups:
        for x in numbers:
            unread = x.allowed == UNREAD or (causality == "input" and x.name not in traced.read)
            start = x.value if causality in ("input", "parameter") else None
            name = f"state.{x.name}" if causality == "local" else x.name
            words = f"{x.doc}; {x.allowed}" if causality == "parameter" and x.allowed else x.doc
            if not unread:
                ends = (None if math.isinf(x.least) else x.least, None if x.infinite or math.isinf(x.most) else x.most)
                found.append(Variable(name, reference, causality, variability, x.unit, words, start, *ends))
            reference += 1
    bits = "; ".join(f"{1 << k}: {traced.block.bits[name]}" for k, (name, _) in enumerate(traced.bits))
    return [*found, Variable(STATUS, reference, "output", "discrete", "", bits, whole=True)]


def token(traced: Trace, identifier: str, files: dict[str, str]) -> str:
    """Return the GUID of an FMU, a digest of its identifier, block and sources. `files`: their texts by name."""
    text = "\n".join([identifier, traced.block.noun, *(files[name] for name in sorted(files))])
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f"{{{uuid.UUID(digest[:32])}}}"


def filled(name: str, **values: object) -> str:
    """Return a file of this folder with its names in braces replaced."""
    path = importlib.resources.files("ambjax.codegen.fmi") / name
    return path.read_text(encoding="utf-8").format(**values)


def description(traced: Trace, identifier: str, case: str, guid: str, sources: list[str], version: int) -> str:
    """Return the text of modelDescription.xml. `case`: name of the case. `sources`: names of the C files."""
    old, period = version == 2, traced.block.period
    words = f"{traced.block.noun} of case {case}: one sample per communication step"
    head = f"modelName={quoteattr(f'{identifier} ({traced.block.noun})')} description={quoteattr(words)}"
    head += f" generationTool={quoteattr(f'ambjax {__version__}')}"
    found = variables(traced)[int(old) :]  # time is no variable of FMI 2.0
    outputs = [(index, x.reference) for index, x in enumerate(found, 1) if x.causality == "output"]

    def unknowns(tag: str) -> str:
        rows = (f'Unknown index="{index}"' if old else f'{tag} valueReference="{ref}"' for index, ref in outputs)
        return "".join(f"<{row}/>" for row in rows)

    return filled(
        f"modelDescription{version}.xml",
        guid=quoteattr(guid),
        head=head,
        identifier=identifier,
        period=period,
        end=1000 * period,
        files="".join(f"<File name={quoteattr(name)}/>" for name in sources),
        units="\n".join(_units(found)),
        variables="\n".join(f"    {_variable(x, old)}" for x in found),
        outputs=unknowns("Output"),
        unknowns=unknowns("InitialUnknown"),
    )


def _variable(x: Variable, old: bool) -> str:
    """Return the element of a variable. `old`: of FMI 2.0, which has no infinity; 1e300 stands for it."""
    numbers = f" unit={quoteattr(x.unit)}" if x.unit else ""
    for name, value in (("min", x.least), ("max", x.most), ("start", x.start)):
        if value is not None:
            text = repr(float(value)) if math.isfinite(value) else "-" * (value < 0) + ("1e300" if old else "INF")
            numbers += f' {name}="{text}"'
    common = (
        f'name={quoteattr(x.name)} valueReference="{x.reference}" causality="{x.causality}" '
        f'variability="{x.variability}" description={quoteattr(x.description)}'
    )
    if old:
        return f"<ScalarVariable {common}><{'Integer' if x.whole else 'Real'}{numbers}/></ScalarVariable>"
    return f"<{'UInt32' if x.whole else 'Float64'} {common}{numbers}/>"


def _units(found: list[Variable]) -> list[str]:
    rows = []
    for unit in sorted({x.unit for x in found if x.unit}):
        powers = exponents(unit) or {}
        base = "".join(f' {name}="{power}"' for name, power in powers.items())
        rows.append(f"    <Unit name={quoteattr(unit)}><BaseUnit{base}/></Unit>")
    return ["  <UnitDefinitions>", *rows, "  </UnitDefinitions>"]


def build_description(identifier: str, sources: list[str]) -> str:
    """Return the text of buildDescription.xml of FMI 3.0, which tells a tool how to compile the sources."""
    files = "\n      ".join(f'<SourceFile name="{name}"/>' for name in sources)
    return filled("buildDescription.xml", identifier=identifier, files=files)


# Exponents of the base units in each derived unit.
DERIVED = {
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Hz": {"s": -1},
    "W": {"kg": 1, "m": 2, "s": -3},
    "rad": {"rad": 1},
}
BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
# Units without a dimension.
COUNTS = ("", "1", "samples", "turns")


def exponents(unit: str) -> dict[str, int] | None:
    """Return the exponents of the base units in a unit, or None for an unknown unit.

    Example: {"m": -2, "A": 2} for "A^2/m^2". A factor after a "/" is in the denominator.
    """
    total: Counter[str] = Counter()
    for k, part in enumerate(unit.split("/")):
        for factor in part.split():
            found = re.fullmatch(r"([A-Za-z]+|1)(?:\^(-?\d+))?", factor)
            if found is None:
                return None
            name, power = found[1], int(found[2] or 1) * (-1 if k else 1)
            if name in COUNTS:
                continue
            if name not in DERIVED and name not in BASE:
                return None
            for base, exponent in DERIVED.get(name, {name: 1}).items():
                total[base] += power * exponent
    return {base: total[base] for base in BASE if total[base]}
