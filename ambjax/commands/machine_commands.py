"""`simulate` and `sensitivity` of a whole machine."""

import argparse
from typing import Any

import numpy as np
from tqdm import tqdm

from ambjax.cases.machine_case import MachineCase
from ambjax.cases.rotor_drawing import radial_axes
from ambjax.commands.band_text import band_lines, running_facts
from ambjax.commands.reading import results
from ambjax.commands.sensitivity_report import injected_numbers, injection_text, signs_note
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.linear import Injection, MachineSensitivity, Zones, machine_injected
from ambjax.page.rotor_motion import motion_page
from ambjax.results import operating
from ambjax.results.outputs import described, directory, drawn, plain, table, write_json
from ambjax.results.runs import simulate_machine
from ambjax.simulation.machine_kinds import SampledMachine
from ambjax.text.words import number
from ambjax.world.rotation import PER_MINUTE

Summary = dict[str, object]
# The measured sensitivity of each axis by speed, rpm.
Measured = dict[float, tuple[Injection, ...]]
# runup.png: only if the speed changes.
SIMULATED = ("trajectory.npz", "metrics.json", "overview.png", "runup.png", "motion.html")
ANALYSED = ("sensitivity.json", "sensitivity.png")
# Metrics of the printed table, with their headings.
COLUMNS = {
    "settled_rms_error_m": "settled rms error, m",
    "settled_max_abs_error_m": "settled largest error, m",
    "clearance_used": "share of clearance",
    "max_abs_i_A": "largest |i|, A",
    "rms_u_V": "rms u, V",
    "max_abs_u_V": "largest |u|, V",
    "force_used": "share of force",
    "z_1x_m": "z at 1x, m",
    "i_1x_A": "i at 1x, A",
}
# Margins of an axis in sensitivity.json, and their names in `Margins`.
MARGINS = {"gain_low": "gm_low", "gain_high": "gm_high", "phase_deg": "pm", "delay_s": "delay", "disk": "dm"}


def refuse(args: argparse.Namespace, names: tuple[str, ...]) -> None:
    """Raise ValueError for an option that a machine does not take."""
    for name in names:
        value = getattr(args, name, None)
        if value is not None and value is not False:
            option = {"begin": "from", "end": "to"}.get(name, name)
            raise ValueError(f"--{option}: a machine with [rotor] does not take it yet. Leave it out.")


def simulate(args: argparse.Namespace, case: MachineCase) -> tuple[int, Summary]:
    """Simulate a machine and write its files. Exit code 1 if the rotor is lost."""
    refuse(args, ("begin", "end", "page"))
    out = directory(args.out, f"simulate-{case.name}", SIMULATED, args.force)
    say(f"method: {case.clock.method}; axes: {', '.join(case.axes)}")
    with tqdm(total=case.clock.samples, unit="sample", unit_scale=True, delay=2, leave=False, desc="simulate") as bar:
        run = simulate_machine(case, bar.update)
    metrics = plain(run.metrics) | {
        "lost_why": run.lost_why, "method": str(case.clock.method), "settle_s": case.settle,
    }  # fmt: skip
    from ambjax.pictures.machine_pictures import machine_figure
    from ambjax.pictures.run_up_picture import run_up_picture

    def text() -> str:
        shown = {name: words for name, words in COLUMNS.items() if name in run.metrics}
        rows = [(axis, *(number(own[name]) for name in shown)) for axis, own in run.metrics["axes"].items()]
        return table(("axis", *shown.values()), rows)

    with results(args, out, SIMULATED, text) as part:
        run.save(part / "trajectory.npz")
        write_json(part / "metrics.json", metrics)
        title = f"{case.name}: {case.clock.method}"
        drawn(part / "overview.png", lambda: machine_figure(case, run.signals, title))
        if np.ptp(run.signals["speed_rpm"]) > 0:
            drawn(part / "runup.png", lambda: run_up_picture(case, run.signals))
        page = described("motion.html", lambda: motion_page(case, run.signals)) if radial_axes(case) else None
        if page is not None:
            (part / "motion.html").write_text(page, encoding="utf-8")
    if run.lost:
        lost = run.metrics["lost_at_s"]
        say(f"the rotor is lost at {lost:.6g} s: {run.lost_why}. 'ambjax sensitivity' shows whether it is stable.")
    return int(run.lost or run.metrics["stalled"]), metrics | {"out": str(out)}


def sensitivity(args: argparse.Namespace, case: MachineCase) -> tuple[int, Summary]:
    """Analyse a machine at its speeds and write the files. Exit code 1 if it is not stable at one of them."""
    refuse(args, ("members", "seed"))
    points = operating.sensitivity(case)
    measured = _injections(case, points, args.inject)
    out = directory(args.out, f"sensitivity-{case.name}", ANALYSED, args.force)
    summary = sensitivity_summary(points, measured)
    from ambjax.pictures.machine_pictures import machine_sensitivity_picture

    words = lambda: "\n".join([sensitivity_text(points, measured, case.zones), *signs_note(case.cases)])  # noqa: E731
    with results(args, out, ANALYSED, words) as part:
        write_json(part / "sensitivity.json", summary)
        limits, path = case.zones.limits, part / "sensitivity.png"
        drawn(path, lambda: machine_sensitivity_picture(points, limits, case.name, measured))
    return int(not all(point.stable for point in points)), plain(summary | {"out": str(out)})


