"""The sensitivity of members of an ensemble, measured by injection into the simulation."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.control.base import hard_signs
from ambjax.control.cascade import USUAL
from ambjax.linear import Analysis, Injection, analyse, injected, linearise, lines
from tuning.objective.limits import PREFIX, Limit
from tuning.problem import TuningProblem

# Members of an ensemble, those with the largest linear peak, into which is injected; repetitions with other noise.
INJECTED, REPETITIONS = 3, 8
# Limited quantities that an injection measures.
MEASURED = {"sensitivity": "S", "complementary": "T", "control_sensitivity": "KS"}


@dataclasses.dataclass(frozen=True)
class MeasuredPeak:
    """The linear and the injected peak of |S| of one member.

    `linear`, `frequency_hz`, `zone`: of the linearised loop. `peak`, `low`, `high`, `at_hz`: injected, with the 95 %
    interval; None if the rotor is lost or the laws run in continuous time. `saturated`: share of samples with the
    supply at its limit. `largest`: peaks of |S|, |T| and |KS| by the name of the limit.
    """

    member: int
    linear: float | None
    frequency_hz: float | None
    zone: str
    peak: float | None
    low: float | None
    high: float | None
    at_hz: float | None
    saturated: float | None
    lost: int
    repetitions: int
    largest: dict[str, float]


class Sensitivity(NamedTuple):
    """The peaks of some judged members. `decides`: whether the injected values decide alone on a limit."""

    peaks: tuple[MeasuredPeak, ...]
    decides: bool


def injects(problem: TuningProblem) -> bool:
    """Return whether the limits need an injection: they limit what it measures, and the laws run on a processor."""
    return problem.sampled and any(limit.name in MEASURED for limit in problem.limits)


def decides(problem: TuningProblem) -> bool:
    """Return whether the injection decides alone: a sign is set-valued, so that no linear loop describes chattering."""
    return injects(problem) and any(hard_signs(getattr(problem.case.cascade, stage)) for stage in USUAL)


def injections(
    problem: TuningProblem, x: np.ndarray, seed: int, columns: dict[str, np.ndarray], most: int = INJECTED
) -> Sensitivity | None:
    """Analyse and measure the members with the largest linear peak at coordinates x [m], of the judged `columns` [N].

    `most`: number of these members. Returns None if no limit needs it, or no member is held.
    """
    name = next((name for name in MEASURED if f"loss.{PREFIX}{name}" in columns), None)
    alive = np.flatnonzero(~np.isfinite(columns["lost_at_s"]))
    if name is None or not alive.size:
        return None
    order = np.argsort(-columns[f"loss.{PREFIX}{name}"][alive], kind="stable")
    count = len(columns["lost_at_s"])
    peaks = tuple(_member(problem, x, seed, int(k), count) for k in alive[order[:most]])
    return Sensitivity(peaks, decides(problem))


def reached_of(limit: Limit, columns: Mapping[str, np.ndarray], measured: Sensitivity | None) -> float:
    """Return the judge's value of a limit: the linear one or, if that is larger or decides, the injected one.

    A member that the injection loses counts as infinite.
    """
    linear = limit.reached(columns)
    if limit.name not in MEASURED or measured is None:
        return linear
    largest = [one.largest.get(limit.name, math.inf) for one in measured.peaks if one.repetitions]
    if not largest:
        return linear
    return max(largest) if measured.decides else max(linear, *largest)


def _member(problem: TuningProblem, x: np.ndarray, seed: int, number: int, total: int) -> MeasuredPeak:
    objective, case, clock = problem.objective, problem.case, problem.case.clock
    member = jax.tree.map(lambda a: a[0], objective.chosen(seed, np.array([number]), total))
    cascade, scenario = objective.world(member)
    cascade = objective.space.decode(jnp.asarray(x), cascade)
    scenario = dataclasses.replace(scenario, seed=case.scenario.seed, member=case.scenario.member)
    period = float(clock.sample_period)
    try:
        analysis = analyse(linearise(cascade, scenario, clock), scenario.plant.m, period, case.zones)
    except ValueError:  # no equilibrium
        analysis = None
    one: Any = None
    if injects(problem):
        longer = dataclasses.replace(clock, samples=math.ceil(1 / (float(case.zones.f_low) * period)))
        at = lines(case.zones, longer, None if analysis is None else analysis.S.frequency)
        one = injected(cascade, scenario, longer, at, members=REPETITIONS if scenario.random else 1)
    return _summary(number, analysis, one)


def _summary(number: int, analysis: Analysis | None, one: Injection | None) -> MeasuredPeak:
    linear, frequency, zone = None, None, "D"
    if analysis is not None and analysis.stable:
        linear, frequency, zone = *analysis.S, analysis.zone
    if one is None:
        return MeasuredPeak(number, linear, frequency, zone, None, None, None, None, None, 0, 0, {})
    largest = {}
    if one.S is not None and not one.lost:
        responses = {name: np.asarray(getattr(one, which)) for name, which in MEASURED.items()}
        largest = {name: float(np.max(np.abs(response))) for name, response in responses.items()}
    return MeasuredPeak(
        number, linear, frequency, zone, one.peak, one.peak_low, one.peak_high, one.peak_frequency, one.saturated,
        one.lost, one.members, largest,
    )  # fmt: skip
