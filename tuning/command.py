"""The command `ambjax tune`: reads a case, searches, judges the gains and writes the report."""

import argparse
import pathlib
import tomllib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.reader import Case, case_from
from ambjax.cases.table import one_line
from ambjax.commands.outputs import check_new, directory, files, plain, say, write_json, written
from ambjax.commands.warnings import print_warnings
from ambjax.control.cascade import Cascade
from ambjax.host.interrupts import reporting
from ambjax.host.lock import locked
from ambjax.host.web_page import render_page
from ambjax.page.html_page import NAME
from ambjax.page.html_page import page as sliders_page
from tuning.config import read_tune, settings
from tuning.gains_table import off
from tuning.problem import TuningProblem, problem_of
from tuning.report import accurate, front_table, pictures
from tuning.report import document as report
from tuning.report.facts import Row, TuningFacts
from tuning.report.judging import examined
from tuning.report.tuned import tuned_case
from tuning.search.checkpoint import can_resume, checkpoint, has_unfinished_search, mark_directory, remove_all
from tuning.search.course import SearchResult
from tuning.search.explore import Slices
from tuning.search.rounds import rounds
from tuning.space import Gain, Space, tunable

WRITTEN = ("tuned.toml", "history.npz", "report.html", "report.md", "report.json")
# This file is written after the search. The search has ended if the file is newer than all checkpoints.
REPORT = "report.json"


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
    """Search, judge the result, and write and print the report. Return the exit code and the content of report.json."""
    answer = _searched(plan, args.resume)
    facts, slices = examined(answer, args.gradients, args.pareto)
    with files(plan.out) as part:
        _write(part, plan.out, answer, facts, slices)
        if args.pareto:
            _write_front(part, plan.out, answer, facts)
        if args.page:
            _write_page(part, answer.problem.case, args.case)
    _print(plan.out, facts, (*WRITTEN, NAME) if args.page else WRITTEN, quiet=args.json)
    return int(not facts.outcome["good"]), plain(facts.table) | {"out": str(plan.out)}


def _searched(plan: TuningPlan, resume: bool) -> SearchResult:
    """Search and return the result. `resume`: whether to continue from the checkpoints."""
    problem, tune = plan.problem, plan.problem.tune
    say(
        f"tuning {', '.join(tune.space.paths)} on {tune.budget.members} members; step: {problem.objective.clock.method}"
    )
    if zero := off(problem.case.cascade):
        say(f"not tuned, because they are 0 in the case, which switches their terms off: {', '.join(zero)}")
    laws = {law.stage: law.digest for law in problem.case.own_laws}
    if problem.case.controller_file:
        laws["position"] = problem.case.controller_file.contents.digest
    laws |= {one.key: one.samples.digest for one in problem.case.recorded}
    return rounds(problem, plan.start, plan.out, {"case": plan.raw, "tune": settings(tune), "laws": laws}, resume)


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


def _write(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, facts: TuningFacts, slices: Slices) -> None:
    """Write the files, except those of --pareto and --page, into the folder `part`. The caller moves them to `out`.

    The text of tuned.toml is read back first, to check that it is a valid case.
    """
    problem = answer.problem
    gains = _laws(problem, {row["path"]: row["after"] for row in facts.gains})
    text, tuned = tuned_case(problem.case, gains, facts.verdict, out)
    (part / "tuned.toml").write_text(text, encoding="utf-8")
    history: dict[str, Any] = answer.history
    np.savez(part / "history.npz", **history)
    words = report.report_markdown(facts)
    drawn = _pictures(problem, tuned.cascade, history, slices, facts.front)
    for name, data in drawn.items():
        (part / name).write_bytes(data)
    (part / "report.md").write_text(words, encoding="utf-8")
    (part / "report.html").write_text(
        render_page(words, drawn, f"Tuning of {facts.case}", unfolded=(front_table.TITLE,)), encoding="utf-8"
    )
    write_json(part / REPORT, facts.table)


def _write_front(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, facts: TuningFacts) -> None:
    """Write a case file for each point of the front of error against voltage into `part`."""
    case = answer.problem.case
    for row in facts.front or []:
        words = (
            f"A point of the front: settled rms error {row['settled_rms_error_m']:.3g} m, settled rms voltage "
            f"{row['settled_rms_u_V']:.3g} V. It is not judged on the held-out members."
        )
        text, _ = tuned_case(case, _laws(answer.problem, row["gains"]), words, out)
        (part / row["file"]).write_text(text, encoding="utf-8")


def _write_page(part: pathlib.Path, case: Case, path: str) -> None:
    """Write the page with sliders into `part`; its presets are the case and the case files in `part`."""
    files = sorted(part.glob("*.toml"), key=lambda file: (file.name != "tuned.toml", file.name))
    found = [case_from(tomllib.loads(text := file.read_text()), file.stem, text, known=case) for file in files]
    (part / NAME).write_text(sliders_page(case, found, path), encoding="utf-8")


def _pictures(
    problem: TuningProblem, tuned: Cascade, history: Any, slices: Slices, front: list[Row] | None
) -> dict[str, bytes]:
    """Return the pictures of the report as PNG data by file name. `tuned`: the controller with the tuned gains."""
    paths, runs = problem.objective.space.paths, {"before": problem.case.cascade, "after": tuned}
    shown = {name: accurate.nominal(problem, one) for name, one in runs.items()}
    drawn = {
        "nominal.png": pictures.before_after(shown, problem.case.settle),
        "spectrum.png": pictures.spectrum(shown, problem.case.settle),
        "convergence.png": pictures.convergence(history, paths),
        "slices.png": pictures.landscape(slices, paths),
    }
    return drawn | ({"front.png": pictures.front(front)} if front else {})


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
