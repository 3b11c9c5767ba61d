"""The text of `ambjax check`: the verdict in a few lines, then the tables that apply."""

import math
from typing import NamedTuple

import numpy as np

from ambjax.cases.forces import forces
from ambjax.cases.reader import Case
from ambjax.cases.warned import idealised
from ambjax.linear.stability import Findings
from ambjax.results.outputs import table
from ambjax.text.words import number
from ambjax.theorem import advice
from ambjax.theorem.conditions import Condition, Report
from ambjax.theorem.sampled_report import Delays, SampledReport

CONTINUOUS = (
    "The tables of Theorem 1 are computed in continuous time, without the case's [processor] and without the low-pass, "
    "the converters and the faults of the sensor. An amplifier is included only if it controls the current. A "
    "set-valued sign is replaced by a sign with a boundary layer. These tables do not affect the verdict on this case."
)

BAND = (
    "Evaluated at the samples after run.settle. Signal: the quantity that the law drives to zero. Disturbance: largest "
    "difference between the rate of the computed signal and the rate that the sign function of the law commands. Band: "
    "largest |computed signal| that such disturbances can cause. Difference: largest difference between the computed "
    "signal and that of the plant. Bound: band plus difference; it bounds the signal of the plant. Largest: largest "
    "|signal| of the plant."
)


# Of a condition; one that is only informative has none.
VERDICTS = {True: "holds", False: "FAILS", None: ""}


class OnProcessor(NamedTuple):
    """Results on the processor. `margin`, `unknown`: delay margins, see `check._margins`.

    `differs`: why simulated and linear delay margins differ, or empty.
    """

    sampled: SampledReport
    margin: Delays
    unknown: Delays | None
    differs: str


class Checked(NamedTuple):
    """Results of a check.

    - `path`: name of the case file as given by the user.
    - `report`: on Theorem 1; None: not computed. `findings`: stability of the loop; None: the rotor is lost.
    - `linear`: whether the loop has a linearisation.
    """

    case: Case
    path: str
    report: Report | None
    findings: Findings | None
    on_processor: OnProcessor | None
    linear: bool

    @property
    def run(self) -> Report | SampledReport:
        """The report on the run that decides: on the processor, if the case has one."""
        run = self.report if self.on_processor is None else self.on_processor.sampled
        assert run is not None
        return run


def verdict(checked: Checked, sensitivity: str, largest: float | None) -> list[str]:
    """Return the lines of the verdict. `largest`: largest |z| after run.settle, m; None: the run ends early."""
    report, findings = checked.report, checked.findings
    failures = list(_failures(checked))
    lines = ["The check passes." if not failures else f"The check FAILS: {'; '.join(failures)}."]
    run, stalled = checked.run, advice.STALLED if checked.on_processor is None else advice.STALLED_PLANT
    lines.append(advice.status(run.lost_at, run.lost_why, run.stalled, stalled) + _clearance(checked.case, largest))
    lines += [] if findings is None else [findings.words()]
    lines.append(sensitivity)
    if report is not None:
        deciding = [line.holds for line in report.conditions if line.holds is not None]
        ideal = " in continuous time, without the processor; not part of the verdict"
        where = "" if checked.on_processor is None else ideal
        held = f"{sum(deciding)} of the {len(deciding)} conditions that apply to these laws hold{where}"
        lines.append(f"Theorem 1: {held if deciding else 'no condition applies to these laws'}.")
    return lines


def _failures(checked: Checked) -> list[str]:
    run, found = checked.run, []
    if math.isfinite(run.lost_at):
        found.append("the run is not decided" if run.stalled else "the rotor is lost")
    if checked.findings is not None and not checked.findings.stable:
        found.append("the loop is not stable")
    if isinstance(run, Report):
        found += [f"{line.requires} does not hold" for line in run.conditions if line.holds is False]
    else:
        found += [f"the step of the {law.stage} law is not stable" for law in run.laws if not law.holds]
        found += ["the run reaches the singular curve C"] if run.distance[0] <= 0 else []
    if not checked.linear:
        found.append("the loop cannot be linearised")
    return [*found, *filter(None, [forces(checked.case).too_small])]


