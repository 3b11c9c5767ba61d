"""The held-out members in the report: metrics before and after, and the worst member."""

import math

from ambjax.text.web_page import markdown_table
from tuning.report.facts import SUMMARY_METRICS, Row, TuningFacts


def section(facts: TuningFacts) -> list[str]:
    """Return the section on the held-out members."""
    before, after = facts.before, facts.after
    if not after["members"]:
        return ["There is no held-out ensemble (tune.held_out = 0).", ""]
    both = before, after
    rows = [
        [f"`{name}`", *(_number(one.get(name)) for one in both)]
        for name in SUMMARY_METRICS
        if name in after or name in before
    ]
    rows += [[name, *(str(one[name]) for one in both)] for name in ("lost", "stalled")]
    rows.append(["survival, 95 % interval", *map(_survival, both)])
    title = f"## {after['members']} held-out members (seed {facts.held_out_seed})"
    words = ["The metrics include only the members that are held.", *_worst(facts.worst_member), ""]
    return [title, "", *markdown_table(["", "before", "after"], rows), "", *words]


def _number(x: float | None) -> str:
    return "-" if x is None or math.isnan(x) else f"{x:.4g}"


def _worst(worst: Row | None) -> list[str]:
    """Describe the worst member, with the command that simulates it alone."""
    if worst is None:
        return []
    status = f"largest settled error {worst['settled_max_abs_error_m']:.4g} m"
    if math.isfinite(worst["lost_at_s"]):
        status = f"it ends at {worst['lost_at_s']:.4g} s"
    line = f"The worst is member {worst['member']}: {status}."
    return ["", f"{line} In the folder of this report: `{worst['replay']}`" if worst["replay"] else line]


def _survival(one: Row) -> str:
    if isinstance(one["survival"], str):
        return one["survival"]
    return f"{one['survival']:.4f} ({one['survival_low']:.4f} to {one['survival_high']:.4f})"
