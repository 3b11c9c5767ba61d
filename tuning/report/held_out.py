"""The held-out members in the report: metrics before and after, also with accurate steps, and the worst member."""

import math

from ambjax.text.web_page import markdown_table
from tuning.report.facts import SUMMARY_METRICS, Row, TuningFacts


def number_text(x: float | None, form: str = ".5g") -> str:
    """Return a number as text; '-' for None and NaN."""
    return "-" if x is None or math.isnan(x) else format(x, form)


def section(facts: TuningFacts) -> list[str]:
    """Return the section on the held-out members."""
    before, after = facts.before, facts.after
    if not after["members"]:
        return ["There is no held-out ensemble (tune.held_out = 0).", ""]
    again = facts.accurate
    head = ["", "before", "after"]
    if again:
        head += [f"after, {again['held']} members", "with accurate steps", "difference"]
    rows = [
        [f"`{name}`", number_text(before.get(name), ".4g"), number_text(after.get(name), ".4g"), *_again(again, name)]
        for name in SUMMARY_METRICS
        if name in after or name in before
    ]
    rows += [[name, str(before[name]), str(after[name]), *_statuses(again, name)] for name in ("lost", "stalled")]
    rows.append(["survival, 95 % interval", *map(_survival, (before, after)), *(["-"] * 3 if again else [])])
    lines = [
        f"## {after['members']} held-out members (seed {facts.held_out_seed})",
        "",
        *markdown_table(head, rows),
        "",
    ]
    words = ["The metrics include only the members that are held.", *_accurate(again), *_worst(facts.worst_member), ""]
    return [*lines, *words]


def _worst(worst: Row | None) -> list[str]:
    """Describe the worst member, with the command that simulates it alone."""
    if worst is None:
        return []
    status = f"largest settled error {worst['settled_max_abs_error_m']:.4g} m"
    if math.isfinite(worst["lost_at_s"]):
        status = f"it ends at {worst['lost_at_s']:.4g} s"
    line = f"The worst is member {worst['member']}: {status}."
    return ["", f"{line} In the folder of this report: `{worst['replay']}`" if worst["replay"] else line]


def _again(again: Row | None, name: str) -> list[str]:
    """Return the cells of a metric: its values with both steps, and the relative difference, in bold if it is large."""
    if again is None:
        return []
    pair = again["metrics"].get(name)
    if pair is None:
        return ["-"] * 3
    off = f"{100 * pair['relative']:.2g} %"
    marked = abs(pair["relative"]) > again["marked_beyond"]
    return [f"{pair['report']:.4g}", f"{pair['accurate']:.4g}", f"**{off}**" if marked else off]


def _statuses(again: Row | None, name: str) -> list[str]:
    return (
        [] if again is None else [f"{again[name][way]} of {again['members']}" for way in ("report", "accurate")] + ["-"]
    )


def _accurate(again: Row | None) -> list[str]:
    if again is None:
        return []
    if not again["metrics"]:
        return ["No member is held with both steps: accurate steps confirm no number of this table."]
    marked = [name for name, pair in again["metrics"].items() if abs(pair["relative"]) > again["marked_beyond"]]
    words = f"The last three columns compare {again['held']} members with simulations by adaptive RODAS3. "
    if not marked:
        return [f"{words}No difference exceeds {100 * again['marked_beyond']:g} %."]
    return [
        f"{words}Differences above {100 * again['marked_beyond']:g} % are in bold. For these metrics, use the values "
        "with accurate steps. With sliding steps, raise tune.substeps."
    ]


def _survival(one: Row) -> str:
    if isinstance(one["survival"], str):
        return one["survival"]
    return f"{one['survival']:.4f} ({one['survival_low']:.4f} to {one['survival_high']:.4f})"
