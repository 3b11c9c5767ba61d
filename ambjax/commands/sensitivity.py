"""`ambjax sensitivity`: sensitivity peaks, ISO 14839-3 zones, margins and stiffness of a case's loop."""

import argparse
from typing import Any

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reach import largest
from ambjax.cases.reader import Case
from ambjax.commands import machine_commands
from ambjax.commands.band_text import running_facts, running_speeds
from ambjax.commands.reading import read_any_with_warnings
from ambjax.commands.sensitivity_report import Injections, sensitivity_summary, set_valued, text_of
from ambjax.ensemble.study import Study
from ambjax.host.heartbeat import FIRST_RUN, doing
from ambjax.linear import Injection, frequency_lines, injected
from ambjax.linear.injection import REPETITIONS
from ambjax.linear.multisine import Reading
from ambjax.results.operating import (
    MEMBERS,
    OperatingPoint,
    SpreadPeaks,
    measured_peaks,
    one_period,
    operating_point,
    shown_band,
    spread_peaks,
)
from ambjax.results.outputs import described, directory, drawn, files, plain, write_json, written
from ambjax.results.spread_runs import study_of

WRITTEN = ("sensitivity.json", "sensitivity.png")


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Analyse the loop of a case.

    The exit code is 1 if the loop is not stable at an equilibrium or cannot be linearised at one of the references, or
    if a member is not stable. Raises ValueError as `linearise` does for the reference 0.
    """
    case = read_any_with_warnings(args.case)
    if isinstance(case, MachineCase):
        return machine_commands.sensitivity(args, case)
    study = _study(case, args)
    with doing(f"linearising the loop at the equilibria; {FIRST_RUN}"):
        points, missing = _points(case)
    spread = None if study is None else _spread(case, study, points[0])
    measured = None
    if points[0].stable and (args.inject or case.cascade.sampled):
        with doing(f"measuring the sensitivity by injection into the simulation; {FIRST_RUN}"):
            measured = _injections(case, points[0])
    out = directory(args.out, f"sensitivity-{case.name}", WRITTEN, args.force)
    summary = sensitivity_summary(points, spread, measured, case.zones, missing)
    speeds, first = running_speeds(case.scenario.rotor, float(case.clock.duration)), points[0]
    summary["running_speed"], lines = running_facts(speeds, first.system, first.analysis.S)
    with files(out) as part:
        write_json(part / "sensitivity.json", summary)
        drawn(part / "sensitivity.png", lambda: _drawn(case, points, spread, measured), 110)
        names = [name for name in WRITTEN if (part / name).exists()]
    if not args.json:
        tables = described("the table", lambda: text_of(case, points, spread, measured)) or ""
        print("\n".join([tables, *(f"{name}: {missing[name]}" for name in missing), *lines]))
        written(out, ", ".join(names))
    stable = all(point.stable for point in points) and (spread is None or spread.stable == spread.members)
    return int(bool(missing) or not stable), plain(summary | {"out": str(out)})


def _spread(case: Case, study: Study, point: OperatingPoint) -> SpreadPeaks:
    """Return the peaks of the members; with set-valued signs and a stable `point`, also those of an injection."""
    with doing(f"linearising the loops of the members; {FIRST_RUN}"):
        spread = spread_peaks(case, study)
    if not set_valued(case) or not point.stable:
        return spread
    with doing(f"measuring the sensitivity of the members by injection into the simulation; {FIRST_RUN}"):
        return spread._replace(measured=measured_peaks(case, study, point.analysis.S.frequency))


def _points(case: Case) -> tuple[list[OperatingPoint], dict[str, str]]:
    """Return the loops at the references, and the cause, by name, for each reference other than 0 without a loop."""
    (first, *rest), missing = references(case), {}
    points = [operating_point(case, *first)]
    for name, r in rest:
        try:
            points.append(operating_point(case, name, r))
        except ValueError as error:
            missing[name] = str(error)
    return points, missing


def references(case: Case) -> list[tuple[str, float]]:
    """Return the names and references r (m) of the equilibria: 0, and plus and minus the largest |r| of the case."""
    size = largest(case.scenario, case.clock)
    ends = [] if size == 0 else [("at +reference", size), ("at -reference", -size)]
    return [("nominal", 0.0), *ends]


def _injections(case: Case, point: OperatingPoint) -> Injections:
    """Measure the sensitivity of the nominal loop by injection into the simulation, at each sensor of the motion."""
    velocity, one = None, point.analysis
    if one.S_velocity is not None:
        velocity = _injected(case, one.S_velocity.frequency, "z_dot")
    return Injections(_injected(case, one.S.frequency, "z"), velocity)


def _injected(case: Case, peak: float, reading: Reading) -> Injection:
    """Inject a multi-sine at one sensor, and measure over one period. Its frequencies are denser near `peak` (Hz)."""
    clock, members = one_period(case), REPETITIONS if case.scenario.random else 1
    at = frequency_lines(case.zones, clock, peak)
    amplitude = case.zones.amplitude
    if amplitude is not None and reading == "z_dot":
        amplitude = float(amplitude) * float(case.scenario.plant.pole)
    return injected(case.cascade, case.scenario, clock, at, reading=reading, amplitude=amplitude, members=members)


def _study(case: Case, args: argparse.Namespace) -> Study | None:
    """Return the study of the case's spread; None without one. Raises ValueError for --members without [spread]."""
    if not case.spread.entries:
        if args.members is not None:
            raise ValueError(
                "--members: all members of this case are the same. Add [spread] to the case, or omit --members."
            )
        return None
    return study_of(case, args.seed, MEMBERS if args.members is None else args.members)


def _drawn(case: Case, points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injections | None) -> Any:
    from ambjax.pictures import frequency

    shown = [point for point in points if point.analysis.stable]
    if spread is not None and spread.point is not None and spread.point.analysis.stable:
        shown.append(spread.point)
    loops = [
        frequency.NamedLoop(point.name, point.system, point.m, point.analysis.margins_at.reading.dm) for point in shown
    ]
    injected_points = None
    one = None if measured is None else measured.position
    if one is not None and one.S is not None and one.T is not None and one.KS is not None:
        injected_points = frequency.MeasuredPoints(one.frequency, one.S, one.T, one.KS)
    span = shown_band(case, [point.system for point in shown])
    return frequency.frequency_figure(case.name, loops, case.zones.limits, span, injected_points)
