"""The page as one HTML file, with the loop as JavaScript, its data, the plotting library, the style and the scripts."""

import dataclasses
import html
import importlib.resources
import json
import math
import pathlib
import shlex
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ambjax.cases.reader import Case
from ambjax.codegen.javascript.script import PRELUDE
from ambjax.host.extensions import extra
from ambjax.page.case_text import TemplateLine, checked, editable_lines
from ambjax.page.loop_functions import COILS, SIGNALS, linear_script, loop_parameters, loop_script
from ambjax.page.sliders import GROUPS, SEED, Slider, changed, parameter_values, parameters, sliders
from ambjax.results.spread_runs import study_of
from ambjax.simulation.metrics import UNITS
from ambjax.simulation.trajectory import STATUSES
from ambjax.world.recorded import Recorded
from ambjax.world.scenario import SLOTS

# Name of the file.
NAME = "page.html"
# Number of members of the envelope.
MEMBERS = 64
# Script files of the web worker and of the page, in the order of execution.
WORKER = ("noise.js", "spectrum.js", "sensitivity.js", "worker.js")
PAGE = ("controls.js", "plots.js", "machine.js", "app.js")
BOKEH = "bokeh.min.js", "bokeh-api.min.js"


def page(case: Case, others: Sequence[Case] = (), path: str = "case.toml") -> str:
    """Return the page of a case as HTML.

    - `others`: cases that differ from it in numbers only; each becomes a preset.
    - `path`: name of the case file, for messages and for the tuning command on the page.

    Raises ValueError with a message of one line if the case has no processor or has a part that the page cannot
    compute, if one of `others` differs in structure, or if Bokeh is missing.
    """
    folder = pathlib.Path(extra("bokeh", "page").__file__).parent / "server" / "static" / "js"
    library = [(folder / name).read_text(encoding="utf-8") for name in BOKEH]
    worker, data = _computed(case, list(others), path)
    title = f"{case.name}: ambjax"
    scripts = "".join(f"<script>{text}</script>\n" for text in (*library, *map(_asset, PAGE)))
    blocks = [
        f"<style>{_asset('style.css')}</style>",
        _block("data", json.dumps(data, allow_nan=False)),
        _block("worker", json.dumps(worker)),
    ]
    shell = _asset("page.html").replace("{title}", html.escape(title)).replace("{name}", html.escape(case.name))
    head, body = shell.split("{scripts}")
    return head + "\n".join(blocks) + scripts + body


def pages(cases: Sequence[Case], paths: Sequence[str]) -> dict[str, str]:
    """Return the pages of several cases by file name: page.html, page-2.html, ...

    Cases that differ only in their numbers share a page. `paths`: names of the case files. Raises ValueError as
    `page` does.
    """
    groups: list[list[int]] = []
    for k, case in enumerate(cases):
        check_processor(case, paths[k])
        group = next((group for group in groups if _alike(cases[group[0]], case)), None)
        if group is None:
            groups.append(group := [])
        group.append(k)
    texts = [page(cases[first], [cases[k] for k in others], paths[first]) for first, *others in groups]
    return {NAME if k == 1 else NAME.replace(".", f"-{k}."): text for k, text in enumerate(texts, 1)}


def check_processor(case: Case, path: str) -> None:
    """Raise ValueError if the case has no processor. `path`: name of the case file, for the message."""
    if not case.cascade.sampled:
        advice = "Add the table [processor]."
        raise ValueError(f"{path}: the page runs a controller on a processor, and this case has none. {advice}")


def _block(name: str, text: str) -> str:
    """Return a script element with JSON, in which every "<" is escaped, so that no text can end the element."""
    safe = text.replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{safe}</script>\n'


def _asset(name: str) -> str:
    return (importlib.resources.files("ambjax.page") / "assets" / name).read_text(encoding="utf-8")


def _check_contents(case: Case, others: list[Case], path: str) -> None:
    """Raise ValueError for a signal from a file, a notch, and other cases that differ in more than numbers."""
    if case.cascade.notch is not None:
        why = "a page cannot contain a notch, whose gain depends on all numbers of the loop. Remove it."
        raise ValueError(f"{path}: [controller.notch]: {why}")
    for slot in SLOTS:
        signal = getattr(case.scenario, slot)
        if any(isinstance(one, Recorded) for one in getattr(signal, "terms", (signal,))):
            where = slot if slot == "reference" else f"disturbance.{slot}"
            raise ValueError(
                f'{path}: {where}: kind = "table": a page cannot contain a signal from a file. Remove it, or '
                "replace it by another signal."
            )
    for other in others:
        if not _alike(case, other):
            raise ValueError(
                f"--also {other.name}: it differs from {path} in more than numbers. Give a case with the same laws, "
                "plant, signals, sensors and number of samples, such as tuned.toml."
            )


