"""The ledger: the verdict on every claim of the paper in each reading, and the noise scan, as data and as a page."""

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

from ambjax.linear import Zones, analyse, linearise
from ambjax.paper.claims import CLAIMS, SIGMA_RADIUS
from ambjax.paper.evidence import Evidence
from ambjax.paper.readings import CLOCK, PROCESSOR, SAMPLED, SUPPLY, TABLE_2, TUNED, Tuned, cascade, scenario
from ambjax.text.words import markdown_table


def _gains(gains: Tuned) -> str:
    return ", ".join(f"{name} = {value:g}" for name, value in gains._asdict().items())


TUNED_WORDS = (
    f"the paper's noise (std {TABLE_2.noise_std:.2e} m on z, held {float(CLOCK.sample_period):g} s) except in the "
    f"scans of noise and basin, a supply of {SUPPLY:g} V, disturbance as scaled force, complementary observer, gains "
    "found by `ambjax tune`: " + _gains(TUNED)
)
SAMPLED_WORDS = (
    f"as `tuned`, on a processor of {1 / float(CLOCK.sample_period):g} Hz: {PROCESSOR.resolved()}; set-valued "
    f"signs, gains tuned on this processor for plants that differ by up to 10 %: {_gains(SAMPLED)}"
)


def judge_claims(evidence: dict[str, Evidence]) -> list[dict[str, Any]]:
    """Return every claim with its finding in each reading, as plain data. `evidence`: by reading."""
    rows = []
    for entry in CLAIMS:
        row = {name: getattr(entry, name) for name in ("says", "where", "paper", "criterion")}
        findings = {name: dataclasses.asdict(entry.judge(one)) for name, one in evidence.items()}
        rows.append({**row, "findings": findings})
    return rows


def noise_table(evidence: dict[str, Evidence]) -> list[dict[str, object]]:
    """Return the noise scan as plain data, one row for each reading and sample period.

    A row has the largest std (m) at which the rotor survives; the next std if it is not decided there (else None); and
    the std at which sigma's neighbourhood has the radius 6e-6 m/s (None: not reached).
    """
    return [
        {
            "reading": name,
            "sample_period_s": n.sample_period,
            "horizon_s": n.horizon,
            "largest_std_survived_m": n.survived,
            "undecided_std_m": n.undecided,
            "std_for_sigma_6e-6_m": n.std_for(SIGMA_RADIUS),
        }
        for name, one in evidence.items()
        for n in one.noise
    ]


def processor_table(evidence: dict[str, Evidence]) -> list[dict[str, object]]:
    """Return the status and metrics of each reading, tracking, on the processor of `sampled`, as plain data.

    `lost_at_s` is the time of the loss or, if `stalled`, of the stall; inf if the rotor survives.
    """
    return [
        {
            "reading": name,
            "noise": noisy,
            "lost_at_s": run.metrics["lost_at_s"],
            "stalled": bool(run.metrics["stalled"]),
            "settled_max_abs_error_m": run.metrics["settled_max_abs_error_m"],
            "settled_rms_u_V": run.metrics["settled_rms_u_V"],
        }
        for name, one in evidence.items()
        for noisy, run in one.on_processor.items()
    ]


def sensitivity_table(readings: Iterable[str]) -> list[dict[str, object]]:
    """Return the linear sensitivity of each reading at rest at r = 0, as plain data.

    A row has the peak of |S| of the position sensor, its frequency (Hz) and its ISO 14839-3 zone; the same of the
    velocity sensor, as every reading measures the velocity; and the static stiffness, N/m. See `ambjax.linear.analyse`.
    """
    rows, zones = [], Zones()
    for name in readings:
        world = scenario("regulation", name, pulse=False)
        system = linearise(cascade(name), world, CLOCK)
        analysis = analyse(system, world.plant.m, CLOCK.sample_period, zones, velocity=True)
        assert analysis.S_velocity is not None
        row: dict[str, object] = {"reading": name}
        for key, peak in (("", analysis.S), ("velocity_", analysis.S_velocity)):
            height, frequency = float(peak.height), float(peak.frequency)
            row |= {f"{key}peak": height, f"{key}frequency_hz": frequency, f"{key}zone": zones.zone(height)}
        rows.append(row | {"static_stiffness_N_per_m": float(analysis.stiffness)})
    return rows


