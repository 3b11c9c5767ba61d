"""The facts of a search: the record from which the verdict, the report and report.json derive."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ambjax.text.web_page import markdown_table

# A row, or a nested table, of report.json.
Row = dict[str, Any]
# A column of a table: the key of a row and the format of its number, or a function of the row.
Column = tuple[str, str] | Callable[[Row], str]
# Fields that report.json leaves out if they are None.
OPTIONAL = ("front", "sensitivity", "stability")


def number(x: float | None, form: str = ".4g") -> str:
    """Return a number as text; '-' for None and NaN."""
    return "-" if x is None or math.isnan(x) else format(x, form)


def table(rows: Sequence[Row], columns: Mapping[str, Column]) -> list[str]:
    """Return a Markdown table of these rows. `columns`: by their heads."""

    def cell(row: Row, column: Column) -> str:
        if callable(column):
            return column(row)
        value = row[column[0]]
        return (value or "-") if isinstance(value, str) else number(value, column[1])

    return markdown_table(list(columns), [[cell(row, column) for column in columns.values()] for row in rows])


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
        rows = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in rows.items() if value is not None or name not in OPTIONAL}
