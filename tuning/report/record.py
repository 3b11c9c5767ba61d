"""The facts on which the results of a search depend, and the record of them in report.json.

With this record, `--resume` finds that a search has ended, and does not judge its answer again.
"""

import json
import pathlib
from collections.abc import Iterable
from typing import Any

from ambjax.host.sealed import checksum_of
from tuning.problem.config import settings
from tuning.problem.tuning_problem import TuningProblem
from tuning.report.facts import Row
from tuning.solve.checkpoint import CheckpointFile, has_unfinished_search

KEY, TUNED = "record", "tuned.toml"
# This file is written after the search. The search has ended if the file is newer than all checkpoints.
REPORT = "report.json"
# Options that add results.
OPTIONS = ("pareto", "page")


def search_facts(raw: dict[str, Any], problem: TuningProblem) -> dict[str, Any]:
    """Return what a checkpoint must match: the case, [tune], and the contents of the other files of the case.

    `raw`: content of the case file.
    """
    case = problem.case
    laws = {law.stage: law.digest for law in case.own_laws}
    if case.controller_file:
        laws["position"] = case.controller_file.contents.digest
    laws |= {one.key: one.samples.digest for one in case.recorded}
    return {"case": raw, "tune": settings(problem.tune), "laws": laws}


def record(facts: dict[str, Any], options: Any, folder: pathlib.Path) -> Row:
    """Return the record: the SHA-256 of the facts, of the options, and of tuned.toml in `folder`."""
    return {KEY: _checksum(facts, options, folder)}


def ended(facts: dict[str, Any], options: Any, out: pathlib.Path, names: Iterable[str]) -> Row | None:
    """Return the content of report.json in `out` if a search with these facts and options has ended there, else None.

    `out` must still contain the files `names`, and tuned.toml as it was written.
    """
    try:
        found = json.loads((out / REPORT).read_text(encoding="utf-8"))
        same = found[KEY] == _checksum(facts, options, out)
    except (OSError, ValueError, KeyError, TypeError):  # there is no such record
        return None
    whole = same and all((out / name).exists() for name in names)
    return found if whole and not has_unfinished_search(out, REPORT) else None


def _checksum(facts: dict[str, Any], options: Any, folder: pathlib.Path) -> str:
    more = {name: getattr(options, name) for name in OPTIONS} | {"text": (folder / TUNED).read_text(encoding="utf-8")}
    return checksum_of(CheckpointFile(None, facts | more).fingerprint)
