"""The gradient search against derivative-free methods, on the same loss, members, coordinates and number of rollouts.

One rollout simulates one member once; a gradient with respect to m gains counts m + 1 rollouts. All methods use the
same coordinates, clipped at the bounds of the gains, and the ranges of the screen. CMA-ES, Nelder-Mead and Powell's
method start in the middle of the ranges and are not limited to them. TPE may leave each range by half its width; random
search stays inside. The gradient search starts with a screen of the ranges and of the case's gains, which lose the
rotor in all these tasks. A seed changes the random numbers of a method, not the members.

The budget is the median number of rollouts of the gradient search; longer gradient searches are cut there. `--times`
multiplies the budget of the other methods. The reported loss is the lowest that a method found. It is computed from
all training members, stressed members included, with the integration steps of the search. The number of rollouts does
not measure the cost: padded lanes are computed too, and a derivative costs less than a rollout. The results therefore
include processor seconds of the search on one core, with two searches at a time. Existing results of other tasks and
methods are kept.
Run: python benchmarks/search.py [--tasks A B C D E] [--seeds 5] [--times 1] [--methods CMA-ES ...] [--processes 2]
"""

import argparse
import concurrent.futures
import json
import os
import pathlib
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import numpy as np

from ambjax.ensemble.worker import processes
from tuning.events import Event
from tuning.problem.config import read_tune
from tuning.problem.tuning_problem import TuningProblem, problem_of
from tuning.solve.course import Course, first_search, training

TASKS = pathlib.Path(__file__).parent / "tasks"
# Points per call for methods without a population.
BATCH = 8
# Goal of a non-finite loss. The goal is a logarithm, about 0 where all members are lost.
WORST = 10.0


class SpentError(Exception):
    """Raised when the budget of rollouts is spent."""


class CountedGoal:
    """The goal at coordinates [S, m] in units of the screen's ranges. It counts rollouts and processor seconds."""

    def __init__(self, problem: TuningProblem, members: Any, most: int):
        self.problem, self.members, self.most = problem, members, most
        space, box = problem.objective.space, problem.ranges
        ends = ([r.low for r in box], [r.high for r in box])
        self.low, self.high = (space.encode(space.clip(np.array(gains))) for gains in ends)
        self.trace: list[tuple[int, float, float]] = []
        self.spent, self.best, self.started = 0, np.inf, time.process_time()

    def __call__(self, units: np.ndarray) -> np.ndarray:
        if self.spent >= self.most:
            raise SpentError
        x = self.low + units * (self.high - self.low)
        values = self.problem.goal.score(self.problem.engine.terms(x, self.members), self.members)
        values = np.where(np.isfinite(values), values, WORST)
        self.spent += len(x) * len(self.members.member)
        row = (self.spent, time.process_time() - self.started, min(self.best, float(values.min())))
        if len(self.trace) > 1 and self.trace[-1][2] == self.trace[-2][2] == row[2]:
            self.trace.pop()  # a plateau keeps its two ends
        self.trace.append(row)
        self.best = row[2]
        return values


def cma_es(goal_at: CountedGoal, seed: int) -> None:
    import cma

    rng, options = np.random.default_rng(seed), {"seed": seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.full(len(goal_at.low), 0.5), 0.25, options)
    while True:  # until the budget ends; CMA-ES restarts when its own criteria stop it
        if strategy.stop():
            options["seed"] += 1000
            strategy = cma.CMAEvolutionStrategy(rng.uniform(size=len(goal_at.low)), 0.25, options)
        points = strategy.ask()
        strategy.tell(points, goal_at(np.array(points)).tolist())


def local(name: str) -> Callable[[CountedGoal, int], None]:
    """SciPy's Nelder-Mead or Powell, restarted from random points when they converge."""
    from scipy.optimize import minimize

    def run(goal_at: CountedGoal, seed: int) -> None:
        rng, x = np.random.default_rng(seed), np.full(len(goal_at.low), 0.5)
        while True:
            minimize(lambda x: goal_at(x[None])[0], x, method=name, options={"maxfev": 10**6, "xatol": 1e-3})
            x = rng.uniform(size=len(x))

    return run


def tpe(goal_at: CountedGoal, seed: int) -> None:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    while True:
        trials = [study.ask() for _ in range(BATCH)]
        x = [[trial.suggest_float(f"x{j}", -0.5, 1.5) for j in range(len(goal_at.low))] for trial in trials]
        for trial, value in zip(trials, goal_at(np.array(x)), strict=True):
            study.tell(trial, value)


def random_search(goal_at: CountedGoal, seed: int) -> None:
    rng = np.random.default_rng(seed)
    while True:
        goal_at(rng.uniform(size=(BATCH, len(goal_at.low))))


