"""The tuning of a case file: it reads the case, searches, judges the gains and writes the report."""

import contextlib
import dataclasses
import pathlib
import tomllib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ambjax.cases.given import names_arguments
from ambjax.cases.machine_case import AnyCase, MachineCase
from ambjax.cases.reader import Case, is_machine, read_case
from ambjax.cases.table import FILE, load, one_line, require_file, text_of
from ambjax.commands.reading import print_warnings
from ambjax.host.heartbeat import say
from ambjax.host.interrupts import reporting
from ambjax.host.lock import locked
from ambjax.host.one_thread import one_thread
from ambjax.page.html_page import NAME
from ambjax.page.html_page import page as sliders_page
from ambjax.results.case_gains import text_with_gains
from ambjax.results.outputs import check_new, described, directory, files, plain, write_json
from tuning.events import Listener, Log, teller
from tuning.machines.machine_tuning import machine_plan, tune_machine
from tuning.problem.config import read_tune
from tuning.problem.gains_table import off
from tuning.problem.tuning_problem import TuningProblem, problem_of
from tuning.report.facts import KEY, NOT_JUDGED, REPORT, TUNED, ended, record, search_facts
from tuning.report.folder import all_laws, put_answer, put_front, put_page, put_report, tuned_case
from tuning.report.judging import examined
from tuning.rounds import rounds
from tuning.solve.checkpoint import can_resume, checkpoint, has_unfinished_search, mark_directory, remove_all

# The tables of a case and their text.
Loaded = tuple[dict[str, Any], str]
WRITTEN = (TUNED, "history.npz", "report.html", "report.md", "report.json")


