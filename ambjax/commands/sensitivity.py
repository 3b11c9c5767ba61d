"""`ambjax sensitivity`: sensitivity peaks, ISO 14839-3 zones, margins and stiffness of a case's loop."""

import argparse
import dataclasses
import math
import pathlib

import numpy as np

from ambjax.cases.reader import Case
from ambjax.commands.ensemble import study_of
from ambjax.commands.operating import MEMBERS, OperatingPoint, SpreadPeaks, numbers_of, operating_point, spread_peaks
from ambjax.commands.outputs import directory, files, plain, table, write_json, written
from ambjax.commands.warnings import read_with_warnings
from ambjax.control.base import hard_signs
from ambjax.control.cascade import USUAL
from ambjax.ensemble.study import Study
from ambjax.linear import Injection, injected, lines

WRITTEN = ("sensitivity.json", "sensitivity.png")
# Members of the injection, which differ in the noise.
INJECTED = 8


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Analyse the loop of a case. Exit code 1 if the nominal loop, or one of its members, is not stable."""
    case = read_with_warnings(args.case)
    study = _study(case, args)
    points = [operating_point(case, name, r) for name, r in references(case)]
    spread = None if study is None else spread_peaks(case, study)
    measured = _injected(case, points[0]) if args.inject or case.cascade.processor is not None else None
    out = directory(args.out, f"sensitivity-{case.name}", WRITTEN)
    summary = _summary(points, spread, measured)
    with files(out) as part:
        write_json(part / "sensitivity.json", summary)
        _draw(case, points, spread, measured, part / "sensitivity.png")
    if not args.json:
        print(_text(case, points, spread, measured))
        written(out, ", ".join(WRITTEN))
    stable = all(point.analysis.stable for point in points) and (spread is None or spread.stable == spread.members)
    return int(not stable), plain(summary | {"out": str(out)})


def references(case: Case) -> list[tuple[str, float]]:
    """Return the names and references (m) of the equilibria: 0, and the extremes of the case's reference."""
    t = np.linspace(0.0, float(case.clock.duration), 2001)
    r = np.asarray([float(case.scenario.reference(x)) for x in t])
    size = float(np.max(np.abs(r)))
    ends = [] if size == 0 else [("at +reference", size), ("at -reference", -size)]
    return [("nominal", 0.0), *ends]


def _injected(case: Case, point: OperatingPoint) -> Injection:
    """Measure the sensitivity of the nominal loop by injection into the simulation, over one period of the lines."""
    zones, period = case.zones, float(case.clock.sample_period)
    clock = dataclasses.replace(case.clock, samples=math.ceil(1 / (float(zones.f_low) * period)))
    members = INJECTED if case.scenario.random else 1
    return injected(
        case.cascade, case.scenario, clock, lines(zones, clock, point.analysis.S.frequency), members=members
    )


def _study(case: Case, args: argparse.Namespace) -> Study | None:
    """Return the study of the case's spread; None without one. Raises ValueError for --members without [spread]."""
    if not case.spread.entries:
        if args.members is not None:
            raise ValueError("--members: all members of this case are the same. Add [spread] to the case, or omit it.")
        return None
    return study_of(case, args.seed, MEMBERS if args.members is None else args.members)


def _summary(points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injection | None) -> dict[str, object]:
    rows = [{"point": point.name, "reference_m": point.r, **numbers_of(point.analysis)} for point in points]
    summary: dict[str, object] = {
        **numbers_of(points[0].analysis),
        **_injected_numbers(points[0], measured),
        "points": rows,
    }
    if spread is not None:
        worst = {} if spread.point is None else numbers_of(spread.point.analysis)
        counts = {"members": spread.members, "stable": spread.stable, "zone_a": spread.zone_a}
        summary["spread"] = {**counts, "worst_member": spread.worst, **({"worst": worst} if worst else {})}
    return summary


def _injected_numbers(point: OperatingPoint, measured: Injection | None) -> dict[str, object]:
    """Return the numbers of the measured sensitivity; None each if it was not measured."""
    if measured is None:
        return {"injected_peak": None, "injected_low": None, "injected_high": None}
    return {
        "injected_peak": measured.peak,
        "injected_low": measured.peak_low,
        "injected_high": measured.peak_high,
        "injected_frequency_hz": measured.peak_frequency,
        "injected_linear_there": _linear_there(point, measured),
        "injected_amplitude_m": measured.amplitude,
        "injected_members": measured.members,
        "injected_lost": measured.lost,
        "injected_saturated": measured.saturated,
    }


