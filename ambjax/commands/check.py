"""`ambjax check`: sensitivity and margins, the conditions of the sampled loop, and those of Theorem 1."""

import argparse
import dataclasses
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.forces import forces
from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.cases.warned import idealised
from ambjax.commands import machine_check
from ambjax.commands.acceptance import acceptance
from ambjax.commands.reading import read_any_with_warnings
from ambjax.control.cascade import Cascade
from ambjax.host.heartbeat import FIRST_RUN, doing, say
from ambjax.linear.stability import Findings, stability_of
from ambjax.results.outputs import plain, table
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import rollout
from ambjax.theorem.causes import Cause, find_cause
from ambjax.theorem.conditions import Condition, Report, check
from ambjax.theorem.sampled_report import Delays, SampledReport
from ambjax.world.scenario import Scenario

Summary = dict[str, object]
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


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """Check a case. Print the results of the linearised loop, then those on the processor, then those of Theorem 1.

    Returns the exit code and the summary. The exit code is 1 if a condition fails, if the rotor is lost, if the
    integrator stalls, if the rotor is held but the loop is not stable, if the magnets cannot carry the rotor, or if the
    loop cannot be linearised. On a processor, the conditions of Theorem 1 do not count. The zones and the margins of
    the linearised loop never count.
    """
    from ambjax.theorem import advice

    case = read_any_with_warnings(args.case)
    if isinstance(case, MachineCase):
        return machine_check.check(args, case)
    with doing(f"simulating and analysing the loop; {FIRST_RUN}"):
        report, (loop, text), on_processor = _results(case)
    lost = report.lost_at if on_processor is None else on_processor.sampled.lost_at
    with doing(f"testing the stability of the loop; {FIRST_RUN}"):
        findings = _stability(case) if math.isinf(lost) else None
    summary = {
        "holds": report.holds,
        "lost_at_s": report.lost_at,
        "lost_why": report.lost_why,
        "cause": _cause(report.cause),
        "stalled": report.stalled,
        "method": report.method,
        "conditions": [_condition(c) for c in report.conditions],
        "proof": [_condition(c) for c in report.proof],
        "loop": loop,
        "stability": None if findings is None else findings._asdict(),
    }
    if not args.json:
        print(text)
        if ideal := idealised(case):
            print(f"\n{ideal}")
    if findings is not None and not args.json:
        print(f"\n{findings.words()}")
    largest, weight, _ = forces(case)
    if not args.json and largest < weight:
        words = f"their largest force is {largest:.4g} N, below its weight of {weight:.4g} N"
        print(f"\nThe magnets cannot carry the rotor: {words}.")
    if on_processor is not None:
        summary |= _processor_summary(case, args, on_processor, loop)
    else:
        summary |= _clearance(case, args, report.largest_z)
    if not args.json:
        print("\nTheorem 1:\n")
        _print_check(report.conditions, report.proof)
        print("\n" + "\n".join(advice.theorem_lines(report, args.case)))
        if on_processor is not None:
            print(CONTINUOUS)
    steady = findings is None or findings.stable
    summary["holds"] = bool(summary["holds"]) and largest >= weight and steady
    return int(not summary["holds"] or loop["stable"] is None), plain(summary)


class _OnProcessor(NamedTuple):
    """Results on the processor. `margin`, `unknown`: delay margins, see `_margins`."""

    sampled: SampledReport
    margin: Delays
    unknown: Delays | None


def _results(case: Case) -> tuple[Report, tuple[Summary, str], _OnProcessor | None]:
    """Return the report of Theorem 1, the summary and text of the linearised loop, and the results on the processor.

    Theorem 1 is checked in a second thread. Compilation and simulation release the GIL, so both threads run at once.
    """
    with ThreadPoolExecutor(1) as pool:
        say(f"checking Theorem 1: simulating {float(case.clock.duration):g} s in continuous time")
        theorem = pool.submit(check, case.cascade, case.scenario, case.clock, case.settle)
        say("linearising the loop")
        loop, on_processor = acceptance(case), None
        if case.cascade.sampled:
            on_processor = _OnProcessor(_sampled(case), *_margins(case))
        report = theorem.result()
    if report.lost and not case.cascade.sampled:
        cause = find_cause(_is_lost, case.cascade, case.scenario, case.clock, say)
        report = dataclasses.replace(report, cause=cause)
    return report, loop, on_processor


def _is_lost(cascade: Cascade, scenario: Scenario, clock: Clock) -> bool:
    return bool(np.isfinite(rollout(cascade, scenario, clock, record_every=0).trajectory.lost_at))


def _sampled(case: Case) -> SampledReport:
    from ambjax.ensemble.replay import as_member, record_system
    from ambjax.theorem.sampled_report import check_sampled, with_causes

    say("simulating on the processor, with and without noise")
    parts = (case.cascade, as_member(case.scenario), case.clock, case.settle, record_system)
    return with_causes(check_sampled(*parts), *parts, say)


def _margins(case: Case) -> tuple[Delays, Delays | None]:
    """Return two delay margins: with prediction over the delay of each run, and over the delay of the case.

    If the processor does not predict, the first is the margin without prediction, and the second is None.
    """
    from ambjax.ensemble.delays import DELAYS, delay_margin
    from ambjax.linear.stability import with_stability

    loop = (case.cascade, case.scenario, case.clock)

    def found(known: bool) -> Delays:
        margin = delay_margin(*loop, known=known)
        say("testing whether the loop is stable at these delays")
        return with_stability(margin, *loop, known=known)

    say(f"finding the delay margin: simulating ensembles of {DELAYS} delays, three at most")
    margin = found(True)
    if (processor := case.cascade.processor) is None or processor.predict is False:
        return margin, None
    say("finding the delay margin again: the prediction uses the delay of the case")
    return margin, found(False)


