"""The text of `ambjax check`: the linearised loop and the machine, the verdict, and the tables that apply."""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.forces import forces, linear_magnet
from ambjax.cases.reader import Case
from ambjax.cases.warned import idealised
from ambjax.commands.band_text import band_lines, band_numbers, running_facts, running_speeds
from ambjax.commands.sensitivity_report import set_valued
from ambjax.linear import PLACES, Analysis, Findings, analyse, linearise
from ambjax.results.operating import margin_numbers
from ambjax.results.outputs import table
from ambjax.text.words import number
from ambjax.theorem import Condition, Report, advice
from ambjax.theorem.sampled_report import Delays, SampledReport
from ambjax.world.amplifier import difference

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


class Fact(NamedTuple):
    """A number of the machine. `value`: None: not applicable. Without a `key` it is not in the JSON summary."""

    key: str
    words: str
    value: float | None
    unit: str


def acceptance(case: Case) -> tuple[dict[str, object], list[str], str]:
    """Return the JSON summary, the lines on the zone of the loop linearised at r = 0, and the table of its numbers."""
    try:
        system = linearise(case.cascade, case.scenario, case.clock)
    except ValueError as error:
        facts = machine(case)
        summary = {"stable": None, "zone": None, "why": str(error), **{fact.key: fact.value for fact in facts}}
        return summary, [f"Sensitivity: no zone and no margins: {error}"], _facts_table(facts)
    loop = analyse(system, case.scenario.plant.m, case.clock.sample_period, case.zones)
    rate = 1 / float(case.clock.sample_period) if case.cascade.sampled else None
    facts = [*_loop_facts(loop, rate), *machine(case)]
    summary = {"stable": loop.stable, "zone": loop.zone, **{fact.key: fact.value for fact in facts if fact.key}}
    lines = [_verdict(case, loop)]
    if loop.stable:
        summary |= {"frequency_hz": loop.S.frequency, **band_numbers(loop, case.zones), "margins": margin_numbers(loop)}
        lines += band_lines("Nominal loop", loop, case.zones)
        speeds = running_speeds(case.scenario.rotor, float(case.clock.duration))
        summary["running_speed"], more = running_facts(speeds, system, loop.S)
        lines += more
    return summary, lines, _facts_table(facts)


def _verdict(case: Case, loop: Analysis) -> str:
    if not loop.stable:
        return "Sensitivity: no zone and no margins: the linearised loop is not stable at r = 0."
    inside = " (linear loop, valid inside the bands of the set-valued signs)" if set_valued(case) else ""
    word = "largest |S|" if loop.S.at_edge else "peak"
    return f"Sensitivity: zone {loop.zone}, {word} {loop.S.height:.4g} at {loop.S.frequency:.4g} Hz{inside}."


def _loop_facts(loop: Analysis, rate: float | None) -> list[Fact]:
    """Return the peak and all margins of a stable loop. `rate`: of the processor, Hz; None: continuous time."""
    if not loop.stable:
        return []
    kinds = {
        "gm": ("gain_margin", "gain margin (the one nearer to 1)", "1"),
        "pm": ("phase_margin_deg", "phase margin", "degrees"),
        "delay": ("delay_margin_s", "delay margin", "s"),
        "dm": ("disk_margin", "disk margin", "1"),
    }
    facts = [Fact("peak", "peak of |S|", loop.S.height, "1")]
    for kind, (key, words, unit) in kinds.items():
        place = loop.margins_at.place(kind)
        other = next(one for one in PLACES if one != place)
        facts.append(Fact(key, f"{words}, at the {place}", getattr(loop.margins, kind), unit))
        facts.append(Fact("", f"{words}, at the {other}", getattr(getattr(loop.margins_at, other), kind), unit))
        if kind == "delay" and rate:
            facts.append(Fact("delay_margin_samples", f"{words}, at the {place}", loop.margins.delay * rate, "samples"))
    return facts


def machine(case: Case) -> list[Fact]:
    """Return the numbers of the plant, its supply and its converters."""
    plant, sensor = case.scenario.plant, case.scenario.sensors
    (force, weight, load), period = forces(case), float(case.clock.sample_period)
    (u_max, reserve), step = _voltages(case), float(sensor.step(plant.s_0)) or None
    k_s, k_i, L, flux = map(float, linear_magnet(plant))
    slew = None if u_max is None else u_max / L
    pole = math.sqrt(abs(k_s) / float(plant.m))
    std = float(sensor.std)
    per_noise = step / std if step and std else None
    return [
        Fact("force_reserve", "largest force / weight", force / weight if weight else None, "1"),
        Fact("load_reserve", "largest force / (weight + largest load)", force / (weight + load) if load else None, "1"),
        Fact("k_s_N_per_m", "negative stiffness k_s", k_s, "N/m"),
        Fact("k_i_N_per_A", "force per current k_i", k_i, "N/A"),
        Fact("unstable_pole_per_s", "unstable pole sqrt(k_s/m)", pole, "1/s"),
        Fact("samples_per_time_constant", "samples per time constant of the pole", 1 / (period * pole), "1"),
        Fact("bias_flux_T", "bias flux density", flux, "T"),
        Fact("current_slew_A_per_s", "slew rate of the current, u_max/L", slew, "A/s"),
        Fact("coil_voltage_reserve_V", "voltage of a coil above the bias, coil.u_max - R i_0", reserve, "V"),
        Fact("converter_step_m", "converter step of z", step, "m"),
        Fact("step_per_noise", "converter step / standard deviation of the noise", per_noise, "1"),
    ]


def _voltages(case: Case) -> tuple[float | None, float | None]:
    """Return the largest u, and the largest voltage of a coil in excess of R i_0, V; None: no limit."""
    scenario, bias = case.scenario, case.scenario.plant.R * case.scenario.plant.i_0
    coil = scenario.actuator.coil
    u_max, reserve = float(scenario.u_max), math.inf
    if coil is not None:
        u_max = float(difference(coil.supplied(jnp.asarray(u_max), bias)))
        reserve = float(coil.reserve(bias))
    most, beyond = (x if math.isfinite(x) else None for x in (u_max, reserve))
    return most, beyond


def _facts_table(facts: list[Fact]) -> str:
    rows = [(fact.words, f"{fact.value:.4g}", fact.unit) for fact in facts if fact.value is not None]
    return table(("loop and machine", "value", "unit"), rows)


class OnProcessor(NamedTuple):
    """Results on the processor. `margin`, `unknown`: delay margins, see `check._margins`.

    `differs`: why simulated and linear delay margins differ, or empty.
    """

    sampled: SampledReport
    margin: Delays
    unknown: Delays | None
    differs: str


class Checked(NamedTuple):
    """Results of a check. `path`: name of the case file as given by the user.

    `report`: on Theorem 1; None: not computed. `findings`: stability of the loop; None: the rotor is lost. `linear`:
    whether the loop has a linearisation.
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
