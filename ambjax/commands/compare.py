"""`ambjax compare`: several cases on the same members: errors, voltages, power losses, sensitivity, margins, cost."""

import argparse
import dataclasses
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from ambjax.cases.given import names_arguments, require_case
from ambjax.cases.machine_case import AnyCase, MachineCase, first_axis
from ambjax.cases.reader import Case
from ambjax.codegen.controller import controller_of
from ambjax.codegen.trace import trace
from ambjax.commands.comparison_loop import ComparedLoop, loop_of_axis, loop_of_machine
from ambjax.commands.comparison_report import (
    BY_AXIS,
    Compared,
    comparison_markdown,
    comparison_summary,
    comparison_table,
)
from ambjax.commands.comparison_tuning import check_options, tuned_cases
from ambjax.commands.machine_commands import refuse
from ambjax.commands.reading import read_any_with_warnings, results
from ambjax.commands.study_report import findings_of
from ambjax.ensemble.study import AnyStudy, Study
from ambjax.ensemble.worker import CALL, chunk
from ambjax.host.heartbeat import FIRST_RUN, doing, is_quiet, quiet, say
from ambjax.host.one_thread import one_thread
from ambjax.page.html_page import check_processor, pages
from ambjax.results.case_export import guarded_for
from ambjax.results.machine_study import MachineStudy
from ambjax.results.operating import MEMBERS, operating_point, sensitivity, shown_band, spread_peaks
from ambjax.results.outputs import described, directory, drawn, plain, write_json
from ambjax.results.spread_runs import study_of
from ambjax.text.web_page import render_page

WRITTEN = ("compare.html", "compare.json", "compare.png")
# Largest number of cases in a table and a picture.
MOST_CASES = 8
# Members that are simulated between two updates of the progress bar: a whole number of calls of the compiled program.
CHUNK = 16 * CALL
# Names in a study's fingerprint whose values may differ: the controller, that of an axis, and the integration method.
MAY_DIFFER = re.compile(r"(bearing\..*\.)?controller\.|clock\.method")


def run(args: argparse.Namespace) -> tuple[int, Mapping[str, object]]:
    """Compare cases.

    The exit code is 0 if each case holds all members, the members tested are stable, and its nominal loop is stable at
    rest, for a machine at each of its speeds.
    """
    check_options(args)
    cases = _read(args.cases)
    of_axis = [case for case in cases if isinstance(case, Case)]
    if not of_axis:
        refuse(args, ("page",))
    studies = _studies(cases, args.seed, args.members)
    notes = _differences(args.cases, cases, studies)
    for note in notes:
        say(note)
    if args.page:
        for path, case in zip(args.cases, of_axis, strict=True):
            check_processor(case, path)
    name = f"compare-{'-'.join(case.name for case in cases)}"[:80]
    out = directory(args.out, name, WRITTEN, args.force or args.resume)
    if args.tune:
        cases = tuned_cases(cases, out, args)
        of_axis = [case for case in cases if isinstance(case, Case)]
        studies = _studies(cases, args.seed, args.members)
    html_pages = pages(of_axis, args.cases) if args.page else {}
    summary, compared = _comparison(cases, studies, notes)
    with results(args, out, (*WRITTEN, *html_pages), lambda: comparison_table(summary)) as part:
        write_json(part / "compare.json", summary)
        drawn(part / "compare.png", lambda: _drawn(compared), 110)
        described("compare.html", lambda: _write_html(summary, part))
        for name, html in html_pages.items():
            (part / name).write_text(html, encoding="utf-8")
    good = all(one.held.all() and one.findings.stable and one.loop.stable for one in compared)
    return int(not good), plain(summary | {"out": str(out)})


class Comparison(NamedTuple):
    """The result of `compare`.

    `summary`: the content of compare.json. `compared`: each case with the columns of its members and its nominal loop.
    """

    summary: dict[str, Any]
    compared: list[Compared]

    def table(self) -> str:
        """Return the table that `ambjax compare` prints."""
        return comparison_table(self.summary)


@one_thread()
@names_arguments()
def compare(cases: Sequence[AnyCase], members: int = 1, *, seed: int | None = None) -> Comparison:
    """Compare cases, or machines, on the same members of their spread, as `ambjax compare` does.

    - `cases`: two to eight cases with the same spread. What differs in more than the controller is in
      `summary["differences"]`.
    - `members`, `seed`: as for `simulate_members`; the seed of all cases is by default that of the first one.

    Raises ValueError for anything but cases, for another number of them, if their spreads differ, and as
    `simulate_members` does.

        print(ambjax.compare([case, other], 200).table())
    """
    if not isinstance(cases, Sequence) or isinstance(cases, str):
        raise ValueError(f"cases = {type(cases).__name__}: it must be a list of 2 to {MOST_CASES} cases.")
    for case in cases:
        require_case(case, machines=True)
    _check_count(len(cases), "case")
    cases = _named(cases, [case.name for case in cases])
    studies = _studies(cases, seed, members)
    with quiet():
        return _comparison(cases, studies, _differences([case.name for case in cases], cases, studies))


def _comparison(cases: Sequence[AnyCase], studies: Sequence[Study | MachineStudy], notes: Sequence[str]) -> Comparison:
    compared = [_compared(case, study) for case, study in zip(cases, studies, strict=True)]
    return Comparison(comparison_summary(compared, studies[0], notes), compared)


def _write_html(summary: Mapping[str, Any], part: pathlib.Path) -> None:
    picture = part / "compare.png"
    drawn = {picture.name: picture.read_bytes()} if picture.exists() else {}
    html = render_page(comparison_markdown(summary), drawn, "Comparison of controllers")
    (part / "compare.html").write_text(html, encoding="utf-8")


