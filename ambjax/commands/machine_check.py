"""`check` of a whole machine."""

import pathlib
import tomllib
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.machine_case import MachineCase, machine_of_axes, parts_of
from ambjax.cases.rotor_body import DAMPING, MODES
from ambjax.cases.rotor_tables import RIGID, axes_and_rotor
from ambjax.cases.table import Table
from ambjax.commands.machine_commands import once_per_revolution, outside_lines, worst_of_speeds
from ambjax.commands.sensitivity_report import signs_note
from ambjax.host.heartbeat import say
from ambjax.linear import MachineSensitivity
from ambjax.linear.linear_machine import turning_machines
from ambjax.linear.machine_stability import growth_of, machine_stability
from ambjax.linear.margins import STATIC
from ambjax.linear.rotor_modes import LIGHT, Mode, modes_of
from ambjax.results.operating import points_of
from ambjax.results.outputs import plain, table
from ambjax.results.runs import MachineRun, simulate_machine
from ambjax.text.words import number
from ambjax.world.rotor import Rotor

# Modes that the second analysis adds to those of a shaft. At most MOST lightly damped modes are listed.
MORE, MOST = 4, 8
# Smallest constant offset of one sensor, as a share of its clearance, that the magnets must bear: sensors are hardly
# aligned better.
LEAST_OFFSET = 0.01
AXIS_COLUMNS = ("axis", "|z|/clearance", "zone", "weight/force", "force reserve", "peak of |S|", "zone")


class CaseCheck(NamedTuple):
    """The result of a check: whether it passes, and its numbers, as `ambjax check --json` prints them.

    `text`: the verdict in the first lines, then the tables that apply.
    """

    holds: bool
    summary: dict[str, Any]
    text: str


def check(case: MachineCase) -> CaseCheck:
    """Check a machine: held in its run, clearance, force, stability and zones at its speeds, and spill-over.

    It fails if the rotor is lost, or if the machine is not stable at one of its speeds, also with more modes, has no
    linearisation, or cannot bear the offset of a sensor.
    """
    say(f"simulating {case.clock.samples} samples")
    run = simulate_machine(case)
    linear = _linear(case)
    share = float(run.metrics["settled_clearance_used"])
    axes = {axis: _axis(case, k, run, linear.points) for k, axis in enumerate(case.axes)}
    summary = {
        "held": not run.lost,
        "lost_why": run.lost_why,
        "clearance_used": share,
        "clearance_zone": _zone(case, run, share),
        "axes": axes,
        **linear.summary,
    }
    held = "held" if summary["held"] else f"LOST ({run.lost_why})"
    lines = [
        f"run: {held}; settled |z| reaches {share:.3g} of the clearance, zone {summary['clearance_zone']}",
        *linear.verdict,
        table(AXIS_COLUMNS, [(axis, *_cells(own)) for axis, own in axes.items()]),
        *linear.details,
    ]
    return CaseCheck(not run.lost and linear.holds, plain(summary), "\n".join(lines))


class _Linear(NamedTuple):
    """What the linear machine adds to a check: its verdict, the points of the speeds, numbers, and lines of text."""

    holds: bool
    points: list[MachineSensitivity]
    summary: dict[str, Any]
    verdict: list[str]
    details: list[str]


