"""The report of a finished study: its summary, its pictures and the text on the terminal."""

import argparse
import pathlib
from typing import Any

import numpy as np

from ambjax.cases.machine_case import MachineCase, first_axis
from ambjax.cases.reader import Case
from ambjax.cases.warned import reversal
from ambjax.ensemble import statistics
from ambjax.ensemble.study import AnyStudy, Study
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.linear import Findings, stability_of, suspects
from ambjax.results.machine_study import MachineStudy
from ambjax.results.outputs import described, drawn, files, plain, table, write_json, written
from ambjax.text.words import number, one_line

# Files written with members.npz; the last one only if the case has a spread and a member survives.
WRITTEN = ("summary.json", "fan.png", "histograms.png", "tornado.png")
# Members and instants in the fan chart, for a study of any size.
FAN_MEMBERS, FAN_TIMES = 256, 500
# If every member is lost, the fan chart ends at this multiple of the last loss time.
BEYOND = 1.15
BANDS = (0.0, 5.0, 25.0, 50.0, 75.0, 95.0, 100.0)
METRICS = ("settled_max_abs_error_m", "settled_rms_error_m", "max_abs_error_m", "max_abs_u_V", "rms_u_V", "max_abs_i_A")


def write_report(
    case: Case | MachineCase,
    study: Study | MachineStudy,
    args: argparse.Namespace,
    out: pathlib.Path,
    error: dict[str, Any] | None,
) -> tuple[int, dict[str, object]]:
    """Write and print the results of a finished study. Return the exit code and the summary.

    The exit code is 0 if every member survives, and the members tested are stable. `error`: result of `sliding_error`,
    or None.
    """
    with np.load(out / "members.npz") as file:
        columns = {name: file[name] for name in file.files}
    with doing(f"testing the stability of the members; {FIRST_RUN}"):
        findings = findings_of(study, columns)
    held = ~np.isfinite(columns["lost_at"])
    survivors = {"survivors": int(held.sum()), "members": study.members}
    with doing("computing the statistics"):
        summary = described("summary.json", lambda: _summary(case, study, columns, str(args.case)))
    with files(out) as part:
        if summary is not None:
            summary["stability"] = findings._asdict()
            if error is not None:
                summary["sliding_step_error"] = error
            write_json(part / "summary.json", summary)
        fan = f": simulating members for the fan chart; {FIRST_RUN}" if isinstance(case, Case) else ""
        with doing(f"drawing the pictures{fan}"):
            _pictures(case, study, columns, summary, part)
        names = [name for name in WRITTEN if (part / name).exists()]
    if not args.json:
        tables = None if summary is None else described("the table", lambda: study_tables(summary, findings.words()))
        print(tables or "{survivors} of {members} members survive".format(**survivors))
        written(out, ", ".join(["members.npz", *names]))
    for warning in reversal(first_axis(case), float(np.max(columns["max_abs_i_A"], initial=0.0, where=held))):
        say(warning)
    good = held.all() and findings.stable
    return int(not good), plain(summary or survivors) | {"out": str(out)}


def _summary(case: Case | MachineCase, study: AnyStudy, columns: dict[str, np.ndarray], path: str) -> dict[str, Any]:
    facts = {
        "case": case.name,
        "method": str(case.clock.method),
        "settle_s": case.settle,
        "design": study.spread.design,
    }
    numbers = statistics.summary(columns, study.spread.paths, study.seed)
    for worst in numbers["worst"]:
        worst["replay"] = study.command(path, worst["index"])
    return facts | numbers


def findings_of(study: Study | MachineStudy, columns: dict[str, np.ndarray]) -> Findings:
    """Test whether the loops of the surviving members with the largest settled errors are stable."""
    index = suspects(columns[statistics.DECIDING], ~np.isfinite(columns["lost_at"]))
    if not index.size:
        return Findings(0, 0)
    if isinstance(study, MachineStudy):
        return study.findings(index[np.argsort(-columns[statistics.DECIDING][index])])
    say(f"testing whether the loops of {index.size} members are stable: simulating them without noise and loads")
    return stability_of(*study.batch(index), study.clock).findings()


