"""`ambjax check`: sensitivity and margins, the conditions of the sampled loop, and those of Theorem 1."""

import argparse
import dataclasses
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ambjax.cases.forces import forces
from ambjax.cases.given import of_case
from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.commands import check_text, machine_check
from ambjax.commands.check_text import OnProcessor, acceptance
from ambjax.commands.machine_check import CaseCheck
from ambjax.commands.reading import read_any_with_warnings
from ambjax.ensemble.delays import DELAYS, at_delays, delay_margin
from ambjax.ensemble.replay import as_member, record_system
from ambjax.host.heartbeat import FIRST_RUN, doing, quiet, say
from ambjax.host.one_thread import one_thread
from ambjax.linear.stability import Findings, Stability, stability_of
from ambjax.results.outputs import plain
from ambjax.simulation.rollout import rollout
from ambjax.theorem import Condition, Report, advice
from ambjax.theorem import check as check_theorem
from ambjax.theorem.causes import find_cause
from ambjax.theorem.sampled_report import Delays, check_sampled, with_causes

Summary = dict[str, object]


def run(args: argparse.Namespace) -> tuple[int, Summary]:
    """Check a case. Print the verdict, then the tables that apply; with `--full` all tables."""
    case = read_any_with_warnings(args.case)
    found = machine_check.check(case) if isinstance(case, MachineCase) else _checked(case, args.case, args.full)
    if not args.json:
        print(found.text)
    return int(not found.holds), found.summary


@of_case(machines=True)
@one_thread()
def check(case: Case | MachineCase, *, full: bool = False) -> CaseCheck:
    """Check a case of one axis or of a machine, as `ambjax check` does.

    The check of an axis fails if a condition fails, if the rotor is lost, if the integrator stalls, if the rotor is
    held but the loop is not stable, if the magnets cannot carry the rotor, or if the loop cannot be linearised. On a
    processor, the conditions of Theorem 1 do not count. The zones and the margins of the linearised loop never count.
    The check of a machine fails if the rotor is lost, if the machine is not stable at one of its speeds, or if it
    has no linearisation.

    `full`: whether to compute and write also what does not affect the verdict. Without it, the summary of a case on a
    processor has None for `method`, `conditions` and `proof` of Theorem 1. Raises ValueError for anything but a case.

        print(ambjax.check(case).text)
    """
    with quiet():
        if isinstance(case, MachineCase):
            return machine_check.check(case)
        return _checked(case, f"{case.name}.toml", full)


def _checked(case: Case, path: str, full: bool) -> CaseCheck:
    """Check a case of one axis. `path`: of its file, for the text."""
    with doing(f"simulating and analysing the loop; {FIRST_RUN}"):
        report, (loop, sensitivity, machine), on_processor, findings = _results(case, full)
    run = report if on_processor is None else on_processor.sampled
    assert run is not None
    if math.isfinite(run.lost_at):
        findings = None
    elif findings is None:
        with doing(f"testing the stability of the loop; {FIRST_RUN}"):
            findings = _stability(case)
    summary = {
        "holds": run.holds,
        "lost_at_s": run.lost_at,
        "lost_why": run.lost_why,
        "cause": run.cause and run.cause._asdict(),
        "stalled": run.stalled,
        "method": report and report.method,
        "conditions": report and [_condition(c) for c in report.conditions],
        "proof": report and [_condition(c) for c in report.proof],
        "loop": loop,
        "stability": None if findings is None else findings._asdict(),
    }
    largest, weight, _ = forces(case)
    if on_processor is not None:
        summary |= _processor_summary(on_processor)
    used, zone = check_text.clearance(case, run.largest_z)
    summary |= {"clearance_used": used, "clearance_zone": zone}
    steady = findings is None or findings.stable
    summary["holds"] = bool(summary["holds"]) and largest >= weight and steady
    shown = check_text.Checked(case, path, report, findings, on_processor, loop["stable"] is not None)
    verdict = "\n".join(check_text.verdict(shown, sensitivity[0], run.largest_z))
    text = "\n\n".join([verdict, "\n".join([*sensitivity[1:], machine]), *check_text.details(shown, full)])
    return CaseCheck(summary["holds"] and loop["stable"] is not None, plain(summary), text)


