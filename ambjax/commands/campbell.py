"""`ambjax campbell`: modes, critical speeds and response to unbalance of a machine against its speed."""

import argparse
import dataclasses
import pathlib

import numpy as np

from ambjax.cases.machine_case import MachineCase, with_notches_for
from ambjax.cases.reader import Case
from ambjax.cases.rotor_drawing import drawing_of, in_pairs, radial_axes
from ambjax.commands.reading import read_any_with_warnings, results
from ambjax.host.heartbeat import say
from ambjax.linear.linear_machine import turning_machines
from ambjax.linear.machine_stability import growth_of, machine_stability
from ambjax.linear.margins import poles_in_s
from ambjax.linear.rotor_modes import LIGHT, OTHERS, Mode, modes_of, springs_critical
from ambjax.linear.unbalance_response import (
    CriticalSpeed,
    UnbalanceResponse,
    a1_limit,
    critical_speeds,
    unbalance_response,
)
from ambjax.results.outputs import directory, drawn, plain, table, write_json
from ambjax.text.web_page import escape_markdown, render_page
from ambjax.text.words import markdown_table

PICTURES = ("campbell.png", "rotor.png", "unbalance.png")
WRITTEN = ("campbell.json", *PICTURES, "campbell.html")
# Number of speeds, and the end of their range as a multiple of the largest speed of the case: a critical speed up to
# 26 % above it needs a separation margin.
SPEEDS, BEYOND = 31, 1.3
# End of the range for a rotor that does not turn, rpm.
SLOWEST = 6000.0
# Largest speed that --to takes, rpm: the bound of rotor.speed.
FASTEST = 1e7
# Range of the stiffness in the critical-speed map, as shares of |k_s|, and its number of points.
SOFTEST, STIFFEST, STIFFNESSES = 1e-2, 1e2, 81
# Damping ratio below which the shape of a mode is drawn if no mode is lightly damped.
DAMPED = 0.95


def run(args: argparse.Namespace) -> tuple[int, dict[str, object]]:
    """Analyse a machine from 0 on in the direction of its speeds, and draw it. Exit code 1 if it is unstable at one."""
    case = read_any_with_warnings(args.case)
    if isinstance(case, Case):
        raise ValueError(
            f"{args.case}: it has no [rotor] with a kind, so it is a case of one axis, and campbell is for machines. "
            "`ambjax template machine` prints one; `ambjax sensitivity` analyses one axis."
        )
    fastest = max(abs(speed) for speed in case.speeds)
    end = args.to if args.to is not None else BEYOND * fastest or SLOWEST
    if args.to is not None and not 0 < end <= FASTEST:
        raise ValueError(f"--to {end:g}: it must be above 0 rpm and at most {FASTEST:g} rpm.")
    way = direction(case)
    out = directory(args.out, f"campbell-{case.name}", WRITTEN, args.force)
    say(f"linearising the machine at {SPEEDS} speeds or more")
    speeds = np.linspace(0.0, way * end, SPEEDS)
    case = with_notches_for(case, speeds.tolist())
    points = list(turning_machines(case.machine, case.clock.sample_period, speeds))
    systems = [point.system.without_idle() for point in points]
    poles = [poles_in_s(system) for system in systems]
    modes = [modes_of(point, case.machine.rotor) for point in points]
    growth = np.array([float(np.max(np.real(own))) for own in poles])
    rates, at = np.array([growth_of(system) for system in systems]), [(0, float(speed)) for speed in speeds]
    runs = machine_stability(case.machine, case.clock, at, rates)
    wrong = rates > 0 if runs is None else ~runs.stable
    unstable = [float(speed) for speed in speeds[wrong]]
    operating = operating_range(case)
    turned = case.machine.rotor.unbalances and radial_axes(case)
    found = unbalance_response(case.machine, case.clock.sample_period, way * end) if turned else None
    criticals = [] if found is None else critical_speeds(found, operating)
    springs = _on_springs(case) if in_pairs(case) else None
    summary = {
        "speeds_rpm": speeds, "stable": not unstable, "unstable_at_rpm": unstable, "growth_per_s": growth,
        "poles_per_s": [[[float(p.real), float(p.imag)] for p in own] for own in poles],
        "modes": [[mode.numbers() for mode in own] for own in modes],
        "unbalance": None if found is None else _unbalance(case, found, criticals, operating),
        "undamped_critical_speeds": springs
        and dict(zip(("stiffness_N_per_m", "speeds_rpm", "k_s"), springs, strict=True)),
    }  # fmt: skip
    words = f"unstable at {ranges(speeds, wrong)} rpm" if unstable else "stable"
    text = f"0 to {way * end:g} rpm: {words}; largest real part of a pole {growth.max():.4g} 1/s"
    text += "" if found is None else "\n" + unbalance_text(case, found, criticals, operating)
    with results(args, out, WRITTEN, lambda: text) as part:
        write_json(part / "campbell.json", summary)
        _pictures(case, (speeds, modes, criticals, springs), found, part)
        (part / "campbell.html").write_text(_report(case, text, speeds, modes, part), encoding="utf-8")
    return int(bool(unstable)), plain(summary | {"out": str(out)})


