"""`ambjax tune` of a whole machine: the gains of the least peak of |S| of the worst axis at any speed, judged."""

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
from ambjax.commands.machine_commands import sensitivity_summary
from ambjax.extend import leaf
from ambjax.host.extensions import NothingToTuneError
from ambjax.host.sealed import flat, provenance
from ambjax.results.machine_study import LinearFindings, MachineStudy
from ambjax.results.operating import sensitivity
from ambjax.results.outputs import directory, files, plain, write_json
from tuning.events import Tell
from tuning.machines.machine_gains import LqgSpace, MachineSpace, lqg_space, machine_space
from tuning.machines.machine_peaks import Peaks
from tuning.machines.machine_search import Settings, save, saved, searched
from tuning.problem.config import with_settings_of
from tuning.problem.members import FEW
from tuning.problem.quantities import KINDS
from tuning.report.facts import KEY, NOT_JUDGED, REPORT, TUNED, Column, record, table
from tuning.report.folder import put_words, tuned
from tuning.solve.checkpoint import checkpoint

WRITTEN = (TUNED, REPORT, "report.md", "report.html")
# Keys of [tune] and of [tune.limits] that a machine takes.
KEYS, SIZES = ("gains", "bounds", "limits", "minutes"), ("seed", "starts", "iterations", "held_out")
LIMIT: dataclasses.Field = leaf(above=0, at_most=1e12)
# Limits of [tune.limits], each with its meaning. The largest value counts of the metric `Kind.exact`.
LIMITS = {
    "sensitivity": "peak of \\|S\\| of the worst axis at any speed",
    "rms_u_V": "rms voltage after run.settle, V",
    "max_u_V": "largest voltage, V",
    "max_abs_i_A": "largest absolute current, A",
    "rms_error_m": "rms error after run.settle, m",
    "largest_error_m": "largest error after run.settle, m",
    "clearance_used": "largest share of the clearance",
    "z_1x_m": "largest amplitude of z at the speed, m",
    "i_1x_A": "largest amplitude of a current at the speed, A",
    "sensitivity_1x": "largest \\|S\\| of an axis at a speed, where the rotor turns with it",
}


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
        held, metrics = simulate(MachineStudy(case_at(x), settings.seed + 1, min(settings.held_out, FEW)))
        within = [metrics[name] <= most for name, most in settings.limits.items() if name in metrics]
        turns = plan.peaks.turning(x) <= settings.limits.get("sensitivity_1x", math.inf)
        return int(np.sum(~np.all([held, *within], axis=0))) + (not turns)

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


def judged(case: MachineCase, found: MachineCase, limits: dict[str, float], seed: int, members: int) -> dict[str, Any]:
    """Return the content of report.json but the gains. `case`, `found`: before and after; `members`: to simulate.

    The peaks of |S| are those over all frequencies, whatever the band of [sensitivity] is.
    """
    period = float(case.clock.sample_period) if case.cases[0].cascade.sampled else None
    everywhere = [dataclasses.replace(one, zones=one.zones.whole(period)) for one in (case, found)]
    each: list[dict[str, Any]] = [sensitivity_summary(sensitivity(one), {}) for one in everywhere]
    before, after = each
    study = MachineStudy(found, seed, members)
    held, simulated = simulate(study)
    loops = study.findings(np.flatnonzero(held)) if held.any() else LinearFindings(0, 0)
    values: dict[str, Any] = {name: float(x[held].max()) if held.any() else math.inf for name, x in simulated.items()}
    turning = [fact["S"] for at in after["speeds"] for axis in at["axes"] for fact in axis["running_speed"]]
    linear = {"sensitivity": after["peak"], "sensitivity_1x": max(turning, default=0.0)}
    values |= linear if after["stable"] else dict.fromkeys(linear, math.inf)
    rows: list[dict[str, Any]] = [
        {"name": name, "meaning": LIMITS[name], "value": values[name], "threshold": most}
        | {"holds": bool(values[name] <= most and (name in linear or held.all()))}
        for name, most in limits.items()
    ]
    broken = [row["name"] for row in rows if not row["holds"]]
    at = f"{after['axis']} at {after['speed_rpm']:g} rpm"
    peak = f"peak of |S| {after['peak']:.4g} ({at}), zone {after['zone']}"
    none = "stable, but the linear machine is not, so it has no peaks"
    words = [
        (none if after["zone"] is None else peak) if after["stable"] else "NOT STABLE",
        f"{int(held.sum())} of {members} members held",
        *([] if loops.stable else [f"{loops.unstable} of {loops.tested} members tested not stable"]),
    ]
    good = bool(after["stable"] and held.all() and loops.stable and not broken)
    if good or broken:
        words.append("all limits met" if good else f"beyond the limits: {', '.join(broken)}")
    return {
        "verdict": f"{'; '.join(words)}.",
        "case": case.name,
        "outcome": {"good": good, "held": int(held.sum()), "members": members, "stability": loops._asdict()},
        "limits": rows,
        "metrics": values,
        "sensitivity": after,
        "before": before,
    }


def simulate(study: MachineStudy) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return which members [n] are held, and the limited metrics [n] of the worst axis of each."""
    columns = study.columns(0, study.members)
    exact = {name: KINDS[name].exact for name in LIMITS}
    found = {name: columns.get(one, np.zeros(study.members)) for name, one in exact.items() if one}
    return np.isposinf(columns["lost_at"]), found  # at rest there are no amplitudes at the speed


def report_text(facts: dict[str, Any]) -> str:
    """Return the report in Markdown."""
    speeds = zip(facts["before"]["speeds"], facts["sensitivity"]["speeds"], strict=True)
    peaks = [
        {"rpm": f"{b['speed_rpm']:g}", "axis": axis["name"], "before": _peak(a, old), "after": _peak(b, axis)}
        | {"Hz": axis["frequency_hz"] if b["stable"] else None, "zone": axis["zone"]}
        for a, b in speeds
        for old, axis in zip(a["axes"], b["axes"], strict=True)
    ]
    limits: dict[str, Column] = {
        "limit": ("name", ""), "meaning": ("meaning", ""), "value": ("value", ".4g"), "at most": ("threshold", ".4g"),
        "met": lambda row: "yes" if row["holds"] else "NO",
    }  # fmt: skip
    gains: dict[str, Column] = {
        "gain": ("path", ""), "before": ("before", ".6g"), "after": ("after", ".6g"), "at a bound": ("at_bound", "")
    }  # fmt: skip
    parts = [f"# Tuning of {facts['case']}", facts["verdict"], "## Limits", table(facts["limits"], limits)]
    parts += ["## Peaks of |S|", table(peaks, {name: (name, ".4g") for name in peaks[0]})]
    return "\n\n".join([*parts, "## Gains", table(facts["gains"], gains)]) + "\n"


def _peak(point: dict[str, Any], axis: dict[str, Any]) -> str:
    if not point["stable"]:
        return "unstable"
    return f"{axis['peak']:.4g}" if math.isfinite(axis["peak"]) else "none"
