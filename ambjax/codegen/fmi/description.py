"""The model description of an FMU: names, units, start values and value references, as XML of FMI 2.0 or 3.0."""

import hashlib
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


class Form(NamedTuple):
    """What differs between the model descriptions of FMI 2.0 and FMI 3.0, with fields for str.format.

    - `root`: attributes of the root; `co_simulation`: the element of that name; `variable`: an element of a variable.
    - `kinds`: names of the elements of a real number and of an integer.
    - `unknowns`: the outputs and the initial unknowns, each from a template of the list and one of an output.
    - `infinity`: FMI 2.0 has no infinity; 1e300 stands for it.
    """

    root: str
    co_simulation: str
    variable: str
    kinds: tuple[str, str]
    unknowns: tuple[tuple[str, str], ...]
    infinity: str


FORMS = {
    2: Form(
        'fmiVersion="2.0" guid={guid} {head} variableNamingConvention="structured" numberOfEventIndicators="0"',
        '<CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="false" '
        'canInterpolateInputs="false" maxOutputDerivativeOrder="0" canGetAndSetFMUstate="true" '
        'canSerializeFMUstate="false">\n    <SourceFiles>{files}</SourceFiles>\n  </CoSimulation>',
        "<ScalarVariable {common}><{kind}{numbers}/></ScalarVariable>",
        ("Real", "Integer"),
        tuple((f"<{tag}>{{}}</{tag}>", '<Unknown index="{index}"/>') for tag in ("Outputs", "InitialUnknowns")),
        "1e300",
    ),
    3: Form(
        'fmiVersion="3.0" instantiationToken={guid} {head}',
        '<CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="false" '
        'fixedInternalStepSize="{period!r}" canGetAndSetFMUState="true" canSerializeFMUState="false"/>',
        "<{kind} {common}{numbers}/>",
        ("Float64", "UInt32"),
        tuple(("{}", f'<{tag} valueReference="{{reference}}"/>') for tag in ("Output", "InitialUnknown")),
        "INF",
    ),
}


def description(traced: Trace, identifier: str, case: str, guid: str, sources: list[str], version: int) -> str:
    """Return the text of modelDescription.xml. `case`: name of the case. `sources`: names of the C files."""
    form, period = FORMS[version], traced.block.period
    words = f"{traced.block.noun} of case {case}: one sample per communication step"
    head = f"modelName={quoteattr(f'{identifier} ({traced.block.noun})')} description={quoteattr(words)}"
    head += f" generationTool={quoteattr(f'ambjax {__version__}')}"
    files = "".join(f"<File name={quoteattr(name)}/>" for name in sources)
    found = variables(traced)[1 if version == 2 else 0 :]  # time is no variable of FMI 2.0
    outputs = [(index, x.reference) for index, x in enumerate(found, 1) if x.causality == "output"]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<fmiModelDescription {form.root.format(guid=quoteattr(guid), head=head)}>",
        f"  {form.co_simulation.format(identifier=identifier, period=period, files=files)}",
        *_units(found),
        '  <LogCategories><Category name="logStatusError"/></LogCategories>',
        f'  <DefaultExperiment startTime="0" stopTime="{1000 * period!r}" stepSize="{period!r}"/>',
        "  <ModelVariables>",
        *(f"    {_variable(x, form)}" for x in found),
        "  </ModelVariables>",
        "  <ModelStructure>",
    ]
    for listed, one in form.unknowns:
        rows = "".join(one.format(index=index, reference=reference) for index, reference in outputs)
        lines.append(f"    {listed.format(rows)}")
    return "\n".join([*lines, "  </ModelStructure>", "</fmiModelDescription>", ""])


def _variable(x: Variable, form: Form) -> str:
    numbers = f" unit={quoteattr(x.unit)}" if x.unit else ""
    for name, value in (("min", x.least), ("max", x.most), ("start", x.start)):
        if value is not None:
            text = repr(float(value)) if math.isfinite(value) else "-" * (value < 0) + form.infinity
            numbers += f' {name}="{text}"'
    common = (
        f'name={quoteattr(x.name)} valueReference="{x.reference}" causality="{x.causality}" '
        f'variability="{x.variability}" description={quoteattr(x.description)}'
    )
    return form.variable.format(kind=form.kinds[x.whole], common=common, numbers=numbers)


def _units(found: list[Variable]) -> list[str]:
    rows = []
    for unit in sorted({x.unit for x in found if x.unit}):
        powers = exponents(unit) or {}
        base = "".join(f' {name}="{power}"' for name, power in powers.items())
        rows.append(f"    <Unit name={quoteattr(unit)}><BaseUnit{base}/></Unit>")
    return ["  <UnitDefinitions>", *rows, "  </UnitDefinitions>"]


def build_description(identifier: str, sources: list[str]) -> str:
    """Return the text of buildDescription.xml of FMI 3.0, which tells a tool how to compile the sources."""
    files = "".join(f'\n      <SourceFile name="{name}"/>' for name in sources)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{identifier}">\n    <SourceFileSet language="C99">{files}\n'
        "    </SourceFileSet>\n  </BuildConfiguration>\n</fmiBuildDescription>\n"
    )


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