def _report(case: MachineCase, text: str, speeds: np.ndarray, modes: list[list[Mode]], part: pathlib.Path) -> str:
    """Return a page with the printed text, the pictures, and the modes at the lowest and the highest speed."""
    pictures = {name: (part / name).read_bytes() for name in PICTURES if (part / name).exists()}
    lines = [f"# Modes and unbalance of {escape_markdown(case.name)}", "", "```text", text, "```"]
    lines += [line for name in pictures for line in ("", f"![{name}]({name})")]
    for k in (0, -1):
        rows = [(f"{mode.frequency:.4g}", f"{mode.damping:.3g}", mode.label) for mode in modes[k]]
        lines += ["", f"## Modes of the closed loops at {speeds[k]:g} rpm", ""]
        lines += markdown_table(("frequency, Hz", "damping ratio", "mode"), rows)
    return render_page("\n".join(lines), pictures, f"Modes of {case.name}")


def ranges(speeds: np.ndarray, wrong: np.ndarray) -> str:
    """Return the speeds (rpm) that are wrong as text: the first and the last one of each group of neighbours."""
    edges = np.diff(np.concatenate([[0], wrong.astype(int), [0]]))
    groups = zip(speeds[np.flatnonzero(edges > 0)], speeds[np.flatnonzero(edges < 0) - 1], strict=True)
    return ", ".join(f"{low:g}" if low == high else f"{low:g} to {high:g}" for low, high in groups)


def direction(case: MachineCase) -> int:
    """Return the sign of the speeds of the case, 1 for a rotor at rest. Raises ValueError for speeds of both signs."""
    if min(case.speeds) < 0 < max(case.speeds):
        listed = ", ".join(f"{speed:g}" for speed in case.speeds)
        raise ValueError(
            f"campbell: the speeds of the case, {listed} rpm, have both signs, and one scan has one direction. "
            "Give sensitivity.speeds of one sign."
        )
    return -1 if min(case.speeds) < 0 else 1


def operating_range(case: MachineCase) -> tuple[float, float]:
    """Return the lowest and the highest operating speed without sign, rpm: the speeds of the case other than 0.

    A run-up, or the speed 0 beside others, counts as a transient: only its end counts.
    """
    speeds = [abs(speed) for speed in case.speeds if speed != 0]
    first, rotor = abs(float(case.machine.rotor.speed)), case.machine.rotor
    varying = float(rotor.acceleration) != 0 or bool(rotor.changes)
    if varying and len(case.speeds) == 2 and len(speeds) == 2 and first == speeds[0]:
        speeds = speeds[1:]
    return (min(speeds), max(speeds)) if speeds else (0.0, 0.0)


def _unbalance(
    case: MachineCase, found: UnbalanceResponse, criticals: list[CriticalSpeed], operating: tuple[float, float]
) -> dict[str, object]:
    limit, largest = _vibration(found, operating)
    way = direction(case)
    return {
        "operating_rpm": [way * speed for speed in operating],
        "critical_speeds": [
            {
                "speed_rpm": way * one.speed, "axis": case.axes[one.axis], "peak_to_peak_m": one.peak_to_peak,
                "amplification_factor": one.amplification, "separation_required_percent": one.required,
                "separation_percent": one.present, "separated": one.separated,
            }
            for one in criticals
        ],
        "a1_limit_m": limit,
        "largest_peak_to_peak_m": largest,
        "speeds_rpm": way * found.speeds,
        "amplitudes": {
            name: {axis: np.abs(getattr(found, name)[:, k]) for k, axis in enumerate(case.axes)}
            for name in ("sensors", "magnets", "current", "command")
        },
    }  # fmt: skip


