"""The report of `ambjax tune` in Markdown."""

import functools
import math
from collections.abc import Callable

from ambjax.results.outputs import described
from ambjax.text.web_page import escape_markdown
from ambjax.text.words import markdown_table
from tuning.report import front_table, limit_table, sensitivity_table
from tuning.report.facts import Column, Row, TuningFacts, number, table
from tuning.report.outcome import answer

# Metrics shown before and after; all others are in report.json.
SUMMARY_METRICS = (
    "settled_rms_error_m", "settled_rms_error_worst_member_m", "settled_max_abs_error_m", "settled_rms_u_V.mean",
    "max_abs_u_V.largest", "max_abs_i_A.largest", "chatter_V.mean", "clearance_used.largest",
)  # fmt: skip


def report_markdown(facts: TuningFacts) -> str:
    """Return the text of report.md: the verdict, the answer and the next command in five lines, and all details.

    Its pictures are files in the same folder.
    """
    said = [f"- **{label}:** {escape_markdown(text)}" for label, text in answer(facts).items()]
    said.append(f"- **Next:** {escape_markdown(facts.advice) or f'in this folder, {facts.next}'}")
    parts = [f"# Tuning of {escape_markdown(facts.case)}", escape_markdown(facts.outcome["text"]), "\n".join(said)]
    for name, section in SECTIONS.items():
        parts += described(f"the section on {name} of the report", functools.partial(section, facts)) or []
    return "\n\n".join(parts) + "\n"


def _gains(facts: TuningFacts) -> list[str]:
    columns: dict[str, Column] = {
        "gain": ("path", ""), "before": ("before", ".6g"), "after": ("after", ".6g"),
        "searched from": ("low", ".3g"), "searched to": ("high", ".3g"),
        "allowed from": ("least", ".3g"), "allowed to": ("most", ".3g"),
        "at a bound": ("at_bound", ""), "risk increase": functools.partial(_sensitivity, trained_on=facts.trained_on),
    }  # fmt: skip
    return [
        "## Gains",
        table(facts.gains, columns),
        "Last column: increase of the risk of least error, without the limits, if this gain alone is larger or smaller "
        "by a factor of e^0.25 = 1.28, whichever is worse; or the number of training members that are then also lost. "
        "`tune.bounds` sets other bounds.",
        "Sources of the ranges:",
        "\n".join(f"- {row['path']}: {escape_markdown(row['source'])}" for row in facts.gains),
        "## One rotor before and after",
        f"The nominal run of the case, without `[spread]`, {facts.nominal_steps}. u is averaged over each sample.",
        "![z - r and u before tuning](before.png)",
        "![z - r and u after tuning](after.png)",
        "Amplitude spectrum of the voltage from `run.settle` on (Hann window).",
        "![Amplitude spectrum of u before and after tuning](spectrum.png)",
    ]


def _sensitivity(row: Row, trained_on: int) -> str:
    """Return the increase of the risk, or the number of further members lost, if a gain changes by a factor of 1.28."""
    if row["sensitivity_lost"]:
        return f"**{row['sensitivity_lost']} of {trained_on} training members are also lost**"
    return "-" if row["sensitivity_percent"] is None else f"{row['sensitivity_percent']:.3g} %"


def _held_out(facts: TuningFacts) -> list[str]:
    both = facts.before, facts.after
    if not facts.after["members"]:
        return ["There is no held-out ensemble (tune.held_out = 0)."]
    names = [name for name in SUMMARY_METRICS if any(name in one for one in both)]
    rows = [[f"`{name}`", *(number(one.get(name)) for one in both)] for name in names]
    rows += [[name, *(str(one[name]) for one in both)] for name in ("lost", "stalled")]
    rows.append(["survival, 95 % interval", *map(_survival, both)])
    return [
        f"## {facts.after['members']} held-out members (seed {facts.held_out_seed})",
        "\n".join(markdown_table(["", "before", "after"], rows)),
        "The metrics include only the members that are held.",
        *_worst(facts.worst_member),
    ]


def _worst(worst: Row | None) -> list[str]:
    if worst is None:
        return []
    status = f"largest settled error {worst['settled_max_abs_error_m']:.4g} m"
    if math.isfinite(worst["lost_at_s"]):
        status = f"it ends at {worst['lost_at_s']:.4g} s"
    replay = f" In the folder of this report: `{worst['replay']}`" if worst["replay"] else ""
    return [f"The worst is member {worst['member']}: {status}.{replay}"]


def _survival(one: Row) -> str:
    if isinstance(one["survival"], str):
        return one["survival"]
    return f"{one['survival']:.4f} ({one['survival_low']:.4f} to {one['survival_high']:.4f})"


def _conditions(facts: TuningFacts) -> list[str]:
    if not facts.conditions:
        return []
    columns: dict[str, Column] = {
        "condition": ("requires", ""),
        "left": ("gain", ".5g"),
        "right": ("against", ".5g"),
        "margin": ("margin", ".5g"),
        "unit": lambda row: row["unit"],
        "verdict": lambda row: {True: "holds", False: "FAILS", None: "-"}[row["holds"]],
    }
    advice = "\n".join(f"- {escape_markdown(line)}" for line in facts.advice_on_conditions)
    heading = "## Conditions of Theorem 1 along the nominal run"
    return [heading, table(facts.conditions, columns), *([advice] if advice else [])]


def _course(facts: TuningFacts) -> list[str]:
    how = facts.search
    lines = [
        f"- risk: {how['risk']} over {how['members']} members (seed {how['seed']})",
        f"- {how['iterations']} iterations, {how['rollouts']} simulated rollouts "
        f"(a gradient of m gains counts m + 1), {how['seconds']:.0f} s",
    ]
    if error := facts.step_error:
        lines.append(
            f"- steps of the search compared with {facts.accurate_steps}, at the answer: {error['text']} "
            f"({error['search_m']:.4e} m against {error['reference_m']:.4e} m)"
        )
    return ["## Course of the search", "\n".join(lines), "![Goal and gains by iteration](convergence.png)"]


# The sections of the report, in order: functions that return the paragraphs.
SECTIONS: dict[str, Callable[[TuningFacts], list[str]]] = {
    "the front": lambda facts: front_table.section(facts.front, facts.front_written),
    "the limits": lambda facts: limit_table.section(facts.limits),
    "the sensitivity": lambda facts: sensitivity_table.section(facts.sensitivity),
    "the gains": _gains,
    "the held-out members": _held_out,
    "the conditions of Theorem 1": _conditions,
    "the search": _course,
}
