"""`ambjax sensitivity`: sensitivity peaks, ISO 14839-3 zones, margins and stiffness of a case's loop."""

import argparse
import dataclasses
import math
import pathlib
from typing import NamedTuple

import numpy as np

from ambjax.cases.reader import Case
from ambjax.commands.ensemble import study_of
from ambjax.commands.outputs import directory, files, plain, table, write_json, written
from ambjax.commands.warnings import read_with_warnings
from ambjax.control.base import hard_signs
from ambjax.control.cascade import USUAL
from ambjax.ensemble.study import Study
from ambjax.linear import Injection, injected, lines
from ambjax.linear.multisine import Reading
from ambjax.results.operating import MEMBERS, OperatingPoint, SpreadPeaks, numbers_of, operating_point, spread_peaks

WRITTEN = ("sensitivity.json", "sensitivity.png")
# Members of the injection, which differ in the noise.
INJECTED = 8


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Analyse the loop of a case. Exit code 1 if the nominal loop, or one of its members, is not stable."""
    case = read_with_warnings(args.case)
    study = _study(case, args)
    points = [operating_point(case, name, r) for name, r in references(case)]
    spread = None if study is None else spread_peaks(case, study)
    measured = _injections(case, points[0]) if args.inject or case.cascade.processor is not None else None
    out = directory(args.out, f"sensitivity-{case.name}", WRITTEN, args.force)
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
    """Return the names and references r (m) of the equilibria: 0, and plus and minus the largest |r| of the case."""
    t = np.linspace(0.0, float(case.clock.duration), 2001)
    r = np.asarray([float(case.scenario.reference(x)) for x in t])
    size = float(np.max(np.abs(r)))
    ends = [] if size == 0 else [("at +reference", size), ("at -reference", -size)]
    return [("nominal", 0.0), *ends]


class Injections(NamedTuple):
    """The measured sensitivity at the position sensor, and at the velocity sensor; None without that sensor."""

    position: Injection
    velocity: Injection | None


def _injections(case: Case, point: OperatingPoint) -> Injections:
    """Measure the sensitivity of the nominal loop by injection into the simulation, at each sensor of the motion."""
    velocity, one = None, point.analysis
    if one.S_velocity is not None:
        velocity = _injected(case, one.S_velocity.frequency, "z_dot")
    return Injections(_injected(case, one.S.frequency, "z"), velocity)


def _injected(case: Case, peak: float, reading: Reading) -> Injection:
    """Inject at one sensor, over one period of the lines, which are denser near `peak` (Hz)."""
    zones, period = case.zones, float(case.clock.sample_period)
    clock = dataclasses.replace(case.clock, samples=math.ceil(1 / (float(zones.f_low) * period)))
    members = INJECTED if case.scenario.random else 1
    at = lines(zones, clock, peak)
    return injected(case.cascade, case.scenario, clock, at, reading=reading, members=members)


def _study(case: Case, args: argparse.Namespace) -> Study | None:
    """Return the study of the case's spread; None without one. Raises ValueError for --members without [spread]."""
    if not case.spread.entries:
        if args.members is not None:
            raise ValueError("--members: all members of this case are the same. Add [spread] to the case, or omit it.")
        return None
    return study_of(case, args.seed, MEMBERS if args.members is None else args.members)


def _summary(
    points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injections | None
) -> dict[str, object]:
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


def _injected_numbers(point: OperatingPoint, measured: Injections | None) -> dict[str, object]:
    """Return the numbers of the measured sensitivity; None each if it was not measured."""
    if measured is None:
        return {"injected_peak": None, "injected_low": None, "injected_high": None}
    one = measured.position
    return {
        "injected_peak": one.peak,
        "injected_low": one.peak_low,
        "injected_high": one.peak_high,
        "injected_frequency_hz": one.peak_frequency,
        "injected_linear_there": _linear_there(point, one),
        "injected_amplitude_m": one.amplitude,
        "injected_members": one.members,
        "injected_lost": one.lost,
        "injected_saturated": one.saturated,
        "injected_velocity_peak": None if measured.velocity is None else measured.velocity.peak,
        "injected_velocity_frequency_hz": None if measured.velocity is None else measured.velocity.peak_frequency,
    }


