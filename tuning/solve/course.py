"""A sequence of searches. Each later search starts from the results of earlier ones."""

import dataclasses
import math
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tuning.events import Event, Listener, Reached, Standing
from tuning.judge.evaluate import StepError
from tuning.problem.loops import check_loops
from tuning.problem.loss import TERMS
from tuning.problem.members import FEW, Members
from tuning.problem.quantities import NEGLIGIBLE
from tuning.problem.ranges import around, initial_points
from tuning.problem.tuning_problem import TuningProblem
from tuning.solve.checkpoint import CheckpointFile, SearchState, checkpoint
from tuning.solve.descent import Starts
from tuning.solve.refine import best_of, screen, search

# Number of random points around the first optimum, relative to tune.screen. Near that of C10, very few are lower.
AROUND = 4


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Result of all searches and validations (`rounds`).

    `problem`, `members`: of the last search. `x` [m]: coordinates of the gains. `error`: step error at x; None if it
    was not computed. `history`, `seconds`: as in `Course`. `lost`: number of lost validation members, plus the number
    of members that are lost or stall with accurate steps. `validation_error`: rms error of the validation members that
    are held, relative to s_0; inf if it was not computed. `unstable`: number of those tested whose loop is not stable.
    `within`: whether the answer is within all limits on the validation members. `complete`: whether neither Ctrl-C nor
    the end of the time has ended the searches early.
    `front`: points of the front of error against voltage (`front.FrontPoint`); empty if it was not traced.
    """

    problem: TuningProblem
    members: Members
    x: np.ndarray
    error: StepError | None
    history: dict[str, np.ndarray]
    lost: int
    seconds: float
    validation_error: float = math.inf
    unstable: int = 0
    within: bool = True
    complete: bool = True
    front: tuple[Any, ...] = ()

    @property
    def confirmed(self) -> bool:
        """Whether the step error is known and accurate steps confirm the result."""
        return self.error is not None and not self.error.refuted

    @property
    def good(self) -> bool:
        """Whether the result is confirmed, and `lost` is at most the number that tune.limits.survival allows."""
        tune = self.problem.tune
        return self.confirmed and self.lost <= tune.limits.may_lose(tune.budget.validation)


@dataclasses.dataclass
class Course:
    """Mutable state of a sequence of searches.

    `problem`, `members`: the problem and the training ensemble of the next search. `seed`: seed of the random numbers.
    `out`: directory of the checkpoints; None: no checkpoints. `facts`: settings that a checkpoint must match. `resume`:
    whether to continue from the checkpoints. `listen`: receives the events of the searches. `minutes`: time of all
    searches and validations; a search that begins or continues after it ends at its next iteration. `past`: the
    searches so far. `began`: start of the first search, s.
    """

    problem: TuningProblem
    members: Members
    seed: int
    out: pathlib.Path | None = None
    facts: dict[str, Any] = dataclasses.field(default_factory=dict)
    resume: bool = False
    listen: Listener = lambda event: None
    minutes: float = math.inf
    past: list[SearchState] = dataclasses.field(default_factory=list)
    began: float = dataclasses.field(default_factory=time.perf_counter)

    def search(self, points: np.ndarray, earlier: Starts | None = None, evolve: bool = True) -> np.ndarray:
        """Search from `points` [K, m] and append the search to `past`. Return the best point [m].

        `earlier`, `evolve`: as in `refine.search`.

        If Ctrl-C ends a later search before its first iteration, the search before it is marked as interrupted, and its
        result is returned. Raises KeyboardInterrupt if Ctrl-C ends the first search before its first iteration, and
        ValueError if the goal is finite at none of the points.
        """
        tune, number = self.problem.tune, len(self.past) + 1
        path = self.out / checkpoint(number) if self.out else None
        keep = tune.budget.starts
        which = f"race of {keep} of {len(points)} points, the winner" if len(points) > keep else "from the best point"
        self.tell(f"search {number}: {which} on {len(self.members.member)} members")
        progress = search(
            self.problem.engine, self.problem.goal, self.members, points, keep=keep, earlier=earlier,
            evolve=evolve, iterations=tune.budget.iterations, seed=self.seed + len(self.past),
            checkpoint_file=CheckpointFile(path, self.facts, number, self.tell), resume=self.resume,
            on_iteration=self._standing(number, []), until=self.began + 60 * self.minutes,
        )  # fmt: skip
        if progress.ended:
            self.tell(f"search {number} is complete; its result is read from {path}")
        if progress.interrupted and not progress.history:  # interrupted before the first iteration
            if not self.past:
                raise KeyboardInterrupt
            progress = dataclasses.replace(self.past.pop(), interrupted=True)
        self.past.append(progress)
        x, value = best_of(progress)
        if not np.isfinite(value):
            raise ValueError(
                "tune: at every starting point, the loss or its derivative is not finite. Check the case with 'ambjax "
                "simulate' (for chattering of u), or change tune.screen and tune.bounds."
            )
        return x

    def again(self, x: np.ndarray, evolve: bool = True) -> tuple[np.ndarray, bool]:
        """Search from x [m] on all members. Return the best point [m], and whether it is another one.

        It begins at x, drawn back from the bounds (`Space.drawn_back`), with the inverse Hessian of the last search.
        `evolve`: as in `refine.search`.
        """
        start = self.problem.objective.space.drawn_back(x)
        found = self.search(start[None], self.past[-1].starts, evolve)
        moved = not np.array_equal(found, start)
        return found if moved else x, moved

    def tell(self, text: str) -> None:
        """Send an event to the listener."""
        self.listen(Event(text))

    def _standing(self, number: int, spent: list[float]) -> Callable[[SearchState, float], None]:
        """Return the function that sends the standing of search `number` after an iteration. `spent`: durations, s."""

        def send(progress: SearchState, seconds: float) -> None:
            spent.append(seconds)
            standing = standing_of(self.problem, progress, number, spent)
            self.listen(Event(standing.text, standing))

        return send

    @property
    def interrupted(self) -> bool:
        """Whether the last search was interrupted by Ctrl-C."""
        return self.past[-1].interrupted

    @property
    def over(self) -> bool:
        """Whether no further search should begin: after Ctrl-C, or if the time is over."""
        return self.interrupted or time.perf_counter() > self.began + 60 * self.minutes

    @property
    def all_lost(self) -> bool:
        """Whether every member is lost at the best point of the last search."""
        past = self.past[-1].history
        return int(past["lost"][-1]) == past["members"][-1]

    @property
    def seconds(self) -> float:
        """Duration of all searches and validations, s, including the searches before a checkpoint was resumed."""
        return time.perf_counter() - self.began + sum(progress.earlier for progress in self.past)

    @property
    def history(self) -> dict[str, np.ndarray]:
        """Arrays of all searches with a row for each iteration."""
        return {
            name: np.array([row for one in self.past for row in one.history.get(name, ())])
            for name in self.past[0].history
        }

    def answer(
        self, x: np.ndarray, error: StepError | None, lost: int, validation_error: float = math.inf
    ) -> SearchResult:
        """Return the result at x [m]. The others are as in SearchResult."""
        return SearchResult(
            self.problem, self.members, x, error, self.history, lost, self.seconds, validation_error,
            complete=not self.over,
        )  # fmt: skip


def first_search(course: Course, start: np.ndarray) -> np.ndarray:
    """Search from the gains `start` [m], SI units, and the points of the screen. Return the coordinates [m].

    A search can end in a valley from which a large change of some gains leads to a lower one. While a point of `around`
    has a goal that is lower by NEGLIGIBLE or more, a further search begins there. Raises ValueError as `check_loops`
    does.
    """
    problem, budget = course.problem, course.problem.tune.budget
    points = initial_points(problem.objective.space, problem.ranges, start, budget.screen, course.seed)
    check_loops(problem.objective, points, course.members.searched)
    x = course.search(points)
    while budget.screen and not course.over:
        course.tell("comparing this optimum with points at which some gains are changed")
        points = around(x, AROUND * budget.screen, course.seed + len(course.past))
        near, _ = screen(problem.engine, course.members, points, problem.goal)
        goals = problem.goal.score(problem.engine.terms(near[:FEW], course.members), course.members)
        _, least = best_of(course.past[-1])
        if not goals.min() < least - NEGLIGIBLE:
            break
        course.tell("with some gains changed, the loss is lower than at this optimum")
        other = course.search(near[[goals.argmin()]])
        # in a chaotic loop, the search may compute another loss at its start than the comparison
        if not best_of(course.past[-1])[1] < least:
            break
        x = other
    return x


def training(problem: TuningProblem) -> Members:
    """Return the training ensemble: ordinary members, then stressed ones."""
    tune = problem.tune
    return problem.objective.training(
        tune.budget.seed, tune.budget.members, tune.budget.stressed, tune.stress, tune.gain_margin
    )


def standing_of(problem: TuningProblem, progress: SearchState, number: int, spent: Sequence[float]) -> Standing:
    """Return the standing of a search. `spent`: durations of its iterations so far, s."""
    last = {name: rows[-1] for name, rows in progress.history.items()}
    loss, most = problem.objective.loss, progress.raced + problem.tune.budget.iterations
    terms = dict(zip(TERMS, last["terms"], strict=True))
    quantities = dict(zip(problem.goal.quantities, last["quantities"], strict=True))
    volts = quantities.get("rms_u_V", float(np.asarray(loss.u_scale)) * math.sqrt(terms["effort"]))
    values = [(one, one.ratio * float(quantities[one.name])) for one in problem.limits]
    members = int(last["members"])
    limits = tuple(
        Reached(one.name, value, one.threshold, one.holds(value), one.other_bound(value, members))
        for one, value in values
    )
    starts = 0 if progress.converged else len(progress.starts.value)
    # the first iteration compiles
    left = (most - progress.iteration) * float(np.median(spent[1:])) if len(spent) > 1 and starts else math.nan
    return Standing(
        number, progress.iteration, most, starts, float(np.asarray(loss.s_0)) * math.sqrt(terms["tracking"]), volts,
        members - int(last["lost"]), members, limits, left, float(last["value"]), int(last["rollouts"]),
    )  # fmt: skip
