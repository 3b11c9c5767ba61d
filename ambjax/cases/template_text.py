"""Annotated case files, from the folder `templates`. What paper.toml has in braces comes from the code's records."""

import dataclasses
import importlib.resources
import math

from ambjax.cases import tune_table
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import PLANTS
from ambjax.cases.scenario_tables import SIGNALS
from ambjax.ensemble.design import DESIGNS
from ambjax.paper.readings import PULSE, REFERENCE, TABLE_2
from ambjax.world.plant import Plant

# Templates of bearings other than the paper's, and of whole machines, by name.
MACHINES = ("rig", "bearing", "machine", "machine-flexible", "machine-ufu")


def _lines(kind: type, values: object) -> list[str]:
    lines = []
    for field in dataclasses.fields(kind):
        value = getattr(values, field.name)
        if value is None:
            continue
        unit = f"{field.metadata['unit']}; " if field.metadata["unit"] else ""
        lines.append(_with_note(f"{field.name} = {_number(value)}", unit + field.metadata["doc"]))
    return lines


def _law(kind: type) -> list[str]:
    """Return the lines of a law. If its steepness p scales with the plant, the line of p is a comment."""
    law = kind()
    scaled, lines = law.size(Plant()) is not None, _lines(kind, law)
    return [
        line.replace("p =", "# p =").replace("  #", "#", 1) if scaled and line.startswith("p = ") else line
        for line in lines
    ]


def _others(kinds: dict[str, type]) -> str:
    return ", ".join(f'"{kind}"' for kind in list(kinds)[1:])


def _with_note(text: str, comment: str) -> str:
    return f"{text:<29} # {comment}"


def _tune() -> dict[str, str]:
    """Return the parts of [tune]: the line of each default, a comment, and the numbers of the other comments."""
    defaults = {f"weights.{name}": field for name, field in tune_table.WEIGHTS.items()}
    defaults |= tune_table.NUMBERS | tune_table.BUDGET | {"limits.survival": tune_table.SURVIVAL}
    lines = {name: _with_note(f"# {name} = {x.default!r}", x.metadata["doc"]) for name, x in defaults.items()}
    shares = {
        "voltage": 100 * tune_table.VOLTAGE_SHARE,
        "settling": 100 * tune_table.SETTLING_BAND,
        "means": tune_table.MEAN_MARGIN,
        "maxima": tune_table.WORST_MARGIN,
        "loops": tune_table.LOOP_MARGIN,
    }
    return {f"tune.{name}": text for name, text in (lines | {name: f"{x:g}" for name, x in shares.items()}).items()}


def _number(value: float) -> str:
    text = repr(float(value)) if math.isfinite(value) else "inf"
    return text if "." in text or "e" in text or text == "inf" else text + ".0"


def template(scenario: str) -> str:
    """Return a case file with comments, as `ambjax template` prints it. Raises ValueError for another name.

    - "tracking", "regulation": the scenarios of the paper with repaired gains, and every key of a case file.
    - "rig", "bearing": a laboratory bearing, and a bearing from a data sheet, both on a processor.
    - "machine", "machine-flexible", "machine-ufu": whole machines with a rigid or a flexible rotor.

        pathlib.Path("my.toml").write_text(ambjax.template("rig"))
    """
    known = ["tracking", "regulation", *MACHINES]
    if scenario not in known:
        raise ValueError(f"template = {scenario!r}: it must be one of {', '.join(known)}.")
    home = importlib.resources.files("ambjax.cases") / "templates"
    if scenario in MACHINES:
        return (home / f"{scenario}.toml").read_text(encoding="utf-8")
    text = (home / "paper.toml").read_text(encoding="utf-8")
    for name, own in _generated(scenario == "tracking").items():
        text = text.replace(f"{{{name}}}", own)
    return text


def _generated(tracking: bool) -> dict[str, str]:
    """Return the parts of paper.toml that come from the code, by the name in braces that they replace."""
    laws = []
    for stage, kinds in KINDS.items():
        kind, law = next(iter(kinds.items()))
        head = (f"[controller.{stage}]", _with_note(f'kind = "{kind}"', f"or {_others(kinds)}"))
        laws.append("\n".join([*head, *_law(law)]))
    sine = ['kind = "sine"', *_lines(type(REFERENCE), REFERENCE)]
    return {
        "scenario": "tracking" if tracking else "regulation",
        "plants": _others(PLANTS),
        "plant": "\n".join(_lines(Plant, Plant())),
        "laws": "\n\n".join(laws),
        "signals": ", ".join(SIGNALS),
        "reference": "\n".join(sine if tracking else ['kind = "constant"', "value = 0.0                   # m"]),
        "pulse": "\n".join(_lines(type(PULSE), PULSE)),
        "paper_std": f"{TABLE_2.noise_std:.3e}",
        "designs": " or ".join(f'"{d}"' for d in list(DESIGNS)[1:]),
        **_tune(),
    }
