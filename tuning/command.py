"""The command `ambjax tune`: reads a case, searches, judges the gains and writes the report."""

import argparse
import functools
import pathlib
import tomllib
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.reader import Case, case_from
from ambjax.cases.table import one_line
from ambjax.commands.outputs import check_new, described, directory, files, plain, say, write_json, written
from ambjax.commands.warnings import print_warnings
from ambjax.control.cascade import Cascade
from ambjax.host.interrupts import reporting
from ambjax.host.lock import locked
from ambjax.host.web_page import render_page
from ambjax.page.html_page import NAME
from ambjax.page.html_page import page as sliders_page
from tuning.config import read_tune
from tuning.gains_table import off
from tuning.problem import TuningProblem, problem_of
from tuning.report import accurate, front_table, pictures
from tuning.report import document as report
from tuning.report.facts import Row, TuningFacts
from tuning.report.judging import examined
from tuning.report.record import REPORT, TUNED, ended, record, search_facts
from tuning.report.tuned import tuned_case
from tuning.search.checkpoint import can_resume, checkpoint, has_unfinished_search, mark_directory, remove_all
from tuning.search.course import SearchResult
from tuning.search.explore import Slices
from tuning.search.rounds import rounds
from tuning.space import Gain, Space, tunable

WRITTEN = (TUNED, "history.npz", "report.html", "report.md", "report.json")
# Verdict in tuned.toml until the gains are judged.
NOT_JUDGED = "The tuned gains are not judged."


class TuningPlan(NamedTuple):
    """The checked input of a tuning.

    `raw`: content of the case file. `problem`: the tuning problem. `start`: initial gains [m], SI units. `out`: output
    directory.
    """

    raw: dict[str, Any]
    problem: TuningProblem
    start: np.ndarray
    out: pathlib.Path


def run(args: argparse.Namespace) -> tuple[int, Row]:
    """Run `ambjax tune` with parsed arguments. Return the exit code and the content of report.json.

    Raises ValueError for bad input before anything is written, and in the search as `rounds` does.
    """
    plan = _plan(args)
    with locked(plan.out):
        if not args.resume:
            _clear(plan.out, args.force)
        elif found := ended(search_facts(plan.raw, plan.problem), args, plan.out, WRITTEN):
            say(f"{plan.out}: this search has ended; its results are kept")
            if not args.json:
                print(found["verdict"])
            return int(not found["outcome"]["good"]), found | {"out": str(plan.out)}
        mark_directory(plan.out)
        with reporting(lambda: _kept(plan.out)):
            return _tune(plan, args)


def _plan(args: argparse.Namespace) -> TuningPlan:
    """Read the case and make the output directory. Raises ValueError for an invalid case or option."""
    case, tune, raw = read_tune(args.case, args.settings_of)
    if args.resume and args.out is None:
        raise ValueError("--resume: the directory of the search is missing. Give it as --out.")
    if args.resume and not can_resume(pathlib.Path(args.out)):
        raise ValueError(f"--resume: --out {args.out} contains no search. Check --out, or leave out --resume.")
    print_warnings(case, args.case)
    if args.page:  # raises ValueError now, before the search, if the case cannot have a page
        sliders_page(case, (), args.case)
    try:
        problem = problem_of(case, tune, front=args.pareto)
        start = tune.space.values(case.cascade)
        tune.space.encode(start)
        tuned_case(case, _laws(problem, {}), "", pathlib.Path())
    except ValueError as why:
        raise ValueError(one_line(f"{args.case}: {why}")) from None
    return TuningPlan(raw, problem, start, directory(args.out, f"tune-{case.name}", WRITTEN, force=True))


def _tune(plan: TuningPlan, args: argparse.Namespace) -> tuple[int, Row]:
    """Search, write the answer, judge it, and write and print the report. Return the exit code and the content of
    report.json.

    The answer is written before it is judged. If it cannot be judged, the exit code is 1 and there is no report.
    """
    answer = _searched(plan, args.resume)
    with files(plan.out) as part:
        _put_answer(part, plan.out, answer, NOT_JUDGED)
    found = described("the judgement of the tuned gains", lambda: examined(answer, args.gradients, args.pareto))
    if found is None:
        say(f"the tuned gains are in {plan.out / TUNED}. To judge them, repeat the command with --resume.")
        return 1, {"verdict": NOT_JUDGED, "outcome": {"good": False}, "out": str(plan.out)}
    facts, slices = found
    with files(plan.out) as part:
        table = _write(part, plan, args, answer, facts, slices)
        if args.pareto:
            described("the case files of the front", lambda: _put_front(part, plan.out, answer, facts))
        if args.page:
            described(NAME, lambda: _put_page(part, answer.problem.case, args.case))
        names = [name for name in (*WRITTEN, NAME) if (part / name).exists()]
    _print(plan.out, facts, names, quiet=args.json)
    return int(not facts.outcome["good"]), plain(table) | {"out": str(plan.out)}


def _searched(plan: TuningPlan, resume: bool) -> SearchResult:
    """Search and return the result. `resume`: whether to continue from the checkpoints."""
    problem, tune = plan.problem, plan.problem.tune
    say(
        f"tuning {', '.join(tune.space.paths)} on {tune.budget.members} members; step: {problem.objective.clock.method}"
    )
    if zero := off(problem.case.cascade):
        say(f"not tuned, because they are 0 in the case, which switches their terms off: {', '.join(zero)}")
    return rounds(problem, plan.start, plan.out, search_facts(plan.raw, problem), resume)


