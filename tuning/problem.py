"""A problem: a case and its [tune], made into an objective, a goal and an engine."""

import dataclasses
import functools
from typing import Any

from ambjax.cases.reader import Case
from ambjax.simulation import integrate
from ambjax.simulation.method import choose_method
from ambjax.simulation.sliding import slides
from tuning.config import Tune
from tuning.objective.goal import Goal
from tuning.objective.lanes import Engine
from tuning.objective.limits import Limit, measures
from tuning.objective.loss import loss_for
from tuning.objective.members import Objective
from tuning.objective.ranges import Range, bounded
from tuning.objective.shortfalls import bounds

# How many times as fine as the search's the steps are when an ensemble is judged. On the tuned loops of
# tests/test_metrics_dense.py, which holds twenty-four a sample, these miss the settled rms voltage by 0.8 % at most;
# twelve a sample by 4.6 %, three by 56 %.
FINE = 8
# Members and tolerance of the accurate reference against which the steps of the search are held.
REFERENCE_MEMBERS, REFERENCE_TOLERANCE, MOST_TRIALS = 4, 1e-6, 10_000
# Beyond this many gains reverse mode is the cheaper one.
MOST_FORWARD = 8


@dataclasses.dataclass(frozen=True)
class TuningProblem:
    """Case, settings and what is compiled from them."""

    case: Case
    tune: Tune
    objective: Objective
    engine: Engine
    goal: Goal
    ranges: list[Range]
    finer: int = 1
    """how many times as fine its steps are as [tune] asks for"""

    @property
    def sampled(self) -> bool:
        """Whether the laws run on a processor: their steps are the loop's own, and only the plant is integrated."""
        return self.case.cascade.processor is not None

    @functools.cached_property
    def reference(self) -> Engine:
        """The same objective in accurate steps; of a plant alone, which is not stiff, in steps FINE times as fine."""
        accurate = integrate.AdaptiveRodas3(REFERENCE_TOLERANCE, most_steps=MOST_TRIALS)
        return self._stepping(self._fine if self.sampled else accurate, lanes=REFERENCE_MEMBERS)

    @functools.cached_property
    def judging(self) -> Engine:
        """The same objective in steps FINE times as fine: what a report prints. On a processor in the case's own."""
        if not self.sampled:
            return self._stepping(self._fine, threads=self.engine.threads)
        method = self.case.clock.integrator
        if not self.replays or method == self.engine.objective.clock.method:
            return self.engine
        return self._stepping(method, threads=self.engine.threads)

    @property
    def replays(self) -> bool:
        """Whether the judge takes the steps of `ambjax ensemble` and `ambjax simulate`, so that these give its numbers.

        They are the case's own: on a processor, unless the search found them too coarse.
        """
        return self.sampled and self.finer == 1

    @property
    def _fine(self) -> integrate.Integrator:
        method: Any = self.objective.clock.method
        return dataclasses.replace(method, substeps=FINE * method.substeps)

    @property
    def accurate(self) -> str:
        """What the accurate steps are, in words."""
        return f"{FINE} times as many steps of the plant" if self.sampled else "adaptive RODAS3"

    def limited(self, limits: tuple[Limit, ...]) -> "TuningProblem":
        """With limits that have learnt something."""
        return dataclasses.replace(self, goal=dataclasses.replace(self.goal, limits=limits))

    def _stepping(self, method: integrate.Integrator, **more: Any) -> Engine:
        objective = dataclasses.replace(self.objective, clock=dataclasses.replace(self.objective.clock, method=method))
        return Engine(objective, settle=self.case.settle, **more)

    @functools.cached_property
    def steps(self) -> tuple[Engine, Engine]:
        """The search's own steps and accurate ones, to be compared: both without the converter, if there is one.

        Where it rounds otherwise for a last digit's sake, two runs go different ways, and differ by more than steps do.
        """
        scenario = self.objective.scenario
        if scenario.sensor is None or scenario.sensor.bits is None:
            return self.engine, self.reference
        sensor = dataclasses.replace(scenario.sensor, bits=None)
        objective = dataclasses.replace(self.objective, scenario=dataclasses.replace(scenario, sensor=sensor))
        exact = dataclasses.replace(self, objective=objective)
        return exact._stepping(objective.clock.integrator, lanes=REFERENCE_MEMBERS), exact.reference


def method_for(case: Case, substeps: int, finer: int) -> integrate.Integrator:
    """The step of the search, `finer` times as fine: of fixed number, so that all members take as long.

    Where the loop slides, `substeps` a sample, blind to the stiffness of the inversion law.
    """
    if slides(case.cascade, case.scenario.plant):
        return integrate.Slide(finer * substeps)
    method: Any = choose_method(case.cascade, case.scenario, float(case.clock.sample_period), reverse=True)
    return dataclasses.replace(method, substeps=finer * method.substeps)


def problem_of(case: Case, tune: Tune, *, finer: int = 1, threads: int | None = None) -> TuningProblem:
    """The problem of a case, in steps `finer` times as fine as [tune] asks for."""
    clock = case.clock.with_method(method_for(case, tune.budget.substeps, finer))
    limits = tune.limits
    measured = measures(limits.each, case.scenario, clock, case.settle, limits.band)
    loss = loss_for(case.scenario, case.settle, tune.early, measured)
    objective = Objective(tune.space, case.cascade, case.scenario, clock, loss, case.spread)
    conditions = bounds(case.cascade, case.scenario, clock)
    space, box = bounded(objective, conditions, tune.space.values(case.cascade))
    objective = dataclasses.replace(objective, space=space)
    goal = Goal(space, tune.weights, tune.risk, conditions, tune.conditions, tune.margin, limits.each)
    mode = "forward" if len(tune.space) <= MOST_FORWARD else "reverse"
    return TuningProblem(
        case, tune, objective, Engine(objective, settle=case.settle, mode=mode, threads=threads), goal, box, finer
    )
