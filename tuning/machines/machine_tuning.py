"""`ambjax tune` of a whole machine: the gains of the least peak of |S| of the worst axis at any speed."""

import dataclasses
import math
import pathlib
import tomllib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.cases.machine_controller import kind_of
from ambjax.cases.table import Table, load, one_line
from ambjax.cases.tune_table import BUDGET, NUMBERS
from ambjax.extend import leaf
from ambjax.host.extensions import NothingToTuneError
from ambjax.host.sealed import flat, provenance
from ambjax.results.machine_study import MachineStudy
from ambjax.results.outputs import directory, files, plain, write_json
from tuning.events import Tell
from tuning.machines.machine_gains import LqgSpace, MachineSpace, lqg_space, machine_space
from tuning.machines.machine_peaks import Peaks
from tuning.machines.machine_search import Settings, save, saved, searched
from tuning.machines.machine_verdict import LIMITS, judged, refused, report_text
from tuning.problem.config import with_settings_of
from tuning.problem.members import FEW
from tuning.report.facts import KEY, NOT_JUDGED, REPORT, TUNED, record
from tuning.report.folder import put_words, tuned
from tuning.solve.checkpoint import checkpoint

WRITTEN = (TUNED, REPORT, "report.md", "report.html")
# Keys of [tune] and of [tune.limits] that a machine takes.
KEYS, SIZES = ("gains", "bounds", "limits", "minutes"), ("seed", "starts", "iterations", "held_out")
LIMIT: dataclasses.Field = leaf(above=0, at_most=1e12)


class MachinePlan(NamedTuple):
    """The checked input of the tuning of a machine.

    `start`: initial gains [m]. `record`: what a resumed search must match. `out`: directory. `names`: the files that
    the tuning writes.
    """

    case: MachineCase
    settings: Settings
    start: np.ndarray
    peaks: Peaks
    record: dict[str, Any]
    out: pathlib.Path
    names: tuple[str, ...] = WRITTEN

    def kept(self) -> MachineCase:
        """Return the case of tuned.toml in `out`."""
        raw, text = load(self.out / TUNED)
        return machine_from(raw, self.case.name, text, self.case.folder)


def settings_from(raw: dict[str, Any], case: MachineCase) -> Settings:
    """Return [tune] of a machine. Raises ValueError, one line, for a key that a machine does not take."""
    own = Table(raw).table("tune")
    sizes = own.leaves({name: BUDGET[name] for name in SIZES}, KEYS)
    limits = own.table("limits")
    limits.only(list(LIMITS))
    thresholds = {name: limits.leaf(name, LIMIT) for name in LIMITS if name in limits.raw}
    lqg = kind_of(raw) == "lqg"
    if case.machine.law is not None and not lqg:
        raise NothingToTuneError(
            "[tune]: one law commands all axes of this machine; only an LQG and laws of axes are tuned."
        )
    return Settings(
        (lqg_space if lqg else machine_space)(own, case, raw),
        {"sensitivity": float(case.zones.zone_a)} | thresholds,
        own.leaf("minutes", NUMBERS["minutes"], math.inf),
        sizes["seed"],
        sizes["starts"],
        10 * sizes["iterations"],
        sizes["held_out"] if "held_out" in own.raw else 16,  # a machine takes longer to simulate than an axis
    )


def machine_plan(
    path: str, out: str | None, minutes: float | None, settings_of: str | None, loaded: tuple[dict[str, Any], str]
) -> MachinePlan:
    """Return the checked input, and make the directory `out`. Raises ValueError for invalid input.

    `settings_of`: a case file whose [tune] replaces that of the case, except for gains and bounds. `loaded`: document
    and text of the file.
    """
    file = pathlib.Path(path)
    try:
        raw = with_settings_of(loaded[0], settings_of)
        case = machine_from(raw, file.stem, loaded[1], file.parent)
        settings = settings_from(raw, case)
        if minutes is not None:
            settings = settings._replace(minutes=minutes)
        start = settings.space.values(case)
        settings.space.space.encode(start)
        # the default of a gain may depend on whether another one is given
        peaks = Peaks(_written(case, settings.space, start.tolist()), settings.space)
    except ValueError as why:
        kind = NothingToTuneError if isinstance(why, NothingToTuneError) else ValueError
        raise kind(one_line(f"{path}: {why}")) from None
    record = {"case": raw, "study": MachineStudy(case, 0, 1).fingerprint()}
    place = directory(out, f"tune-{case.name}", WRITTEN, force=True)
    return MachinePlan(case, settings, start, peaks, record, place)


def tune_machine(plan: MachinePlan, resume: bool, tell: Tell) -> tuple[MachineCase, dict[str, Any]]:
    """Tune a machine and write tuned.toml and the report. Return the tuned case and report.json."""
    case, settings, own, path = plan.case, plan.settings, plan.settings.space, plan.out / checkpoint(1)

    def case_at(x: np.ndarray, verdict: str = NOT_JUDGED) -> MachineCase:
        return _written(case, own, own.space.named(x).values(), verdict)

    def refused_at(x: np.ndarray) -> int:  # other members than those of the judgement
        count = refused(case_at(x), settings.limits, settings.seed + 1, min(settings.held_out, FEW))
        return count + (plan.peaks.turning(x) > settings.limits.get("sensitivity_1x", math.inf))

    speeds = ", ".join(f"{speed:g}" for speed in case.speeds)
    tell(f"tuning {', '.join(own.space.paths)} for the least peak of |S| at {speeds} rpm")
    facts = flat({**provenance(), **plan.record})
    before = saved(path, facts, tell) if resume else None
    found = searched(plan.peaks, settings, plan.start, refused_at, tell, before, lambda now: save(path, facts, now))
    x = found.answer.x
    with files(plan.out) as part:
        (part / TUNED).write_text(case_at(x).text, encoding="utf-8")
    tell(f"simulating {settings.held_out} members with the tuned gains")
    report = judged(case, case_at(x), settings.limits, settings.seed, settings.held_out)
    report["gains"] = [
        {"path": one.path, "before": a, "after": b, "at_bound": one.at_bound(b)}
        for one, a, b in zip(own.space.gains, plan.start.tolist(), own.space.named(x).values(), strict=True)
    ]
    tuned_case = case_at(x, report["verdict"])
    with files(plan.out) as part:
        (part / TUNED).write_text(tuned_case.text, encoding="utf-8")
        mark = {KEY: record(plan.record, part)} if found.number == settings.starts else {}
        write_json(part / REPORT, report | mark)
        put_words(part, case.name, report_text(report))
    return tuned_case, plain(report)


def _written(
    case: MachineCase, space: MachineSpace | LqgSpace, gains: Iterable[float], verdict: str = NOT_JUDGED
) -> MachineCase:
    """Return the case with these gains [m] in its text."""
    text = tuned(case.text, dict(zip(space.where, gains, strict=True)), case.name, verdict)
    return machine_from(tomllib.loads(text), case.name, text, case.folder)
