"""The tuning problem: simulation (`objective`), cost function (`goal`) and compiled evaluation (`engine`) of a case."""

import dataclasses
import functools
from typing import Any

import numpy as np

from ambjax.cases.reader import Case
from ambjax.simulation.integrate import Integrator
from ambjax.simulation.method import choose_method
from ambjax.simulation.rosenbrock import AdaptiveRodas3
from ambjax.simulation.sliding import Slide, slides
from tuning.problem.config import Tune, seeds
from tuning.problem.goal import Goal
from tuning.problem.lanes import Engine
from tuning.problem.limits import FRONT, Limit, measures
from tuning.problem.loss import HELD, TERMS, loss_for
from tuning.problem.members import FEW, LoopRange, Members, Objective
from tuning.problem.quantities import BY_INJECTION, KINDS, LimitContext
from tuning.problem.ranges import Range, bounded

# Ratio of the number of steps of the judge to that of the search, in continuous time. On a processor, it is the ratio
# for the accurate steps, and the judge makes the steps of the case. On the tuned loops of tests/test_metrics_dense.py,
# 24 steps a sample have an error of at most 0.8 % in the settled rms voltage, 12 steps 4.6 %, 3 steps 56 %.
REFINEMENT = 8
# Relative tolerance of the accurate steps.
REFERENCE_TOLERANCE = 1e-6
# Quantities that the front of error against voltage needs.
TRACED = ("rms_error_m", "rms_u_V")


@dataclasses.dataclass(frozen=True)
class TuningProblem:
    """A case, its settings, and the engine and goal made from them.

    `finer`: factor on the number of integration steps of the search (`method_for`). `limits`: the limits, and the state
    of their augmented Lagrangian. `front`: whether the front of error against voltage is to be traced.
    """

    case: Case
    tune: Tune
    engine: Engine
    goal: Goal
    ranges: list[Range]
    finer: int = 1
    limits: tuple[Limit, ...] = ()
    front: bool = False

    @property
    def objective(self) -> Objective:
        """What the search simulates, with its steps."""
        return self.engine.objective

    def validation(self, numbers: np.ndarray) -> Members:
        """Return the members of the validation ensemble with these numbers."""
        budget = self.tune.budget
        return self.objective.chosen(seeds(budget)[1], numbers, budget.validation)

    @property
    def sampled(self) -> bool:
        """Whether the laws run on a processor, so that only the plant is integrated."""
        return self.case.cascade.sampled

    @property
    def sliding(self) -> bool:
        """Whether the search integrates with sliding steps, tune.substeps in each sample."""
        return slides(self.case.cascade, self.case.scenario)

    @functools.cached_property
    def reference(self) -> Engine:
        """Engine with accurate steps.

        Adaptive RODAS3 or, on a processor, REFINEMENT times as many steps as in the search.
        """
        accurate = AdaptiveRodas3(REFERENCE_TOLERANCE)
        return self._stepping(self._fine if self.sampled else accurate, lanes=FEW)

    @functools.cached_property
    def judging(self) -> Engine:
        """Engine of the judge.

        In continuous time, it makes REFINEMENT times as many steps as the search. On a processor, it makes the steps of
        the case, or those of the search if the search has refined its steps.
        """
        if not self.sampled:
            return self._stepping(self._fine, threads=self.engine.threads)
        method = self.case.clock.integrator
        if not self.replays or method == self.engine.objective.clock.method:
            return self.engine
        return self._stepping(method, threads=self.engine.threads)

    @property
    def replays(self) -> bool:
        """Whether the judge uses the steps of `ambjax ensemble` and `ambjax simulate`, so that its values equal theirs.

        This is true on a processor, unless the search has refined the steps.
        """
        return self.sampled and self.finer == 1

    @property
    def _fine(self) -> Integrator:
        return _finer(self.objective.clock.method, REFINEMENT)

    @property
    def accurate(self) -> str:
        """Description of the accurate steps, for the report."""
        return f"{REFINEMENT} times as many steps of the plant" if self.sampled else "adaptive RODAS3"

    def refined(self) -> "TuningProblem":
        """Return the problem with steps half as long. The count of rollouts is kept."""
        finer = 2 * self.finer
        method = method_for(self.case, self.tune.budget.substeps, finer)
        engine = self._stepping(method, mode=self.engine.mode, threads=self.engine.threads)
        engine.rollouts = self.engine.rollouts
        return dataclasses.replace(self, engine=engine, finer=finer)

    def limited(self, limits: tuple[Limit, ...]) -> "TuningProblem":
        """Return the problem with these limits."""
        return dataclasses.replace(
            self, limits=limits, goal=dataclasses.replace(self.goal, limits=tuple(limit.term for limit in limits))
        )

    def towards_voltage(self, error_m: float, volts: float, factor: float, multiplier: float) -> "TuningProblem":
        """Return the problem of least rms voltage, subject to an rms error of at most `factor` times `error_m` (m).

        If the case has a smaller limit on the rms error, that limit applies. The other limits are kept. `volts`: rms
        voltage at `error_m`, V. `Goal.unit` is chosen so that (unit volts)^2 = (error_m/s_0)^2. A lost rotor then
        costs as much, relative to the voltage term, as it did relative to the error. `multiplier`: the first one of the
        limit on the error.
        """
        weights = tuple(weight if name in HELD else 0.0 for name, weight in zip(TERMS, self.tune.weights, strict=True))
        unit = error_m / float(np.asarray(self.objective.loss.s_0)) / volts
        goal = dataclasses.replace(self.goal, weights=weights, minimised="rms_u_V", unit=unit)
        others = (limit for limit in self.limits if limit.name != "rms_error_m")
        own = [dataclasses.replace(limit, multiplier=0.0, history=()) for limit in others]
        asked = min([factor * error_m, *(one.threshold for one in self.tune.limits.each if one.name == "rms_error_m")])
        nearly = Limit("rms_error_m", asked, FRONT, KINDS["rms_error_m"].margin, multiplier)
        limits = tuple(sorted([*own, nearly], key=lambda limit: limit.name))
        return dataclasses.replace(self, goal=goal).limited(limits)

    @property
    def error_goal(self) -> Goal:
        """The goal of least error, without limits."""
        return dataclasses.replace(self.goal, weights=self.tune.weights, minimised="", limits=())

    def _stepping(self, method: Integrator, **more: Any) -> Engine:
        objective = dataclasses.replace(self.objective, clock=self.objective.clock.with_method(method))
        return Engine(objective, settle=self.case.settle, **more)

    @functools.cached_property
    def steps(self) -> tuple[Engine, Engine]:
        """Engines with the search's steps and with accurate ones, both without the sensor's converter.

        The converter turns a rounding difference into a difference of a whole converter step, which would hide the
        error of the integration steps.
        """
        scenario = self.objective.scenario
        if scenario.sensors.current_bits is None:
            return self.engine, self.reference
        exact = scenario.with_sensor(bits=None, bits_i=None)
        ours, accurate = (
            Engine(dataclasses.replace(one.objective, scenario=exact, loop=None), settle=self.case.settle, lanes=FEW)
            for one in (self.engine, self.reference)
        )
        return ours, accurate


