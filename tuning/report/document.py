"""The report of `ambjax tune` in Markdown."""

import functools
import math
from collections.abc import Callable

from ambjax.results.outputs import described
from ambjax.text.web_page import escape_markdown, markdown_table
from tuning.report import front_table, held_out, limit_table, sensitivity_table
from tuning.report.facts import Row, TuningFacts
from tuning.report.limit_table import broken, prices


def report_markdown(facts: TuningFacts) -> str:
    """Return the text of report.md: the answer in five lines, the front, and all details.

    Its pictures are files in the same folder.
    """
    lines = [f"# Tuning of {escape_markdown(facts.case)}", "", *answer_lines(facts)]
    for name, section in SECTIONS.items():
        lines += described(f"the section on {name} of the report", functools.partial(section, facts)) or []
    return "\n".join(lines) + "\n"


def answer_lines(facts: TuningFacts) -> list[str]:
    """Return five list items and an empty line: held or not, error and voltage, sensitivity, limits, next command."""
    items = {"members": _held, "error": _sizes, "sensitivity": _peaks, "limits": _limiting, "next command": _next}
    lines = [described(f"the line on the {name}", functools.partial(line, facts)) for name, line in items.items()]
    return [*(f"- {line}" for line in lines if line), ""]


def _held(facts: TuningFacts) -> str:
    """Return the item on the rotors that are held, and on the requirements."""
    outcome, after = facts.outcome, facts.after
    word = "NOT held" if not outcome["rotors_held"] else "Not verified" if facts.refuted else "Held"
    which = "held-out members" if after["members"] else "training members"
    kept = outcome["members"] - outcome["lost"] - outcome["stalled"]
    words = f"**{word}:** {kept} of {outcome['members']} {which} are held"
    if facts.before["members"]:
        words += f" (before tuning: {facts.before['held']})"
    met = "All requirements are met." if outcome["good"] else f"Not met: {'; '.join(outcome['against'])}."
    return f"{words}. {met}"


def _sizes(facts: TuningFacts) -> str:
    """Return the item on the error and the voltage after tuning, and before it."""
    after, before = facts.after, facts.before
    if not after["members"]:
        return "**Error and voltage:** not measured on held-out members (tune.held_out = 0)."
    if not after["held"]:
        return "**Error and voltage:** no held-out member is held."

    def change(name: str, unit: str) -> str:
        was = f" (before: {before[name]:.3g})" if before["held"] else ""
        return f"{after[name]:.3g} {unit}{was}"

    most = after.get("max_abs_u_V.largest")
    return (
        f"**Error:** {change('settled_rms_error_m', 'm')} rms after settling, largest "
        f"{after['settled_max_abs_error_m']:.3g} m. **Voltage:** {change('settled_rms_u_V.mean', 'V')} rms"
        f"{'' if most is None else f', largest {most:.3g} V'}."
    )


def _peaks(facts: TuningFacts) -> str:
    return sensitivity_table.line(facts.sensitivity)


def _limiting(facts: TuningFacts) -> str:
    """Return the item on the limits that are not held or active, and on the gains at a bound."""
    words = [escape_markdown(line) for line in (*broken(facts.limits), *prices(facts.limits))]
    if ends := [row["path"] for row in facts.gains if row["at_bound"]]:
        words.append(f"gains at a bound of `[tune.bounds]`: {', '.join(ends)}")
    if not words:
        front = "the trade-off between error and voltage (table below); " if len(facts.front or ()) > 1 else ""
        words = [f"{front}no limit of `[tune.limits]` is active, and no gain is at a bound"]
    return f"**Limited by:** {'; '.join(words)}."


def _next(facts: TuningFacts) -> str:
    """Return the next command, or the advice if a requirement is not met."""
    if facts.advice:
        return f"**Next:** {escape_markdown(facts.advice)}"
    return f"**Next:** in this folder, {facts.next}"


def _verdict(facts: TuningFacts) -> list[str]:
    return ["## Verdict in full", "", facts.verdict, ""]