def _results(
    case: Case, full: bool
) -> tuple[Report | None, tuple[Summary, list[str], str], OnProcessor | None, Findings | None]:
    """Return the report of Theorem 1, the linear loop, the results on the processor, and the stability of the loop.

    The report is None for a case on a processor, unless `full`. The stability is None if, on a processor, the search of
    the delay margin has not computed it. It has no meaning if the rotor is lost.
    """
    with ThreadPoolExecutor(2) as pool:  # compilations use one core each
        theorem = on_processor = findings = None
        if full or not case.cascade.sampled:
            say(f"checking Theorem 1: simulating {float(case.clock.duration):g} s in continuous time")
            theorem = pool.submit(check_theorem, case.cascade, case.scenario, case.clock, case.settle)
        say("linearising the loop")
        linear = pool.submit(acceptance, case)
        if case.cascade.sampled:
            say("simulating on the processor, with and without noise")
            parts = (case.cascade, as_member(case.scenario), case.clock, case.settle, record_system)
            run = pool.submit(lambda: with_causes(check_sampled(*parts), *parts, say))
            (margin, unknown), findings = _margins(case)
            places: Any = linear.result()[0].get("margins") or {"command": {}}
            own, delay = places["command"].get("delay_margin_s"), float(case.cascade.timing.delay)
            differs = advice.delay_difference(own, unknown or margin, delay, float(case.clock.sample_period))
            on_processor = OnProcessor(run.result(), margin, unknown, differs)
        else:
            findings = _stability(case)
        loop, report = linear.result(), theorem and theorem.result()
    if report is not None and report.lost and not case.cascade.sampled:
        lost = lambda *loop: bool(np.isfinite(rollout(*loop, record_every=0).trajectory.lost_at))  # noqa: E731
        cause = find_cause(lost, case.cascade, case.scenario, case.clock, say)
        report = dataclasses.replace(report, cause=cause)
    return report, loop, on_processor, findings


def _stability(case: Case) -> Findings:
    say("testing whether the loop is stable: simulating without noise and loads")
    return stability_of(case.cascade, as_member(case.scenario), case.clock).findings()


def _margins(case: Case) -> tuple[tuple[Delays, Delays | None], Findings | None]:
    """Return the delay margins with prediction over each delay, and over that of the case, and the stability."""
    say(f"finding the delay margin: simulating ensembles of {DELAYS} delays, three at most")
    margin, stability = _margin_of(case, known=True)
    if (processor := case.cascade.processor) is None or processor.predict is False:
        return (margin, None), stability
    say("finding the delay margin again: the prediction uses the delay of the case")
    unknown, stability = _margin_of(case, known=False)
    return (margin, unknown), stability


def _margin_of(case: Case, *, known: bool) -> tuple[Delays, Findings | None]:
    """Return the result of `delay_margin` with the delays, up to its `held`, up to which the loop is stable.

    DELAYS delays are tested; a second pass divides the step after the last one that is stable. Also returns the
    findings at the case's own delay; None if the rotor is not held there.
    """
    margin = delay_margin(case.cascade, case.scenario, case.clock, known=known)
    say("testing whether the loop is stable at these delays")
    if margin.held is None:
        return margin, None
    own = float(case.cascade.timing.delay)
    first = own if margin.held >= own else 0.0

    def tried(low: float, high: float) -> tuple[np.ndarray, Stability]:
        delays = np.linspace(low, high, DELAYS)
        return delays, stability_of(at_delays(case.cascade, delays, known=known), case.scenario, case.clock)

    delays, found = tried(first, margin.held)
    at_own = found.of([0]).findings() if first == own else None
    if found.stable.all():
        return margin._replace(stable=margin.held, tested=DELAYS), at_own
    facts, at = found.findings(), int(np.argmin(found.stable))
    stable = None
    if at:
        finer, again = tried(delays[at - 1], delays[at])
        stable = float(finer[max(int(np.argmin(again.stable)) - 1, 0)])
    return margin._replace(stable=stable, swing_m=facts.swing_m, current_A=facts.current_A, tested=DELAYS), at_own


def _processor_summary(results: OnProcessor) -> Summary:
    sampled, margin, unknown, differs = results
    laws = [dataclasses.asdict(law) | {"holds": law.holds} for law in sampled.laws]
    return {
        "processor": {
            "laws": laws,
            "distance_to_C": sampled.distance[0],
            "distance_to_C_at_s": sampled.distance[1],
            "alternating": sampled.alternating,
            "alternates": sampled.alternates,
            "alternation_cause": sampled.alternation_cause and sampled.alternation_cause._asdict(),
            "bands": [dataclasses.asdict(band) | {"bound": band.bound} for band in sampled.bands],
            "delay_margin": _margin(margin),
            "delay_margin_unknown": None if unknown is None else _margin(unknown),
            "delay_margins_differ": differs or None,
        },
    }


def _margin(margin: Delays) -> Mapping[str, object]:
    return margin._asdict() | {"resolution": margin.resolution}


def _condition(c: Condition) -> Mapping[str, object]:
    return dataclasses.asdict(c) | {"margin": c.margin}
