"""Test of the limit on the delay margin: members are simulated with the limit as an additional delay."""

from typing import NamedTuple

import numpy as np

from ambjax.control.processor import MOST_DELAY
from ambjax.ensemble import run_ensemble
from ambjax.linear import stability_of
from tuning.judge.evaluate import JudgedMembers
from tuning.problem.limits import PREFIX, Limit
from tuning.problem.quantities import LOOPS
from tuning.problem.tuning_problem import TuningProblem

DELAY_MARGIN = "delay_margin_s"


class DelayTest(NamedTuple):
    """Number of members tested with the additional delay, and how many of them are lost, or held but not stable."""

    members: int
    lost: int
    unstable: int

    @property
    def fails(self) -> bool:
        """Whether the delay is not survived: a member is lost or not stable."""
        return bool(self.lost or self.unstable)


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
