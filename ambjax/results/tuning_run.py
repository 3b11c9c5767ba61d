"""The tuner as a function of `ambjax`. It is loaded through its entry point, so `ambjax` does not import it."""

import importlib
import importlib.metadata
import pathlib
from typing import Any

from ambjax.host.extensions import GROUP


def tune(case: str | pathlib.Path, out: str | pathlib.Path | None = None, **options: Any) -> Any:
    """Tune the gains of a case file, as `ambjax tune` does. Return the result of `tuning.tune`, a `TunedCase`.

    - `case`: path of the case file; its table [tune] sets what is tuned.
    - `out`: directory of the results; None: a new one under ./out.
    - `options`: see `tuning.tune`.

    Raises ValueError for bad input, or if the tuner is not installed.
    """
    found = tuple(importlib.metadata.entry_points(group=GROUP, name="tune"))
    if not found:
        raise ValueError("ambjax.tune: the tuner is not installed. Reinstall ambjax with pip.")
    package = importlib.import_module(found[0].module.partition(".")[0])
    return package.tune(case, out, **options)
