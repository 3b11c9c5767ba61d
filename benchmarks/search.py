"""The gradient search against derivative-free methods, on the same loss, members, coordinates and number of rollouts.

One rollout is one member simulated once; a gradient of m gains counts m + 1. Every method moves in the same
coordinates, in which a gain ends at its bound, and knows the ranges of the screen: CMA-ES, Nelder-Mead and Powell's
method are unbounded in them and begin in their middle, TPE draws from them and half of them beyond either end, random
search from them alone. The search by gradients begins with a screen of them, and of the case's gains, which lose the
rotor in all these tasks. Each seed changes what is random in the method, not the members. The budget is what the
search by gradients took in the median, and those of its seeds that took more are cut there too; `--times` runs the
rivals with as many times that. Best so far is the loss over the training members, stressed ones included, at the
search's own steps. Rollouts are not cost: lanes of a call that are not needed are computed all the same, and a
derivative costs less than a run; so seconds are told too: processor time of the search, which runs on one core, two
searches at once. Results of tasks and methods that are not asked for stay.
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
from tuning.config import read_tune
from tuning.objective.ranges import ranges
from tuning.problem import TuningProblem, problem_of
from tuning.search.course import Course, search_and_restart, training
from tuning.search.keeper import SearchState

TASKS = pathlib.Path(__file__).parent / "tasks"
# Evaluations whose results are asked for at once, by methods that have no population of their own.
BATCH = 8
# Worse than anything that is simulated: a loss of all members is about 1, its log 0.
WORST = 10.0


class SpentError(Exception):
    """Raised when the budget of rollouts is spent."""


class Judge:
    """The goal at coordinates [S, m] in units of the screen's box, any real number; counted and clocked."""

    def __init__(self, problem: TuningProblem, who: Any, most: int):
        self.problem, self.who, self.most = problem, who, most
        start = problem.tune.space.values(problem.case.cascade)
        space, box = problem.objective.space, ranges(problem.objective, problem.goal.conditions, start)
        ends = ([r.low for r in box], [r.high for r in box])
        self.low, self.high = (space.encode(space.clip(np.array(gains))) for gains in ends)
        self.trace: list[tuple[int, float, float]] = []
        self.spent, self.best, self.began = 0, np.inf, time.process_time()

    def __call__(self, units: np.ndarray) -> np.ndarray:
        if self.spent >= self.most:
            raise SpentError
        x = self.low + units * (self.high - self.low)
        values = self.problem.goal.score(x, self.problem.engine.terms(x, self.who), self.who)
        values = np.where(np.isfinite(values), values, WORST)
        self.spent += len(x) * len(self.who.member)
        row = (self.spent, time.process_time() - self.began, min(self.best, float(values.min())))
        if len(self.trace) > 1 and self.trace[-1][2] == self.trace[-2][2] == row[2]:
            self.trace.pop()  # of a plateau, its ends
        self.trace.append(row)
        self.best = row[2]
        return values


def cma_es(judge: Judge, seed: int) -> None:
    import cma

    dice, quiet = np.random.default_rng(seed), {"seed": seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.full(len(judge.low), 0.5), 0.25, quiet)
    while True:  # until the budget ends; CMA's own criteria may end it before, and then it begins again
        if strategy.stop():
            quiet["seed"] += 1000
            strategy = cma.CMAEvolutionStrategy(dice.uniform(size=len(judge.low)), 0.25, quiet)
        asked = strategy.ask()
        strategy.tell(asked, judge(np.array(asked)).tolist())


def local(name: str) -> Callable[[Judge, int], None]:
    """SciPy's Nelder-Mead or Powell, restarted from random points when they converge."""
    from scipy.optimize import minimize

    def run(judge: Judge, seed: int) -> None:
        dice, x = np.random.default_rng(seed), np.full(len(judge.low), 0.5)
        while True:
            minimize(lambda x: judge(x[None])[0], x, method=name, options={"maxfev": 10**6, "xatol": 1e-3})
            x = dice.uniform(size=len(x))

    return run


def tpe(judge: Judge, seed: int) -> None:
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
    study = optuna.create_study(sampler=sampler)
    while True:
        trials = [study.ask() for _ in range(BATCH)]
        x = [[trial.suggest_float(f"x{j}", -0.5, 1.5) for j in range(len(judge.low))] for trial in trials]
        for trial, value in zip(trials, judge(np.array(x)), strict=True):
            study.tell(trial, value)


