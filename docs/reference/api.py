"""The Python API: the public names, and every module by layer."""

import inspect
from typing import Any

import ambjax
from ambjax import actuators, ensemble, extend, laws, linear, paper, plants, sensors, signals, solvers, theorem
from reference.layers import ROOT, layers
from reference.markdown import code, escaped, first_paragraph, table

PUBLIC = {
    "ambjax": (ambjax, "Cases, simulation, tuning and export."),
    "ambjax.laws": (laws, "Laws by stage, and schedules of gains."),
    "ambjax.signals": (signals, "References, loads and disturbances."),
    "ambjax.plants": (plants, "Bearings, coils, iron and stops."),
    "ambjax.sensors": (sensors, "Sensors, runout and faults."),
    "ambjax.actuators": (actuators, "Amplifiers and limits of coils."),
    "ambjax.solvers": (solvers, "Integration methods."),
    "ambjax.ensemble": (ensemble, "Ensembles."),
    "ambjax.linear": (linear, "Linear analysis of the loop."),
    "ambjax.theorem": (theorem, "Theorem 1 along a run."),
    "ambjax.paper": (paper, "The simulation study of the paper."),
    "ambjax.extend": (extend, "Names for custom laws, plants and metrics."),
}
# Names without a docstring of their own.
CONSTANTS = {
    "INPUTS": "inputs of a linearised loop, in order",
    "OUTPUTS": "outputs of a linearised loop, in order",
    "NOISY": "readings with the paper's noise and a finite supply",
    "READINGS": "interpretations of the paper's parameters",
    "GAINS": "open lower and upper bound of every gain",
    "Scalar": "a number or an array: the type of a leaf",
    "TWO_OVER_PI": "2/pi, the factor of the smooth sign",
    "__version__": "version of the package",
}


def pages() -> dict[str, str]:
    """Return the page of public names and one page for each layer."""
    names = [(package, layer) for package, order in layers().items() for layer in order.split()]
    found = {f"{package}.{layer}": modules(package, layer) for package, layer in names}
    made = {f"api-{layer}.rst": _layer(layer, files) for layer, files in found.items() if files}
    return {"api.md": _public(sorted(made))} | made


def modules(package: str, layer: str) -> list[str]:
    """Return the dotted names of the modules of a layer, the layer first; none for a package's own files."""
    path = ROOT / package / layer
    if layer.startswith("_"):
        return []
    if not path.is_dir():
        return [f"{package}.{layer}"]
    files = sorted(file.relative_to(path).with_suffix("") for file in path.rglob("*.py") if file.stem != "__init__")
    folders = {file.parent for file in files if file.parent.parts}
    inner = [".".join(name.parts) for name in sorted([*files, *folders])]
    return [f"{package}.{layer}", *(f"{package}.{layer}.{name}" for name in inner)]


def _public(layer_pages: list[str]) -> str:
    lines = [
        "# Python API",
        "",
        "Shapes are those of one member; `vmap` and `ambjax.ensemble.run_ensemble` add the axis of members. All units "
        "are SI.",
        "",
    ]
    for name, (module, words) in PUBLIC.items():
        rows = [
            (_link(getattr(module, one), one), escaped(_says(getattr(module, one), one)))
            for one in module.__all__
            if not one.startswith("_")
        ]
        lines += [f"## `{name}`", "", words, "", *table(("name", "meaning"), rows, "keys")]
    lines += ["## Modules by layer", "", "```{toctree}", ":maxdepth: 1", ""]
    return "\n".join([*lines, *(page.removesuffix(".rst") for page in layer_pages), "```", ""])


def _link(thing: Any, name: str) -> str:
    """Return a link to the description of a public name; plain code unless it is a class, function or module."""
    if inspect.ismodule(thing):
        return f"{{py:mod}}`{name} <{thing.__name__}>`"
    if getattr(thing, "__module__", "").startswith("ambjax") and hasattr(thing, "__qualname__"):
        role = "class" if inspect.isclass(thing) else "func"
        return f"{{py:{role}}}`{name} <{thing.__module__}.{thing.__qualname__}>`"
    return code(name)


def _says(thing: Any, name: str) -> str:
    """Return the first paragraph of the docstring of a name; for a constant, its meaning and its value."""
    if name not in CONSTANTS:
        return f"{thing:g}" if isinstance(thing, float) else first_paragraph(thing)
    shown = f"{thing:g}" if isinstance(thing, float) else ", ".join(map(str, thing)) if isinstance(thing, tuple) else ""
    return f"{CONSTANTS[name]}: {shown}" if shown else CONSTANTS[name]


def _layer(layer: str, found: list[str]) -> str:
    lines = [layer, "=" * len(layer), ""]
    for module in found:
        head = [] if module == layer else [module, "-" * len(module), ""]
        lines += [*head, f".. automodule:: {module}", ""]
    return "\n".join(lines)
