"""The model description of an FMU: names, units, start values and value references, as XML of FMI 2.0 or 3.0."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from ambjax._version import __version__
from ambjax.codegen.fmi.si_units import exponents
from ambjax.codegen.numbering import UNREAD, Number
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
    """Return the variables of an exported block, except inputs and parameters that it does not read.

    Their value references are those of fmu_core.h: time, inputs, outputs, parameters, states, status.
    """
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
    return "{" + "-".join([digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32]]) + "}"


def description(traced: Trace, identifier: str, case: str, guid: str, sources: list[str], version: int) -> str:
    """Return the text of modelDescription.xml.

    - `case`: name of the case.
    - `sources`: names of the C files.
    - `version`: of FMI, 2 or 3.
    """
    words = f"{traced.block.noun} of case {case}: one sample per communication step"
    lines = _three(traced, identifier, guid) if version == 3 else _two(traced, identifier, guid, sources)
    head = f" modelName={quoteattr(f'{identifier} ({traced.block.noun})')} description={quoteattr(words)}"
    tool = f" generationTool={quoteattr(f'ambjax {__version__}')}"
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + "\n".join(lines).replace("@HEAD@", head + tool) + "\n"


def _units(found: list[Variable]) -> list[str]:
    """Return the lines that define the units in base units of SI."""
    rows = []
    for unit in sorted({x.unit for x in found if x.unit}):
        powers = exponents(unit) or {}
        base = "".join(f' {name}="{power}"' for name, power in powers.items())
        rows.append(f"    <Unit name={quoteattr(unit)}><BaseUnit{base}/></Unit>")
    return ["  <UnitDefinitions>", *rows, "  </UnitDefinitions>"]


def _experiment(traced: Trace) -> str:
    """Return the line of the default experiment: 1,000 sample periods."""
    period = traced.block.period
    return f'  <DefaultExperiment startTime="0" stopTime="{1000 * period!r}" stepSize="{period!r}"/>'


def _number(x: float, version: int) -> str:
    """Return a number as text of XML Schema. FMI 2.0 has no infinity: 1e300 stands for it."""
    if abs(x) == float("inf"):
        return ("-" if x < 0 else "") + ("INF" if version == 3 else "1e300")
    return repr(float(x))


def _values(x: Variable, version: int) -> str:
    """Return the attributes of a variable that are numbers: its bounds and its start value."""
    given = (("min", x.least), ("max", x.most), ("start", x.start))
    return "".join(f' {name}="{_number(value, version)}"' for name, value in given if value is not None)


def _three(traced: Trace, identifier: str, guid: str) -> Iterator[str]:
    """Yield the lines of the description for FMI 3.0; `description` fills in @HEAD@."""
    found, period = variables(traced), traced.block.period
    yield f'<fmiModelDescription fmiVersion="3.0" instantiationToken={quoteattr(guid)}@HEAD@>'
    yield (
        f'  <CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="false" '
        f'fixedInternalStepSize="{period!r}" canGetAndSetFMUState="true" canSerializeFMUState="false"/>'
    )
    yield from _units(found)
    yield '  <LogCategories><Category name="logStatusError"/></LogCategories>'
    yield _experiment(traced)
    yield "  <ModelVariables>"
    for x in found:
        unit = f" unit={quoteattr(x.unit)}" if x.unit else ""
        kind = "UInt32" if x.whole else "Float64"
        yield (
            f'    <{kind} name={quoteattr(x.name)} valueReference="{x.reference}" causality="{x.causality}" '
            f'variability="{x.variability}" description={quoteattr(x.description)}{unit}{_values(x, 3)}/>'
        )
    yield "  </ModelVariables>"
    yield "  <ModelStructure>"
    yield from (f'    <Output valueReference="{x.reference}"/>' for x in found if x.causality == "output")
    yield from (f'    <InitialUnknown valueReference="{x.reference}"/>' for x in found if x.causality == "output")
    yield "  </ModelStructure>"
    yield "</fmiModelDescription>"


def _two(traced: Trace, identifier: str, guid: str, sources: list[str]) -> Iterator[str]:
    """Yield the lines of the description for FMI 2.0; `description` fills in @HEAD@."""
    found = [x for x in variables(traced) if x.causality != "independent"]
    yield (
        f'<fmiModelDescription fmiVersion="2.0" guid={quoteattr(guid)}@HEAD@ '
        'variableNamingConvention="structured" numberOfEventIndicators="0">'
    )
    yield (
        f'  <CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="false" '
        'canInterpolateInputs="false" maxOutputDerivativeOrder="0" canGetAndSetFMUstate="true" '
        'canSerializeFMUstate="false">'
    )
    yield f"    <SourceFiles>{''.join(f'<File name={quoteattr(name)}/>' for name in sources)}</SourceFiles>"
    yield "  </CoSimulation>"
    yield from _units(found)
    yield '  <LogCategories><Category name="logStatusError"/></LogCategories>'
    yield _experiment(traced)
    yield "  <ModelVariables>"
    for x in found:
        unit = f" unit={quoteattr(x.unit)}" if x.unit else ""
        kind = f"<Integer{_values(x, 2)}/>" if x.whole else f"<Real{unit}{_values(x, 2)}/>"
        yield (
            f'    <ScalarVariable name={quoteattr(x.name)} valueReference="{x.reference}" causality="{x.causality}" '
            f'variability="{x.variability}" description={quoteattr(x.description)}>{kind}</ScalarVariable>'
        )
    yield "  </ModelVariables>"
    outputs = [k for k, x in enumerate(found, 1) if x.causality == "output"]
    yield "  <ModelStructure>"
    for tag in ("Outputs", "InitialUnknowns"):
        rows = "".join(f'<Unknown index="{k}"/>' for k in outputs)
        yield f"    <{tag}>{rows}</{tag}>"
    yield "  </ModelStructure>"
    yield "</fmiModelDescription>"


def build_description(identifier: str, sources: list[str]) -> str:
    """Return the text of buildDescription.xml of FMI 3.0, which tells a tool how to compile the sources.

    `sources`: names of the C files.
    """
    files = "".join(f'\n      <SourceFile name="{name}"/>' for name in sources)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">\n'
        f'  <BuildConfiguration modelIdentifier="{identifier}">\n    <SourceFileSet language="C99">{files}\n'
        "    </SourceFileSet>\n  </BuildConfiguration>\n</fmiBuildDescription>\n"
    )
