"""Histograms of the metrics of an ensemble, from columns in SI units, and the tornado chart of a metric's drivers."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from ambjax.pictures.fans import statuses
from ambjax.pictures.figures import BLUE, INK, ORANGE, RED
from ambjax.pictures.scales import axis_of, digits, log_ticks, own_style, size_of, style_axes
from ambjax.simulation.metrics import REACHED

# Metrics that are drawn by default.
CHIEF = (
    "settled_max_abs_error_m",
    "settled_rms_error_m",
    "max_abs_error_m",
    "rms_error_m",
    "clearance_used",
    "settled_max_abs_sigma_m_per_s",
    "v_tilde_reached_s",
    "max_abs_i_A",
    "max_abs_u_V",
    "rms_u_V",
    "chatter_V",
    "copper_loss_W",
)
# Largest number of bars of a tornado chart, and their colours.
MOST_DRIVERS = 12
TRENDS = {"grows with it": BLUE, "falls with it": ORANGE, "no steady trend": "#8a8a8a"}
LOST = {"facecolor": RED, "edgecolor": "white", "hatch": "////", "linewidth": 0.0}
MARKS: dict[float, tuple[Any, str, str]] = {0.5: ("-", "median", "median"), 0.95: ("--", "95 %", "95 % quantile")}


@own_style
def histogram_figure(columns: Mapping[str, np.ndarray], metrics: Sequence[str] = CHIEF) -> Figure:
    """Return histograms of the `metrics` in `columns`, the arrays [N] of members.npz. Survivors have their own colour.

    A member with a finite `lost_at` or `lost_at_s` does not survive; without these columns all survive. The column
    `stalled` marks members at which the integrator stalled; they are drawn like lost members. Raises ValueError if
    `columns` has none of the metrics.
    """
    names = [name for name in metrics if name in columns]
    if not names:
        raise ValueError(f"histograms: none of {', '.join(metrics)} is a column. The columns are {', '.join(columns)}.")
    none = np.full(len(columns[names[0]]), math.inf)
    lost = np.isfinite(np.asarray(columns.get("lost_at", columns.get("lost_at_s", none)), float))
    open_ = int(np.sum(lost & np.asarray(columns.get("stalled", False), bool)))
    across = min(3, len(names))
    down = -(-len(names) // across)
    figure = Figure(figsize=(max(4.0 * across, 5.5), 2.5 * down + 0.8), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for ax, name in zip(axes, names, strict=False):
        _histogram(ax, name, np.asarray(columns[name], float), lost)
    for ax in axes[len(names) :]:
        ax.set_axis_off()
    others = "lost members" + " and those not decided" * bool(open_)
    keys = [Patch(color=BLUE, label="survivors"), Patch(label=others, **LOST)]
    keys += [Line2D([], [], color=INK, linestyle=s, label=f"{n} of survivors") for s, _, n in MARKS.values()]
    figure.suptitle(f"{lost.size} members, {statuses(int(lost.sum()) - open_, open_)}", fontsize=11)
    figure.legend(handles=keys, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def _histogram(ax: Axes, name: str, values: np.ndarray, lost: np.ndarray) -> None:
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    log = positive.size > 0 and not np.any(finite < 0) and positive.max() > 30 * positive.min()
    factor, label, unit = axis_of(name, size_of(finite, log))
    mask = np.isfinite(values) & ((values > 0) | (not log))
    bounds = _bins(factor * values[mask], log)
    alive, _ = np.histogram(factor * values[mask & ~lost], bounds)
    dead, _ = np.histogram(factor * values[mask & lost], bounds)
    ax.stairs(alive, bounds, fill=True, color=BLUE)
    if dead.any():
        ax.stairs(alive + dead, bounds, baseline=alive, fill=True, **LOST)
    if log:
        ax.set_xscale("log")
        log_ticks(ax.xaxis, bounds[0], bounds[-1])
    notes, reached = [], name in REACHED
    order = np.sort(values[~np.isnan(values) & ~lost])
    for share, (style, words, _) in MARKS.items():
        value = factor * order[math.ceil(share * order.size) - 1] if order.size else math.nan
        if math.isfinite(value) and (value > 0 or not log):
            ax.axvline(value, color=INK, linestyle=style, linewidth=1.2)
        missing = "never" if reached and order.size else "none"
        notes.append(f"{words}: {f'{digits(value)} {unit}'.rstrip() if math.isfinite(value) else missing}")
    counts = {"never" if reached else "not finite": np.sum(~np.isfinite(values)), "at zero": np.sum(finite == 0) * log}
    notes += [f"{count} {words}" for words, count in counts.items() if count]
    ax.set_title(", ".join(notes), fontsize=8, pad=3)
    ax.set_xlabel(f"{label} ({unit})" if unit else label, fontsize=9)
    ax.set_ylim(0, 1.08 * max((alive + dead).max(), 1))
    ax.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    style_axes(ax, "members")


def _bins(values: np.ndarray, log: bool) -> np.ndarray:
    """Return the edges of 40 bins over the values, or of 41 bins around a constant."""
    low, high = (values.min(), values.max()) if values.size else (0.0, 1.0)
    if log:
        return np.geomspace(low / 1.001, 1.001 * high, 41)
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        room = 0.1 * abs(high) or 1.0
        return np.linspace(low - room, high + room, 42)  # an odd number of bins: the constant is inside one
    return np.linspace(low, high, 41)


@own_style
def tornado(drivers: Sequence[Mapping[str, Any]], metric: str, says: str) -> Figure:
    """Return a chart with the share of a metric's variation that each driver explains, the largest on top.

    `drivers`: at least one row of `drivers` in summary.json: the `path`, the `share` with its interval `low` to `high`,
    and the rank correlation `rho`. The chart has at most MOST_DRIVERS bars, coloured by the trend, with whiskers from
    low to high. `says`: the text below the title.
    """
    ranking = sorted(drivers, key=lambda driver: -driver["share"])
    bars = ranking[:MOST_DRIVERS]
    figure = Figure(figsize=(7.5, 0.36 * len(bars) + 2.2), layout="constrained")
    ax = figure.subplots()
    for row, one in enumerate(bars):
        share, low, high = (100 * one[key] for key in ("share", "low", "high"))
        ax.barh(row, share, height=0.62, color=TRENDS[_trend(one)])
        ax.plot([low, high], [row, row], color=INK, linewidth=1.2, marker="|", markersize=7)
        ax.text(max(share, high) + 1.5, row, f"{share:.0f} %", fontsize=8, va="center", color=INK)
    ax.set_yticks(range(len(bars)), [one["path"] for one in bars])
    ax.set_ylim(len(bars) - 0.4, -0.6)
    ax.set_xlim(0, 112)
    ax.set_xticks(np.linspace(0, 100, 6))
    more = len(ranking) - len(bars)
    words = "share of the variation of the rank explained alone, %; whiskers: 95 % interval"
    ax.set_xlabel(words + (f"; {more} weaker not shown" if more else ""), fontsize=9)
    figure.suptitle(f"Drivers of {axis_of(metric, 0.0)[1]}", fontsize=11)
    ax.set_title(textwrap.fill(says, 95), fontsize=8)
    style_axes(ax, "")
    trends = dict.fromkeys(_trend(one) for one in bars)
    keys = [Patch(color=TRENDS[trend], label=trend) for trend in TRENDS if trend in trends]
    figure.legend(handles=keys, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _trend(one: Mapping[str, Any]) -> str:
    """Return the trend of the metric. A monotonic trend must explain at least half of the share."""
    rising, falling, neither = TRENDS
    if one["share"] <= 0 or one["rho"] ** 2 < 0.5 * one["share"]:
        return neither
    return rising if one["rho"] > 0 else falling
