"""Twenty-four scheduled gains: the tuner's search against CMA-ES, and the cost of their gradient.

The task is G20 (two coils, plant varied by 10 %, 20 kHz, one sample of delay), cut to SECONDS s and to few members, so
that a search takes less than a minute. Each of its eight gains is a schedule with three knots. The signal of the
schedules is the error in the observer and the position law, and the reference in the other laws. Both searches have the
loss, the members, the coordinates and the ranges of `search.py`. CMA-ES starts in the middle of the ranges. The tuner's
search starts with a screen, in which every schedule is constant. Both start with gains that lose the rotor.

Each search runs until it has used `--seconds` of processor time on one core, without compilation. The traces give the
least loss of each method at equal processor seconds, and at equal rollouts. A gradient counts as its measured processor
time relative to a rollout (`cost`), not as m + 1 rollouts for m gains, as in `search.py`.
Run: python benchmarks/schedules.py [--seeds 5] [--seconds 30] [--processes 2]
"""

import argparse
import concurrent.futures
import copy
import json
import os
import time
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import numpy as np
import search

from ambjax.cases.reader import case_from
from ambjax.cases.table import Table, load
from ambjax.ensemble.worker import processes
from tuning.events import Event
from tuning.problem.config import tune_from
from tuning.problem.lanes import LANES, Engine
from tuning.problem.tuning_problem import TuningProblem, problem_of
from tuning.solve.course import Course, first_search, training

SECONDS, MEMBERS, STRESSED = 0.25, 12, 4
ERRORS, REFERENCES = [0.0, 2e-6, 1e-5], [0.0, 1.25e-3, 2.5e-3]
OVER = {"observer": ("error", ERRORS), "position": ("error", ERRORS)}
REST = "reference", REFERENCES


def problem(mode: str | None = None) -> tuple[TuningProblem, Any]:
    """Return the problem and its members, on one core. `mode`: of differentiation; None: that of the tuner."""
    raw = copy.deepcopy(load(search.TASKS / "sampled" / "G20.toml")[0])
    raw["controller"]["observer"].setdefault("w", 800.0)
    for path in raw["tune"]["gains"]:
        _, stage, name = path.split(".")
        over, at = OVER.get(stage, REST)
        law = raw["controller"][stage]
        law[name] = {"over": over, "at": at, "values": [law[name]] * 3}
    raw["clock"]["duration"], raw["run"]["settle"] = SECONDS, SECONDS / 5
    raw["disturbance"]["q_z"] |= {"start": SECONDS / 2, "stop": 0.7 * SECONDS}
    raw["tune"] |= {"members": MEMBERS, "stressed": STRESSED}
    case = case_from(raw, "G20 scheduled")
    found = problem_of(case, tune_from(Table(raw).table("tune"), case), threads=1)
    found.engine.mode = mode or found.engine.mode
    return found, training(found)


class SpentError(Exception):
    """Raised when the processor time is spent."""


class Counter:
    """Counts the plain rollouts and the gradients of an engine, and its processor seconds."""

    def __init__(self, engine: Engine, seconds: float) -> None:
        self.engine, self.seconds = engine, seconds
        self.values = self.gradients = 0
        self.trace: list[tuple[int, int, float, float]] = []
        self.started = time.process_time()
        terms, gradient = type(engine).terms, type(engine).gradient

        def counted_terms(x: np.ndarray, members: Any) -> Any:
            self.values += len(x) * len(members.member)
            return terms(engine, x, members)

        def counted_gradient(x: np.ndarray, members: Any, weights: Any) -> Any:
            self.gradients += len(x) * len(members.member)
            return gradient(engine, x, members, weights)

        engine.terms, engine.gradient = counted_terms, counted_gradient  # pyright: ignore

    def note(self, best: float) -> None:
        """Append a row to the trace. Raises SpentError after the last one."""
        used = time.process_time() - self.started
        last = self.trace[-1][3] if self.trace else np.inf
        self.trace.append((self.values, self.gradients, used, min(best, last)))
        if used > self.seconds:
            raise SpentError


