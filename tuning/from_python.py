"""`tune`: the command `ambjax tune` as a function."""

import contextlib
import pathlib

from ambjax.cases.reader import require_file
from ambjax.host.arguments import names_arguments
from tuning.command import Options, TunedCase, run
from tuning.events import Listener, Log


@names_arguments(budget="minutes")
def tune(
    case: str | pathlib.Path,
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

    - `case`: path of the case file. Its table [tune] selects the gains, the limits and the budget.
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
    for name, path in (("case", case), ("out", out), ("settings_of", settings_of)):
        if path is not None or name == "case":
            require_file(name, path)
    paths = (None if path is None else str(path) for path in (out, settings_of))
    directory, other = paths
    options = Options(directory, resume, force, pareto, page, other, minutes)
    with contextlib.ExitStack() as stack:
        return run(str(case), options, listen or stack.enter_context(Log()))
