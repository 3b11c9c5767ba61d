"""The tuner as a function of `ambjax`. It is loaded through its entry point, so `ambjax` does not import it."""

import importlib
import pathlib
from typing import Any

from ambjax.host.extensions import extension


def tune(case: str | pathlib.Path, out: str | pathlib.Path | None = None, **options: Any) -> Any:
    """Tune the gains of a case file, as `ambjax tune` does. Return the result of `tuning.tune`, a `TunedCase`.

    - `case`: path of the case file; its table [tune] sets what is tuned.
    - `out`: directory of the results; None: a new one under ./out.
    - `options`: `minutes`, `listen`, `resume`, `force`, `pareto`, `page`, `settings_of`: see `tuning.tune`.

    Raises ValueError for bad input, or if the tuner is not installed.

        tuned = ambjax.tune("my.toml", "tuned", minutes=10)
        tuned.good, tuned.case  # whether the gains meet all requirements, and the case with them
    """
    package = importlib.import_module(extension("tune").__module__.partition(".")[0])
    return package.tune(case, out, **options)
