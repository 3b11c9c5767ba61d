"""The report of a search in Markdown, from its facts."""

import dataclasses
import math
from typing import Any

import numpy as np

from ambjax.theorem.conditions import Report as Check
from tuning.objective.loss import TERMS
from tuning.report import extras, limit_table
from tuning.report.breakdown import FORMULA
from tuning.report.page import literal, table
from tuning.space import Space

Facts = dict[str, Any]
# Metrics shown before and after; all others are in report.json.
SHOWN = (
    "settled_rms_error_m",
    "settled_rms_error_worst_member_m",
    "settled_max_abs_error_m",
    "settled_rms_u_V.mean",
    "max_abs_u_V.largest",
    "max_abs_i_A.largest",
    "chatter_V.mean",
    "clearance_used.largest",
)
# Relative improvement below which a point of a slice counts as equal to the answer.
AS_GOOD = 0.01


def conditions(check: Check) -> list[Facts]:
    """Return the theorem's conditions as plain data."""
    return [dataclasses.asdict(line) | {"margin": line.margin} for line in check.conditions]


def gains_table(space: Space, before: np.ndarray, after: np.ndarray, sensitivity: np.ndarray | None) -> list[Facts]:
    """Return one row for each gain."""
    return [
        {
            "path": gain.path,
            "before": float(before[j]),
            "after": float(after[j]),
            "least": gain.low,
            "most": gain.high,
            "at_bound": gain.at_bound(float(after[j])),
            "sensitivity_percent": None if sensitivity is None else float(sensitivity[j]),
            "sensitivity_lost": 0,
        }
        for j, gain in enumerate(space.gains)
    ]


def markdown(facts: Facts) -> str:
    """Return the text of report.md. It refers to the pictures in the same folder."""
    lines = [f"# Tuning of {literal(facts['case'])}", "", facts["verdict"], ""]
    lines += (
        limit_table.section(facts.get("limits", []))
        + _gains(facts)
        + _held_out(facts)
        + _loss(facts)
        + _minimised(facts)
        + _conditions(facts)
    )
    lines += ["## How the search went", "", *_how(facts), "", "![Goal and gains by iteration](convergence.png)", ""]
    if facts.get("pareto"):
        lines += extras.pareto(facts["pareto"])
    if facts.get("gradient"):
        lines += extras.gradient(facts["gradient"])
    return "\n".join(lines) + "\n"


def _number(x: float | None, form: str = ".5g") -> str:
    return "-" if x is None or math.isnan(x) else format(x, form)


def _gains(facts: Facts) -> list[str]:
    ranged = any(row.get("source") for row in facts["gains"])
    looked = ["looked for from", "to"] if ranged else []
    head = ["gain", "before", "after", *looked, "may end from", "to", "at an end", "risk grows by"]
    rows = []
    for row in facts["gains"]:
        ends = [_number(row.get(end), ".3g") for end in ("low", "high")] if ranged else []
        bounds = [_number(row.get(end), ".3g") for end in ("least", "most")]
        gains = f"{row['before']:.6g}", f"{row['after']:.6g}"
        rows.append([row["path"], *gains, *ends, *bounds, row["at_bound"] or "-", _sensitivity(row, facts)])
    lines = ["## Gains", "", *table(head, rows), ""]
    words = (
        "The last column: where this gain alone is off by a factor of e^0.25 = 1.28, up or down, the worse of both. A "
        "large number: set it with care. A small one: it hardly matters. Where that loses members of the training "
        "ensemble that the answer holds, their number stands there, for the risk of a lost rotor is not that of an "
        "error. "
        "`tune.bounds` sets other ends."
    )
    sources = [f"- {row['path']}: {literal(row['source'])}" for row in facts["gains"] if row.get("source")]
    return [
        *lines,
        words,
        "",
        *(["Where these ranges come from:", "", *sources, ""] if sources else []),
        "## One rotor before and after",
        "",
        f"The case's own run, nothing spread, {facts.get('nominal_steps', 'by accurate steps')}; u averaged over each "
        "sample.",
        "",
        "![z - r and u before and after tuning](nominal.png)",
        "",
        "The voltage's amplitude spectrum (Hann window, from `run.settle` on): a sine of 1 V stands at 1 V.",
        "",
        "![Amplitude spectrum of u before and after tuning](spectrum.png)",
        "",
    ]