def _computed(case: Case, others: list[Case], path: str) -> tuple[str, dict[str, Any]]:
    check_processor(case, path)
    _check_contents(case, others, path)
    case = _finest(case, others)
    try:
        (loop, states), (moving, _) = loop_script(case), loop_script(case, any_delay=True)
        linear, facts = linear_script(case)
    except ValueError as why:
        raise ValueError(f"{path}: the page cannot compute this case: {why}") from None
    given, lines = _written(case, others)
    presets = [_preset(one, text) for one, text in zip((case, *others), lines, strict=True)]
    clearance = [] if case.scenario.clearance is None else ["run.clearance"]
    data = {
        "name": case.name,
        "from": pathlib.Path(path).name,
        "command": shlex.join(["ambjax", "tune", pathlib.Path(path).name, "--out", "tuned"]),
        "presets": presets,
        "sliders": [{k: None if x in (math.inf, -math.inf) else x for k, x in one._asdict().items()} for one in given],
        "groups": list(GROUPS.items()),
        "units": UNITS,
        "statuses": STATUSES,
        "signals": [*SIGNALS, *COILS],
        "samples": case.clock.samples,
        "delay": parameters(case, ["processor.delay"])["processor.delay"],
        "seed": parameters(case, [SEED])[SEED],
        "settle": float(case.settle),
        "period": float(case.clock.sample_period),
        "members": _members(case),
        "linear": facts,
        **states,
        "places": parameters(case, ["plant.s_0", "plant.i_0", *clearance]),
    }
    generated = [PRELUDE, loop, moving.replace("function ", "function any_"), linear]
    return "\n".join([*generated, *map(_asset, WORKER)]), data


def _written(case: Case, others: list[Case]) -> tuple[list[Slider], list[list[TemplateLine]]]:
    """Return the sliders that have a place in all case files, and the template of each file.

    If added lines make a file invalid, only numbers that the file of `case` contains have sliders. If a file is still
    invalid, there are no sliders.
    """
    cases, given = (case, *others), sliders(case, others)
    for kept in (given, [one for one in given if _in_file(one, case)]):
        placed = set.intersection(*(set(editable_lines(one.text, _own(kept, one))[1]) for one in cases))
        kept = [one for k, one in enumerate(kept) if k in placed]
        found = [editable_lines(one.text, _own(kept, one))[0] for one in cases]
        if all(checked(lines, _own(kept, one)) for lines, one in zip(found, cases, strict=True)):
            return kept, found
    return [], [[] for _ in cases]


def _in_file(slider: Slider, case: Case) -> bool:
    lines, _ = editable_lines(case.text, [slider])
    return any(not line.only and len(line.parts) > 1 for line in lines)


def _own(given: list[Slider], case: Case) -> list[Slider]:
    values = parameter_values(case)
    return [one._replace(value=float(values[one.parameter])) for one in given]


def _preset(case: Case, lines: list[TemplateLine]) -> dict[str, Any]:
    values = [float(x) for x in parameter_values(case)]
    return {"name": case.name, "P": [x if np.isfinite(x) else "Infinity" for x in values], "lines": lines}


def _alike(case: Case, other: Case) -> bool:
    same = other.cascade.sampled and other.clock.samples == case.clock.samples
    return same and jax.tree.structure(loop_parameters(other)) == jax.tree.structure(loop_parameters(case))


def _finest(case: Case, others: list[Case]) -> Case:
    """Return `case` with the integrator of the smallest step among all cases."""
    period = float(case.clock.sample_period)
    steps = [one.clock for one in (case, *others) if one.clock.integrator.step_size(period) is not None]
    clock = min(steps, key=lambda clock: clock.integrator.step_size(period) or 0.0, default=case.clock)
    return dataclasses.replace(case, clock=case.clock.with_method(clock.method))


def _members(case: Case) -> dict[str, Any]:
    """Return the members of the ensemble for JSON: their number, and rows for the parameters that vary."""
    own, drawn = parameter_values(case), study_of(case, None, MEMBERS).drawn(np.arange(MEMBERS))
    relative = {path for path, kind in case.spread.entries if kind.relative}
    rows = []
    for path, values in drawn.items():
        moved = [parameter_values(changed(case, {path: float(x)})) for x in values]
        for k in np.flatnonzero(np.any([one != own for one in moved], axis=0)):
            factor = path in relative and own[k] != 0
            rows.append([int(k), bool(factor), [float(one[k] / own[k] if factor else one[k]) for one in moved]])
    return {"count": MEMBERS, "rows": rows}
