"""The report of a study: Markdown, JSON, and one HTML page with its pictures inside."""

import base64
import dataclasses
import html
import io
from typing import Any

import numpy as np

from ambjax.theorem import Report as Check
from tuning.explore import Slices
from tuning.loss import TERMS
from tuning.space import Space

Facts = dict[str, Any]
# Where the picture of the risk ends: a lost member costs a million times an error.
HIGHEST = 30.0
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


def conditions(check: Check) -> list[Facts]:
    """The theorem's conditions as plain data."""
    return [dataclasses.asdict(line) | {"margin": line.margin} for line in check.conditions]


def gains_table(space: Space, before: np.ndarray, after: np.ndarray, sensitivity: np.ndarray | None) -> list[Facts]:
    """One row for each gain."""
    return [
        {
            "path": gain.path,
            "before": float(before[j]),
            "after": float(after[j]),
            "at_bound": gain.at_bound(float(after[j])),
            "sensitivity_percent": None if sensitivity is None else float(sensitivity[j]),
        }
        for j, gain in enumerate(space.gains)
    ]


def markdown(facts: Facts) -> str:
    """report.md."""
    lines = [f"# Tuning of {facts['case']}", "", facts["verdict"], "", "## Gains", ""]
    lines += ["| gain | before | after | at a bound | off by e^0.25: risk grows by |", "|---|---|---|---|---|"]
    for row in facts["gains"]:
        grows = "-" if row["sensitivity_percent"] is None else f"{row['sensitivity_percent']:.3g} %"
        lines.append(
            f"| {row['path']} | {row['before']:.6g} | {row['after']:.6g} | {row['at_bound'] or '-'} | {grows} |"
        )
    lines += ["", "A large number in the last column: set this gain with care. A small one: it hardly matters.", ""]
    lines += _held_out(facts)
    lines += ["## Terms of the loss, held-out mean", "", "| term | weight | before | after |", "|---|---|---|---|"]
    for name, weight in zip(TERMS, facts["weights"], strict=True):
        before, after = (facts[when].get(f"loss.{name}.mean", float("nan")) for when in ("before", "after"))
        lines.append(f"| {name} | {weight:g} | {before:.3e} | {after:.3e} |")
    lines += ["", "## Conditions of Theorem 1 along the nominal run", ""]
    lines += ["| condition | gain | against | margin | verdict |", "|---|---|---|---|---|"]
    for row in facts["conditions"]:
        gain, margin = ("-" if x is None else f"{x:.5g}" for x in (row["gain"], row["margin"]))
        verdict = {True: "holds", False: "FAILS", None: "-"}[row["holds"]]
        lines.append(f"| {row['requires']} | {gain} | {row['against']:.5g} | {margin} | {verdict} |")
    lines += ["", "## How the search went", "", *_how(facts), ""]
    if facts.get("pareto"):
        lines += [
            "## Error against voltage",
            "",
            "On the training ensemble; u is read at the start of each sample.",
            "",
        ]
        lines += ["| settled rms error (m) | settled rms u (V) | lost | gains |", "|---|---|---|---|"]
        for row in facts["pareto"]:
            gains = ", ".join(f"{path.rpartition('.')[2]} {value:.4g}" for path, value in row["gains"].items())
            cells = f"{row['settled_rms_error_m']:.3e} | {row['settled_rms_u_V']:.4g} | {row['lost']} | {gains}"
            lines.append(f"| {cells} |")
        lines.append("")
    if facts.get("gradient"):
        lines += _gradient(facts["gradient"])
    return "\n".join(lines) + "\n"


def _held_out(facts: Facts) -> list[str]:
    before, after = facts["before"], facts["after"]
    if not after["members"]:
        return ["No held-out ensemble was asked for (tune.held_out = 0).", ""]
    lines = [f"## {after['members']} held-out members (seed {facts['held_out_seed']})", ""]
    lines += ["| | before | after |", "|---|---|---|"]
    for name in SHOWN:
        if name in after:
            lines.append(f"| {name} | {before.get(name, float('nan')):.4g} | {after[name]:.4g} |")
    for name, one in (("lost", "lost"), ("survival, 95 % interval", None)):
        cells = [str(x["lost"]) if one else _survival(x) for x in (before, after)]
        lines.append(f"| {name} | {cells[0]} | {cells[1]} |")
    return [*lines, "", "Lost members count with the error at which they were frozen.", ""]


def _survival(one: Facts) -> str:
    if isinstance(one["survival"], str):
        return one["survival"]
    return f"{one['survival']:.4f} ({one['survival_low']:.4f} to {one['survival_high']:.4f})"


def _how(facts: Facts) -> list[str]:
    how = facts["search"]
    told = [
        f"- risk: {how['risk']} over {how['members']} members (seed {how['seed']}), optimiser {how['optimiser']}",
        f"- {how['iterations']} iterations, {how['rollouts']} simulated rollouts "
        f"(a gradient of m gains counts m + 1), {how['seconds']:.0f} s",
    ]
    if error := facts.get("step_error"):
        told.append(
            f"- step of the search at the optimum: settled rms error {error['search_m']:.4e} m, adaptive RODAS3 "
            f"{error['reference_m']:.4e} m on {error['members']} members: {error['told']}"
        )
    return told