def _vibration(found: UnbalanceResponse, operating: tuple[float, float]) -> tuple[float, float]:
    """Return A1 at the highest operating speed, and the largest displacement at a sensor at operating speeds, m.

    The displacement is NaN if the machine is not stable at one of these speeds, or if the scan ends below one of them.
    """
    size = 2 * np.abs(found.sensors).max(1)
    between = (found.speeds > operating[0]) & (found.speeds < operating[1])
    ends = np.interp(operating, found.speeds, size, right=np.nan)
    return float(a1_limit(operating[1])), float(np.max([*ends, *size[between]]))


def _on_springs(case: MachineCase) -> tuple[np.ndarray, list[np.ndarray], float]:
    """Return stiffnesses (N/m), the undamped critical speeds (rpm) of the rotor on such springs, and |k_s| (N/m)."""
    k_s = abs(float(case.cases[radial_axes(case)[0]].scenario.plant.k_s))
    stiffness = k_s * np.geomspace(SOFTEST, STIFFEST, STIFFNESSES)
    return stiffness, springs_critical(case.machine.rotor, stiffness), k_s


def _pictures(case: MachineCase, analysed: tuple, found: UnbalanceResponse | None, part: pathlib.Path) -> None:
    """Draw the pictures. `analysed`: speeds, modes, critical speeds, and `_on_springs` (None: no rotor is drawn)."""
    from ambjax.pictures.machine_pictures import campbell_picture
    from ambjax.pictures.rotor_pictures import rotor_picture, unbalance_picture

    speeds, modes, criticals, springs = analysed
    way, operating = direction(case), operating_range(case)
    case = dataclasses.replace(case, name=case.name + ", negative speeds" * (way < 0))
    drawn(part / "campbell.png", lambda: campbell_picture(case.name, abs(speeds), modes))
    if found is not None and np.isfinite(found.sensors).any():  # stable at a speed
        drawn(part / "unbalance.png", lambda: unbalance_picture(case, found, criticals, operating))
    if springs is None:
        return
    speed = way * operating[1]
    point = next(turning_machines(case.machine, case.clock.sample_period, [speed]))
    flat = ("axial", *OTHERS)
    bent = [mode for mode in modes_of(point, case.machine.rotor) if mode.name not in flat and mode.damping < DAMPED]
    light = [mode for mode in bent if mode.damping < LIGHT]
    shown = light or bent
    drawn(part / "rotor.png", lambda: rotor_picture(case.name, drawing_of(case), shown, springs, speed))


def unbalance_text(
    case: MachineCase, found: UnbalanceResponse, criticals: list[CriticalSpeed], operating: tuple[float, float]
) -> str:
    """Return the critical speeds and the vibration at operating speeds as text."""
    way, (low, high) = direction(case), operating  # 0: no margin to a rotor at rest
    rows = [
        (
            f"{way * one.speed:.0f}", case.axes[one.axis],
            *((f"{1e6 * one.peak_to_peak:.3g}", f"{one.amplification:.3g}") if np.isfinite(one.amplification)
              else ("-", "undamped")),
            *(("none" if one.required is None else f"{one.required:.3g}", f"{one.present:.3g}",
               "yes" if one.separated else "NO") if high else "---"),
        )
        for one in criticals
    ]  # fmt: skip
    limit, largest = _vibration(found, operating)
    header = ("critical speed, rpm", "axis", "um p-p", "AF", "margin required, %", "present, %", "enough")
    speeds = (f"{way * low:g} to " if low != high else "") + f"{way * high:g} rpm"
    last = f"unbalance at {speeds}: {1e6 * largest:.3g} um peak to peak at the sensors; limit A1 {1e6 * limit:.3g} um"
    last += ", exceeded" if largest > limit else ""
    if np.isnan(largest):
        end = float(found.speeds[-1])
        why = "the machine is unstable at one of these speeds" if high <= end else f"the scan ends at {way * end:g} rpm"
        last = f"unbalance at {speeds}: not judged by A1, because {why}"
    none = "no critical speed with a peak" + " at the stable speeds" * bool(np.isnan(found.sensors).any())
    return "\n".join([table(header, rows) if rows else none, *([last] if high else [])])
