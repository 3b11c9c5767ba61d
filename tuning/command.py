"""The tuning of a case file: it reads the case, searches, judges the gains and writes the report."""

import dataclasses
import functools
import pathlib
import tomllib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.reader import Case, case_from, read_case
from ambjax.cases.table import one_line
from ambjax.commands.outputs import check_new, described, directory, files, plain, say, write_json
from ambjax.commands.warnings import print_warnings
from ambjax.control.cascade import Cascade
from ambjax.host.interrupts import reporting
from ambjax.host.lock import locked
from ambjax.host.web_page import render_page
from ambjax.page.html_page import NAME
from ambjax.page.html_page import page as sliders_page
from tuning.events import Listener, teller
from tuning.problem.config import allowed_minutes, read_tune
from tuning.problem.gains_table import off
from tuning.problem.space import Gain, Space, tunable
from tuning.problem.tuning_problem import TuningProblem, problem_of
from tuning.report import accurate, front_table, pictures
from tuning.report import document as report
from tuning.report.facts import Row, TuningFacts
from tuning.report.judging import examined
from tuning.report.record import REPORT, TUNED, ended, record, search_facts
from tuning.report.slices import Slices
from tuning.report.tuned import tuned_case
from tuning.rounds import rounds
from tuning.solve.checkpoint import can_resume, checkpoint, has_unfinished_search, mark_directory, remove_all
from tuning.solve.course import SearchResult

WRITTEN = (TUNED, "history.npz", "report.html", "report.md", "report.json")
# Verdict in tuned.toml until the gains are judged.
NOT_JUDGED = "The tuned gains are not judged."


@dataclasses.dataclass(frozen=True)
class TunedCase:
    """The result of `tune`.

    - `case`: the case with the tuned gains, as in tuned.toml.
    - `good`: whether the gains meet all requirements: [tune.limits], and confirmation by accurate steps.
    - `report`: the contents of report.json.
    - `directory`: directory of tuned.toml, history.npz and the report.
    """

    case: Case
    good: bool
    report: dict[str, Any]
    directory: pathlib.Path


class Options(NamedTuple):
    """Options of the command: see `tune`. `out`: output directory; None: a new one."""

    out: str | None = None
    resume: bool = False
    force: bool = False
    pareto: bool = False
    page: bool = False
    settings_of: str | None = None
    minutes: float | None = None


class TuningPlan(NamedTuple):
    """The checked input of a tuning.

    `raw`: content of the case file. `problem`: the tuning problem. `start`: initial gains [m], SI units. `out`: output
    directory.
    """

    raw: dict[str, Any]
    problem: TuningProblem
    start: np.ndarray
    out: pathlib.Path


def run(path: str, options: Options, listen: Listener) -> TunedCase:
    """Tune the case file at `path`, write the results, and return them. `listen`: receives the events.

    Raises ValueError for bad input before anything is written, and in the search as `rounds` does.
    """
    plan = _plan(path, options)
    with locked(plan.out):
        if not options.resume:
            _clear(plan.out, options.force)
        elif found := ended(search_facts(plan.raw, plan.problem), options, plan.out, WRITTEN):
            teller(listen)(f"{plan.out}: this search has ended; its results are kept")
            return TunedCase(read_case(plan.out / TUNED), found["outcome"]["good"], found, plan.out)
        mark_directory(plan.out)
        with reporting(lambda: _kept(plan.out)):
            return _tune(plan, path, options, listen)


def _plan(path: str, options: Options) -> TuningPlan:
    """Read the case and make the output directory. Raises ValueError for an invalid case or option."""
    case, tune, raw = read_tune(path, options.settings_of)
    if options.resume and options.out is None:
        raise ValueError("--resume: the directory of the search is missing. Give it as --out.")
    if options.resume and not can_resume(pathlib.Path(str(options.out))):
        raise ValueError(f"--resume: --out {options.out} contains no search. Check --out, or leave out --resume.")
    if options.minutes is not None:
        tune = dataclasses.replace(tune, minutes=allowed_minutes(options.minutes))
    print_warnings(case, path)
    for limit, why in tune.limits.unbreakable:
        say(f"{path}: tune.limits.{limit.name} = {limit.threshold:g} is left out. It cannot be broken: {why}.")
    if options.page:  # raises ValueError now, before the search, if the case cannot have a page
        sliders_page(case, (), path)
    try:
        problem = problem_of(case, tune, front=options.pareto)
        start = tune.space.values(case.cascade)
        tune.space.encode(start)
        tuned_case(case, _laws(problem, {}), "", pathlib.Path())
    except ValueError as why:
        raise ValueError(one_line(f"{path}: {why}")) from None
    return TuningPlan(raw, problem, start, directory(options.out, f"tune-{case.name}", WRITTEN, force=True))


def _tune(plan: TuningPlan, path: str, options: Options, listen: Listener) -> TunedCase:
    """Search, write the answer, judge it, and write the report.

    The answer is written before it is judged. If it cannot be judged, it is not good, and there is no report.
    """
    answer = _searched(plan, options.resume, listen)
    with files(plan.out) as part:
        case = _put_answer(part, plan.out, answer, NOT_JUDGED)
    tell = teller(listen)
    found = described("the judgement of the tuned gains", lambda: examined(answer, options.pareto, tell))
    if found is None:
        tell(f"the tuned gains are in {plan.out / TUNED}. To judge them, repeat the command with --resume.")
        return TunedCase(case, False, {"verdict": NOT_JUDGED, "outcome": {"good": False}}, plan.out)
    facts, slices = found
    with files(plan.out) as part:
        table = _write(part, plan, options, answer, facts, slices)
        if options.pareto:
            described("the case files of the front", lambda: _put_front(part, plan.out, answer, facts))
        if options.page:
            described(NAME, lambda: _put_page(part, answer.problem.case, path))
    return TunedCase(case, facts.outcome["good"], plain(table), plan.out)


def _searched(plan: TuningPlan, resume: bool, listen: Listener) -> SearchResult:
    """Search and return the result. `resume`: whether to continue from the checkpoints."""
    problem, tune, tell = plan.problem, plan.problem.tune, teller(listen)
    tell(
        f"tuning {', '.join(tune.space.paths)} on {tune.budget.members} members; step: {problem.objective.clock.method}"
    )
    if zero := off(problem.case.cascade):
        tell(f"not tuned, because they are 0 in the case, which switches their terms off: {', '.join(zero)}")
    return rounds(problem, plan.start, plan.out, search_facts(plan.raw, problem), resume, listen)


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


def _put_answer(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, verdict: str) -> Case:
    """Write tuned.toml and history.npz into the folder `part`, and return the case with the tuned gains.

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
    return tuned


def _write(
    part: pathlib.Path,
    plan: TuningPlan,
    options: Options,
    answer: SearchResult,
    facts: TuningFacts,
    slices: Slices | None,
) -> Row:
    """Write the files, except those of --pareto and --page, into the folder `part`. Return the content of report.json.

    The caller moves the files to the output directory.
    """
    cascade = _put_answer(part, plan.out, answer, facts.verdict).cascade
    table = facts.table
    if answer.complete:
        table |= record(search_facts(plan.raw, plan.problem), options, part)
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