def _linear(case: MachineCase) -> _Linear:
    say(f"linearising at {', '.join(f'{speed:g}' for speed in case.speeds)} rpm")
    try:
        turning = list(turning_machines(case.machine, case.clock.sample_period, case.speeds))
    except ValueError as error:
        nothing = dict.fromkeys(("stable", "zone", "peak", "axis", "speed_rpm"))
        return _Linear(False, [], nothing | {"why": str(error)}, [f"sensitivity: no zone and no margins: {error}"], [])
    points = points_of(case, turning)
    modes = {one.speed: modes_of(point, case.machine.rotor) for point, one in zip(turning, points, strict=True)}
    spilled, untested, spills = _spill_over(case)
    worst = worst_of_speeds(points)
    at_speeds = [once_per_revolution(point) for point in points]
    offset, not_borne = _offset(case, points)
    summary = {
        "stable": {f"{point.speed:g}": point.stable for point in points},
        "zone": worst.worst.zone,
        "peak": worst.worst.S.height,
        "axis": worst.worst.name if worst.linear else None,
        "speed_rpm": worst.speed,
        "running_speed": {
            axis: [fact for point in at_speeds for fact in point[k][0]] for k, axis in enumerate(case.axes)
        },
        "modes": {f"{speed:g}": [mode.numbers() for mode in own] for speed, own in modes.items()},
        "growth_with_more_modes_per_s": spilled,
        "more_modes_why": untested,
        "sensor_offset_borne": offset,
    }
    at = f"{worst.worst.name} at {worst.speed:g} rpm"
    peak = f"peak {worst.worst.S.height:.4g} ({at}), zone {worst.worst.zone}"
    more = f"not tested with more bending modes: {untested}"
    if spilled:
        rate = f"{'NOT STABLE: ' if spills else ''}the largest growth rate is {max(spilled.values()):.3g} 1/s"
        more = f"with up to {MORE} more bending modes {rate}"
    found = [
        f"{word} at {', '.join(f'{one.speed:g}' for one in points if one.stable == stable)} rpm"
        for word, stable in (("NOT STABLE", False), ("stable", True))
        if stable in [one.stable for one in points]
    ]
    why = "the linear machine is not" if worst.stable else "not"
    verdict = [
        f"sensitivity: {peak if worst.linear else f'no peak and no zone: {why} stable at {worst.speed:g} rpm'}",
        f"stability: {'; '.join([*found, more])}{max(points, key=lambda one: one.swing or 0.0).swings}",
    ]
    verdict += [*signs_note(case.cases), *not_borne]
    details = [line for point in points if point.linear for line in outside_lines(point, case.zones)]
    details += [line for point in at_speeds for _, own in point for line in own]
    if light := _light({one.speed: modes[one.speed] for one in points if one.linear or not one.stable}):
        details.append(table(("lightly damped mode", "Hz", "damping ratio", "rpm"), light))
    holds = all(point.stable for point in points) and not spills and not not_borne
    return _Linear(holds, points, summary, verdict, details)


def _offset(case: MachineCase, points: list[MachineSensitivity]) -> tuple[float | None, list[str]]:
    """Return the least constant offset of one sensor, as a share of its clearance, that takes a whole bias current.

    It is that of the static response of the linear machine: about 0 if integral actions drift apart; None if no speed
    is stable. Also the line of the verdict on an offset below LEAST_OFFSET.
    """
    stops, biases = (
        np.array([float(np.min(np.asarray(x))) for x in values])
        for values in zip(*((one.scenario.touchdown, one.scenario.plant.i_0) for one in case.cases), strict=True)
    )
    c, found = len(stops), []
    for system in (point.system for point in points if point.linear):
        H = np.asarray(system.response(np.array([STATIC * float(case.zones.f_low)])))[0, 2 * c : 3 * c]
        currents = np.abs(H) * stops / biases[:, None]
        i, k = np.unravel_index(np.argmax(currents), currents.shape)
        found.append((float(1 / currents[i, k]), case.axes[k], case.axes[i]))
    least, sensor, magnet = min(found, default=(None, "", ""))
    if least is None or least >= LEAST_OFFSET:
        return least, []
    drift = (
        " Integral actions of more axes than the rotor has rigid motions drift apart: let only two radial bearings "
        'integrate, or set coordinates = "rigid-body".'
    )
    rigid = np.linalg.matrix_rank(np.asarray(case.machine.rotor.at_magnets)[:, :RIGID])
    return least, [
        f"sensors: NOT BORNE: a constant offset of the sensor of {sensor} of {least:.2g} of its clearance takes the "
        f"bias current of {magnet} in the end." + drift * bool(case.machine.law is None and c > rigid)
    ]