def random_search(judge: Judge, seed: int) -> None:
    dice = np.random.default_rng(seed)
    while True:
        judge(dice.uniform(size=(BATCH, len(judge.low))))


METHODS: dict[str, Callable[[Judge, int], None]] = {
    "CMA-ES": cma_es,
    "Nelder-Mead": local("Nelder-Mead"),
    "Powell": local("Powell"),
    "TPE": tpe,
    "random": random_search,
}


def ours(problem: TuningProblem, who: Any, seed: int) -> list[tuple[int, float, float]]:
    """Return the trace of the gradient search on all members, repeated searches around its answer included."""
    problem.engine.rollouts, trace, began = 0, [], time.process_time()

    def note(progress: SearchState, _: float) -> None:
        if progress.history["members"][-1] == len(who.member):  # else its goal is that of a part of them
            best = min(float(np.min(progress.history["value"][-1])), trace[-1][2] if trace else np.inf)
            trace.append((problem.engine.rollouts, time.process_time() - began, best))

    search_and_restart(Course(problem, who, seed, on_iteration=note), problem.tune.space.values(problem.case.cascade))
    return trace


class Told(NamedTuple):
    """Result of a search: logarithm of the loss, rollouts, seconds, and rollouts until a goal (None: never)."""

    final: float
    rollouts: int
    seconds: float
    reached: int | None


def told(trace: list[tuple[int, float, float]], goal: float) -> Told:
    reached = next((n for n, _, best in trace if best <= goal), None)
    return Told(trace[-1][2], trace[-1][0], trace[-1][1], reached)


def prepared(name: str) -> tuple[TuningProblem, Any]:
    """Return the problem and the training members of a task, on one core."""
    case, tune, _ = read_tune(TASKS / f"{name}.toml")
    problem = problem_of(case, tune, threads=1)
    return problem, training(problem)


def by_gradients(name: str, seeds: int) -> dict[str, Any]:
    """Run the gradient search on one task; return the budget, the goal, and a row for each seed."""
    problem, who = prepared(name)
    ours(problem, who, 0)  # compiles
    traces = [ours(problem, who, seed) for seed in range(seeds)]
    goal = statistics.median(trace[-1][2] for trace in traces)
    budget = round(statistics.median(trace[-1][0] for trace in traces))
    within = [[step for step in trace if step[0] <= budget] for trace in traces]
    rows = {"gradients": within, "gradients, to their own end": traces}
    return {"budget": budget, "goal": goal} | {
        name: [told(trace, goal)._asdict() for trace in each] for name, each in rows.items()
    }


def by_others(name: str, found: dict[str, Any], seeds: int, times: float, methods: list[str]) -> dict[str, Any]:
    """Return the rows of the other methods on one task, with `times` the budget of the gradients."""
    warnings.simplefilter("ignore")
    problem, who = prepared(name)
    space = problem.objective.space
    problem.engine.terms(
        space.encode(space.clip(problem.tune.space.values(problem.case.cascade)))[None], who
    )  # compiles
    rows: dict[str, Any] = {}
    for method in methods:
        key = method if times == 1 else f"{method}, {times:g} times"
        rows[key] = []
        for seed in range(seeds):
            judge = Judge(problem, who, round(times * found["budget"]))
            try:
                METHODS[method](judge, seed)
            except SpentError:
                rows[key].append(told(judge.trace, found["goal"])._asdict())
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
        if given.times == 1:  # else the budget and the goal are those that are there
            for name, found in zip(given.tasks, pool.map(by_gradients, given.tasks, [given.seeds] * 5), strict=True):
                tasks[name] = tasks.get(name, {}) | found
                for method in ("gradients", "gradients, to their own end"):
                    show(name, method, found[method])
                _measure.write("search", {"tasks": dict(sorted(tasks.items()))})
        jobs = {
            pool.submit(by_others, name, tasks[name], given.seeds, given.times, [method]): name
            for method in given.methods
            for name in given.tasks
        }
        for job in concurrent.futures.as_completed(jobs):  # an hour in all: what is measured is written at once
            tasks[jobs[job]] |= job.result()
            for method, rows in job.result().items():
                show(jobs[job], method, rows)
            _measure.write("search", {"tasks": dict(sorted(tasks.items()))})


if __name__ == "__main__":
    main()
