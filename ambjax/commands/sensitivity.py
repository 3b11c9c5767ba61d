"""`ambjax sensitivity`: sensitivity peaks, ISO 14839-3 zones, margins and stiffness of a case's loop."""

import argparse
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reach import largest
from ambjax.cases.reader import Case
from ambjax.commands import machine_commands
from ambjax.commands.band_text import running_facts, running_speeds
from ambjax.commands.reading import read_any_with_warnings, results
from ambjax.commands.sensitivity_report import Injections, sensitivity_summary, set_valued, text_of
from ambjax.ensemble.study import Study
from ambjax.host.heartbeat import FIRST_RUN, doing
from ambjax.linear import Injection, frequency_lines, injected
from ambjax.linear.injection import REPETITIONS
from ambjax.linear.member_responses import Reading
from ambjax.results import operating
from ambjax.results.operating import OperatingPoint, SpreadPeaks
from ambjax.results.outputs import directory, drawn, plain, write_json
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
    with ThreadPoolExecutor(1) as pool:  # the nominal loop on one core, the members on the other one
        with doing(f"linearising the loop at the equilibria, and those of the members; {FIRST_RUN}"):
            nominal = pool.submit(_points, case)
            spread = None if study is None else operating.spread_peaks(case, study)
            points, missing = nominal.result()
        injects = points[0].stable and (args.inject or case.cascade.sampled)
        with doing(f"measuring the sensitivity by injection into the simulation; {FIRST_RUN}"):
            injection = pool.submit(_injections, case, points[0]) if injects else None
            if spread is not None and study is not None and set_valued(case) and points[0].stable:
                peaks = operating.measured_peaks(case, study, points[0].analysis.S.frequency)
                spread = spread._replace(measured=peaks)
            measured = injection and injection.result()
    out = directory(args.out, f"sensitivity-{case.name}", WRITTEN, args.force)
    summary = sensitivity_summary(points, spread, measured, case.zones, missing)
    speeds, first = running_speeds(case.scenario.rotor, float(case.clock.duration)), points[0]
    summary["running_speed"], lines = running_facts(speeds, first.system, first.analysis.S)

    def text() -> str:
        words = text_of(case, points, spread, measured)
        return "\n".join([words, *(f"{name}: {missing[name]}" for name in missing), *lines])

    with results(args, out, WRITTEN, text) as part:
        write_json(part / "sensitivity.json", summary)
        drawn(part / "sensitivity.png", lambda: _drawn(case, points, spread, measured), 110)
    stable = all(point.stable for point in points) and (spread is None or spread.stable == spread.members)
    return int(bool(missing) or not stable), plain(summary | {"out": str(out)})


def _injections(case: Case, point: OperatingPoint) -> Injections:
    """Measure the sensitivity of the nominal loop, `point`, by injection."""
    one = point.analysis
    velocity = None if one.S_velocity is None else _injected(case, one.S_velocity.frequency, "z_dot")
    return Injections(_injected(case, one.S.frequency, "z"), velocity)


def _points(case: Case) -> tuple[list[OperatingPoint], dict[str, str]]:
    """Return the loops at the references, and the cause, by name, for each reference other than 0 without a loop."""
    (first, *rest), missing = references(case), {}
    points = [operating.operating_point(case, *first)]
    for name, r in rest:
        try:
            points.append(operating.operating_point(case, name, r))
        except ValueError as error:
            missing[name] = str(error)
    return points, missing


def references(case: Case) -> list[tuple[str, float]]:
    """Return the names and references r (m) of the equilibria: 0, and plus and minus the largest |r| of the case."""
    size = largest(case.scenario, case.clock)
    ends = [] if size == 0 else [("at +reference", size), ("at -reference", -size)]
    return [("nominal", 0.0), *ends]


def _injected(case: Case, peak: float, reading: Reading) -> Injection:
    """Inject a multi-sine at one sensor, and measure over one period. Its frequencies are denser near `peak` (Hz)."""
    clock, members = operating.one_period(case), REPETITIONS if case.scenario.random else 1
    at = frequency_lines(case.zones, clock, peak)
    amplitude = case.zones.amplitude
    if amplitude is not None and reading == "z_dot":
        amplitude = float(amplitude) * float(case.scenario.plant.pole)
    return injected(case.cascade, case.scenario, clock, at, reading=reading, amplitude=amplitude, members=members)


def _study(case: Case, args: argparse.Namespace) -> Study | None:
    """Return the study of the case's spread; None without one. Raises ValueError for --members without [spread]."""
    if not case.spread.entries:
        if args.members is not None:
            advice = "Add [spread] to the case, or omit --members."
            raise ValueError(f"--members: all members of this case are the same. {advice}")
        return None
    return study_of(case, args.seed, operating.MEMBERS if args.members is None else args.members)


def _drawn(case: Case, points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injections | None) -> Any:
    from ambjax.pictures import frequency

    shown = [point for point in points if point.analysis.stable]
    if spread is not None and spread.point is not None and spread.point.analysis.stable:
        shown.append(spread.point)
    one = None if measured is None else measured.position
    span = operating.shown_band(case, [point.system for point in shown])
    injected_points = None if one is None or one.S is None else one
    return frequency.frequency_figure(case.name, shown, case.zones.limits, span, injected_points)
