"""The facts on which the results of a search depend, and the record of them in report.json.

With this record, `--resume` finds that a search has ended, and does not judge its answer again.
"""

import json
import pathlib
from collections.abc import Iterable
from typing import Any

from ambjax.cases.reader import Case
from ambjax.host.sealed import checksum_of, flat, provenance
from tuning.problem.config import Tune, settings
from tuning.report.facts import Row
from tuning.solve.checkpoint import has_unfinished_search

KEY, TUNED = "record", "tuned.toml"
# This file is written after the search. The search has ended if the file is newer than all checkpoints.
REPORT = "report.json"


# Verdict in tuned.toml until the gains are judged.
NOT_JUDGED = "The tuned gains are not judged."


def search_facts(raw: dict[str, Any], case: Case, tune: Tune) -> Row:
    """Return what a checkpoint must match: the case, [tune], and the contents of the other files of the case.

    `raw`: content of the case file.
    """
    laws = {law.stage: law.digest for law in case.own_laws}
    if case.controller_file:
        laws["position"] = case.controller_file.contents.digest
    laws |= {one.key: one.samples.digest for one in case.recorded}
    return {"case": raw, "tune": settings(tune), "laws": laws}


def record(facts: Row, folder: pathlib.Path) -> str:
    """Return the SHA-256 of the facts, which include the options that add results, and of tuned.toml in `folder`."""
    text = (folder / TUNED).read_text(encoding="utf-8")
    return checksum_of(flat({**provenance(), **facts, "text": text}))


def ended(facts: Row, out: pathlib.Path, names: Iterable[str]) -> Row | None:
    """Return the content of report.json in `out` if a search with these facts (`record`) has ended there, else None.

    `out` must still contain the files `names`, and tuned.toml as it was written.
    """
    try:
        found = json.loads((out / REPORT).read_text(encoding="utf-8"))
        same = found[KEY] == record(facts, out)
    except (OSError, ValueError, KeyError, TypeError):  # there is no such record
        return None
    whole = same and all((out / name).exists() for name in names)
    return found if whole and not has_unfinished_search(out, REPORT) else None