def method_for(case: Case, substeps: int, finer: int) -> Integrator:
    """Return the search's integration method, with `finer` times as many steps.

    The number of steps is fixed, so every member takes the same time. In sliding mode there are `substeps` steps a
    sample, independent of the stiffness of the inversion law.
    """
    if slides(case.cascade, case.scenario):
        return Slide(finer * substeps)
    return _finer(choose_method(case.cascade, case.scenario, float(case.clock.sample_period), reverse=True), finer)


def _finer(method: Any, times: int) -> Integrator:
    """Return an integrator with this many times as many steps."""
    return dataclasses.replace(method, substeps=times * method.substeps)


def problem_of(case: Case, tune: Tune, *, threads: int | None = None, front: bool = False) -> TuningProblem:
    """Return the tuning problem of a case.

    `threads`: number of cores; None: all. `front`: whether to trace the front of error against voltage even if
    tune.objective does not need it.
    """
    clock = case.clock.with_method(method_for(case, tune.budget.substeps, 1))
    limits = tune.limits
    front = front or tune.objective == "knee"
    loop = _loop_range(case, limits.each)
    asked = {limit.name for limit in limits.each}
    # after saturated injections, the search limits the voltage
    names = sorted(asked | set(TRACED if front else ("rms_u_V",) if asked & set(BY_INJECTION) else ()))
    names = [*(name for name in names if KINDS[name].fold), *(loop.names if loop else ())]
    context = LimitContext(
        case.settle, float(clock.duration), float(case.scenario.touchdown), limits.band, case.scenario.rotor
    )
    loss = loss_for(case.scenario, case.settle, tune.early, measures(names, limits.each, context))
    objective = Objective(tune.space, case.cascade, case.scenario, clock, loss, case.spread, loop)
    space, box = bounded(objective, tune.space.values(case.cascade))
    objective = dataclasses.replace(objective, space=space)
    goal = Goal(tune.weights, tune.risk, quantities=tuple(names))
    mode = cheaper_mode(len(tune.space), 1 + len(loss.measures))
    engine = Engine(objective, settle=case.settle, mode=mode, threads=threads)
    return TuningProblem(case, tune, engine, goal, box, front=front).limited(limits.each)


def cheaper_mode(gains: int, outcomes: int) -> str:
    """Return "forward" or "reverse": the cheaper mode for the derivatives of `outcomes` quantities in `gains` gains.

    A gradient costs 1 + m rollouts in forward mode for m gains, 5 + 4 q in reverse mode for q quantities
    (benchmarks/schedules.py, gradients.py).
    """
    return "forward" if 1 + gains <= 5 + 4 * outcomes else "reverse"


def _loop_range(case: Case, limits: tuple[Limit, ...]) -> LoopRange | None:
    """Return the settings for limits that concern linearised loops; None if there is no such limit."""
    names = tuple(limit.name for limit in limits if limit.kind.fold is None)
    if not names:
        return None
    plant = case.scenario.plant
    size = (plant.R + plant.L * plant.pole) * plant.i_0 / plant.s_0
    # these are scale factors, so the mean plant of the ensemble is sufficient
    pole, size = (float(np.mean(np.asarray(one))) for one in (plant.pole, size))
    return LoopRange(names, float(case.zones.f_low), pole, size)