METHODS: dict[str, Callable[[CountedGoal, int], None]] = {
    "CMA-ES": cma_es,
    "Nelder-Mead": local("Nelder-Mead"),
    "Powell": local("Powell"),
    "TPE": tpe,
    "random": random_search,
}


def gradient_search(problem: TuningProblem, members: Any, seed: int) -> list[tuple[int, float, float]]:
    """Return the trace of the gradient search on all members, including repeated searches around the answer."""
    problem.engine.rollouts, trace, started = 0, [], time.process_time()

    def note(event: Event) -> None:
        found = event.standing
        if found is not None and found.members == len(members.member):  # else the goal is over a subset
            best = min(found.goal, trace[-1][2] if trace else np.inf)
            trace.append((found.rollouts, time.process_time() - started, best))

    first_search(Course(problem, members, seed, listen=note), problem.tune.space.values(problem.case.cascade))
    return trace


class SearchResult(NamedTuple):
    """Result of a search: logarithm of the loss, rollouts, seconds, and rollouts until a goal (None: never)."""

    final: float
    rollouts: int
    seconds: float
    reached: int | None


def result_of(trace: list[tuple[int, float, float]], goal: float) -> SearchResult:
    reached = next((n for n, _, best in trace if best <= goal), None)
    return SearchResult(trace[-1][2], trace[-1][0], trace[-1][1], reached)


def prepared(name: str) -> tuple[TuningProblem, Any]:
    """Return the problem and the training members of a task, on one core."""
    case, tune, _ = read_tune(TASKS / f"{name}.toml")
    problem = problem_of(case, tune, threads=1)
    return problem, training(problem)


def by_gradients(name: str, seeds: int) -> dict[str, Any]:
    """Run the gradient search on one task; return the budget, the goal, and a row for each seed."""
    problem, members = prepared(name)
    gradient_search(problem, members, 0)  # compiles
    traces = [gradient_search(problem, members, seed) for seed in range(seeds)]
    goal = statistics.median(trace[-1][2] for trace in traces)
    budget = round(statistics.median(trace[-1][0] for trace in traces))
    within = [[step for step in trace if step[0] <= budget] for trace in traces]
    rows = {"gradients": within, "gradients, until the search ends": traces}
    return {"budget": budget, "goal": goal} | {
        name: [result_of(trace, goal)._asdict() for trace in each] for name, each in rows.items()
    }


def by_others(name: str, found: dict[str, Any], seeds: int, times: float, methods: list[str]) -> dict[str, Any]:
    """Return the rows of the other methods on one task, with `times` the budget of the gradient search."""
    warnings.simplefilter("ignore")
    problem, members = prepared(name)
    space = problem.objective.space
    problem.engine.terms(
        space.encode(space.clip(problem.tune.space.values(problem.case.cascade)))[None], members
    )  # compiles
    rows: dict[str, Any] = {}
    for method in methods:
        key = method if times == 1 else f"{method}, {times:g} times"
        rows[key] = []
        for seed in range(seeds):
            goal_at = CountedGoal(problem, members, round(times * found["budget"]))
            try:
                METHODS[method](goal_at, seed)
            except SpentError:
                rows[key].append(result_of(goal_at.trace, found["goal"])._asdict())
    return rows


def show(name: str, method: str, rows: list[dict[str, Any]]) -> None:
    losses = [np.exp(row["final"]) for row in rows]
    seconds, spent = (statistics.median(row[key] for row in rows) for key in ("seconds", "rollouts"))
    print(
        f"{name} {method:<18} loss {statistics.median(losses):.4e} (best {min(losses):.4e}, worst {max(losses):.4e}) "
        f"after {spent:,.0f} rollouts, {seconds:.0f} s",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=list("ABCDE"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--times", type=float, default=1.0)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    path = _measure.RESULTS / "search.json"
    tasks = json.loads(path.read_text())["tasks"] if path.exists() else {}
    with processes(given.processes) as pool:
        if given.times == 1:  # else the budget and the goal are those in the file
            for name, found in zip(given.tasks, pool.map(by_gradients, given.tasks, [given.seeds] * 5), strict=True):
                tasks[name] = tasks.get(name, {}) | found
                for method in ("gradients", "gradients, until the search ends"):
                    show(name, method, found[method])
                _measure.write("search", {"tasks": dict(sorted(tasks.items()))})
        jobs = {
            pool.submit(by_others, name, tasks[name], given.seeds, given.times, [method]): name
            for method in given.methods
            for name in given.tasks
        }
        for job in concurrent.futures.as_completed(jobs):  # takes about an hour: write each result at once
            tasks[jobs[job]] |= job.result()
            for method, rows in job.result().items():
                show(jobs[job], method, rows)
            _measure.write("search", {"tasks": dict(sorted(tasks.items()))})


if __name__ == "__main__":
    main()
