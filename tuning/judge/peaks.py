"""Tests of judged members: linear and injected peaks of the sensitivity, and an additional delay."""

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.control.base import set_valued_signs
from ambjax.control.cascade import DEFAULT_LAWS
from ambjax.control.processor import MOST_DELAY
from ambjax.ensemble import run_ensemble
from ambjax.linear import Analysis, Injection, analyse, frequency_lines, linearise, stability_of
from ambjax.linear.injection import REPETITIONS, injection_of
from ambjax.linear.member_responses import Responses, member_responses
from ambjax.linear.stability import MOST_TESTED
from ambjax.results.operating import one_period
from tuning.judge.evaluate import JudgedMembers
from tuning.problem.limits import PREFIX, Limit
from tuning.problem.members import FEW
from tuning.problem.quantities import BY_INJECTION, LOOPS
from tuning.problem.tuning_problem import TuningProblem

DELAY_MARGIN = "delay_margin_s"

# Share of samples at the limit of the voltage above which an injection does not measure the linear loop.
SATURATED = 0.01


class MemberPeak(NamedTuple):
    """The peaks of the sensitivity of one member.

    `linear`: analysis of the linearised loop; a text: why it cannot be linearised. `injected`: the injections; None if
    the laws run in continuous time.
    """

    member: int
    linear: Analysis | str
    injected: Injection | None = None

    @property
    def largest(self) -> dict[str, float]:
        """Injected peaks by the name of the limit; empty without injections, or if one of them loses the rotor."""
        if self.injected is None or self.injected.lost:
            return {}
        responses = {name: np.asarray(getattr(self.injected, which)) for name, which in BY_INJECTION.items()}
        return {name: float(np.max(np.abs(response))) for name, response in responses.items()}


class Sensitivity(NamedTuple):
    """The peaks of some judged members. `decides`: whether the injected values decide alone on a limit."""

    peaks: tuple[MemberPeak, ...]
    decides: bool

    @property
    def saturates(self) -> bool:
        """Whether injections saturate the voltage in more than SATURATED of the samples, or lose a rotor."""
        each = [one.injected for one in self.peaks if one.injected is not None]
        return any(one.lost or (one.saturated or 0.0) > SATURATED for one in each)


def injects(problem: TuningProblem) -> bool:
    """Return whether the laws run on a processor and a limit concerns a quantity that injections measure."""
    return problem.sampled and any(limit.name in BY_INJECTION for limit in problem.limits)


def decides(problem: TuningProblem) -> bool:
    """Return whether only injected peaks are compared with the limits.

    This holds if injections measure a limited quantity and a sign is set-valued: no linear loop describes the
    chattering of such a sign.
    """
    return injects(problem) and any(set_valued_signs(getattr(problem.case.cascade, stage)) for stage in DEFAULT_LAWS)


def injections(of: JudgedMembers) -> Sensitivity | None:
    """Analyse the FEW held members with the largest peaks; on a processor, also inject.

    The members are those with the largest linear peak of the first quantity of BY_INJECTION that has a limit. If only
    injections decide, or if these injections saturate the voltage, they are those with the largest injected peak, by
    one injection into each of the first MOST_TESTED held members. Returns None if no quantity of BY_INJECTION has a
    limit, or if no member is held.
    """
    name, alive = next((name for name in BY_INJECTION if f"loss.{PREFIX}{name}" in of.columns), None), of.held
    if name is None or not alive.size:
        return None
    order = alive[np.argsort(-of.columns[f"loss.{PREFIX}{name}"][alive], kind="stable")]
    if not injects(of.problem):
        return Sensitivity(tuple(MemberPeak(int(k), _analysis(of, k)) for k in order[:FEW]), False)
    first = _analysis(of, order[0])
    peak = None if isinstance(first, str) else first.S.frequency
    only = decides(of.problem)
    found = None if only else _injected(of, order[:FEW], peak)
    if found is None or found.saturates:
        once = _responses(of, alive[:MOST_TESTED], 1, peak)
        response = {"S": once.S, "T": once.S - 1, "KS": once.KS}[BY_INJECTION[name]]
        size = np.where(once.held, np.abs(response).max(axis=1), np.inf)
        found = _injected(of, alive[np.argsort(-size, kind="stable")][:FEW], peak)
    return found._replace(decides=only)


