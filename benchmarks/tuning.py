"""The search by gradients against derivative-free ones, on the same loss, members, ranges and number of rollouts.

One rollout is one member simulated once; a gradient of m gains counts m + 1. Each method starts from the same
knowledge: the case's gains and the ranges of the screen; each seed changes what is random in the method, not the
members. The budget is what the search by gradients took in the median (the derivative-free methods get `--times`
as much); best so far is the loss over the training members, stressed ones included, at the search's own steps.
Results of tasks and methods that are not asked for stay in the JSON.
Run: python benchmarks/tuning.py [--tasks A B C D E] [--seeds 5] [--times 1] [--methods CMA-ES ...]
"""

import argparse
import json
import os
import pathlib
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import numpy as np

from tuning.config import read_study
from tuning.optimise import best_of, search
from tuning.rounds import look_again, training
from tuning.screen import around, everywhere, ranges
from tuning.study import Study, study_of

TASKS = pathlib.Path(__file__).parent / "tasks"
# Evaluations whose results are asked for at once, by methods that have no population of their own.
BATCH = 8
# Worse than anything that is simulated: a loss of all members is about 1, its log 0.
WORST = 10.0


class SpentError(Exception):
    """All rollouts are spent."""


class Judge:
    """The goal at unit coordinates in the screen's box [S, m], counted and clocked."""

    def __init__(self, study: Study, who: Any, most: int):
        self.study, self.who, self.most = study, who, most
        start = study.tune.space.values(study.case.cascade)
        box = ranges(study.objective, study.goal.conditions, start)
        self.low, self.high = np.log([r.low for r in box]), np.log([r.high for r in box])
        self.trace: list[tuple[int, float, float]] = []
        self.spent, self.best, self.began = 0, np.inf, time.perf_counter()

    def __call__(self, units: np.ndarray) -> np.ndarray:
        """Beyond the box, half its size either way is allowed: the search by gradients may leave it too."""
        if self.spent >= self.most:
            raise SpentError
        space = self.study.objective.space
        gains = np.exp(self.low + np.clip(units, -0.5, 1.5) * (self.high - self.low))
        x = np.stack([space.encode(space.clip(g)) for g in gains])
        values = self.study.goal.score(space, x, self.study.engine.terms(x, self.who), self.who)
        values = np.where(np.isfinite(values), values, WORST)
        self.spent += len(x) * len(self.who.member)
        row = (self.spent, time.perf_counter() - self.began, min(self.best, float(values.min())))
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


def ours(study: Study, who: Any, seed: int) -> list[tuple[int, float, float]]:
    """Trace of the search by gradients, its looks around its own answer included, on all members."""
    study.engine.rollouts, trace, began = 0, [], time.perf_counter()

    def tell(kept: Any, _: float) -> None:
        if kept.history["members"][-1] == len(who.member):  # else its goal is that of a part of them
            best = min(float(np.min(kept.history["value"][-1])), trace[-1][2] if trace else np.inf)
            trace.append((study.engine.rollouts, time.perf_counter() - began, best))

    budget, start = study.tune.budget, study.tune.space.values(study.case.cascade)
    points = everywhere(study.objective, study.goal.conditions, start, budget.screen, seed)
    looks: list[tuple[float, np.ndarray]] = []
    while True:
        kept = search(
            study.engine, study.goal, who, points, keep=budget.starts, iterations=budget.iterations,
            name=study.tune.optimiser, tell=tell,
        )  # fmt: skip
        x, value = best_of(kept)
        looks.append((value, x))
        if not look_again([value for value, _ in looks]):
            return trace
        points = around(min(looks, key=lambda look: look[0])[1], budget.screen, seed + len(looks))


def first_at(trace: list[Any], value: float) -> float:
    """Rollouts at which the trace reaches a value; inf if never."""
    return next((float(n) for n, _, best in trace if best <= value), np.inf)


def task(name: str, seeds: int, times: float, methods: list[str]) -> dict[str, Any]:
    """All traces of one task."""
    case, tune, _ = read_study(TASKS / f"{name}.toml")
    study = study_of(case, tune)
    who = training(study)
    ours(study, who, 0)  # compiles
    found: dict[str, Any] = {"gradients": [ours(study, who, seed) for seed in range(seeds)]}
    budget = round(statistics.median(trace[-1][0] for trace in found["gradients"]))
    for method in methods:
        found[method] = []
        for seed in range(seeds):
            judge = Judge(study, who, round(times * budget))
            try:
                METHODS[method](judge, seed)
            except SpentError:
                found[method].append(judge.trace)
    final = {name: [trace[-1][2] for trace in traces] for name, traces in found.items()}
    goal = statistics.median(final["gradients"])
    for method, values in final.items():
        reached = statistics.median(first_at(trace, goal) for trace in found[method])
        seconds = statistics.median(trace[-1][1] for trace in found[method])
        spent = found[method][0][-1][0]
        middle, low, high = (np.exp(f(values)) for f in (statistics.median, min, max))
        print(
            f"{name} {method:<12} loss {middle:.3e} (best {low:.3e}, worst {high:.3e}) after {spent:,} "
            f"rollouts, {seconds:.0f} s; gradients' median after {reached:,.0f}",
            flush=True,
        )
    return {"budget": budget, "times": times, "traces": found, "final": final}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=list("ABCDE"))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--times", type=float, default=1.0)
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    name = "tuning" if given.times == 1 else f"tuning_x{given.times:g}"
    path = _measure.RESULTS / f"{name}.json"
    results = json.loads(path.read_text())["tasks"] if path.exists() else {}
    for each in given.tasks:  # hours in all: what is measured is written at once; other tasks and methods stay
        found, kept = task(each, given.seeds, given.times, given.methods), results.get(each, {})
        results[each] = found | {name: kept.get(name, {}) | found[name] for name in ("traces", "final")}
        _measure.write(name, {"tasks": dict(sorted(results.items()))})


if __name__ == "__main__":
    main()