def _gains(facts: TuningFacts) -> list[str]:
    """Return the sections on the gains and on the nominal run."""
    ranged = any(row.get("source") for row in facts.gains)
    looked = ["searched from", "to"] if ranged else []
    head = ["gain", "before", "after", *looked, "allowed from", "to", "at a bound", "risk increase"]
    rows = []
    for row in facts.gains:
        ends = [_number(row.get(end), ".3g") for end in ("low", "high")] if ranged else []
        bounds = [_number(row.get(end), ".3g") for end in ("least", "most")]
        gains = f"{row['before']:.6g}", f"{row['after']:.6g}"
        rows.append([row["path"], *gains, *ends, *bounds, row["at_bound"] or "-", _sensitivity(row, facts)])
    lines = ["## Gains", "", *markdown_table(head, rows), ""]
    words = (
        "Last column: increase of the risk if this gain alone is larger or smaller by a factor of e^0.25 = 1.28. The "
        "larger of the two increases is shown. Here the risk is that of the search of least error: it includes the "
        "stressed members and the penalty of the theorem's conditions, but not the limits. A gain with a large "
        "increase must be set accurately. If this change loses more members of the training ensemble than the "
        "answer does, the column shows how many more. "
        "`tune.bounds` sets other bounds."
    )
    sources = [f"- {row['path']}: {escape_markdown(row['source'])}" for row in facts.gains if row.get("source")]
    return [
        *lines,
        words,
        "",
        *(["Sources of the ranges:", "", *sources, ""] if sources else []),
        "## One rotor before and after",
        "",
        f"The nominal run of the case, without `[spread]`, {facts.nominal_steps}. u is averaged over each sample.",
        "",
        "![z - r and u before tuning](before.png)",
        "",
        "![z - r and u after tuning](after.png)",
        "",
        "Amplitude spectrum of the voltage from `run.settle` on (Hann window). A sine with an amplitude of 1 V has a "
        "peak of 1 V.",
        "",
        "![Amplitude spectrum of u before and after tuning](spectrum.png)",
        "",
    ]


def _sensitivity(row: Row, facts: TuningFacts) -> str:
    """Return the increase of the risk, or the number of further members lost, if a gain changes by a factor of 1.28."""
    if row.get("sensitivity_lost"):
        return f"**{row['sensitivity_lost']} of {facts.trained_on} training members are also lost**"
    return "-" if row["sensitivity_percent"] is None else f"{row['sensitivity_percent']:.3g} %"


def _objective(facts: TuningFacts) -> list[str]:
    """Return the section on the objective around the answer."""
    if facts.beside is None:
        return []
    return [
        "## Objective along each gain",
        "",
        "The objective is that of the search: stressed members must be held, but their error does not count.",
        "",
        "![Objective along each gain, through the answer](slices.png)",
        "",
        _lower_point(facts.beside),
        "",
    ]


def _lower_point(beside: Row) -> str:
    """Return a sentence on the point of the slices with the lowest objective."""
    if beside["lower"] == 0:
        return "No point of these slices has a lower objective without losing more members than the answer."
    return (
        f"The lowest point of these slices is {100 * beside['lower']:.2g} % lower, at {beside['path']} = "
        f"{beside['gain']:.4g}, and loses no more members. It was not verified. To continue from it, set the gain in "
        "tuned.toml and tune that file."
    )


def _number(x: float | None, form: str = ".5g") -> str:
    """Return a number as text; '-' for None and NaN."""
    return "-" if x is None or math.isnan(x) else format(x, form)


def _conditions(facts: TuningFacts) -> list[str]:
    """Return the section on the conditions of Theorem 1, left > right."""
    if not facts.conditions:
        return []
    rows = []
    for row in facts.conditions:
        gain, margin = (_number(x) for x in (row["gain"], row["margin"]))
        verdict = {True: "holds", False: "FAILS", None: "-"}[row["holds"]]
        rows.append([row["requires"], gain, _number(row["against"]), margin, row["unit"], verdict])
    head = ["condition", "left", "right", "margin", "unit", "verdict"]
    lines = ["## Conditions of Theorem 1 along the nominal run", "", *markdown_table(head, rows), ""]
    if facts.advice_on_conditions:
        lines += [f"- {escape_markdown(line)}" for line in facts.advice_on_conditions] + [""]
    return lines


def _course(facts: TuningFacts) -> list[str]:
    """Return the section on the search: its settings, its cost, and the error of its steps."""
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
    picture = "![Goal and gains by iteration](convergence.png)"
    return ["## Course of the search", "", *lines, "", picture, ""]


# The sections of the report, in order.
SECTIONS: dict[str, Callable[[TuningFacts], list[str]]] = {
    "the front": lambda facts: front_table.section(facts.front, facts.front_written),
    "the verdict": _verdict,
    "the limits": lambda facts: limit_table.section(facts.limits),
    "the sensitivity": lambda facts: sensitivity_table.section(facts.sensitivity),
    "the gains": _gains,
    "the held-out members": held_out.section,
    "the objective": _objective,
    "the conditions of Theorem 1": _conditions,
    "the search": _course,
}