def ledger_markdown(ledger: dict[str, list[dict[str, Any]]]) -> str:
    """Return the ledger as Markdown: the claims and the three tables, as ledger.json names them."""
    rows = ledger["claims"]
    heads = [head for reading in rows[0]["findings"] for head in (f"{reading}: ours", f"{reading}: verdict")]
    lines = ["# Ledger: the paper's claims, per reading", ""]
    quiet = "`repaired`: gamma = 7.5e4, disturbance as scaled force. Both without noise."
    lines += [f"`literal`: Table 2 as printed. {quiet}"]
    lines += [f"`tuned`: {TUNED_WORDS}.", f"`sampled`: {SAMPLED_WORDS}.", ""]
    verdicts = [[cell for f in row["findings"].values() for cell in (f["ours"], f"**{f['verdict']}**")] for row in rows]
    claims = [(row["says"], row["where"], row["paper"], *own) for row, own in zip(rows, verdicts, strict=True)]
    lines += [*markdown_table(("claim", "section", "paper", *heads), claims), "", "## Criteria and causes", ""]
    for row in rows:
        lines.append(f"- **{row['says']}** ({row['criterion']})")
        lines += [f"  - {name}: {f['verdict']}; {f['cause']}" for name, f in row["findings"].items()]
    lines += ["", "## Noise at which the rotor is held (regulation without the pulse, noise on z only, two seeds)", ""]
    head = ("reading", "sample period", "duration", "largest std", "std with max |sigma| = 6e-6 m/s")
    lines += markdown_table(head, [_noise_cells(n) for n in ledger["noise"]])
    lines += ["", "## All readings on the processor of `sampled` (tracking, pulse included)", ""]
    head = ("reading", "noise and supply", "lost", "largest error after settling", "voltage, rms")
    lines += markdown_table(head, [_processor_cells(row) for row in ledger["processor"]])
    lines += ["", "## Sensitivity (linear, at rest at r = 0; zones of ISO 14839-3)", ""]
    head = ("reading", "position sensor: peak of |S|, zone", "velocity sensor", "static stiffness")
    return "\n".join([*lines, *markdown_table(head, [_sensitivity_cells(row) for row in ledger["sensitivity"]])]) + "\n"


def _noise_cells(n: dict[str, Any]) -> tuple[str, ...]:
    names = ("largest_std_survived_m", "std_for_sigma_6e-6_m")
    survived, gives = (f"{n[name]:.1e} m" if n[name] else "none" for name in names)
    if n["undecided_std_m"]:
        survived += f", not decided at {n['undecided_std_m']:.1e} m"
    return n["reading"], f"{n['sample_period_s']:g} s", f"{n['horizon_s']:g} s", survived, gives


def _processor_cells(row: dict[str, Any]) -> tuple[str, ...]:
    under = f"the paper's, {SUPPLY:g} V" if row["noise"] else "none, no limit"
    if math.isfinite(row["lost_at_s"]):
        status = "not decided: stalled at" if row["stalled"] else "at"
        return row["reading"], under, f"{status} {1e3 * row['lost_at_s']:.3g} ms", "-", "-"
    error, u = row["settled_max_abs_error_m"], row["settled_rms_u_V"]
    return row["reading"], under, "no", f"{error:.2e} m", f"{u:.3g} V"


def _sensitivity_cells(row: dict[str, Any]) -> tuple[str, ...]:
    peaks = [
        f"{row[f'{key}peak']:.4g} at {row[f'{key}frequency_hz']:.3g} Hz, **{row[f'{key}zone']}**"
        for key in ("", "velocity_")
    ]
    return row["reading"], *peaks, f"{row['static_stiffness_N_per_m']:.3g} N/m"