def _sensitivity(row: Facts, facts: Facts) -> str:
    """Describe the growth of the risk, or the additional lost members, when a gain is off."""
    if row.get("sensitivity_lost"):
        return f"**{row['sensitivity_lost']} of {facts['trained_on']} members lost**"
    return "-" if row["sensitivity_percent"] is None else f"{row['sensitivity_percent']:.3g} %"


def _held_out(facts: Facts) -> list[str]:
    before, after = facts["before"], facts["after"]
    if not after["members"]:
        return ["No held-out ensemble was asked for (tune.held_out = 0).", ""]
    again = facts.get("accurate")
    head = ["", "before", "after"]
    if again:
        head += [f"after, {again['held']} of them", "by accurate steps", "off by"]
    rows = [
        [f"`{name}`", _number(before.get(name), ".4g"), _number(after.get(name), ".4g"), *_again(again, name)]
        for name in SHOWN
        if name in after or name in before
    ]
    rows += [[name, str(before[name]), str(after[name]), *_statuses(again, name)] for name in ("lost", "stalled")]
    rows.append(["survival, 95 % interval", *map(_survival, (before, after)), *(["-"] * 3 if again else [])])
    lines = [f"## {after['members']} held-out members (seed {facts['held_out_seed']})", "", *table(head, rows), ""]
    words = ["Metrics are of the members that are held.", *_accurate(again), *_worst(facts.get("worst_member")), ""]
    return [*lines, *words]


def _worst(worst: Facts | None) -> list[str]:
    """Describe the worst member, with the command that simulates it alone."""
    if worst is None:
        return []
    status = f"largest settled error {worst['settled_max_abs_error_m']:.4g} m"
    if math.isfinite(worst["lost_at_s"]):
        status = f"it ends at {worst['lost_at_s']:.4g} s"
    line = f"The worst is member {worst['member']}: {status}."
    return ["", f"{line} In the folder of this report: `{worst['replay']}`" if worst["replay"] else line]


def _again(again: Facts | None, name: str) -> list[str]:
    """Return the cells of a metric with either steps and the relative error, in bold if it is large."""
    if again is None:
        return []
    pair = again["metrics"].get(name)
    if pair is None:
        return ["-"] * 3
    off = f"{100 * pair['relative']:.2g} %"
    marked = abs(pair["relative"]) > again["marked_beyond"]
    return [f"{pair['report']:.4g}", f"{pair['accurate']:.4g}", f"**{off}**" if marked else off]


def _statuses(again: Facts | None, name: str) -> list[str]:
    return (
        [] if again is None else [f"{again[name][way]} of {again['members']}" for way in ("report", "accurate")] + ["-"]
    )


def _accurate(again: Facts | None) -> list[str]:
    if again is None:
        return []
    if not again["metrics"]:
        return ["No member is held by accurate steps too: nothing in this table is confirmed."]
    marked = [name for name, pair in again["metrics"].items() if abs(pair["relative"]) > again["marked_beyond"]]
    words = f"The last columns: {again['held']} members once more, by adaptive RODAS3. "
    if not marked:
        return [f"{words}No number is off by more than {100 * again['marked_beyond']:g} %."]
    return [
        f"{words}In bold: off by more than {100 * again['marked_beyond']:g} %; there believe the accurate steps, and "
        "raise tune.substeps for the others."
    ]


def _loss(facts: Facts) -> list[str]:
    if not facts.get("loss"):
        return []
    before, after = facts["loss"]["before"], facts["loss"]["after"]
    rows = [
        [name, f"{weight:g}"]
        + [f"{x[what][name]:.4e}" for x in (before, after) for what in ("mean", "adds")]
        for name, weight in zip(TERMS, facts["weights"], strict=True)
    ]  # fmt: skip
    rows.append(["**loss, the sum**", "", "", f"{before['loss']:.4e}", "", f"**{after['loss']:.4e}**"])
    risk = facts["search"]["risk"]
    if risk != "mean":
        rows.append([f"risk: {risk} of the losses", "", "", f"{before['risk']:.4e}", "", f"{after['risk']:.4e}"])
    return [
        "## The loss of the held-out members",
        "",
        f"`loss = {FORMULA}` of each member, each term times its weight. Means over members: what tracking, peak, "
        "clearance and survival add is weight x mean. Costs multiply the error member by member, so what effort and "
        "chatter add is the mean of weight x term x (tracking + peak), which is not the product of the means shown.",
        "",
        *table(["term", "weight", "mean before", "adds before", "mean after", "adds after"], rows),
        "",
    ]


