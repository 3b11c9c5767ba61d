"""The facts of a search: the record from which the verdict, the report and report.json derive."""

import dataclasses
import math
from typing import Any

# A row, or a nested table, of report.json.
Row = dict[str, Any]
# Metrics shown before and after; all others are in report.json.
SUMMARY_METRICS = (
    "settled_rms_error_m",
    "settled_rms_error_worst_member_m",
    "settled_max_abs_error_m",
    "settled_rms_u_V.mean",
    "max_abs_u_V.largest",
    "max_abs_i_A.largest",
    "chatter_V.mean",
    "clearance_used.largest",
)
# Fields that report.json leaves out if they are None.
OPTIONAL = ("front", "sensitivity", "stability")


def number(x: float | None, form: str = ".4g") -> str:
    """Return a number as text; '-' for None and NaN."""
    return "-" if x is None or math.isnan(x) else format(x, form)


@dataclasses.dataclass(frozen=True)
class TuningFacts:
    """What a search found. Each field is a key of report.json.

    `before`, `after`: the held-out members under the case's gains and the tuned ones. `refuted`: why accurate steps
    contradict the answer; '' if they confirm it.
    `stability`: of the held-out members with the largest settled errors (`ambjax.linear.Findings`); None if
    no member was judged. `front`: of error against voltage; None if it was not traced. `front_written`: whether each of
    its points has a case file. `sensitivity`: peaks of |S| of some held-out members; None if no limit needs it.
    `next`: the next command, in words. `conditions` is empty if they could not be computed.
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