def _spill_over(case: MachineCase) -> tuple[dict[str, float], str, bool]:
    """Return the growth rates (1/s) by speed with MORE modes, why there are none, and whether a speed is not stable."""
    raw = tomllib.loads(case.text) if case.text else {}
    table, known = raw.get("rotor", {}), (len(case.coordinates) - 5) // 2
    more = min(MORE, MODES.metadata["at_most"] - known)
    if table.get("kind") != "shaft" and "file" not in table:
        return {}, "only a rotor of the kind shaft or of a file has further modes", False
    if not more:
        return {}, f"the rotor has {known} already, the largest number", False
    try:
        rotor = _with_modes(raw, known, known + more, case.folder)
        q = np.zeros(len(rotor.gravity))
        machine = machine_of_axes(rotor, parts_of(case.cases), case.clock, q, case.machine.law)
        points = list(turning_machines(machine, case.clock.sample_period, case.speeds))
    except ValueError as error:
        return {}, str(error), False
    growth = np.array([growth_of(point.system) for point in points])
    found = machine_stability(machine, case.clock, [(0, speed) for speed in case.speeds], growth)
    stable = growth <= 0 if found is None else found.stable
    return dict(zip(map("{:g}".format, case.speeds), growth.tolist(), strict=True)), "", not stable.all()


def _with_modes(raw: dict[str, Any], known: int, count: int, folder: pathlib.Path) -> Rotor:
    """Return the rotor with `count` modes, or with as many above `known` as it has. Raises ValueError if none."""
    more, given = count - known, raw["rotor"].get("damping")
    if isinstance(given, list):  # further modes are damped as the last one
        given = given + given[-1:] * more if given else DAMPING.default
    own = raw["rotor"] | {"modes": count} | ({} if given is None else {"damping": given})
    try:
        return axes_and_rotor(Table(raw | {"rotor": own}), folder)[1]
    except ValueError:
        if more == 1:
            raise
    return _with_modes(raw, known, count - 1, folder)


def _axis(case: MachineCase, k: int, run: MachineRun, points: list[MachineSensitivity]) -> dict[str, object]:
    """Return clearance and force of an axis, as shares, and its largest sensitivity at any speed (None: no points)."""
    metrics = run.metrics["axes"][case.axes[k]]
    scenario, share = case.cases[k].scenario, float(metrics["settled_clearance_used"])
    worst = max((point.axes[k] for point in points), key=lambda axis: (axis.S.height, axis.zone or ""), default=None)
    carried = abs(float(scenario.plant.m * scenario.plant.g)) / float(scenario.largest_force)
    used = max(float(metrics["force_used"]), carried)
    return {
        "clearance_used": share, "clearance_zone": _zone(case, run, share), "force_carried": carried,
        "force_reserve": 1 - used, "peak": worst and worst.S.height, "zone": worst and worst.zone,
    }  # fmt: skip


def _zone(case: MachineCase, run: MachineRun, share: float) -> str:
    return "D" if run.lost else case.zones.clearance_zone(share)


def _cells(own: dict[str, Any]) -> list[str]:
    """Return the cells of an axis; no peak and no zone if the machine is unstable at a speed or not linearised."""
    shown = own if own["peak"] is not None and np.isfinite(own["peak"]) else own | {"peak": "-", "zone": "-"}
    return [number(value, 3) if isinstance(value, float) else str(value) for value in shown.values()]


def _light(modes: dict[float, list[Mode]]) -> list[tuple[str, ...]]:
    """Return the rows of the lightly damped modes, the least damped first: of each name, the least damped speed."""
    found: dict[str, tuple[float, Mode]] = {}
    for speed, own in modes.items():
        for mode in own:
            best = found.get(mode.label)
            if mode.damping < LIGHT and (best is None or mode.damping < best[1].damping):
                found[mode.label] = speed, mode
    rows = sorted(found.values(), key=lambda row: row[1].damping)[:MOST]
    return [(mode.label, f"{mode.frequency:.4g}", f"{mode.damping:.3g}", f"{speed:g}") for speed, mode in rows]
