"""The summary of `ambjax sensitivity` as plain data, and as text."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ambjax.cases.reader import Case
from ambjax.commands.band_text import band_lines, band_numbers
from ambjax.control.base import set_valued_signs
from ambjax.control.cascade import DEFAULT_LAWS
from ambjax.linear import PLACES, Injection, MemberPeaks, StateSpace, Zones
from ambjax.results.operating import OperatingPoint, SpreadPeaks, analysis_summary
from ambjax.results.outputs import table
from ambjax.text.words import number

UNSTABLE = "The nominal loop is not stable, so it has no peaks, no zone and no margins, and nothing is injected."
WITHOUT = "The nominal loop is stable, but its linear loop is not, and has no peaks, no zone and no margins."


class Injections(NamedTuple):
    """The measured sensitivity at the position sensor, and at the velocity sensor (None without a velocity sensor)."""

    position: Injection
    velocity: Injection | None


def set_valued(case: Case) -> list[str]:
    """Return the names of the case-file tables of the laws with set-valued signs; none without a processor."""
    if not case.cascade.sampled:
        return []
    return [f"controller.{stage}" for stage in DEFAULT_LAWS if set_valued_signs(getattr(case.cascade, stage))]


def signs_note(cases: Sequence[Case]) -> list[str]:
    """Return the line on the set-valued signs of a case, or of the axes of a machine; none without such signs."""
    if not (signs := sorted({name for case in cases for name in set_valued(case)})):
        return []
    return [
        f"{', '.join(signs)}: the signs are set-valued. The linear analysis applies while the signal of each law "
        "stays inside its band, that is, without chattering; runs without noise and loads decide on the stability."
    ]


def sensitivity_summary(
    points: list[OperatingPoint],
    spread: SpreadPeaks | None,
    measured: Injections | None,
    zones: Zones,
    missing: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, object]:
    """Return the numbers of sensitivity.json: of the equilibria `points`, the spread, and the injection."""

    def numbers(point: OperatingPoint) -> dict[str, object]:
        own = {"stable": point.stable, "zone": point.zone}
        return analysis_summary(point.analysis) | own | band_numbers(point.analysis, zones)

    rows: list[dict[str, object]] = [{"point": one.name, "reference_m": one.r, **numbers(one)} for one in points]
    rows += [{"point": name, "stable": None, "zone": None, "why": why} for name, why in missing.items()]
    summary: dict[str, object] = {**numbers(points[0]), **_position_numbers(points[0], measured), "points": rows}
    if spread is not None:
        worst = {} if spread.point is None else numbers(spread.point)
        counts = {name: getattr(spread, name) for name in ("members", "stable", "zone_a", "failed")}
        summary["spread"] = {**counts, "worst_member": spread.worst, **({"worst": worst} if worst else {})}
        if spread.measured is not None:
            summary["spread"] |= _measured_numbers(spread.measured, zones)
    return summary


def _measured_numbers(peaks: MemberPeaks, zones: Zones) -> dict[str, object]:
    """Return the numbers of the measured peaks of the members; the peak is None if the worst member is lost."""
    worst = int(np.argmax(peaks.peak))
    lost = bool(peaks.lost[worst])
    return {
        "injected_zone_a": int((peaks.peak < float(zones.zone_a)).sum()),
        "injected_lost": int(peaks.lost.sum()),
        "injected_worst_member": worst,
        "injected_worst_peak": None if lost else float(peaks.peak[worst]),
        "injected_worst_frequency_hz": None if lost else float(peaks.frequency[worst]),
    }


def _position_numbers(point: OperatingPoint, measured: Injections | None) -> dict[str, object]:
    """Return the numbers of the measured sensitivity at both sensors; those of `injected_numbers` without one."""
    if measured is None:
        return injected_numbers(None, None)
    velocity = measured.velocity
    return injected_numbers(point.system if point.analysis.stable else None, measured.position) | {
        "injected_velocity_peak": None if velocity is None else velocity.peak,
        "injected_velocity_frequency_hz": None if velocity is None else velocity.peak_frequency,
    }


def injected_numbers(system: StateSpace | None, one: Injection | None, channel: int = 0) -> dict[str, object]:
    """Return the numbers of a measured sensitivity, None without one. `system`: None if it is not stable."""
    if one is None:
        return {"injected_peak": None, "injected_low": None, "injected_high": None}
    return {
        "injected_peak": one.peak,
        "injected_low": one.peak_low,
        "injected_high": one.peak_high,
        "injected_frequency_hz": one.peak_frequency,
        "injected_at_band_edge": _at_edge(one),
        "injected_linear_there": _linear_there(system, one, channel),
        "injected_amplitude_m": one.amplitude,
        "injected_members": one.members,
        "injected_lost": one.lost,
        "injected_saturated": one.saturated,
    }


def _linear_there(system: StateSpace | None, measured: Injection, channel: int) -> float | None:
    """Return the linear |S| at the frequency of the injected peak."""
    if measured.peak_frequency is None or system is None:
        return None
    return float(np.abs(system.response(np.array([measured.peak_frequency])))[0, channel, channel])


def _at_edge(measured: Injection) -> bool | None:
    return None if measured.peak is None else measured.peak_frequency in measured.frequency[[0, -1]]


def injection_text(
    system: StateSpace | None,
    measured: Injection,
    zones: Zones | None,
    linear: str = "",
    channel: int = 0,
    at: str = "",
) -> str:
    """Describe the measured sensitivity at one sensor in one line.

    `system`: None if it is not stable. `zones`: those of the position sensor; None at the velocity sensor. `linear`:
    zone of the linear peak.
    """
    unit = "m/s" if zones is None else "m"
    how = f"Injected{at} into the simulation (multi-sine of {measured.amplitude:.3g} {unit}"
    how += f", {measured.members} members)" if measured.members > 1 else ")"
    if measured.peak is None:
        return f"{how}: the rotor is lost, so no sensitivity can be measured. Use a smaller sensitivity.amplitude."
    text = f"{how}: |S| peaks at {measured.peak:.4g} at {measured.peak_frequency:.4g} Hz"
    if zones is not None:
        zone = zones.zone(measured.peak)
        text += f", zone {zone}" + f" (the linear peak: zone {linear})" * bool(linear and zone != linear)
    if _at_edge(measured):
        text += ", an end of the measured band, so this value is not a peak"
    if measured.peak_low is not None and measured.members > 1:
        text += f" (95 % interval {measured.peak_low:.4g} to {measured.peak_high:.4g})"
    there = _linear_there(system, measured, channel)
    text += "." if there is None else f"; the linear value there is {there:.4g}."
    if measured.lost:
        text += f" {measured.lost} of {measured.members} members lose the rotor and are left out."
    if measured.saturated:
        text += f" The supply limits u in {100 * measured.saturated:.2g} % of the samples, where the linear values do "
        text += "not apply. A smaller sensitivity.amplitude measures the loop without this limit."
    return text


def text_of(case: Case, points: list[OperatingPoint], spread: SpreadPeaks | None, measured: Injections | None) -> str:
    """Return the numbers of `sensitivity_summary` as a table and sentences."""
    worst = [spread.point] if spread is not None and spread.point is not None else []
    head = ("loop", "peak |S|", "at (Hz)", "zone", "peak |T|", "peak |KS| (V/m)")
    margins = ("loop", "broken at", "gain margins", "phase margin (deg)", "delay margin (s)", "disk margin")
    shown = [*points, *worst]
    rows = [table(head, [_row(point) for point in shown]), ""]
    one, zones = points[0].analysis, case.zones
    stable = [point for point in shown if point.analysis.stable]
    bands = [line for point in stable for line in band_lines(point.name, point.analysis, zones)]
    rows += [*bands, ""] if bands else []
    if stable:
        rows += [table(margins, [row for point in stable for row in _margin_rows(point)]), ""]
        first = stable[0].analysis
        where = first.margins_at.place("delay")
        rows += [f"The delay margin is the smaller one, {_delay(case, first.margins.delay)}, at the {where}."]
        rows += [
            f"Zones of the peak of |S|: A below {zones.zone_a:g}, B below {zones.zone_b:g}, C below {zones.zone_c:g}, "
            "D above."
        ]
    growth = f"Largest real part of the poles: {number(one.poles[0].real)} 1/s."
    if one.stable:
        stiffness = f"{number(one.stiffness)} N/m" if np.isfinite(one.stiffness) else "infinite"
        rows += [f"Static stiffness: {stiffness}. Rms of z per rms of position noise: {number(one.noise)}. {growth}"]
    else:
        rows += [f"{WITHOUT if points[0].stable else UNSTABLE} {growth}"]
    if measured is not None:
        system, velocity = points[0].system if one.stable else None, measured.velocity
        rows += [injection_text(system, measured.position, zones, points[0].zone or "")]
        rows += [] if velocity is None else [injection_text(system, velocity, None, "", 1, " at the velocity sensor")]
    if spread is not None:
        rows += [
            f"Of {spread.members} members of [spread], {spread.stable} are stable and {spread.zone_a} are in zone A; "
            f"the worst is member {spread.worst}."
        ]
        if spread.failed:
            rows += [f"{spread.failed} of them have no equilibrium at r = 0 m, and so no linearised loop."]
        rows += [] if spread.measured is None else [_measured_text(spread.measured, case.zones)]
    rows += signs_note([case])
    if one.S_velocity is not None and one.stable:
        larger = "velocity" if one.S_velocity.height > one.S.height else "position"
        rows += [
            "The velocity has its own sensor. |S| at the position sensor does not include the errors of the velocity "
            f"sensor; |S| at the velocity sensor peaks at {one.S_velocity.height:.4g}. The {larger} sensor gives the "
            "larger peak."
        ]
    return "\n".join(rows)


def _measured_text(peaks: MemberPeaks, zones: Zones) -> str:
    numbers, members = _measured_numbers(peaks, zones), len(peaks.peak)
    text = f"Injected into each of the {members} members: {numbers['injected_zone_a']} are in zone A"
    if peaks.lost.any():
        return f"{text}; {numbers['injected_lost']} lose the rotor, first member {numbers['injected_worst_member']}."
    return (
        f"{text}; the largest peak is {numbers['injected_worst_peak']:.4g} at "
        f"{numbers['injected_worst_frequency_hz']:.4g} Hz, of member {numbers['injected_worst_member']}."
    )


def _row(point: OperatingPoint) -> tuple[str, ...]:
    one = point.analysis
    if not one.stable:
        return (point.name, "no peak" if point.stable else "unstable", *["-"] * 4)
    S, T, KS = (number(x.height) + (" (at edge)" if x.at_edge else "") for x in (one.S, one.T, one.KS))
    return (point.name, S, number(one.S.frequency), one.zone, T, KS)


def _margin_rows(point: OperatingPoint) -> list[tuple[str, ...]]:
    """Return the margins of a stable loop at each place, the place with the smaller disk margin first."""
    at, rows = point.analysis.margins_at, []
    for place in sorted(PLACES, key=lambda place: place != at.place("dm")):
        one = getattr(at, place)
        gains = f"{number(one.gm_low)} to {number(one.gm_high)}"
        rows.append((point.name, place, gains, *map(number, (one.pm, one.delay, one.dm))))
    return rows


def _delay(case: Case, delay: float) -> str:
    samples = f" ({number(delay / float(case.clock.sample_period))} samples)" if case.cascade.sampled else ""
    return f"{number(delay)} s{samples}"
