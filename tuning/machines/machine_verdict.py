"""The verdict on the tuned gains of a machine: its sensitivity, members of its spread, the limits, and the report."""

import dataclasses
import math
from typing import Any

import numpy as np

from ambjax.cases.machine_case import MachineCase
from ambjax.commands.machine_commands import sensitivity_summary
from ambjax.results.machine_study import LinearFindings, MachineStudy
from ambjax.results.operating import sensitivity
from tuning.report.facts import Column, table

# Limits of [tune.limits], each with its meaning and the metric whose largest value counts; "": a sensitivity.
LIMITS = {
    "sensitivity": ("peak of \\|S\\| of the worst axis at any speed", ""),
    "rms_u_V": ("rms voltage after run.settle, V", "settled_rms_u_V"),
    "max_u_V": ("largest voltage, V", "max_abs_u_V"),
    "max_abs_i_A": ("largest absolute current, A", "max_abs_i_A"),
    "rms_error_m": ("rms error after run.settle, m", "settled_rms_error_m"),
    "largest_error_m": ("largest error after run.settle, m", "settled_max_abs_error_m"),
    "clearance_used": ("largest share of the clearance", "clearance_used"),
    "z_1x_m": ("largest amplitude of z at the speed, m", "z_1x_m"),
    "i_1x_A": ("largest amplitude of a current at the speed, A", "i_1x_A"),
    "sensitivity_1x": ("largest \\|S\\| of an axis at a speed, where the rotor turns with it", ""),
}


def judged(case: MachineCase, found: MachineCase, limits: dict[str, float], seed: int, members: int) -> dict[str, Any]:
    """Return the content of report.json but the gains. `case`, `found`: before and after; `members`: to simulate.

    The peaks of |S| are those over all frequencies, whatever the band of [sensitivity] is.
    """
    period = float(case.clock.sample_period) if case.cases[0].cascade.sampled else None
    everywhere = [dataclasses.replace(one, zones=one.zones.whole(period)) for one in (case, found)]
    each: list[dict[str, Any]] = [sensitivity_summary(sensitivity(one), {}) for one in everywhere]
    before, after = each
    study = MachineStudy(found, seed, members)
    held, simulated = simulate(study)
    loops = study.findings(np.flatnonzero(held)) if held.any() else LinearFindings(0, 0)
    values: dict[str, Any] = {name: _worst(x, held) for name, x in simulated.items()}
    turning = [fact["S"] for at in after["speeds"] for axis in at["axes"] for fact in axis["running_speed"]]
    linear = {"sensitivity": after["peak"], "sensitivity_1x": max(turning, default=0.0)}
    values |= linear if after["stable"] else dict.fromkeys(linear, math.inf)
    rows: list[dict[str, Any]] = [
        {"name": name, "meaning": LIMITS[name][0], "value": values[name], "threshold": most}
        | {"holds": bool(values[name] <= most and (name in linear or held.all()))}
        for name, most in limits.items()
    ]
    broken = [row["name"] for row in rows if not row["holds"]]
    at = f"{after['axis']} at {after['speed_rpm']:g} rpm"
    peak = f"peak of |S| {after['peak']:.4g} ({at}), zone {after['zone']}"
    none = "stable, but the linear machine is not, so it has no peaks"
    words = [
        (none if after["zone"] is None else peak) if after["stable"] else "NOT STABLE",
        f"{int(held.sum())} of {members} members held",
        *([] if loops.stable else [f"{loops.unstable} of {loops.tested} members tested not stable"]),
    ]
    good = bool(after["stable"] and held.all() and loops.stable and not broken)
    if good or broken:
        words.append("all limits met" if good else f"beyond the limits: {', '.join(broken)}")
    return {
        "verdict": f"{'; '.join(words)}.",
        "case": case.name,
        "outcome": {"good": good, "held": int(held.sum()), "members": members, "stability": loops._asdict()},
        "limits": rows,
        "metrics": values,
        "sensitivity": after,
        "before": before,
    }


def _worst(values: np.ndarray, held: np.ndarray) -> float:
    return float(np.max(values[held])) if held.any() else math.inf


def simulate(study: MachineStudy) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return which members [n] are held, and the limited metrics [n] of the worst axis of each."""
    columns = study.columns(0, study.members)
    found = {name: columns.get(metric, np.zeros(study.members)) for name, (_, metric) in LIMITS.items() if metric}
    return np.isposinf(columns["lost_at"]), found  # at rest there are no amplitudes at the speed


def refused(case: MachineCase, limits: dict[str, float], seed: int, members: int) -> int:
    """Return how many members are lost or beyond the limits of a simulation."""
    held, found = simulate(MachineStudy(case, seed, members))
    within = [found[name] <= most for name, most in limits.items() if name in found]
    return int(np.sum(~np.all([held, *within], axis=0)))


def report_text(facts: dict[str, Any]) -> str:
    """Return the report in Markdown."""
    speeds = zip(facts["before"]["speeds"], facts["sensitivity"]["speeds"], strict=True)
    peaks = [
        {"rpm": f"{b['speed_rpm']:g}", "axis": axis["name"], "before": _peak(a, old), "after": _peak(b, axis)}
        | {"Hz": axis["frequency_hz"] if b["stable"] else None, "zone": axis["zone"]}
        for a, b in speeds
        for old, axis in zip(a["axes"], b["axes"], strict=True)
    ]
    limits: dict[str, Column] = {
        "limit": ("name", ""), "meaning": ("meaning", ""), "value": ("value", ".4g"), "at most": ("threshold", ".4g"),
        "met": lambda row: "yes" if row["holds"] else "NO",
    }  # fmt: skip
    gains: dict[str, Column] = {
        "gain": ("path", ""), "before": ("before", ".6g"), "after": ("after", ".6g"), "at a bound": ("at_bound", "")
    }  # fmt: skip
    parts = [f"# Tuning of {facts['case']}", facts["verdict"], "## Limits", table(facts["limits"], limits)]
    parts += ["## Peaks of |S|", table(peaks, {name: (name, ".4g") for name in peaks[0]})]
    return "\n\n".join([*parts, "## Gains", table(facts["gains"], gains)]) + "\n"


def _peak(point: dict[str, Any], axis: dict[str, Any]) -> str:
    if not point["stable"]:
        return "unstable"
    return f"{axis['peak']:.4g}" if math.isfinite(axis["peak"]) else "none"