def _clear(out: pathlib.Path, force: bool) -> None:
    """Remove the checkpoints of an earlier search from `out`.

    Raises ValueError, without `force`, if that search has not ended or if its results would be overwritten.
    """
    if not force and has_unfinished_search(out, REPORT):
        raise ValueError(
            f"--out {out}: it contains a search that has not ended. Continue it with --resume, discard it with "
            "--force, or choose another directory."
        )
    if not force:
        check_new(out, WRITTEN)
    left = remove_all(out)
    if left:
        say(f"{out}: removed {left} checkpoints of an earlier search")


def _kept(out: pathlib.Path) -> str:
    """Return the message after an interruption: what is saved, and how to continue."""
    if not (out / checkpoint(1)).exists():
        return "nothing is saved"
    return f"the search so far is saved. To continue, repeat the command with --out {out} --resume"


def _put_answer(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, verdict: str) -> Cascade:
    """Write tuned.toml and history.npz into the folder `part`, and return the cascade with the tuned gains.

    The text of tuned.toml is read back first, to check that it is a valid case. `verdict`: first lines of the file.
    `out`: the folder to which the caller moves the files.
    """
    problem = answer.problem
    history: dict[str, Any] = answer.history
    np.savez(part / "history.npz", **history)
    gains = np.asarray(problem.objective.space.gains_at(jnp.asarray(answer.x))).tolist()
    after = dict(zip(problem.objective.space.paths, gains, strict=True))
    text, tuned = tuned_case(problem.case, _laws(problem, after), verdict, out)
    (part / TUNED).write_text(text, encoding="utf-8")
    return tuned.cascade


def _write(
    part: pathlib.Path,
    plan: TuningPlan,
    args: argparse.Namespace,
    answer: SearchResult,
    facts: TuningFacts,
    slices: Slices | None,
) -> Row:
    """Write the files, except those of --pareto and --page, into the folder `part`. Return the content of report.json.

    The caller moves the files to the output directory.
    """
    cascade = _put_answer(part, plan.out, answer, facts.verdict)
    table = facts.table | record(search_facts(plan.raw, plan.problem), args, part)
    write_json(part / REPORT, table)
    drawn = _pictures(answer.problem, cascade, answer.history, slices, facts.front)
    for name, data in drawn.items():
        (part / name).write_bytes(data)
    words = report.report_markdown(facts)
    (part / "report.md").write_text(words, encoding="utf-8")
    title = f"Tuning of {facts.case}"
    page = described("report.html", lambda: render_page(words, drawn, title, unfolded=(front_table.TITLE,)))
    if page is not None:
        (part / "report.html").write_text(page, encoding="utf-8")
    return table


def _put_front(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, facts: TuningFacts) -> None:
    """Write a case file for each point of the front of error against voltage into `part`."""
    case = answer.problem.case
    for row in facts.front or []:
        words = (
            f"A point of the front: settled rms error {row['settled_rms_error_m']:.3g} m, settled rms voltage "
            f"{row['settled_rms_u_V']:.3g} V. It is not judged on the held-out members."
        )
        text, _ = tuned_case(case, _laws(answer.problem, row["gains"]), words, out)
        (part / row["file"]).write_text(text, encoding="utf-8")


def _put_page(part: pathlib.Path, case: Case, path: str) -> None:
    """Write the page with sliders into `part`; its presets are the case and the case files in `part`."""
    files = sorted(part.glob("*.toml"), key=lambda file: (file.name != "tuned.toml", file.name))
    found = [case_from(tomllib.loads(text := file.read_text()), file.stem, text, known=case) for file in files]
    (part / NAME).write_text(sliders_page(case, found, path), encoding="utf-8")


def _pictures(
    problem: TuningProblem, tuned: Cascade, history: Any, slices: Slices | None, front: list[Row] | None
) -> dict[str, bytes]:
    """Return the pictures of the report as PNG data by file name. `tuned`: the controller with the tuned gains.

    A picture that cannot be drawn is left out.
    """
    paths, settle = problem.objective.space.paths, problem.case.settle
    runs = {"before": problem.case.cascade, "after": tuned}
    shown = {}
    for name, cascade in runs.items():
        run = described(f"the run {name} tuning", functools.partial(accurate.nominal, problem, cascade))
        if run is not None:
            shown[name] = run
    draw = {"convergence.png": lambda: pictures.convergence(history, paths)}
    if shown:
        draw["nominal.png"] = lambda: pictures.before_after(shown, settle)
        draw["spectrum.png"] = lambda: pictures.spectrum(shown, settle)
    if slices is not None:
        draw["slices.png"] = lambda: pictures.landscape(slices, paths)
    if front:
        draw["front.png"] = lambda: pictures.front(front)
    drawn = {name: described(name, one) for name, one in draw.items()}
    return {name: data for name, data in drawn.items() if data is not None}


def _laws(problem: TuningProblem, tuned: dict[str, float]) -> dict[str, float]:
    """Return every gain of the laws by path: the value in `tuned` if there is one, else that of the case.

    tuned.toml lists all gains, because the default of a steepness p depends on the plant.
    """
    everything = Space(tuple(Gain(path) for path in tunable(problem.case.cascade, idle=True)))
    return dict(zip(everything.paths, everything.values(problem.case.cascade).tolist(), strict=True)) | tuned


def _print(out: pathlib.Path, facts: TuningFacts, names: Sequence[str], *, quiet: bool) -> None:
    """Print the verdict, the gains and the files unless `quiet`. If a requirement is not met, print the advice too."""
    if not quiet:
        print(facts.verdict)
        for row in facts.gains:
            bound = f" ({row['at_bound']})" if row["at_bound"] else ""
            print(f"  {row['path']}: {row['before']:.6g} -> {row['after']:.6g}{bound}")
        written(out, f"{', '.join(names)}, *.png")
    if not facts.outcome["good"]:
        say(facts.advice)