@dataclasses.dataclass(frozen=True)
class TunedCase:
    """The result of `tune`.

    - `case`: the case with the tuned gains, as in tuned.toml.
    - `good`: whether the gains meet all requirements: [tune.limits], and confirmation by accurate steps.
    - `report`: the contents of report.json.
    - `directory`: directory of tuned.toml, history.npz and the report.
    """

    case: Case | MachineCase
    good: bool
    report: dict[str, Any] = dataclasses.field(repr=False)
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

    `facts`: what a checkpoint must match. `problem`: the tuning problem. `start`: initial gains [m], SI units. `out`:
    output directory. `options`: of the command. `names`: the files that the tuning writes.
    """

    facts: dict[str, Any]
    problem: TuningProblem
    start: np.ndarray
    out: pathlib.Path
    options: Options
    names: tuple[str, ...] = WRITTEN

    @property
    def record(self) -> dict[str, Any]:
        """The facts on which report.json depends: those of the search, and the options that add results."""
        return self.facts | {"options": [self.options.pareto, self.options.page]}

    def kept(self) -> Case:
        """Return the case of tuned.toml in `out`."""
        return read_case(self.out / TUNED)


@names_arguments(budget="minutes")
def tune(
    case: str | pathlib.Path | Mapping[str, Any] | AnyCase,
    out: str | pathlib.Path | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    pareto: bool = False,
    page: bool = False,
    settings_of: str | pathlib.Path | None = None,
    minutes: float | None = None,
    listen: Listener | None = None,
) -> TunedCase:
    """Tune the gains of a case file, as `ambjax tune` does, and write the same files.

    - `case`: path of the case file, a dict of its tables, or a case that was read; its gains may be those of
      `with_gains`. The table [tune] selects the gains, limits and budget.
    - `out`: directory of the results; None: a new one under ./out.
    - `resume`: continue the search whose checkpoints are in `out`.
    - `force`: overwrite the files of an earlier search in `out`.
    - `pareto`: write each point of the front of error against voltage as a case file.
    - `page`: also write page.html, with sliders and presets; the case needs [processor] (extra `[page]`).
    - `settings_of`: path of another case file, whose limits, loss and budget replace those of `case`.
    - `minutes`: time for the whole tuning; None: that of [tune].
    - `listen`: function that receives each event (`tuning.events.Event`); None: the events are lines on stderr.

    Raises ValueError for an invalid case or option before any search, and in the search if the loss is not finite at
    any starting point.

        tuned = ambjax.tune("my.toml", "tuned", minutes=10)
        print(tuned.good, tuned.case.cascade)
    """
    for name, path in (("out", out), ("settings_of", settings_of)):
        if path is not None:
            require_file(name, path)
    if not (listen is None or callable(listen)):
        raise ValueError(f"listen = {listen!r}: it must be a function of an event.")
    if not isinstance(minutes, (int, float, type(None))):
        raise ValueError(f"minutes = {minutes!r}: it must be a number above 0.")
    loaded, known = None, None
    if isinstance(case, Mapping):
        loaded, case = (dict(case), text_of(case)), "case"
    elif isinstance(case, (Case, MachineCase)):
        text, known = text_with_gains(case), case if isinstance(case, Case) else None
        loaded, case = (tomllib.loads(text), text), pathlib.Path(getattr(case, "folder", ""), f"{case.name}.toml")
    require_file("case", case, f"{FILE}, a dict of tables, or a case that was read")
    folder, other = (None if path is None else str(path) for path in (out, settings_of))
    options = Options(folder, resume, force, pareto, page, other, minutes)
    with contextlib.ExitStack() as stack, one_thread():
        return run(str(case), options, listen or stack.enter_context(Log()), loaded, known)


def run(
    path: str, options: Options, listen: Listener, loaded: Loaded | None = None, known: Case | None = None
) -> TunedCase:
    """Tune the case file at `path`, write the results, and return them. `listen`: receives the events.

    `loaded`: its contents as of `load`; None: they are read. `known`: a case that names the same files; they are not
    read again.
    Raises ValueError for bad input before anything is written, and in the search as `rounds` does.
    """
    loaded = loaded or load(path)  # once: a second read of a pipe would be empty
    if options.resume and options.out is None:
        raise ValueError("--resume: the directory of the search is missing. Give it as --out.")
    if options.resume and not can_resume(pathlib.Path(str(options.out))):
        raise ValueError(f"--resume: --out {options.out} contains no search. Check --out, or leave out --resume.")
    if options.minutes is not None and not options.minutes > 0:
        raise ValueError(f"--budget {options.minutes:g}: it must be above 0, in minutes.")
    if is_machine(loaded[0]):
        if refused := next((name for name in ("pareto", "page") if getattr(options, name)), None):
            raise ValueError(f"--{refused}: the tuning of a machine does not take it. Leave it out.")
        plan = machine_plan(path, options.out, options.minutes, options.settings_of, loaded)
    else:
        plan = _plan(path, options, loaded, known)
    with locked(plan.out):
        if not options.resume:
            _clear(plan.out, options.force)
        elif found := ended(plan.record, plan.out, plan.names):
            teller(listen)(f"{plan.out}: this search has ended; its results are kept")
            return TunedCase(plan.kept(), found["outcome"]["good"], found, plan.out)
        mark_directory(plan.out)
        with reporting(lambda: _kept(plan.out)):
            if isinstance(plan, TuningPlan):
                return _tune(plan, path, listen)
            case, report = tune_machine(plan, options.resume, teller(listen))
            return TunedCase(case, report["outcome"]["good"], report, plan.out)


def _plan(path: str, options: Options, loaded: Loaded, known: Case | None) -> TuningPlan:
    """Read the case and make the output directory. Raises ValueError for an invalid case or option."""
    case, tune, raw = read_tune(path, options.settings_of, loaded, known)
    if options.minutes is not None:
        tune = dataclasses.replace(tune, minutes=options.minutes)
    print_warnings(case, path)
    for limit, why in tune.limits.unbreakable:
        say(f"{path}: tune.limits.{limit.name} = {limit.threshold:g} is left out. It cannot be broken: {why}.")
    if options.page:  # raises ValueError now, before the search, if the case cannot have a page
        sliders_page(case, (), path)
    try:
        problem = problem_of(case, tune, front=options.pareto)
        start = tune.space.values(case.cascade)
        tune.space.encode(start)
        tuned_case(case, all_laws(problem, {}), "", pathlib.Path())
    except ValueError as why:
        raise ValueError(one_line(f"{path}: {why}")) from None
    out = directory(options.out, f"tune-{case.name}", WRITTEN, force=True)
    return TuningPlan(search_facts(raw, case, tune), problem, start, out, options)


def _tune(plan: TuningPlan, path: str, listen: Listener) -> TunedCase:
    """Search, write the answer, judge it, and write the report.

    The answer is written before it is judged. If it cannot be judged, it is not good, and there is no report.
    """
    options, tell = plan.options, teller(listen)
    problem, tune = plan.problem, plan.problem.tune
    method = problem.objective.clock.method
    tell(f"tuning {', '.join(tune.space.paths)} on {tune.budget.members} members; step: {method}")
    if zero := off(problem.case.cascade):
        tell(f"not tuned, because they are 0 in the case, which switches their terms off: {', '.join(zero)}")
    answer = rounds(problem, plan.start, plan.out, plan.facts, options.resume, listen)
    with files(plan.out) as part:
        case = put_answer(part, plan.out, answer, NOT_JUDGED)
    facts = described("the judgement of the tuned gains", lambda: examined(answer, options.pareto, tell))
    if facts is None:
        tell(f"the tuned gains are in {plan.out / TUNED}. To judge them, repeat the command with --resume.")
        return TunedCase(case, False, {"verdict": NOT_JUDGED, "outcome": {"good": False}}, plan.out)
    with files(plan.out) as part:
        case = put_answer(part, plan.out, answer, facts.verdict)
        table = facts.table
        if answer.complete:
            table |= {KEY: record(plan.record, part)}
        write_json(part / REPORT, table)
        put_report(part, case.cascade, answer, facts)
        if options.pareto:
            described("the case files of the front", lambda: put_front(part, plan.out, answer, facts))
        if options.page:
            described(NAME, lambda: put_page(part, answer.problem.case, path))
    return TunedCase(case, facts.outcome["good"], plain(table), plan.out)


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
    if left := remove_all(out):
        say(f"{out}: removed {left} checkpoints of an earlier search")


def _kept(out: pathlib.Path) -> str:
    """Return the message after an interruption: what is saved, and how to continue."""
    if not (out / checkpoint(1)).exists():
        return "nothing is saved"
    return f"the search so far is saved. To continue, repeat the command with --out {out} --resume"