def _injected(of: JudgedMembers, members: np.ndarray, peak: float | None) -> Sensitivity:
    """Return the peaks of some members, by repeated injections if there is noise."""
    random = of.problem.objective.scenario.random
    repetitions = REPETITIONS if random else 1
    every = _responses(of, members, repetitions, peak)
    peaks = []
    for at, k in enumerate(members):
        own = slice(at * repetitions, (at + 1) * repetitions)
        parts = {name: getattr(every, name)[own] for name in ("S", "KS", "saturated", "held")}
        peaks.append(MemberPeak(int(k), _analysis(of, k), injection_of(every._replace(**parts), random)))
    return Sensitivity(tuple(peaks), False)


def reached_of(limit: Limit, columns: Mapping[str, np.ndarray], injected: Sensitivity | None) -> float:
    """Return the judge's value of a limit: the larger of the linear and the injected one, or the injected one alone.

    The injected value counts alone if `injected.decides`. Without an injection, the value is the linear one.

    The value of a member that is lost during its injection is infinite.
    """
    linear = limit.reached(columns)
    if limit.name not in BY_INJECTION or injected is None:
        return linear
    largest = [one.largest.get(limit.name, math.inf) for one in injected.peaks if one.injected]
    if not largest:
        return linear
    return max(largest) if injected.decides else max(linear, *largest)


def _analysis(of: JudgedMembers, number: int) -> Analysis | str:
    """Analyse the linearised loop of one member. Return the cause as text if it cannot be linearised."""
    objective, case = of.problem.objective, of.problem.case
    cascade, scenario = objective.world(jax.tree.map(lambda a: a[0], of.chosen(np.array([number]))))
    cascade = objective.notched(of.x, objective.space.decode(jnp.asarray(of.x), cascade))
    scenario = dataclasses.replace(scenario, seed=case.scenario.seed, member=case.scenario.member)
    try:
        system = linearise(cascade, scenario, case.clock)
    except ValueError as error:
        return str(error)
    return analyse(system, scenario.plant.m, float(case.clock.sample_period), case.zones.whole(system.period))


def _responses(of: JudgedMembers, numbers: np.ndarray, repetitions: int, peak: float | None) -> Responses:
    """Inject a test signal into the members `numbers` [n], each `repetitions` times with different noise.

    The lines are denser near `peak` (Hz). The results are in the order of the members.
    """
    case = of.problem.case
    cascade, scenario = of.problem.objective.fixed(of.x, of.chosen(np.repeat(numbers, repetitions)))
    scenario = dataclasses.replace(scenario, seed=0, member=np.arange(len(numbers) * repetitions))
    clock = one_period(case)
    lines = frequency_lines(dataclasses.replace(case.zones, f_high=None), clock, peak)
    return member_responses(cascade, scenario, clock, lines, amplitude=case.zones.amplitude)


class DelayTest(NamedTuple):
    """Number of members tested with the additional delay, and how many of them are lost, or held but not stable."""

    members: int
    lost: int
    unstable: int


def not_simulated(problem: TuningProblem, limit: Limit) -> str:
    """Return why the additional delay of the limit is not simulated; '' if it is."""
    cascade, period = problem.case.cascade, float(problem.case.clock.sample_period)
    if not cascade.sampled:
        return "the controller runs in continuous time"
    total = float(np.max(np.asarray(cascade.timing.delay))) + limit.threshold / period
    if total > MOST_DELAY:
        return f"the total delay of {total:.3g} samples exceeds the {MOST_DELAY:g} samples that can be simulated"
    return ""


def delay_test(of: JudgedMembers) -> DelayTest | None:
    """Simulate the LOOPS held members of least delay margin, with the limit on it as an additional delay.

    The prediction of the controller assumes the delay of the case. Returns None without such a limit, if
    `not_simulated` gives a reason, or if no member is held.
    """
    problem, alive = of.problem, of.held
    limit = next((limit for limit in problem.limits if limit.name == DELAY_MARGIN), None)
    if limit is None or not_simulated(problem, limit) or not alive.size:
        return None
    order = np.argsort(of.columns[f"loss.{PREFIX}{DELAY_MARGIN}"][alive], kind="stable")
    members = of.chosen(alive[order[:LOOPS]])
    cascade, scenario = problem.objective.fixed(of.x, members)
    processor = cascade.timing
    delay = np.asarray(processor.delay) + limit.threshold / float(problem.case.clock.sample_period)
    if np.max(delay) > MOST_DELAY:
        return None
    cascade = cascade.with_processor(delay=delay, assumed=processor.ahead, predict=processor.predicts)
    ended = run_ensemble(cascade, scenario, problem.case.clock, fold=None, record_every=0)
    lost = np.isfinite(ended.trajectory.lost_at)
    unstable = ~lost & ~stability_of(cascade, scenario, problem.case.clock).stable
    return DelayTest(len(members.member), int(lost.sum()), int(unstable.sum()))
