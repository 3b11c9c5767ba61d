"""The files of a tuning: the case with the tuned gains, the report with its pictures, the front and the page."""

import functools
import pathlib
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np

from ambjax.cases.reader import Case, case_from
from ambjax.control.cascade import Cascade
from ambjax.ensemble.replay import record_member
from ambjax.page.html_page import NAME
from ambjax.page.html_page import page as sliders_page
from ambjax.results.case_gains import files_from, with_numbers
from ambjax.results.outputs import described, drawn
from ambjax.simulation.rollout import rollout
from ambjax.simulation.trajectory import Trajectory
from ambjax.text.web_page import render_page
from tuning.problem.space import read, tunable
from tuning.problem.tuning_problem import TuningProblem
from tuning.report import document as report
from tuning.report import front_table, pictures
from tuning.report.facts import TUNED, Row, TuningFacts
from tuning.solve.course import SearchResult

FIRST = "Tuned by ambjax tune from the case"
AUTO = "auto"
# First lines of tuned.toml. They are removed when the file is tuned again.
HEAD = re.compile(rf"\A# {FIRST} [^\n]*\n(#[^\n]*\n)?\n?")
# Characters that a comment must not contain; surrogates come from file names that are not UTF-8.
CONTROL = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")


def put_answer(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, verdict: str) -> Case:
    """Write tuned.toml and history.npz into the folder `part`, and return the case with the tuned gains.

    The text of tuned.toml is read back first, to check that it is a valid case. `verdict`: first lines of the file.
    `out`: the folder to which the caller moves the files.
    """
    problem, history = answer.problem, dict[str, Any](answer.history)
    np.savez(part / "history.npz", **history)
    text, tuned = tuned_case(problem.case, all_laws(problem, problem.objective.space.named(answer.x)), verdict, out)
    (part / TUNED).write_text(text, encoding="utf-8")
    return tuned


def put_report(part: pathlib.Path, cascade: Cascade, answer: SearchResult, facts: TuningFacts) -> None:
    """Write the report and its pictures into the folder `part`. `cascade`: the controller with the tuned gains."""
    _pictures(part, answer.problem, cascade, answer.history, facts.front)
    put_words(part, facts.case, report.report_markdown(facts), (front_table.TITLE,))


def put_words(part: pathlib.Path, case: str, words: str, unfolded: tuple[str, ...] | None = None) -> None:
    """Write the report `words` of a case as report.md and report.html, with the pictures in the folder `part`.

    `unfolded`: as for `render_page`.
    """
    (part / "report.md").write_text(words, encoding="utf-8")
    found = {path.name: path.read_bytes() for path in part.glob("*.png")}
    page = described("report.html", lambda: render_page(words, found, f"Tuning of {case}", unfolded))
    if page is not None:
        (part / "report.html").write_text(page, encoding="utf-8")


def put_front(part: pathlib.Path, out: pathlib.Path, answer: SearchResult, facts: TuningFacts) -> None:
    """Write a case file for each point of the front of error against voltage into `part`."""
    case = answer.problem.case
    for row in facts.front or []:
        words = (
            f"A point of the front: settled rms error {row['settled_rms_error_m']:.3g} m, settled rms voltage "
            f"{row['settled_rms_u_V']:.3g} V. It is not judged on the held-out members."
        )
        text, _ = tuned_case(case, all_laws(answer.problem, row["gains"]), words, out)
        (part / row["file"]).write_text(text, encoding="utf-8")


def put_page(part: pathlib.Path, case: Case, path: str) -> None:
    """Write the page with sliders into `part`; its presets are the case and the case files in `part`."""
    files = sorted(part.glob("*.toml"), key=lambda file: (file.name != "tuned.toml", file.name))
    found = [case_from(tomllib.loads(text := file.read_text()), file.stem, text, known=case) for file in files]
    (part / NAME).write_text(sliders_page(case, found, path), encoding="utf-8")


def _pictures(
    part: pathlib.Path, problem: TuningProblem, tuned: Cascade, history: Any, front: list[Row] | None
) -> None:
    """Draw the pictures of the report into the folder `part`. `tuned`: the controller with the tuned gains.

    A picture that cannot be drawn is left out.
    """
    paths, settle, runs = problem.objective.space.paths, problem.case.settle, dict[str, Trajectory]()
    for name, cascade in (("before", problem.case.cascade), ("after", tuned)):
        run = described(f"the run {name} tuning", functools.partial(nominal, problem, cascade))
        if run is not None:
            runs[name] = run
            drawn(part / f"{name}.png", functools.partial(pictures.nominal, run, f"{name} tuning", settle), 110)
    drawn(part / "convergence.png", lambda: pictures.convergence(history, paths), 110)
    if runs:
        drawn(part / "spectrum.png", lambda: pictures.spectrum(runs, settle), 110)
    if front:
        drawn(part / "front.png", lambda: pictures.front(front), 110)


def nominal(problem: TuningProblem, cascade: Cascade) -> Trajectory:
    """Simulate the nominal case under this cascade and record every sample.

    The steps are accurate ones, or those of `ambjax simulate` if the judge uses these.
    """
    case = problem.case
    if problem.replays:
        return record_member(cascade, case.scenario, case.clock).trajectory
    clock = case.clock.with_method(problem.reference.objective.clock.method)
    return rollout(cascade, case.scenario, clock).trajectory


def all_laws(problem: TuningProblem, tuned: dict[str, float]) -> dict[str, float]:
    """Return every gain of the laws by path: the value in `tuned` if there is one, else that of the case.

    tuned.toml lists all gains, because the default of a steepness p depends on the plant.
    """
    cascade = problem.case.cascade
    return {path: float(read(cascade, path)) for path in tunable(cascade, idle=True)} | tuned


def tuned_case(case: Case, gains: Mapping[str, float], verdict: str, out: pathlib.Path) -> tuple[str, Case]:
    """Return the text of tuned.toml for the folder `out`, and its case. Raises ValueError if the text is no valid case.

    If the integration step of the case is too coarse for the tuned gains, "auto" replaces clock.dt and clock.method,
    and the first lines of the text say so.

    The custom laws, the linear controller and the recorded signals are those of `case`: a change of their files during
    the search has no effect.
    """
    values = {**gains, **files_from(case, out)}
    text = tuned(case.text, values, case.name, verdict)
    try:
        return text, case_from(tomllib.loads(text), case.name, known=case)
    except ValueError as error:
        steps = [key for key in ("dt", "method") if tomllib.loads(case.text).get("clock", {}).get(key, AUTO) != AUTO]
        if not steps:
            raise
        words = f'{verdict} In [clock], "{AUTO}" replaces {" and ".join(steps)} of the case: {error}'
        text = tuned(case.text, {**values, **{f"clock.{key}": AUTO for key in steps}}, case.name, words)
        return text, case_from(tomllib.loads(text), case.name, known=case)


def tuned(text: str, gains: Mapping[str, float | str], case: str, verdict: str) -> str:
    """Return the text of `with_numbers` after a comment: the name of the case and the verdict."""
    body = with_numbers(HEAD.sub("", text.replace("\r\n", "\n")), gains)
    head = [f"# {CONTROL.sub(_escaped, line)}" for line in (f"{FIRST} '{case}'.", verdict)]
    return "\n".join([*head, "", body.strip()]) + "\n"


def _escaped(character: re.Match[str]) -> str:
    return f"\\u{ord(character[0]):04x}"