def worst_of_speeds(points: list[MachineSensitivity]) -> MachineSensitivity:
    """Return the sensitivity at the speed with the largest peak; an unstable one first."""
    return max(points, key=lambda point: (not point.stable, not point.linear, point.worst.S.height))


def _injections(case: MachineCase, points: list[MachineSensitivity], everywhere: bool) -> Measured:
    """Measure the axes, on a processor at the speed with the largest peak; `everywhere`: always, at all speeds."""
    sampled = isinstance(case.machine, SampledMachine)
    at = points if everywhere else [worst_of_speeds(points)] if sampled else []
    at = [point for point in at if point.stable]  # otherwise the rotor swings by itself
    if not at:
        return {}
    with doing(f"measuring the sensitivity by injection into the simulation; {FIRST_RUN}"):
        peaks = [[axis.S.frequency if point.linear else None for axis in point.axes] for point in at]
        speeds = [point.speed for point in at]
        found = machine_injected(case.machine, operating.one_period(case), case.zones, speeds, peaks)
    return dict(zip(speeds, found, strict=True))


def sensitivity_summary(points: list[MachineSensitivity], measured: Measured) -> Summary:
    """Return the JSON of the sensitivities: the axis with the largest peak at any speed, and each speed."""
    worst = worst_of_speeds(points)
    at = [
        {
            "speed_rpm": point.speed,
            "stable": point.stable,
            "axes": [
                {
                    "name": axis.name, "peak": axis.S.height, "frequency_hz": axis.S.frequency, "zone": axis.zone,
                    "outside_peak": None if axis.S.outside is None else axis.S.outside.height,
                    "peak_T": axis.T.height, "peak_KS": axis.KS.height,
                    "margins": axis.margins and {key: getattr(axis.margins, name) for key, name in MARGINS.items()},
                    "running_speed": facts,
                    **injected_numbers(point.system if point.linear else None, one, k),
                }
                for k, (axis, one, (facts, _)) in enumerate(
                    zip(point.axes, _measured_at(point, measured), once_per_revolution(point), strict=True)
                )
            ],
            "sigma_max": point.sigma.height,
            "sigma_frequency_hz": point.sigma.frequency,
            "poles_per_s": [[float(p.real), float(p.imag)] for p in point.poles],
        }
        for point in points
    ]  # fmt: skip
    axis = worst.worst
    first: Summary = {
        "stable": all(point.stable for point in points), "peak": axis.S.height, "frequency_hz": axis.S.frequency,
        "zone": axis.zone, "axis": axis.name if worst.linear else None, "speed_rpm": worst.speed,
    }  # fmt: skip
    own: dict[str, Any] = at[points.index(worst)]
    first |= {key: x for key, x in own["axes"][worst.axes.index(axis)].items() if key.startswith("injected")}
    return first | {key: own[key] for key in ("axes", "sigma_max", "sigma_frequency_hz")} | {"speeds": at}


def _measured_at(point: MachineSensitivity, measured: Measured) -> tuple[Injection | None, ...]:
    return measured.get(point.speed, (None,) * len(point.axes))


def once_per_revolution(point: MachineSensitivity) -> list[tuple[list[Summary], list[str]]]:
    """Return |S| of each axis at the speed, as `running_facts` does."""
    speeds = (abs(point.speed) * PER_MINUTE,) if point.speed else ()
    return [running_facts(speeds, point.system, axis.S, k, f"|S| of {axis.name}") for k, axis in enumerate(point.axes)]


def outside_lines(point: MachineSensitivity, zones: Zones) -> list[str]:
    """Return `band_lines` of |S| of each axis at a speed at which the machine is stable."""
    name = f"{{}} at {point.speed:g} rpm"
    return [line for axis in point.axes for line in band_lines(name.format(axis.name), axis, zones, ["S"])]


def sensitivity_text(points: list[MachineSensitivity], measured: Measured, zones: Zones) -> str:
    """Return the tables of the sensitivities, one for each speed."""
    parts = []
    for point in points:
        rows = [
            (axis.name, f"{axis.S.height:.4g}", f"{axis.S.frequency:.4g}", axis.zone or "", f"{axis.T.height:.4g}",
             *(["", ""] if axis.margins is None else [f"{axis.margins.gm:.3g}", f"{axis.margins.pm:.3g}"]))
            for axis in point.axes
        ]  # fmt: skip
        slow = f"largest real part of a pole {np.max(np.real(point.poles)):.4g} 1/s"
        measured_at = zip(point.axes, _measured_at(point, measured), strict=True)
        injected = [
            injection_text(point.system if point.linear else None, one, zones, axis.zone or "", k, f" at {axis.name}")
            for k, (axis, one) in enumerate(measured_at) if one is not None
        ]  # fmt: skip
        if not point.linear:
            word = "stable, but the linear machine is not" if point.stable else "NOT STABLE"
            none = "so there are no peaks, zones and margins"
            parts += [f"{point.speed:g} rpm: {word}, {none}; {slow}{point.swings}", *injected]
            continue
        parts.append(f"{point.speed:g} rpm: stable; {slow}")
        single = f"{point.sigma.height:.4g}", f"{point.sigma.frequency:.4g}"
        rows.append(("largest singular value", *single, "", "", "", ""))
        head = ("axis", "peak of |S|", "Hz", "zone", "peak of |T|", "gain margin", "phase margin, deg")
        parts.append(table(head, rows))
        parts += outside_lines(point, zones)
        for _, lines in once_per_revolution(point):
            parts += lines
        parts += injected
    return "\n".join(parts)