def _studies(cases: Sequence[AnyCase], seed: int | None, members: int) -> list[Study | MachineStudy]:
    """Return the studies of the cases, with the same seed: by default the first case's."""
    seed = study_of(cases[0], seed, members).seed
    studies = [study_of(case, seed, members) for case in cases]
    return [dataclasses.replace(one, by_axis=BY_AXIS) if isinstance(one, MachineStudy) else one for one in studies]


def _read(paths: Sequence[str]) -> list[AnyCase]:
    _check_count(len(paths), "case file")
    for path in paths:
        same = [other for other in paths if pathlib.Path(other).resolve() == pathlib.Path(path).resolve()]
        if len(same) > 1:
            raise ValueError(f"{path}: this file is given {len(same)} times. Give each once.")
    return _named([read_any_with_warnings(path) for path in paths], paths)


def _check_count(count: int, what: str) -> None:
    if not 2 <= count <= MOST_CASES:
        raise ValueError(f"{count} {what}{'s' * (count != 1)}: give 2 to {MOST_CASES} {what}s.")


def _named(cases: Sequence[AnyCase], paths: Sequence[str]) -> list[AnyCase]:
    """Append a number to a name that occurs more than once. Raises ValueError for machines beside cases of one axis."""
    for path, case in zip(paths, cases, strict=True):
        if type(case) is not type(cases[0]):
            advice = "Compare cases of one kind."
            raise ValueError(f"{path}, {paths[0]}: one has one axis, the other is a machine with [rotor]. {advice}")
    names = [case.name for case in cases]
    return [
        case if names.count(case.name) == 1 else dataclasses.replace(case, name=f"{case.name} ({n})")
        for n, case in enumerate(cases, 1)
    ]


def _differences(paths: Sequence[str], cases: Sequence[AnyCase], studies: Sequence[AnyStudy]) -> list[str]:
    """Note the cases that differ in more than the laws and the method. Raises ValueError if the spreads differ."""
    first, notes = studies[0].fingerprint(), []
    for path, case, study in zip(paths[1:], cases[1:], studies[1:], strict=True):
        other = study.fingerprint()
        differing = [name for name in {**first, **other} if first.get(name) != other.get(name)]
        names = [name for name in differing if not MAY_DIFFER.match(name)]
        spread = [name for name in names if name.startswith("spread.")]
        if spread:
            own, its = (
                dict(one.spread.entries).get(spread[0].removeprefix("spread."), facts.get(spread[0], "none"))
                for one, facts in ((study, other), (studies[0], first))
            )
            why = "the members would not be the same. Give both cases the same [spread]."
            raise ValueError(f"{path}: {spread[0]} = {own}, and {paths[0]} has {its}: {why}")
        if names:
            shown = [f"{name} ({first.get(name, 'none')} and {other.get(name, 'none')})" for name in names[:6]]
            shown += [f"{len(names) - 6} more"] * (len(names) > 6)
            notes.append(f"{cases[0].name} and {case.name} differ in more than the laws: {', '.join(shown)}")
    return notes


def _compared(case: AnyCase, study: Study | MachineStudy) -> Compared:
    with doing(f"{case.name}: linearising and simulating the loops of the members; {FIRST_RUN}"):
        loop, columns = _linear(case, study), _columns(case, study)
        flops = _flops(case) if isinstance(case, Case) else None
        return Compared(case, columns, loop, flops, findings_of(study, columns))


def _columns(case: AnyCase, study: AnyStudy) -> dict[str, np.ndarray]:
    """Simulate the members, with a progress bar, and return their columns [N] by name."""
    size, parts = min(CHUNK, study.members), []
    shown = {"unit": "member", "unit_scale": True, "delay": 2, "leave": False, "desc": case.name}
    with tqdm(total=study.members, disable=is_quiet(), **shown) as bar:
        for start in range(0, study.members, size):
            stop = min(start + size, study.members)
            parts.append(chunk(study, start, stop, size))
            bar.update(stop - start)
    return {name: np.concatenate([np.asarray(part[name]) for part in parts]) for name in parts[0]}


def _linear(case: AnyCase, study: Study | MachineStudy) -> ComparedLoop:
    """Analyse the nominal loop and, if a case of one axis has a spread, its first members."""
    try:
        if isinstance(case, MachineCase):
            return loop_of_machine(sensitivity(case))
        point = operating_point(case, "nominal", 0.0)
    except ValueError as error:
        say(f"{case.name}: {error}")
        return ComparedLoop({"stable": None})
    drawn = spread_peaks(case, study, MEMBERS) if isinstance(study, Study) and case.spread.entries else None
    return loop_of_axis(point, drawn)


def _flops(case: Case) -> int | None:
    """Return the floating-point operations of a step of the exported controller; None if it cannot be exported."""
    if not case.cascade.sampled:
        return None
    try:
        controller = controller_of(guarded_for(case), case.scenario.command_limit, float(case.clock.sample_period))
        return trace(controller, "float").flops()
    except ValueError as error:
        say(f"{case.name}: the cost of a step cannot be computed ({error})")
        return None


def _drawn(compared: Sequence[Compared]) -> Any:
    from ambjax.pictures import frequency

    loops = [(first_axis(one.case), one.loop.system) for one in compared]
    spans = [shown_band(case, [system] if system else []) for case, system in loops]
    span = min(low for low, _ in spans), max(high for _, high in spans)
    return frequency.comparison_figure(compared, compared[0].case.zones.limits, span)
