"""`ambjax tune` of a whole machine: the gains of the least peak of |S| of the worst axis at any speed."""

import dataclasses
import math
import pathlib
import tomllib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.cases.machine_controller import kind_of
from ambjax.cases.table import Table, one_line
from ambjax.cases.tune_table import BUDGET, NUMBERS
from ambjax.extend import leaf
from ambjax.results.outputs import directory, files, plain, write_json
from ambjax.text.web_page import render_page
from tuning.events import Tell
from tuning.machines.lqg_weights import LqgSpace, lqg_space
from tuning.machines.machine_gains import MachineSpace, machine_space
from tuning.machines.machine_peaks import Peaks
from tuning.machines.machine_search import Settings, searched
from tuning.machines.machine_verdict import LIMITS, judged, refused, report_text
from tuning.report.tuned import tuned

WRITTEN = ("tuned.toml", "report.json", "report.md", "report.html")
# Keys of [tune] and of [tune.limits] that a machine takes.
KEYS, SIZES = ("gains", "bounds", "limits", "minutes"), ("seed", "starts", "iterations", "held_out")
LIMIT: dataclasses.Field = leaf(above=0, at_most=1e12)
# Default of `held_out`: a machine takes longer to simulate than an axis.
JUDGED = 16
# Largest number of members that the search simulates.
SEARCHED = 4
NOT_JUDGED = "The tuned gains are not judged."


class MachineTuning(NamedTuple):
    """The result: the case with the tuned gains, whether all limits are met, report.json, and its directory."""

    case: MachineCase
    good: bool
    report: dict[str, Any]
    directory: pathlib.Path


def settings_from(raw: dict[str, Any], case: MachineCase) -> Settings:
    """Return [tune] of a machine. Raises ValueError, one line, for a key that a machine does not take."""
    own = Table(raw).table("tune")
    own.only([*KEYS, *SIZES])
    limits = own.table("limits")
    limits.only(list(LIMITS))
    thresholds = {name: limits.leaf(name, LIMIT) for name in LIMITS if name in limits.raw}
    sizes = {name: own.whole(name, BUDGET[name]) for name in SIZES}
    lqg = kind_of(raw) == "lqg"
    if case.machine.law is not None and not lqg:
        raise ValueError("[tune]: one law commands all axes of this machine; only an LQG and laws of axes are tuned.")
    return Settings(
        (lqg_space if lqg else machine_space)(own, case, raw),
        {"sensitivity": float(case.zones.zone_a)} | thresholds,
        min(own.leaf("minutes", NUMBERS["minutes"], math.inf), 1e6),
        sizes["seed"],
        sizes["starts"],
        10 * sizes["iterations"],
        sizes["held_out"] if "held_out" in own.raw else JUDGED,
    )


def tune_machine(
    path: str, out: str | None, force: bool, minutes: float | None, tell: Tell, loaded: tuple[dict[str, Any], str]
) -> MachineTuning:
    """Tune the machine of a case file and write tuned.toml and the report. Raises ValueError for invalid input.

    `loaded`: document and text of the file.
    """
    case, settings, start, peaks = _checked(path, minutes, loaded)
    place, own = directory(out, f"tune-{case.name}", WRITTEN, force), settings.space

    def case_at(x: np.ndarray, verdict: str = NOT_JUDGED) -> MachineCase:
        return _written(case, loaded[1], own, _gains(own, x), verdict)

    def refused_at(x: np.ndarray) -> int:  # other members than those of the judgement
        return refused(case_at(x), settings.limits, settings.seed + 1, min(settings.held_out, SEARCHED))

    speeds = ", ".join(f"{speed:g}" for speed in case.speeds)
    tell(f"tuning {', '.join(own.space.paths)} for the least peak of |S| at {speeds} rpm")
    best = searched(peaks, settings, start, refused_at, tell)
    found = case_at(best.x)
    with files(place) as part:
        (part / "tuned.toml").write_text(found.text, encoding="utf-8")
    tell(f"simulating {settings.held_out} members with the tuned gains")
    facts = judged(case, found, settings.limits, settings.seed, settings.held_out)
    facts["gains"] = [
        {"path": one.path, "before": a, "after": b, "at_bound": one.at_bound(b)}
        for one, a, b in zip(own.space.gains, start.tolist(), _gains(own, best.x), strict=True)
    ]
    found = case_at(best.x, facts["verdict"])
    _put(place, found.text, facts)
    return MachineTuning(found, facts["outcome"]["good"], plain(facts), place)


def _checked(
    path: str, minutes: float | None, loaded: tuple[dict[str, Any], str]
) -> tuple[MachineCase, Settings, np.ndarray, Peaks]:
    """Return the case, its settings, its gains [m], and the peaks. Raises ValueError for invalid input."""
    raw, text = loaded
    file = pathlib.Path(path)
    try:
        case = machine_from(raw, file.stem, text, file.parent)
        settings = settings_from(raw, case)
        if minutes is not None:
            settings = settings._replace(minutes=minutes)
        start = settings.space.values(case)
        settings.space.space.encode(start)
        # the default of a gain may depend on whether another one is given
        return case, settings, start, Peaks(_written(case, text, settings.space, start.tolist()), settings.space)
    except ValueError as why:
        raise ValueError(one_line(f"{path}: {why}")) from None


def _gains(space: MachineSpace | LqgSpace, x: np.ndarray) -> list[float]:
    return np.asarray(space.space.gains_at(jnp.asarray(x))).tolist()


def _written(
    case: MachineCase, text: str, space: MachineSpace | LqgSpace, gains: list[float], verdict: str = NOT_JUDGED
) -> MachineCase:
    """Return the case with these gains [m] in its text."""
    where = [gain.where for gain in space.gains]
    text = tuned(text, dict(zip(where, gains, strict=True)), case.name, verdict)
    return machine_from(tomllib.loads(text), case.name, text, case.folder)


def _put(place: pathlib.Path, text: str, facts: dict[str, Any]) -> None:
    """Write the case with the tuned gains and the report."""
    words = report_text(facts)
    with files(place) as part:
        (part / "tuned.toml").write_text(text, encoding="utf-8")
        write_json(part / "report.json", facts)
        (part / "report.md").write_text(words, encoding="utf-8")
        (part / "report.html").write_text(render_page(words, {}, f"Tuning of {facts['case']}"), encoding="utf-8")
