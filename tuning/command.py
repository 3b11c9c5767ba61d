"""The command `ambjax tune`: reads a case, searches, judges the gains and writes the report."""

import argparse
import dataclasses
import pathlib
import tomllib
from typing import Any

import jax.numpy as jnp
import numpy as np

from ambjax.cases.reader import case_from
from ambjax.cases.table import one_line
from ambjax.commands.outputs import directory, files, plain, say, write_json, written
from ambjax.commands.warnings import print_warnings
from ambjax.control.cascade import Cascade
from ambjax.host.interrupts import reporting
from ambjax.host.lock import alone
from ambjax.theorem.advice import advice as on_conditions
from ambjax.theorem.conditions import check
from tuning.config import read_tune, seeds, settings
from tuning.judge import StepError, describe, held, judge, step_error, summarise, worst, worst_of
from tuning.problem import TuningProblem, problem_of
from tuning.report import accurate, breakdown, gradient, limit_table, outcome, pictures
from tuning.report import document as report
from tuning.report.page import page
from tuning.report.tuned import tuned as tuned_text
from tuning.search import explore
from tuning.search.course import SearchResult
from tuning.search.keeper import begin, begun, checkpoint, remove_all, unfinished
from tuning.search.rounds import rounds
from tuning.space import Gain, Space, tunable

WRITTEN = ("tuned.toml", "history.npz", "report.html", "report.md", "report.json")
# The last file written: its presence marks a search that has ended.
REPORT = "report.json"


def run(args: argparse.Namespace) -> tuple[int, dict[str, Any]]:
    """Run `ambjax tune`. Return the exit code and report.json. Raises ValueError for bad input, before any output."""
    case, tune, raw = read_tune(args.case)
    if args.resume and not (args.out and begun(pathlib.Path(args.out))):
        raise ValueError(f"--resume: there is no search in --out {args.out}. Check --out, or leave out --resume.")
    print_warnings(case, args.case)
    try:
        problem = problem_of(case, tune)
        start = tune.space.values(case.cascade)
        tune.space.encode(start)
        case_from(tomllib.loads(tuned_text(case.text, _laws(problem, {}), case.name, "")))
    except ValueError as why:
        raise ValueError(one_line(f"{args.case}: {why}")) from None
    out = directory(args.out, f"tune-{case.name}", WRITTEN)
    with alone(out):
        if not args.resume:
            _clear(out)
        begin(out)
        with reporting(lambda: _kept(out)):
            return _tune(args, raw, problem, start, out)


def _clear(out: pathlib.Path) -> None:
    """Remove the checkpoints of a search that has ended, so that this search is not resumed with them.

    Raises ValueError if that search has not ended.
    """
    if unfinished(out, REPORT):
        raise ValueError(
            f"--out {out}: it holds a search that has not ended. Add --resume to go on with it, or choose another."
        )
    left = remove_all(out)
    if left:
        say(f"{out}: {left} checkpoints of an earlier search are removed")


def _kept(out: pathlib.Path) -> str:
    """Return the message after an interruption: what is saved, and how to continue."""
    if not (out / checkpoint(1)).exists():
        return "nothing is kept"
    return f"the search so far is kept. To go on, give the same command with --out {out} --resume"


def _tune(
    args: argparse.Namespace, raw: dict[str, Any], problem: TuningProblem, start: np.ndarray, out: pathlib.Path
) -> tuple[int, dict[str, Any]]:
    """Search, judge and write. The input is valid. `raw`: the document of the case file; `start` [m]: its gains."""
    tune = problem.tune
    held_out = seeds(tune.budget)[2]
    say(
        f"tuning {', '.join(tune.space.paths)} on {tune.budget.members} members; step: {problem.objective.clock.method}"
    )
    answer = rounds(problem, start, out, {"case": raw, "tune": settings(tune)}, args.resume)
    problem, members, x = answer.problem, answer.members, answer.x
    facts = _facts(answer, held_out)
    if args.gradients:
        say("gradient report ...")
        facts["gradient"] = gradient.report(problem, x, members)
    if args.pareto:
        say("front of error against voltage ...")
        facts["pareto"] = explore.pareto(problem, x, members)
    slices = explore.slices(problem, x, members)
    with files(out) as part:
        _write(part, problem, answer.history, facts, slices)
    summary = plain(facts) | {"out": str(out)}
    if not args.json:
        print(_short(facts))
        written(out, f"{', '.join(WRITTEN)}, *.png")
    good = facts["outcome"]["good"]
    if not good:
        say(facts["advice"])
    return int(not good), summary


