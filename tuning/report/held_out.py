"""The held-out members in the report: metrics before and after, their errors due to the steps, and the worst member.

To find these errors, a few members are simulated again with accurate steps, in continuous time only, where these are
the steps of adaptive RODAS3.
"""

import math

import numpy as np

from ambjax.text.web_page import markdown_table
from tuning.judge.evaluate import compare_metrics, metrics_of, summarise
from tuning.problem.tuning_problem import TuningProblem
from tuning.report.facts import SUMMARY_METRICS, Row, TuningFacts

# Number of held-out members that are simulated by accurate steps.
COMPARED = 8
# Relative error of the report's steps above which a number is marked.
MARKED = 0.05


def compare_steps(problem: TuningProblem, x: np.ndarray, seed: int, count: int) -> Row:
    """Compare the report's steps with accurate steps on the first members of an ensemble, at coordinates x [m].

    Returns plain data. `members`: number of members simulated. `held`: number of members that survive with both steps.
    `metrics`: for each of SUMMARY_METRICS, the summary over these members (`summarise`) with the report's steps and
    with accurate steps, and the relative error. `lost`, `stalled`: numbers of members with each of the steps.
    `refuted`: why accurate steps contradict the report; '' if they do not, or if no member survives in the report.
    """
    numbers = np.arange(min(COMPARED, count))
    members = problem.objective.chosen(seed, numbers, count)
    both = metrics_of(problem.judging, x, members), metrics_of(problem.reference, x, members)
    error = compare_metrics(problem, *both, members)
    held = np.logical_and.reduce([~np.isfinite(metrics["lost_at_s"]) for metrics in both])
    found: Row = {"members": len(numbers), "held": int(held.sum()), "marked_beyond": MARKED, "metrics": {}}
    found["refuted"] = error.refuted if error.members + error.unconfirmed else ""
    for status in ("lost", "stalled"):
        found[status] = dict(zip(("report", "accurate"), (int(one[status].sum()) for one in both), strict=True))
    if not held.any():
        return found
    ours, theirs = (summarise({name: values[held] for name, values in metrics.items()}) for metrics in both)
    for name in SUMMARY_METRICS:
        if name in ours and name in theirs:
            pair = ours[name], theirs[name]
            relative = 0.0 if pair[0] == pair[1] else pair[0] / pair[1] - 1 if pair[1] else math.inf
            found["metrics"][name] = {"report": pair[0], "accurate": pair[1], "relative": relative}
    return found


def section(facts: TuningFacts) -> list[str]:
    """Return the section on the held-out members."""
    before, after, again = facts.before, facts.after, facts.accurate
    if not after["members"]:
        return ["There is no held-out ensemble (tune.held_out = 0).", ""]
    rows = [
        [f"`{name}`", _number(before.get(name)), _number(after.get(name)), *([_off(again, name)] if again else [])]
        for name in SUMMARY_METRICS
        if name in after or name in before
    ]
    dash = ["-"] * bool(again)
    rows += [[name, str(before[name]), str(after[name]), *dash] for name in ("lost", "stalled")]
    rows.append(["survival, 95 % interval", *map(_survival, (before, after)), *dash])
    head = ["", "before", "after", *["error of the steps"] * bool(again)]
    title = f"## {after['members']} held-out members (seed {facts.held_out_seed})"
    words = ["The metrics include only the members that are held.", *_accurate(again), *_worst(facts.worst_member), ""]
    return [title, "", *markdown_table(head, rows), "", *words]


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


def _off(again: Row, name: str) -> str:
    """Return the relative error of a metric, in bold if it is large; '-' if it is not known."""
    if name not in again["metrics"]:
        return "-"
    relative = again["metrics"][name]["relative"]
    return f"**{100 * relative:.2g} %**" if abs(relative) > MARKED else f"{100 * relative:.2g} %"


def _accurate(again: Row | None) -> list[str]:
    if again is None:
        return []
    if not again["metrics"]:
        return ["No member is held with both steps: accurate steps confirm no number of this table."]
    return [
        f"The last column compares {again['held']} members with simulations by adaptive RODAS3. If an error exceeds "
        f"{100 * MARKED:g} %, in bold, use the value with accurate steps in report.json. With sliding steps, raise "
        "tune.substeps."
    ]


def _survival(one: Row) -> str:
    if isinstance(one["survival"], str):
        return one["survival"]
    return f"{one['survival']:.4f} ({one['survival_low']:.4f} to {one['survival_high']:.4f})"