def _pictures(
    case: Case | MachineCase,
    study: AnyStudy,
    columns: dict[str, np.ndarray],
    summary: dict[str, Any] | None,
    out: pathlib.Path,
) -> None:
    from ambjax.pictures import ensembles

    if isinstance(case, Case) and isinstance(study, Study):
        drawn(out / "fan.png", lambda: ensembles.fan(*_bands(case, study, columns)), 150)
    drawn(out / "histograms.png", lambda: ensembles.histogram_figure(columns))
    if summary is not None and summary["drivers"][statistics.DECIDING]:  # there are none if no member survives
        of = statistics.DECIDING
        told = summary["drivers"][of], of, summary["explained"][of]["says"]
        drawn(out / "tornado.png", lambda: ensembles.tornado(*told), 150)


def _bands(case: Case, study: Study, columns: dict[str, np.ndarray]) -> tuple[Any, ...]:
    """Return the arguments of the fan chart."""
    lost_at = columns["lost_at"]
    # End the fan chart soon after the last loss if every member is lost.
    bands = study.bands(FAN_MEMBERS, FAN_TIMES, BEYOND * float(np.max(lost_at)))
    shown = {name: _quantiles(x, bands.extremes.get(name)) for name, x in bands.signals.items()}
    few = np.size(bands.trajectory.lost_at)
    title = case.name if few == study.members else f"{case.name}: bands of {few} of {study.members} members"
    limits = {"z - r": float(np.min(study.scenario.touchdown)), "u": float(np.min(study.scenario.u_max))}
    return bands.t, shown, limits, title, lost_at, columns["stalled"]


def _quantiles(x: np.ndarray, extremes: tuple[np.ndarray, np.ndarray] | None) -> dict[float, np.ndarray]:
    """Compute quantiles [T] of x [members, T] over the surviving members at each instant, keyed by per cent.

    NaN where no member survives. `extremes`, if given, replace the 0 and 100 % quantiles: minimum and maximum between
    neighbouring instants.
    """
    left = np.isfinite(x).any(axis=0)
    quantiles = np.full((len(BANDS), x.shape[1]), np.nan)
    quantiles[:, left] = np.nanquantile(x[:, left], np.array(BANDS) / 100, axis=0)
    if extremes is not None:
        quantiles[[0, -1]] = extremes
    return dict(zip(BANDS, quantiles, strict=True))


def study_tables(summary: dict[str, Any], stable: str = "") -> str:
    """Return the tables that the command prints. `stable`: the sentence on the stability of the members."""
    share, low, high = (100 * summary["survival"][key] for key in ("estimate", "low", "high"))
    sure = f"{100 * summary['confidence']:g} % interval"
    held = f"{summary['survivors']} of {summary['members']} members survive"
    lines = [f"{held}: {share:.4g} % ({sure} {low:.4g} to {high:.4g} %)"]
    if summary["stalled"]:
        why = "the integrator stalled, so whether the rotor survives is not known"
        lines += [f"{summary['lost']} lost, {summary['stalled']} not decided: {why}"]
    lines += [stable] * bool(stable)
    lines += [f"note: {note}" for note in summary["notes"]]

    if summary["survivors"]:
        rows = []
        for name in METRICS:
            metric = summary["metrics"][name]
            shown = [metric[key]["estimate"] for key in ("median", "q95", "cvar_95")] + [metric["max"]]
            rows.append((name, *map(number, shown)))
        head = f"metric over the {summary['metrics_of']}"
        lines += ["", table((head, "median", "95 % quantile", "mean of worst 5 %", "largest"), rows)]
    drivers, account = summary["drivers"][statistics.DECIDING][:5], summary["explained"][statistics.DECIDING]
    if drivers:
        where = f"{statistics.DECIDING} over the {summary['metrics_of']}"
        lines += ["", f"Influence of the spread quantities on {where}: {account['says']}."]
    if account["alone"]:
        bars = []
        for d in drivers:
            share, low, high = (f"{100 * d[key]:.1f}" for key in ("share", "low", "high"))
            bars.append((d["path"], f"{share} %", f"{low} to {high} %", f"{d['rho']:+.2f}"))
        lines += [table(("quantity", "share explained alone", sure, "rank correlation"), bars)]
    worst = summary["worst"][0]
    return "\n".join([*lines, "", f"To simulate the worst member: {one_line(worst['replay'])}"])