def _facts(answer: SearchResult, held_out: int) -> dict[str, Any]:
    problem, x, members = answer.problem, answer.x, answer.members
    case, tune, space = problem.case, problem.tune, problem.objective.space
    rollouts = problem.engine.rollouts
    before = space.values(case.cascade)
    after = np.asarray(space.gains_at(jnp.asarray(x)))
    tuned = dataclasses.replace(case, cascade=space.decode(jnp.asarray(x), case.cascade))
    count = tune.budget.held_out
    say(f"judging on {count} members of another seed ...")
    none = {"members": 0, "held": 0, "lost": 0, "stalled": 0}
    judged = [judge(problem, at, held_out, count) for at in (_at(problem, before), x)] if count else []
    summaries = [summarise(one) for one in judged] or [none, none]
    loss = dict(zip(("before", "after"), (breakdown.table(problem.goal, one) for one in judged), strict=False))
    unlucky, again, refuted = _checked(answer, judged[1] if judged else None, held_out)
    limited = limit_table.facts(problem.goal.limits, tune.limits, judged[1] if judged else {}, summaries[1], refuted)
    if refuted and judged:
        summaries[1] |= dict.fromkeys(("survival", "survival_low", "survival_high"), limit_table.UNVERIFIED)
    lost = int((problem.engine.terms(x[None], members)["survival"] > 0).sum())
    line = check(tuned.cascade, case.scenario, dataclasses.replace(case.clock, method=None))
    facts: dict[str, Any] = {
        "case": case.name,
        "weights": list(tune.weights),
        "before": summaries[0],
        "after": summaries[1],
        "held_out_seed": held_out,
        "trained_on": len(members.member),
        "lost_in_training": lost,
        "limits": limited,
        "loss": loss,
        "minimised": breakdown.minimised(problem, x, members),
        "conditions": report.conditions(line),
        "advice_on_conditions": on_conditions(line),
        "step_error": answer.error.facts() if answer.error else None,
        "worst_step_error": unlucky.facts() if unlucky else None,
        "worst_member": worst(problem, judged[1], held_out) if judged else None,
        "accurate_steps": problem.accurate,
        "nominal_steps": "in the steps of `ambjax simulate`" if problem.replays else "by accurate steps",
        "refuted": refuted,
        "verified": not refuted,
        "verified_reason": refuted or _confirmed(unlucky, answer.error),
        "lost_in_validation": answer.lost,
        "search": settings(tune)
        | {"iterations": len(answer.history["value"]), "rollouts": rollouts, "seconds": answer.seconds},
    }
    if again:
        facts["accurate"] = again
    facts["gains"] = [
        row | dataclasses.asdict(where)
        for row, where in zip(report.gains_table(space, before, after, None), problem.ranges, strict=True)
    ]
    found = outcome.outcome_of(facts, tune.limits.may_lose(count))
    facts["outcome"] = found.facts()
    facts["verdict"] = outcome.verdict(facts, found)
    facts["advice"] = outcome.advice(problem, facts, found, x, members)
    return facts


def _checked(
    answer: SearchResult, judged: dict[str, np.ndarray] | None, held_out: int
) -> tuple[StepError | None, dict[str, Any] | None, str]:
    """Simulate the worst and the first of the held-out members `judged` [N] again by accurate steps.

    Returns the step error on the worst members, the comparison on the first ones, and the reason why accurate steps do
    not confirm the answer ('' if they confirm it).
    """
    problem, again, error = answer.problem, None, None
    if judged and not problem.sampled:
        error = _worst_checked(answer, judged, held_out) if answer.confirmed else None
        count = problem.tune.budget.held_out
        say(f"{min(accurate.AGAIN, count)} of them again by accurate steps ...")
        again = accurate.compared(problem, answer.x, held_out, count, report.SHOWN)
    refuted = (error or answer.error).refuted if answer.error else "every member that it was tuned on is lost"
    return error, again, refuted or (again["refuted"] if again else "")