def by_gradients(made: tuple[TuningProblem, Any], seed: int, seconds: float) -> list[tuple[int, int, float, float]]:
    """Return the trace of the tuner's search: plain rollouts, gradients, processor seconds, logarithm of the loss."""
    found, members = made
    counter = Counter(found.engine, seconds)

    def note(event: Event) -> None:
        if event.standing is not None:
            whole = event.standing.members == len(members.member)  # else the goal is over a part
            counter.note(event.standing.goal if whole else np.inf)

    try:
        while True:
            start = found.tune.space.values(found.case.cascade)
            first_search(Course(found, members, seed, listen=note), start)
            seed += 1000
    except SpentError:
        return counter.trace


def by_cma_es(made: tuple[TuningProblem, Any], seed: int, seconds: float) -> list[tuple[int, int, float, float]]:
    """Return the trace of CMA-ES with its restarts."""
    found, members = made
    counter = Counter(found.engine, seconds)
    goal = search.CountedGoal(found, members, 10**12)

    def noted(units: np.ndarray) -> np.ndarray:
        values = goal(units)
        counter.note(float(values.min()))
        return values

    noted.low = goal.low  # pyright: ignore
    try:
        search.cma_es(noted, seed)  # pyright: ignore
    except SpentError:
        return counter.trace
    raise AssertionError


METHODS = {"gradients": by_gradients, "CMA-ES": by_cma_es}


def traces(method: str, seeds: list[int], seconds: float) -> list[list[tuple[int, int, float, float]]]:
    """Return the trace of each seed, after a short search that compiles."""
    made = problem()
    METHODS[method](made, 10_000, seconds / 3)
    found = []
    for seed in seeds:
        found.append(METHODS[method](made, seed, seconds))
        values, gradients, used, best = found[-1][-1]
        print(f"{method} {seed}: {values} values, {gradients} gradients, {used:.0f} s: {np.exp(best):.4e}", flush=True)
    return found


def cost(repeats: int = 5) -> dict[str, float]:
    """Return the processor time of one gradient of all gains, by mode, relative to one plain rollout."""
    runs = {}
    for mode in ("value", "forward", "reverse"):
        found, members = problem(None if mode == "value" else mode)
        x = found.objective.space.encode(found.objective.space.clip(held(found)))[None]
        x, engine = np.repeat(x, LANES // 2 // len(members.member), 0), found.engine
        engine.lanes = LANES // 2
        weights = found.goal.weights
        call = (lambda e=engine, x=x, m=members: e.terms(x, m)) if mode == "value" else None
        runs[mode] = call or (lambda e=engine, x=x, m=members, w=weights: e.gradient(x, m, w))
    times = _measure.alternating(runs, repeats=repeats, clock=_measure.own_seconds)
    return {mode: times[mode].over(times["value"]) for mode in ("forward", "reverse")}


def held(found: TuningProblem) -> np.ndarray:
    """Return gains that hold the rotor: those of `sampled_tasks.py`, in every knot."""
    tuned = json.loads((_measure.RESULTS / "sampled_tasks.json").read_text())["tasks"]["G20"]["gains"]
    return np.array([tuned[path.rpartition(".")[0]] for path in found.objective.space.paths])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    seeds = list(range(given.seeds))
    results: dict[str, Any] = {"seconds": given.seconds, "members": MEMBERS + STRESSED, "gains": 24, "cost": {}}
    results["simulated_s"], results["methods"] = SECONDS, {}
    with processes(given.processes) as pool:
        jobs = {pool.submit(traces, method, seeds, given.seconds): method for method in METHODS}
        for job in concurrent.futures.as_completed(jobs):
            results["methods"][jobs[job]] = job.result()
    results["cost"] = cost()
    print(results["cost"])
    _measure.write("schedules", results)


if __name__ == "__main__":
    main()
