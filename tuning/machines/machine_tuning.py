"""`ambjax tune` of a whole machine: the gains of the least peak of |S| of the worst axis at any speed."""

import dataclasses
import math
import pathlib
import time
import tomllib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.cases.machine_controller import kind_of
from ambjax.cases.table import Table, one_line
from ambjax.cases.tune_table import BUDGET, NUMBERS
from ambjax.extend import leaf
from ambjax.results.machine_study import MachineStudy
from ambjax.results.outputs import directory, files, plain, write_json
from ambjax.text.web_page import render_page
from tuning.events import Tell
from tuning.machines.lqg_weights import LqgSpace, lqg_space
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
# Largest number of members that the search simulates.
SEARCHED = 4
NOT_JUDGED = "The tuned gains are not judged."


class Settings(NamedTuple):
    """The table [tune] of a machine."""

    space: MachineSpace | LqgSpace
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
    own = settings.space

    def gains_at(x: np.ndarray) -> dict[str, float]:
        return {gain.where: float(g) for gain, g in zip(own.gains, own.space.gains_at(jnp.asarray(x)), strict=True)}

    def case_at(x: np.ndarray, verdict: str = NOT_JUDGED) -> MachineCase:
        written = tuned(text, gains_at(x), case.name, verdict)
        return machine_from(tomllib.loads(written), case.name, written, folder)

    best = searched(peaks, settings, start, lambda x: lost_of(case_at(x), settings), tell)
    found = case_at(best.x)
    with files(place) as part:
        (part / "tuned.toml").write_text(found.text, encoding="utf-8")
    tell(f"simulating {settings.held_out} members with the tuned gains")
    facts = judged(case, found, settings.limits, settings.seed, settings.held_out)
    facts["gains"] = [
        {"path": one.path, "before": a, "after": b, "at_bound": one.at_bound(b)}
        for one, a, b in zip(own.space.gains, start.tolist(), gains_at(best.x).values(), strict=True)
    ]
    found = dataclasses.replace(found, text=tuned(text, gains_at(best.x), case.name, facts["verdict"]))
    _put(place, found.text, facts)
    return MachineTuning(found, facts["outcome"]["good"], plain(facts), place)


def _put(place: pathlib.Path, text: str, facts: dict[str, Any]) -> None:
    """Write the case with the tuned gains and the report."""
    words = report_text(facts)
    with files(place) as part:
        (part / "tuned.toml").write_text(text, encoding="utf-8")
        write_json(part / "report.json", facts)
        (part / "report.md").write_text(words, encoding="utf-8")
        (part / "report.html").write_text(render_page(words, {}, f"Tuning of {facts['case']}"), encoding="utf-8")


def lost_of(case: MachineCase, settings: Settings) -> int:
    """Return how many members are lost of those that the search simulates: not those of the judgement."""
    study = MachineStudy(case, settings.seed + 1, min(settings.held_out, SEARCHED))
    return int(np.sum(np.isfinite(study.columns(0, study.members)["lost_at"])))


def searched(
    peaks: Peaks, settings: Settings, start: np.ndarray, lost: Callable[[np.ndarray], int], tell: Tell
) -> Value:
    """Return the lowest peak with the fewest lost members, or the least growth rate if no start can be made stable.

    From each start, BFGS reduces the largest growth rate until the machine is stable, then the peak. `lost`: number of
    members that are lost at coordinates [m].
    """
    rng, space, first = np.random.default_rng(settings.seed), settings.space.space, settings.space.space.encode(start)
    end = time.monotonic() + 60 * (settings.minutes if math.isfinite(settings.minutes) else MINUTES)
    slowest = Value(first, math.inf, np.zeros(len(first)))
    best, fewest = slowest, math.inf
    over = lambda _: time.monotonic() > end  # noqa: E731
    for number in range(settings.starts):
        near = number % 2 == 1 and math.isfinite(best.f)
        centre, size = (best.x, NEAR) if near else (first, FAR if number else 0.0)
        x = space.drawn_back(centre + size * rng.normal(size=len(first)))
        stop = lambda value: peaks.stable(value) or over(value)  # noqa: E731
        held = peaks.stability(x)
        if not peaks.stable(held):
            held = minimise(peaks.stability, held, settings.iterations, stop)
        slowest = min(slowest, held, key=lambda v: v.f)
        if peaks.stable(held):
            low = _descended(peaks, peaks.peak(held.x), settings.iterations, lost, over)
            count = lost(low.x) if fewest or low.f < best.f else math.inf
            best, fewest = (low, count) if (count, low.f) < (fewest, best.f) else (best, fewest)
        found = f"best peak {math.exp(best.f):.4g}" if math.isfinite(best.f) else f"growth rate {slowest.f:.3g} 1/s"
        tell(
            f"start {number + 1} of {settings.starts}: {found}"
            + (f", {fewest} members lost" if 0 < fewest < math.inf else "")
        )
        if over(best):
            break
    return best if math.isfinite(best.f) else slowest


def _descended(
    peaks: Peaks, start: Value, iterations: int, lost: Callable[[np.ndarray], int], over: Callable[[Value], bool]
) -> Value:
    """Return the lowest point of a descent of the peak at which no member is lost; the lowest of all if there is none.

    The simulations take longer than the peaks. If members are lost at the end of a descent without simulations, one
    that rejects such points begins at the last point at which none is lost.
    """
    path = [start]

    def followed(value: Value) -> bool:
        path.append(value)
        return over(value)

    low = minimise(peaks.peak, start, iterations, followed)
    if not lost(low.x):
        return low
    first, last = 0, len(path) - 1
    if lost(path[first].x):
        return low
    while last - first > 1:
        middle = (first + last) // 2
        first, last = (first, middle) if lost(path[middle].x) else (middle, last)

    def guarded(x: np.ndarray) -> Value:
        value = peaks.peak(x)
        good = value.f < path[first].f and not over(value) and not lost(x)
        return value if good else Value(x, math.inf, np.zeros(len(x)))

    return minimise(guarded, path[first], iterations, over)
