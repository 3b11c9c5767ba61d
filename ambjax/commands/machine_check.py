"""`check` of a whole machine."""

import argparse
import tomllib

import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_from
from ambjax.commands.machine_commands import analysed
from ambjax.host.heartbeat import say
from ambjax.linear import linearise_machine, poles_in_s
from ambjax.results.machine_run import simulate_machine
from ambjax.results.outputs import plain, table

# Modes that the second analysis adds to those of a shaft. Modes whose damping ratio is below LIGHT are listed.
MORE, LIGHT = 4, 0.05


def check(args: argparse.Namespace, case: MachineCase) -> tuple[int, dict[str, object]]:
    """Check a machine: held in its run, clearance, force, stability and zones at its speeds, and spill-over.

    The exit code is 1 if the rotor is lost, or if the machine is not stable at one of its speeds, also with more modes.
    """
    say(f"simulating {case.clock.samples} samples; the first run compiles for some seconds")
    run = simulate_machine(case)
    say(f"linearising at {', '.join(f'{speed:g}' for speed in case.speeds)} rpm")
    points = analysed(case)
    share = float(run.metrics["settled_clearance_used"])
    carried = {
        axis: abs(float(one.scenario.plant.m * one.scenario.plant.g)) / float(one.scenario.largest_force)
        for axis, one in zip(case.axes, case.cases, strict=True)
    }
    spilled = _spill_over(case)
    worst = max(points, key=lambda point: (not point.stable, point.worst.S.height))
    summary = {
        "held": not run.lost,
        "lost_why": run.lost_why,
        "clearance_used": share,
        "clearance_zone": case.zones.clearance_zone(share),
        "force_carried": carried,
        "stable": {f"{point.speed:g}": point.stable for point in points},
        "zone": worst.worst.zone,
        "peak": worst.worst.S.height,
        "axis": worst.worst.name,
        "speed_rpm": worst.speed,
        "growth_with_more_modes_per_s": spilled,
    }
    stable = all(point.stable for point in points) and all(rate <= 0 for rate in spilled.values())
    if not args.json:
        held = "held" if summary["held"] else f"LOST ({run.lost_why})"
        at = f"{worst.worst.name} at {worst.speed:g} rpm"
        print(f"run: {held}; settled |z| reaches {share:.3g} of the clearance, zone {summary['clearance_zone']}")
        print(f"sensitivity: peak {worst.worst.S.height:.4g} ({at}), zone {worst.worst.zone}")
        print(
            f"stability: {'stable' if stable else 'NOT STABLE'} at {', '.join(summary['stable'])} rpm{_more(spilled)}"
        )
        most = max(carried, key=lambda axis: carried[axis])
        print(f"weight: the most loaded axis, {most}, carries {carried[most]:.3g} of the force of its magnet")
        print(table(("pole, 1/s", "Hz", "damping ratio", "rpm"), _light(points)))
    return int(run.lost or not stable), plain(summary)


def _spill_over(case: MachineCase) -> dict[str, float]:
    """Return the largest real part of a pole (1/s) with MORE modes, by speed; {} for a rotor without a geometry."""
    raw = tomllib.loads(case.text) if case.text else {}
    if raw.get("rotor", {}).get("kind") != "shaft" or isinstance(raw["rotor"].get("damping"), list):
        return {}
    known = (len(case.coordinates) - 5) // 2
    raw["rotor"]["modes"] = known + MORE
    if raw.get("controller", {}).get("kind") == "lqg":  # the same controller
        raw["controller"]["lqg"] = {"modes": known} | raw["controller"].get("lqg", {})
    more = machine_from(raw, case.name)
    return {f"{speed:g}": float(np.max(np.real(_poles(more, speed)))) for speed in case.speeds}


def _poles(case: MachineCase, speed: float) -> np.ndarray:
    return poles_in_s(linearise_machine(case.machine, case.clock.sample_period, speed))


def _more(spilled: dict[str, float]) -> str:
    if not spilled:
        return ""
    return f"; with {MORE} more bending modes the largest growth rate is {max(spilled.values()):.3g} 1/s"


def _light(points: list) -> list[tuple[str, ...]]:
    """Return the rows of the lightly damped poles, at most six, the least damped first."""
    rows = []
    for point in points:
        for pole in point.poles:
            size = abs(pole)
            if pole.imag > 0 and -pole.real < LIGHT * size:
                rows.append((-pole.real / size, f"{pole.real:.4g}", f"{pole.imag / (2 * np.pi):.4g}", point.speed))
    return [(real, hertz, f"{ratio:.3g}", f"{speed:g}") for ratio, real, hertz, speed in sorted(rows)[:6]]