def clearance(case: Case, largest: float | None) -> tuple[float | None, str]:
    """Return the share of the clearance of the largest |z| after run.settle, m, and its zone; None: zone D."""
    used = None if largest is None else largest / float(np.min(np.asarray(case.scenario.touchdown)))
    return used, "D" if used is None else case.zones.clearance_zone(used)


def _clearance(case: Case, largest: float | None) -> str:
    zones, (used, zone) = case.zones, clearance(case, largest)
    if used is None:
        return ""
    return (
        f" After run.settle |z| reaches {largest:.4g} m, {100 * used:.3g} % of the clearance: clearance zone "
        f"{zone} (A below {100 * zones.clearance_a:g} %, B below {100 * zones.clearance_b:g} %, "
        f"C below {100 * zones.clearance_c:g} %)."
    )


def details(checked: Checked, full: bool) -> list[str]:
    """Return the parts below the verdict. `full`: also what does not affect it."""
    case, report, parts = checked.case, checked.report, []
    if ideal := idealised(case):
        parts.append(ideal)
    if checked.on_processor is not None:
        sampled, margin, unknown, differs = checked.on_processor
        parts += [f"On the processor: {case.cascade.on_processor().processor}, T = {case.clock.sample_period:g} s."]
        parts += [_laws(sampled), *([_bands(sampled)] if full else [])]
        parts.append("\n".join([*advice.processor_lines(sampled, margin, unknown), *filter(None, [differs])]))
    if report is not None and (checked.on_processor is None or full):
        shown = [line for line in report.conditions if line.gain is not None and (full or line.holds is not None)]
        parts += ["Theorem 1:", *([_conditions(shown)] if shown else [])]
        steps = [(c.name, c.requires, number(c.against, 3), c.unit, number(c.at_s, 5), c.note) for c in report.proof]
        parts += [table(("proof", "statement", "worst", "unit", "at (s)", "meaning"), steps)] if full else []
        parts.append("\n".join(advice.theorem_lines(report, checked.path)))
        parts += [CONTINUOUS] if checked.on_processor is not None else []
    return parts if full else [*parts, "--full prints every table."]


def _conditions(conditions: list[Condition]) -> str:
    rows = []
    for c in conditions:
        sides = [number(x, 5) for x in (c.gain, c.against, c.margin)]
        rows.append((c.requires, *sides, c.unit, number(c.at_s, 5), VERDICTS[c.holds], c.note))
    head = ("condition", "left", "right", "margin", "unit", "at (s)", "verdict", "note")
    columns = len(head) - (not any(row[-1] for row in rows))  # without an empty column of notes
    return table(head[:columns], [row[:columns] for row in rows])


def _laws(sampled: SampledReport) -> str:
    head = ("law", "step", "largest |pole|", "least damping ratio", "verdict")
    steps = {True: "implicit", False: "explicit"}
    numbers = [(number(law.radius), number(law.damping), VERDICTS[law.holds]) for law in sampled.laws]
    return table(head, [(law.stage, steps[law.implicit], *own) for law, own in zip(sampled.laws, numbers, strict=True)])


def _bands(sampled: SampledReport) -> str:
    def limit(x: float | None) -> str:
        return "none" if x is not None and math.isinf(x) else number(x)

    if not sampled.bands:
        return "No bands, because every run ends early."
    rows = []
    for b in sampled.bands:
        values = map(limit, (b.gain, b.disturbance, b.band, b.difference, b.bound, b.largest))
        rows.append((b.signal, b.unit, "the case's" if b.noise else "none", *values, b.note))
    values = ("gain, per s", "disturbance", "band", "difference", "bound", "largest")
    return table(("signal", "unit", "noise", *values, "note"), rows) + "\n" + BAND