def _confirmed(*errors: StepError | None) -> str:
    return "; ".join(f"accurate steps: {describe(error)}" for error in errors if error)


def _worst_checked(answer: SearchResult, judged: dict[str, np.ndarray], held_out: int) -> StepError | None:
    """Return the step error on the worst held-out members that are held; None if none is held."""
    those = np.flatnonzero(held(judged))
    if not those.size:
        return None
    those = those[worst_of(judged["settled_max_abs_error_m"][those])]
    error = step_error(
        answer.problem, answer.x, answer.problem.objective.chosen(held_out, those, len(judged["lost_at_s"]))
    )
    say(f"accurate steps on the worst of them: {describe(error)}")
    return error


def _at(problem: TuningProblem, gains: np.ndarray) -> np.ndarray:
    return problem.objective.space.encode(problem.objective.space.clip(gains))


def _write(
    out: pathlib.Path, problem: TuningProblem, history: Any, facts: dict[str, Any], slices: explore.Slices
) -> None:
    space = problem.objective.space
    for row, grows, lost in zip(facts["gains"], slices.sensitivity(), slices.more_lost(), strict=True):
        row |= {"sensitivity_percent": None if lost else float(grows), "sensitivity_lost": int(lost)}
    j, k, drop = slices.lowest()
    facts["beside"] = {"path": space.paths[j], "gain": slices.gains[j, k], "lower": -np.expm1(-drop)}
    facts["slices"] = {"gains": slices.gains, "log_risk": slices.goals, "lost": slices.lost}
    gains = _laws(problem, {row["path"]: row["after"] for row in facts["gains"]})
    text = tuned_text(problem.case.text, gains, facts["case"], facts["verdict"])
    tuned = case_from(tomllib.loads(text), facts["case"])  # a file that could not be read back is not written
    (out / "tuned.toml").write_text(text, encoding="utf-8")
    np.savez(out / "history.npz", **history)
    words = report.markdown(facts)
    drawn = _pictures(problem, tuned.cascade, history, facts, slices)
    for name, data in drawn.items():
        (out / name).write_bytes(data)
    (out / "report.md").write_text(words, encoding="utf-8")
    (out / "report.html").write_text(page(words, drawn, f"Tuning of {facts['case']}"), encoding="utf-8")
    write_json(out / REPORT, facts)


def _pictures(
    problem: TuningProblem, tuned: Cascade, history: Any, facts: dict[str, Any], slices: explore.Slices
) -> dict[str, bytes]:
    """Return the pictures of the report, PNG by file name."""
    paths, runs = problem.objective.space.paths, {"before": problem.case.cascade, "after": tuned}
    shown = {name: accurate.nominal(problem, one) for name, one in runs.items()}
    drawn = {
        "nominal.png": pictures.before_after(shown),
        "spectrum.png": pictures.spectrum(shown, problem.case.settle),
        "convergence.png": pictures.convergence(history, paths),
        "slices.png": pictures.landscape(slices, paths),
    }
    return drawn | ({"front.png": pictures.front(facts["pareto"])} if facts.get("pareto") else {})


def _laws(problem: TuningProblem, tuned: dict[str, float]) -> dict[str, float]:
    """Return every gain of the laws by path, untuned ones included, because a p that is left out follows the plant."""
    everything = Space(tuple(Gain(path) for path in tunable(problem.case.cascade)))
    return dict(zip(everything.paths, everything.values(problem.case.cascade).tolist(), strict=True)) | tuned


def _short(facts: dict[str, Any]) -> str:
    lines = [facts["verdict"]]
    lines += [
        f"  {row['path']}: {row['before']:.6g} -> {row['after']:.6g}" + f" ({row['at_bound']})" * bool(row["at_bound"])
        for row in facts["gains"]
    ]
    return "\n".join(lines)