def _minimised(facts: Facts) -> list[str]:
    parts = facts.get("minimised")
    if not parts:
        return []
    words = f"over {parts['ordinary']} members (seed {facts['search']['seed']})"
    rows = [[f"risk: {parts['of']} of the loss {words}", f"{parts['risk']:.4e}"]]
    if parts["asked_to_be_held"]:
        asked = f"+ mean of clearance + survival over {parts['asked_to_be_held']} members asked only to be held"
        rows.append([asked, f"{parts['held']:.4e}"])
    rows.append(["x penalty of the theorem's conditions", f"{parts['penalty']:.6g}"])
    if parts["limits"] != 1:
        rows.append(["x pull of the limits", f"{parts['limits']:.6g}"])
    rows.append(["**= what was minimised**", f"**{parts['total']:.4e}**"])
    return [
        "## What the search minimised",
        "",
        "Members asked only to be held are stressed (more noise, every gain off by a factor) or were found lost by the "
        "validation ensemble or by accurate steps. So this is not the loss of the held-out members above, and it is "
        "this that the picture shows.",
        "",
        *table(["at the answer", "value"], rows),
        "",
        "![What was minimised along each gain, through the answer](slices.png)",
        "",
        _lower_point(facts),
        "",
    ]


def _lower_point(facts: Facts) -> str:
    """Describe a point of the slices with a lower risk than the answer, if there is one."""
    beside = facts.get("beside")
    if not beside or beside["lower"] == 0:
        return "No point of these slices that loses no more members is lower than the answer."
    where = f"{100 * beside['lower']:.2g} % lower, at {beside['path']} = {beside['gain']:.4g}"
    if beside["lower"] <= AS_GOOD:
        return (
            f"The lowest point of these slices is {where}, and loses no more members: as good as the answer, as far as "
            "a search is carried."
        )
    return (
        f"**The lowest point of these slices is {where}**, and loses no more members: the search ended before it went "
        "there. Neither the validation ensemble nor accurate steps have seen that point. To go on from there set the "
        "gain in tuned.toml and tune that file."
    )


def _conditions(facts: Facts) -> list[str]:
    rows = []
    for row in facts["conditions"]:
        gain, margin = (_number(x) for x in (row["gain"], row["margin"]))
        verdict = {True: "holds", False: "FAILS", None: "-"}[row["holds"]]
        rows.append([row["requires"], gain, _number(row["against"]), margin, row["unit"], verdict])
    head = ["condition", "left", "right", "margin", "unit", "verdict"]
    lines = ["## Conditions of Theorem 1 along the nominal run", "", *table(head, rows), ""]
    if facts.get("advice_on_conditions"):
        lines += [f"- {literal(line)}" for line in facts["advice_on_conditions"]] + [""]
    return lines


def _survival(one: Facts) -> str:
    if isinstance(one["survival"], str):
        return one["survival"]
    return f"{one['survival']:.4f} ({one['survival_low']:.4f} to {one['survival_high']:.4f})"


def _how(facts: Facts) -> list[str]:
    how = facts["search"]
    lines = [
        f"- risk: {how['risk']} over {how['members']} members (seed {how['seed']}), optimiser {how['optimiser']}",
        f"- {how['iterations']} iterations, {how['rollouts']} simulated rollouts "
        f"(a gradient of m gains counts m + 1), {how['seconds']:.0f} s",
    ]
    if error := facts.get("step_error"):
        lines.append(
            f"- step of the search at the optimum: settled rms error {error['search_m']:.4e} m, by "
            f"{facts['accurate_steps']} {error['reference_m']:.4e} m on {error['members']} members: {error['told']}"
        )
    return lines
