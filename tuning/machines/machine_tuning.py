"""`ambjax tune` of a whole machine: the gains of the least peak of |S| of the worst axis at any speed."""

import dataclasses
import math
import pathlib
import time
import tomllib
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.cases.table import Table, one_line
from ambjax.cases.tune_table import BUDGET, NUMBERS
from ambjax.extend import leaf
from ambjax.results.outputs import directory, files, plain, write_json
from ambjax.text.web_page import render_page
from tuning.events import Tell
from tuning.machines.machine_gains import MachineSpace, machine_space
from tuning.machines.machine_peaks import Peaks
from tuning.machines.machine_verdict import LIMITS, judged, report_text
from tuning.machines.nonsmooth import Value, minimise
from tuning.report.tuned import tuned

WRITTEN = ("tuned.toml", "report.json", "report.md", "report.html")
# Keys of [tune] and of [tune.limits] that a machine takes.
KEYS, SIZES = ("gains", "bounds", "limits", "minutes"), ("seed", "starts", "iterations", "held_out")
LIMIT: dataclasses.Field = leaf(above=0, at_most=1e12)
# Standard deviations of the logarithms of the gains of random starts: around the case, and around the best point.
FAR, NEAR = 0.7, 0.3
# Default of `minutes`, and of `held_out`: a machine takes longer to simulate than an axis.
MINUTES, JUDGED = 5.0, 16


class Settings(NamedTuple):
    """The table [tune] of a machine."""

    space: MachineSpace
    limits: dict[str, float]
    minutes: float
    seed: int
    starts: int
    iterations: int
    held_out: int


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
    if case.machine.law is not None:
        raise ValueError("[tune]: one law commands all axes of this machine; only laws of single axes are tuned.")
    return Settings(
        machine_space(own, case, raw),
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
    raw, text = loaded
    folder = pathlib.Path(path).parent
    try:
        case = machine_from(raw, pathlib.Path(path).stem, text, folder)
        settings = settings_from(raw, case)
        if minutes is not None:
            settings = settings._replace(minutes=minutes)
        start = settings.space.values(case)
        settings.space.space.encode(start)
        peaks = Peaks(case, settings.space)
    except ValueError as why:
        raise ValueError(one_line(f"{path}: {why}")) from None
    place = directory(out, f"tune-{case.name}", WRITTEN, force)
    speeds = ", ".join(f"{speed:g}" for speed in case.speeds)
    tell(f"tuning {', '.join(settings.space.space.paths)} for the least peak of |S| at {speeds} rpm")
    best = searched(peaks, settings, start, tell)
    gains = np.asarray(settings.space.space.gains_at(best.x))
    written = {gain.where: float(x) for gain, x in zip(settings.space.gains, gains, strict=True)}
    first = tuned(text, written, case.name, "The tuned gains are not judged.")
    found = machine_from(tomllib.loads(first), case.name, first, folder)
    with files(place) as part:
        (part / "tuned.toml").write_text(first, encoding="utf-8")
    tell(f"simulating {settings.held_out} members with the tuned gains")
    facts = judged(case, found, settings.limits, settings.seed, settings.held_out)
    facts["gains"] = [
        {"path": own.path, "before": a, "after": b, "at_bound": own.at_bound(b)}
        for own, a, b in zip(settings.space.space.gains, start.tolist(), gains.tolist(), strict=True)
    ]
    text = tuned(text, written, case.name, facts["verdict"])
    _put(place, text, facts)
    return MachineTuning(dataclasses.replace(found, text=text), facts["outcome"]["good"], plain(facts), place)


def _put(place: pathlib.Path, text: str, facts: dict[str, Any]) -> None:
    """Write the case with the tuned gains and the report."""
    words = report_text(facts)
    with files(place) as part:
        (part / "tuned.toml").write_text(text, encoding="utf-8")
        write_json(part / "report.json", facts)
        (part / "report.md").write_text(words, encoding="utf-8")
        (part / "report.html").write_text(render_page(words, {}, f"Tuning of {facts['case']}"), encoding="utf-8")


def searched(peaks: Peaks, settings: Settings, start: np.ndarray, tell: Tell) -> Value:
    """Return the lowest peak, or the least growth rate if no start can be made stable.

    From each start, BFGS reduces the largest growth rate until the machine is stable, then the peak.
    """
    rng, space, first = np.random.default_rng(settings.seed), settings.space.space, settings.space.space.encode(start)
    end = time.monotonic() + 60 * (settings.minutes if math.isfinite(settings.minutes) else MINUTES)
    best, slowest = Value(first, math.inf, np.zeros(len(first))), Value(first, math.inf, np.zeros(len(first)))
    over = lambda value: time.monotonic() > end  # noqa: E731
    for number in range(settings.starts):
        near = number % 2 == 1 and math.isfinite(best.f)
        centre, size = (best.x, NEAR) if near else (first, FAR if number else 0.0)
        x = space.drawn_back(centre + size * rng.normal(size=len(first)))
        held = minimise(peaks.stability, peaks.stability(x), settings.iterations, lambda v: v.f < 0 or over(v))
        slowest = min(slowest, held, key=lambda v: v.f)
        if held.f < 0:
            best = min(best, minimise(peaks.peak, peaks.peak(held.x), settings.iterations, over), key=lambda v: v.f)
        found = f"best peak {math.exp(best.f):.4g}" if math.isfinite(best.f) else f"growth rate {slowest.f:.3g} 1/s"
        tell(f"start {number + 1} of {settings.starts}: {found}")
        if over(best):
            break
    return best if math.isfinite(best.f) else slowest
