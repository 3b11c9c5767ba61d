"""Run CMA-ES from the tuner's answer, to check whether the search stopped before the optimum.

Each task is tuned as in tasks.py. CMA-ES then makes `--evaluations` evaluations of the tuner's objective, on the
training ensemble and the 16 validation members with the least clearance. Limits are penalties on the values of the
members, without a margin for smoothing. The best point and the last mean are evaluated on the tuner's 1,000 held-out
members; a point that loses more of them, or breaks a limit, is marked. Results of other tasks are kept.
Run: python benchmarks/from_answer.py [--out DIR] [--evaluations 300] [--size 0.2] [TASK ...]
"""

import argparse
import dataclasses
import os
import pathlib
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import _measure
import numpy as np
import tasks

from tuning.judge.evaluate import judge, summarise
from tuning.problem.config import read_tune, seeds
from tuning.problem.limits import PREFIX
from tuning.problem.members import Members
from tuning.problem.tuning_problem import TuningProblem, problem_of
from tuning.solve.course import training

TASKS = ("limited/light", "sampled/F10-signs", "D")
# Number of validation members that are added, the noise factor that the tuner gives them, weight of the penalties.
JOINED, NOISE_FACTOR, PENALTY = 16, 1.1, 300.0


def members(problem: TuningProblem, x: np.ndarray) -> Members:
    """Return the training ensemble plus the validation members with the least clearance at x [m]."""
    count, seed = problem.tune.budget.validation, seeds(problem.tune.budget)[1]
    terms = problem.engine.terms(x[None], problem.objective.chosen(seed, np.arange(count), count))
    order = np.argsort(-terms["clearance"][0] - terms["survival"][0], kind="stable")[:JOINED]
    tightest = problem.objective.chosen(seed, order, count)
    return training(problem).joined(tightest._replace(noise_factor=NOISE_FACTOR * tightest.noise_factor))


def goals(problem: TuningProblem, x: np.ndarray, ensemble: Members) -> np.ndarray:
    """Return the objective [S] at x [S, m], with limits as penalties on the values of ordinary members."""
    terms, free = problem.engine.terms(x, ensemble), dataclasses.replace(problem.goal, limits=())
    values = free.score({name: rows for name, rows in terms.items() if not name.startswith(PREFIX)}, ensemble)
    for limit in problem.limits:
        rows = terms[PREFIX + limit.name][:, : ensemble.ordinary]
        excess = [max(limit.log_excess(float(limit.kind.judged(one))), 0.0) for one in rows]
        values = values + PENALTY * np.square(excess) / 2
    return np.where(np.isfinite(values), values, 10.0)


def judged(problem: TuningProblem, x: np.ndarray) -> dict[str, Any]:
    """Return the errors of the held-out members at x [m], the number lost, and the limits not held."""
    columns = judge(problem, x, seeds(problem.tune.budget)[2], problem.tune.budget.held_out)
    summary = summarise(columns)
    broken = [limit.name for limit in problem.limits if limit.reached(columns) > limit.threshold]
    names = ("settled_rms_error_m", "settled_max_abs_error_m", "lost")
    return {name: summary[name] for name in names} | {"broken": broken}


def measured(task: str, out: pathlib.Path, evaluations: int, size: float) -> dict[str, Any]:
    """Return the tuner's answer for one task and the result of CMA-ES started from it."""
    import cma

    row = tasks.tuned(tasks.TASKS / f"{task}.toml", out)
    case, tune, _ = read_tune(out / "tuned.toml")
    problem = problem_of(case, tune)
    space = problem.objective.space
    x = space.encode(space.clip(space.values(case.cascade)))
    ensemble = members(problem, x)
    first = lowest = goals(problem, x[None], ensemble)[0]
    best, spent = x, 0
    strategy = cma.CMAEvolutionStrategy(x, size, {"seed": 7, "verbose": -9})
    while spent < evaluations:
        points = np.array(strategy.ask())
        values = goals(problem, points, ensemble)
        strategy.tell(list(points), values.tolist())
        spent += len(points)
        if values.min() < lowest:
            lowest, best = values.min(), points[int(values.argmin())]
    found = {"answer": judged(problem, x), "best": judged(problem, best), "mean": judged(problem, strategy.mean)}
    gains = {name: 1 - found[name]["settled_rms_error_m"] / found["answer"]["settled_rms_error_m"] for name in found}
    print(
        f"{task}: rms error {found['answer']['settled_rms_error_m']:.4e} m; {spent} evaluations of CMA-ES: "
        + ", ".join(
            f"{name} {100 * gains[name]:+.2f} % lower, {found[name]['lost']} lost, broken: {found[name]['broken']}"
            for name in ("best", "mean")
        ),
        flush=True,
    )
    kept = {key: row[key] for key in ("rollouts", "seconds", "processor_s")}
    return found | {"evaluations": spent, "size": size, "of_the_goal": float(first - lowest), **kept}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=list(TASKS))
    parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out", "tasks"))
    parser.add_argument("--evaluations", type=int, default=300)
    parser.add_argument("--size", type=float, default=0.2)
    given = parser.parse_args()
    rows = tasks.kept("from_answer")
    for task in given.tasks:
        rows[task] = measured(task, given.out / pathlib.Path(task).name, given.evaluations, given.size)
        _measure.write("from_answer", {"tasks": dict(sorted(rows.items()))})


if __name__ == "__main__":
    main()