def _stability(case: Case) -> Findings:
    """Return whether the loop of the case is stable, from its poles and from a run without noise and loads."""
    from ambjax.ensemble.replay import as_member

    say("testing whether the loop is stable: simulating without noise and loads")
    return stability_of(case.cascade, as_member(case.scenario), case.clock).findings()


def _processor_summary(case: Case, args: argparse.Namespace, results: _OnProcessor, loop: Summary) -> Summary:
    """Print the results on the processor, and return their summary; "holds" is True if all conditions hold.

    `loop`: summary of the linearised loop.
    """
    from ambjax.theorem import advice

    sampled, margin, unknown = results
    places: Any = loop.get("margins") or {}
    linear = places.get("command", {}).get("delay_margin_s")
    sizes = float(case.cascade.timing.delay), float(case.clock.sample_period)
    differs = advice.delay_difference(linear, unknown or margin, *sizes)
    if not args.json:
        print(f"\nOn the processor: {case.cascade.on_processor().processor}, T = {case.clock.sample_period:g} s.\n")
        _print_sampled(sampled)
        print("\n" + "\n".join([*advice.processor_lines(sampled, margin, unknown), *([differs] if differs else [])]))
    laws = [dataclasses.asdict(law) | {"holds": law.holds} for law in sampled.laws]
    return {
        **_clearance(case, args, sampled.largest_z),
        "holds": sampled.holds,
        "processor": {
            "lost_at_s": sampled.lost_at,
            "lost_why": sampled.lost_why,
            "loss_cause": _cause(sampled.loss_cause),
            "stalled": sampled.stalled,
            "laws": laws,
            "distance_to_C": sampled.distance[0],
            "distance_to_C_at_s": sampled.distance[1],
            "alternating": sampled.alternating,
            "alternates": sampled.alternates,
            "alternation_cause": _cause(sampled.alternation_cause),
            "bands": [dataclasses.asdict(band) | {"bound": band.bound} for band in sampled.bands],
            "delay_margin": _margin(margin),
            "delay_margin_unknown": None if unknown is None else _margin(unknown),
            "delay_margins_differ": differs or None,
        },
    }


def _clearance(case: Case, args: argparse.Namespace, largest: float | None) -> Summary:
    """Print and return the clearance zone.

    `largest`: largest |z| after run.settle, m. None: the zone is D, and nothing is printed.
    """
    if largest is None:
        return {"clearance_used": None, "clearance_zone": "D"}
    used = largest / float(np.min(np.asarray(case.scenario.touchdown)))
    zone, zones = case.zones.clearance_zone(used), case.zones
    if not args.json:
        print(
            f"\nClearance: zone {zone}. After run.settle |z| reaches {largest:.4g} m, {100 * used:.3g} % of the "
            f"clearance (A below {100 * zones.clearance_a:g} %, B below {100 * zones.clearance_b:g} %, C below "
            f"{100 * zones.clearance_c:g} %)."
        )
    return {"clearance_used": used, "clearance_zone": zone}


def _margin(margin: Delays) -> Mapping[str, object]:
    return margin._asdict() | {"resolution": margin.resolution}


def _cause(cause: Cause | None) -> Mapping[str, object] | None:
    return None if cause is None else cause._asdict()


def _condition(c: Condition) -> Mapping[str, object]:
    return dataclasses.asdict(c) | {"margin": c.margin}


def _print_check(conditions: list[Condition], proof: list[Condition]) -> None:
    verdicts = {True: "holds", False: "FAILS", None: "-"}

    def number(x: float | None) -> str:
        return "-" if x is None else f"{x:.5g}"

    rows = [
        (
            c.requires,
            number(c.gain),
            number(c.against),
            number(c.margin),
            c.unit,
            f"{c.at_s:.5g}",
            verdicts[c.holds],
            c.note,
        )
        for c in conditions
    ]
    print(table(("condition", "left", "right", "margin", "unit", "at (s)", "verdict", "note"), rows))
    steps = [(c.name, c.requires, f"{c.against:.3g}", c.unit, f"{c.at_s:.5g}", c.note) for c in proof]
    print("\n" + table(("proof", "statement", "worst", "unit", "at (s)", "meaning"), steps))


def _print_sampled(sampled: SampledReport) -> None:
    rows = [
        (
            law.stage,
            "implicit" if law.implicit else "explicit",
            f"{law.radius:.4g}",
            f"{law.damping:.4g}",
            "holds" if law.holds else "FAILS",
        )
        for law in sampled.laws
    ]
    head = ("law", "step", "largest |pole|", "least damping ratio", "verdict")
    print(table(head, rows))

    def number(x: float | None) -> str:
        return "-" if x is None else "none" if math.isinf(x) else f"{x:.4g}"

    bands = [
        (
            b.signal,
            b.unit,
            "the case's" if b.noise else "none",
            *map(number, (b.gain, b.disturbance, b.band, b.difference, b.bound, b.largest)),
            b.note,
        )
        for b in sampled.bands
    ]
    if bands:
        values = ("gain, per s", "disturbance", "band", "difference", "bound", "largest")
        print("\n" + table(("signal", "unit", "noise", *values, "note"), bands) + "\n" + BAND)
    else:
        print("\nNo bands, because every run ends early.")