def _linear_there(point: OperatingPoint, measured: Injection, channel: int = 0) -> float | None:
    """Return the linear |S| at the frequency of the injected peak. `channel`: 0 position sensor, 1 velocity sensor."""
    if measured.peak_frequency is None:
        return None
    return float(np.abs(point.system.response(np.array([measured.peak_frequency])))[0, channel, channel])


def _injection_text(point: OperatingPoint, measured: Injection, channel: int = 0) -> str:
    """Describe the measured sensitivity at one sensor in one line. `channel` as in `_linear_there`."""
    unit, sensor = (("m", ""), ("m/s", " at the velocity sensor"))[channel]
    how = f"Injected{sensor} into the simulation (multi-sine of {measured.amplitude:.3g} {unit}"
    how += f", {measured.members} members)" if measured.members > 1 else ")"
    if measured.peak is None:
        return f"{how}: the rotor is lost, so no sensitivity can be measured."
    text = f"{how}: |S| peaks at {measured.peak:.4g} at {measured.peak_frequency:.4g} Hz"
    if measured.peak_low is not None and measured.members > 1:
        text += f" (95 % interval {measured.peak_low:.4g} to {measured.peak_high:.4g})"
    text += f"; the linear value there is {_linear_there(point, measured, channel):.4g}."
    if measured.lost:
        text += f" {measured.lost} of {measured.members} members lose the rotor and are left out."
    if measured.saturated:
        text += (
            f" The supply limits u in {100 * measured.saturated:.2g} % of the samples, where the linear values do not"
        )
        text += " apply."
    return text


def _text(case: Case, points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injections | None) -> str:
    worst = [spread.point] if spread is not None and spread.point is not None else []
    head = ("loop", "peak |S|", "at (Hz)", "zone", "peak |T|", "peak |KS| (V/m)", "gain margins")
    margins = ("phase margin (deg)", "delay margin (s)", "disk margin")
    rows = [table((*head, *margins), [_row(point) for point in [*points, *worst]]), ""]
    one, zones = points[0].analysis, case.zones
    rows += [
        f"Zones of the peak of |S|: A below {zones.zone_a:g}, B below {zones.zone_b:g}, C below {zones.zone_c:g}, D "
        "above.",
        f"Static stiffness: {_number(one.stiffness)} N/m. Rms of z per rms of position noise: {_number(one.noise)}. "
        f"Largest real part of the poles: {_number(one.poles[0].real)} 1/s.",
    ]
    if not one.stable:
        rows += ["The nominal loop is not stable: the rotor does not stay at this equilibrium."]
    if measured is not None:
        rows += [_injection_text(points[0], measured.position)]
        rows += [] if measured.velocity is None else [_injection_text(points[0], measured.velocity, channel=1)]
    if spread is not None:
        rows += [
            f"Of {spread.members} members of [spread], {spread.stable} are stable and {spread.zone_a} are in zone A; "
            f"the worst is member {spread.worst}."
        ]
    signs = [f"controller.{stage}" for stage in USUAL if hard_signs(getattr(case.cascade, stage))]
    if signs and case.cascade.processor is not None:
        rows += [
            f"{', '.join(signs)}: the signs are set-valued. The linear analysis applies while the signal of each law "
            "stays inside its band, that is, without chattering."
        ]
    if one.S_velocity is not None:
        larger = "velocity" if one.S_velocity.height > one.S.height else "position"
        rows += [
            "The velocity has its own sensor, whose errors |S| of the position sensor leaves out: for them |S| peaks "
            f"at {one.S_velocity.height:.4g}. The {larger} sensor gives the larger peak."
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
    return f"{x:.4g}"


def _draw(
    case: Case,
    points: list[OperatingPoint],
    spread: SpreadPeaks | None,
    measured: Injections | None,
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
    one = None if measured is None else measured.position
    if one is not None and one.S is not None and one.T is not None and one.KS is not None:
        injected_points = frequency.MeasuredPoints(one.frequency, one.S, one.T, one.KS)
    frequency.sensitivity(case.name, loops, limits, (low, high), path, injected_points)
