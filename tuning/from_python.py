"""`tune`: the command `ambjax tune` as a function."""

import argparse
import dataclasses
import pathlib
from typing import Any

from ambjax import Case, read_case
from ambjax.cases.reader import require_file
from ambjax.host.arguments import names_arguments


@dataclasses.dataclass(frozen=True)
class TunedCase:
    """The result of `tune`.

    - `case`: the case with the tuned gains, as read from tuned.toml.
    - `good`: whether the gains meet all requirements: [tune.limits], and confirmation by accurate steps.
    - `report`: the contents of report.json.
    - `directory`: directory of tuned.toml, history.npz and the report.
    """

    case: Case
    good: bool
    report: dict[str, Any]
    directory: pathlib.Path


@names_arguments()
def tune(
    case: str | pathlib.Path,
    out: str | pathlib.Path | None = None,
    *,
    resume: bool = False,
    force: bool = False,
    gradients: bool = False,
    pareto: bool = False,
    page: bool = False,
    settings_of: str | pathlib.Path | None = None,
) -> TunedCase:
    """Tune the gains of a case file, as `ambjax tune` does, and write the same files.

    - `case`: path of the case file. Its table [tune] selects the gains, the limits and the budget.
    - `out`: directory of the results; None: a new one under ./out.
    - `resume`: continue the search whose checkpoints are in `out`.
    - `force`: overwrite the files of an earlier search in `out`.
    - `gradients`: also report the gradient of the loss.
    - `pareto`: write each point of the front of error against voltage as a case file.
    - `page`: also write page.html, with sliders and presets; the case needs [processor] (extra `[page]`).
    - `settings_of`: path of another case file, whose limits, loss and budget replace those of `case`.

    Prints progress to stderr and returns a `TunedCase`. Raises ValueError for an invalid case or option before any
    search, and in the search if the loss is not finite at any starting point.
    """
    from tuning.command import run

    for name, path in (("case", case), ("out", out), ("settings_of", settings_of)):
        if path is not None or name == "case":
            require_file(name, path)
    code, report = run(
        argparse.Namespace(
            case=str(case),
            out=None if out is None else str(out),
            resume=resume,
            force=force,
            gradients=gradients,
            pareto=pareto,
            page=page,
            settings_of=None if settings_of is None else str(settings_of),
            json=True,
        )
    )
    directory = pathlib.Path(str(report["out"]))
    return TunedCase(read_case(directory / "tuned.toml"), code == 0, report, directory)