def _gradient(facts: Facts) -> list[str]:
    ways, noise = facts["three_ways"], facts["noise"]
    lines = ["## Gradients, in the logarithms of the gains", ""]
    lines += [f"Over {ways['samples']} samples, of the mean loss:", ""]
    lines += ["| gain | forward | reverse | central differences |", "|---|---|---|---|"]
    for row in zip(facts["gains"], ways["forward"], ways["reverse"], ways["differences"], strict=True):
        lines.append(f"| {row[0]} | {row[1]:.10e} | {row[2]:.10e} | {row[3]:.8e} |")
    lines += ["", "| horizon (s) | norm of the gradient of the log loss | share of members lost |", "|---|---|---|"]
    lines += [f"| {r['horizon_s']:g} | {r['norm']:.3g} | {r['lost']:.3g} |" for r in facts["horizons"]]
    lines += ["", "| gain | gradient of the log loss | standard error over members | ratio |", "|---|---|---|---|"]
    for row in zip(facts["gains"], noise["gradient"], noise["standard_error"], noise["ratio"], strict=True):
        lines.append(f"| {row[0]} | {row[1]:.3e} | {row[2]:.1e} | {row[3]:.3g} |")
    return [*lines, ""]


def convergence(history: dict[str, Any], paths: list[str]) -> bytes:
    """PNG: the goal and the gains of the best start against iterations."""
    from matplotlib.figure import Figure

    value, gains, members = (np.asarray(history[name]) for name in ("value", "gains", "members"))
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps, best = np.arange(1, len(value) + 1), np.argmin(value, axis=1)
    for s in range(value.shape[1]):
        left.plot(steps, value[:, s], "0.75", lw=1)
    left.plot(steps, value.min(axis=1), "C0", lw=1.8)
    left.set(xlabel="iteration", ylabel="log of the risk", title="blue: the best start; dotted: other members asked")
    for j, path in enumerate(paths):
        right.plot(steps, gains[steps - 1, best, j] / gains[-1, best[-1], j], label=path.removeprefix("controller."))
    right.set(xlabel="iteration", ylabel="gain / its final value", yscale="log", title="gains of the best start")
    right.legend(fontsize=8)
    for at in np.flatnonzero(np.diff(members)):
        for ax in (left, right):
            ax.axvline(at + 1.5, color="0.5", ls=":", lw=1)
    for ax in (left, right):
        ax.grid(alpha=0.3)
    return _png(figure)


def landscape(found: Slices, paths: list[str]) -> bytes:
    """PNG: the risk along each gain through the optimum."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    m = len(paths)
    figure = Figure(figsize=(2.4 * m + 1, 3.2), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, m, sharey=True))
    middle = found.goals.shape[1] // 2
    for ax, gains, goals, lost, path in zip(axes, found.gains, found.goals, found.lost, paths, strict=True):
        risk = np.minimum(np.exp(goals - goals[middle]), HIGHEST)
        ax.loglog(gains, risk, "C0-", lw=1.2)
        held = lost == 0
        ax.plot(gains[held], risk[held], "C0o", ms=3.5, label="all members held")
        if not held.all():
            ax.plot(gains[~held], risk[~held], "C3x", ms=5, label="members lost")
        ax.axvline(gains[middle], color="0.5", lw=0.8, ls=":")
        ax.set_xlabel(path.removeprefix("controller."))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
    axes[0].set_ylabel(f"risk / risk at the optimum (cut at {HIGHEST:g})")
    handles = {label: h for ax in axes for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    axes[0].legend(handles.values(), handles.keys(), fontsize=8)
    return _png(figure)


def front(rows: list[Facts]) -> bytes:
    """PNG: error against voltage."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3.4), layout="constrained")
    ax = figure.subplots()
    ax.plot([r["settled_rms_u_V"] for r in rows], [r["settled_rms_error_m"] for r in rows], "o-", ms=4)
    ax.set(xlabel="settled rms voltage (V)", ylabel="settled rms error (m)", yscale="log")
    ax.grid(alpha=0.3, which="both")
    return _png(figure)


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;margin:.6rem 0}td,th{border:1px solid #ccc;padding:.2rem .6rem;text-align:left}
th{background:#f3f3f3}img{max-width:100%}"""


def page(text: str, pictures: dict[str, bytes], title: str) -> str:
    """One HTML page from the Markdown above and PNG pictures by caption; needs nothing else."""
    lines, rows = [], []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
            continue
        if rows:
            lines.append(_html_table(rows))
            rows = []
        marks = len(line) - len(line.lstrip("#"))
        if marks:
            lines.append(f"<h{marks}>{html.escape(line[marks:].strip())}</h{marks}>")
        elif line.strip():
            lines.append(f"<p>{html.escape(line)}</p>")
    for caption, data in pictures.items():
        source = base64.b64encode(data).decode()
        words = html.escape(caption)
        lines.append(f'<h2>{words}</h2><img alt="{words}" src="data:image/png;base64,{source}">')
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
    return f"{head}<style>{STYLE}</style>\n" + "\n".join(lines) + "\n</html>\n"


def _html_table(rows: list[list[str]]) -> str:
    def row(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = [row(cells, "td") for cells in rows[2:]]
    return "<table>" + row(rows[0], "th") + "".join(body) + "</table>"
