"""The facts of a search: the record from which the verdict, the report and report.json derive.

report.json also contains a checksum of all that its results depend on. By it, `--resume` finds that a search has ended,
and does not judge its answer again.
"""

import dataclasses
import json
import math
import pathlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from ambjax.cases.reader import Case
from ambjax.host.sealed import checksum_of, flat, provenance
from ambjax.text.words import markdown_table
from tuning.problem.config import Tune, settings
from tuning.solve.checkpoint import has_unfinished_search

KEY, TUNED = "record", "tuned.toml"
# This file is written after the search. The search has ended if the file is newer than all checkpoints.
REPORT = "report.json"
# Verdict in tuned.toml until the gains are judged.
NOT_JUDGED = "The tuned gains are not judged."
# A row, or a nested table, of report.json.
Row = dict[str, Any]
# A column of a table: the key of a row and the format of its number, or a function of the row.
Column = tuple[str, str] | Callable[[Row], str]
# Fields that report.json leaves out if they are None.
OPTIONAL = ("front", "sensitivity", "stability")


def number(x: float | None, form: str = ".4g") -> str:
    """Return a number as text; '-' for None and NaN."""
    return "-" if x is None or math.isnan(x) else format(x, form)


def table(rows: Sequence[Row], columns: Mapping[str, Column]) -> str:
    """Return a Markdown table of these rows. `columns`: by their heads."""

    def cell(row: Row, column: Column) -> str:
        if callable(column):
            return column(row)
        value = row[column[0]]
        return (value or "-") if isinstance(value, str) else number(value, column[1])

    cells = [[cell(row, column) for column in columns.values()] for row in rows]
    return "\n".join(markdown_table(list(columns), cells))


@dataclasses.dataclass(frozen=True)
class TuningFacts:
    """What a search found. Each field is a key of report.json.

    `before`, `after`: the held-out members under the case's gains and the tuned ones. `refuted`: why accurate steps
    contradict the answer; '' if they confirm it. `stability`: of the held-out members with the largest settled errors
    (`ambjax.linear.Findings`). `front_written`: whether each point of the front has a case file. `next`: the next
    command, in words. What was not computed is None or empty.
    """

    case: str
    before: Row
    after: Row
    held_out_seed: int
    trained_on: int
    lost_in_training: int
    limits: list[Row]
    sensitivity: Row | None
    conditions: list[Row]
    advice_on_conditions: list[str]
    step_error: Row | None
    worst_step_error: Row | None
    worst_member: Row | None
    accurate_steps: str
    nominal_steps: str
    refuted: str
    verified: bool
    verified_reason: str
    lost_in_validation: int
    search: Row
    gains: list[Row]
    front: list[Row] | None
    front_written: bool = False
    stability: Row | None = None
    outcome: Row = dataclasses.field(default_factory=dict)
    verdict: str = ""
    advice: str = ""
    next: str = ""

    @property
    def table(self) -> Row:
        """The content of report.json."""
        return {name: value for name, value in vars(self).items() if value is not None or name not in OPTIONAL}


def search_facts(raw: dict[str, Any], case: Case, tune: Tune) -> Row:
    """Return what a checkpoint must match: the case, [tune], and the contents of the other files of the case.

    `raw`: content of the case file.
    """
    laws = {law.stage: law.digest for law in case.own_laws}
    names = {"controller.position.file": "position"}
    laws |= {names.get(one.key, one.key): one.contents.digest for one in case.files}
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