def _linear_there(point: OperatingPoint, measured: Injection) -> float | None:
    """Return the linear |S| at the frequency of the injected peak."""
    if measured.peak_frequency is None:
        return None
    return float(np.abs(point.system.sensitivity(np.array([measured.peak_frequency])))[0])


def _injection_text(point: OperatingPoint, measured: Injection) -> str:
    """Describe the measured sensitivity in one line."""
    how = f"Injected into the simulation (multi-sine of {measured.amplitude:.3g} m"
    how += f", {measured.members} members)" if measured.members > 1 else ")"
    if measured.peak is None:
        return f"{how}: the rotor is lost, so no sensitivity can be measured."
    text = f"{how}: |S| peaks at {measured.peak:.4g} at {measured.peak_frequency:.4g} Hz"
    if measured.peak_low is not None and measured.members > 1:
        text += f" (95 % interval {measured.peak_low:.4g} to {measured.peak_high:.4g})"
    text += f"; the linear value there is {_linear_there(point, measured):.4g}."
    if measured.lost:
        text += f" {measured.lost} of {measured.members} members lose the rotor and are left out."
    if measured.saturated:
        text += f" The supply limits u in {100 * measured.saturated:.2g} % of the samples: only the injection holds."
    return text


def _text(case: Case, points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injection | None) -> str:
    worst = [spread.point] if spread is not None and spread.point is not None else []
    head = ("loop", "peak of |S|", "at (Hz)", "zone", "|T|", "|KS| (V/m)", "gain margins", "phase (deg)", "delay (s)")
    rows = [table((*head, "disk"), [_row(point) for point in [*points, *worst]]), ""]
    one, zones = points[0].analysis, case.zones
    rows += [
        f"Zones of the peak of |S|: A below {zones.zone_a:g}, B below {zones.zone_b:g}, C below {zones.zone_c:g}, D "
        "above.",
        f"Static stiffness: {_number(one.stiffness)} N/m. Noise of the position sensor reaches z times "
        f"{_number(one.noise)} (rms). Slowest pole: {_number(abs(one.poles[0].real))} 1/s.",
    ]
    if not one.stable:
        rows += ["The nominal loop is not stable: the rotor does not stay at this equilibrium."]
    rows += [] if measured is None else [_injection_text(points[0], measured)]
    if spread is not None:
        rows += [
            f"Of {spread.members} members of [spread], {spread.stable} are stable and {spread.zone_a} are in zone A; "
            f"the worst is member {spread.worst}."
        ]
    signs = [f"controller.{stage}" for stage in USUAL if hard_signs(getattr(case.cascade, stage))]
    if signs and case.cascade.processor is not None:
        rows += [
            f"{', '.join(signs)}: the signs are set-valued. The linear analysis holds while each stays inside its "
            "band, so for motions without chattering."
        ]
    if one.S_velocity is not None:
        larger = "velocity" if one.S_velocity.height > one.S.height else "position"
        rows += [
            f"The velocity has its own sensor: for errors of that sensor |S| peaks at "
            f"{one.S_velocity.height:.4g}. The {larger} sensor gives the larger peak."
        ]
    return "\n".join(rows)


def _row(point: OperatingPoint) -> tuple[str, ...]:
    one = point.analysis
    if not one.stable:
        return (point.name, "unstable", "-", "D", *["-"] * 6)
    margins = one.margins
    gains = f"{_number(margins.gain_low)} to {_number(margins.gain_high)}"
    return (
        point.name,
        *map(_number, (one.S.height, one.S.frequency)),
        one.zone,
        *map(_number, (one.T.height, one.KS.height)),
        gains,
        *map(_number, (margins.phase_deg, margins.delay, margins.disk)),
    )


def _number(x: float) -> str:
    return "none" if math.isinf(x) else f"{x:.4g}"


def _draw(
    case: Case,
    points: list[OperatingPoint],
    spread: SpreadPeaks | None,
    measured: Injection | None,
    path: pathlib.Path,
) -> None:
    from ambjax.pictures import frequency

    shown = [point for point in points if point.analysis.stable]
    if spread is not None and spread.point is not None and spread.point.analysis.stable:
        shown.append(spread.point)
    loops = [frequency.NamedLoop(point.name, point.system, point.m, point.analysis.margins.disk) for point in shown]
    limits = [float(x) for x in (case.zones.zone_a, case.zones.zone_b, case.zones.zone_c)]
    low, high = case.zones.range(None if case.cascade.processor is None else case.clock.sample_period)
    injected_points = None
    if measured is not None and measured.S is not None and measured.T is not None and measured.KS is not None:
        injected_points = frequency.MeasuredPoints(measured.frequency, measured.S, measured.T, measured.KS)
    frequency.sensitivity(case.name, loops, limits, (low, high), path, injected_points)
