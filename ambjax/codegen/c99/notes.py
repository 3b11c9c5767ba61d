"""Texts about a block for the header and the README: order of operations, what the export fixes, what a step checks."""

import importlib.resources
import tomllib

import numpy as np

from ambjax.codegen.block import UNREAD
from ambjax.codegen.c99.statements import word
from ambjax.codegen.interface import INPUTS
from ambjax.codegen.trace import Trace


def template(name: str) -> str:
    """Return a file of the folder `templates`."""
    return (importlib.resources.files("ambjax.codegen.c99") / "templates" / name).read_text(encoding="utf-8")


def notes_of(trace: Trace) -> list[str]:
    """Return lines on the order of operations in a sample, on what the export fixes, and on what a step checks."""
    if trace.block.noun == "controller":
        return [*order_of_work(trace), "", *fixed(trace)]
    texts = tomllib.loads(template("about.toml"))
    command = texts[trace.block.noun]["command"]
    return texts["motion"]["notes"].format(period=f"{trace.block.period:g}", command=command).splitlines()


def order_of_work(trace: Trace) -> list[str]:
    """Return lines on the order of operations of a controller in every sample."""
    block = trace.block
    processor = block.parameters.controller.timing
    delay, unit = processor.delay, block.outputs["u"][0]
    lines = [
        f"Every T = {block.period:g} s: read the sensors, call the step at once, and apply output->u",
        f"{delay:g} T after the reading, until the u of the next sample replaces it; before the first u, apply 0 "
        f"{unit}.",
    ]
    ahead = f"{processor.ahead:g} T after the reading" if processor.predicts else "of the reading"
    lines.append(f"The reference is that of the instant {ahead}.")
    model = block.parameters.controller.model
    rest = f"R i_0 = {model.R * model.i_0:.6g} V" if unit == "V" else f"i_0 = {model.i_0:.6g} A"
    return [
        *lines,
        "With two coils, coil 1 pulls towards z > 0, coil 2 towards z < 0, and i = (i_1 - i_2)/2. With",
        f"{rest}, coil 1 gets {rest.partition(' =')[0]} + u, and coil 2 gets {rest.partition(' =')[0]} - u.",
    ]


def fixed(trace: Trace) -> list[str]:
    """Return lines on what the export of a controller fixes, what params contains, and what a step checks."""
    parameters = {x.name: x for x in trace.parameters}
    unit = trace.block.outputs["u"][0]
    u_max, delay = parameters["limits.u_max"].value, parameters["processor.delay"].allowed
    lines = [
        f"Fixed at export: T = {trace.block.period:g} s, the laws, which signs are set-valued, and whether the",
        "delay is predicted. Export again to change one of these. Any value in params may change between two steps.",
        f"params->limits.u_max: u is {'not limited' if np.isinf(u_max) else f'limited to +-{u_max:g} {unit}'}.",
    ]
    if samples := parameters.get("processor.guard.samples"):
        time = samples.value * trace.block.period
        lines += [
            f"params->processor.guard: a reading is refused beyond {_ends(trace, 'processor.guard')}, or if it",
            "cannot follow from the last one. The model's prediction replaces it for at most",
            f"{samples.value:g} samples in a row ({time:g} s); then u = 0. After an invalid or a failed step there is",
            "no prediction: a reading within its limit is accepted, and a refused one gives u = 0.",
        ]
    else:
        lines += ["No guard: readings are not checked."]
    lines += [f"params->limits: a step is invalid beyond {_ends(trace, 'limits')}."]
    if delay == UNREAD:
        lines += ["params->processor.delay is not read: nothing is predicted."]
    else:
        lines += [f"params->processor.delay: {delay}, else every step is invalid; for a longer one export again."]
    for x in (x for x in trace.parameters if x.name.endswith("notch.rotor.speed")):
        rates = word(x.name).removesuffix(".speed")
        lines += [
            f"params->{word(x.name)}: speed of the notch, rpm. Before each step, set it to the measured speed, and",
            f"all rates in params->{rates} to 0. Without this, the notch has the speed of the case, whose time",
            "begins at the first step whose readings are all accepted.",
        ]
    for x in (x for x in trace.parameters if "export again" in x.allowed):
        lines += [f"params->{word(x.name)}: finite, else every step is invalid."]
    return [
        *lines,
        "No other parameter is checked. If a law returns a value that is not finite, the bit FAILED is set.",
        "An invalid or failed step holds u. There is no timeout: the caller decides for how many steps u may be held.",
    ]


def _ends(trace: Trace, of: str) -> str:
    """Return the limits of the inputs in the struct `of` of params, such as "|z| = 0.001 m"."""
    parameters = {x.name: x for x in trace.parameters}
    found = {name: parameters.get(f"{of}.{name}") for name in INPUTS if name in trace.read}
    return ", ".join(f"|{name}| = {x.value:g} {x.unit}" for name, x in found.items() if x)
