"""Charts of ensembles: quantiles over time, histograms of metrics, and the drivers of a metric. All from SI units."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from ambjax.pictures.figures import BLUE, INK, ORANGE, RED, envelope, thin
from ambjax.pictures.scales import axis_of, digits, log_ticks, own_style, prefix_of, size_of, style_axes
from ambjax.simulation.metrics import REACHED

# Quantities of a fan chart: label and SI unit.
QUANTITIES = {
    "z - r": ("$z - r$", "m"),
    "sigma": (r"sliding variable $\sigma$", "m/s"),
    "u": ("voltage $u$", "V"),
    "variation of u": ("variation of $u$", "V/s"),
}
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
def fan(
    t: np.ndarray,
    bands: Mapping[str, Mapping[float, np.ndarray]],
    limits: Mapping[str, float],
    title: str,
    lost_at: np.ndarray,
    stalled: np.ndarray,
) -> Figure:
    """Return quantile bands over time, one panel per quantity (keys of QUANTITIES), all in SI units.

    `bands[quantity][percent]`: the quantile [T] at the times t [T] (s) over the members not yet lost; NaN if all are
    lost. `limits[quantity]` (> 0): drawn at plus and minus its value if the data come near it. `lost_at` [N] (s, +inf:
    never): for the last panel, the share of survivors. `stalled` [N] (bool): members at which the integrator stalled.
    """
    heights = [1.0] * len(bands) + [0.55]
    figure = Figure(figsize=(8.0, 2.1 * sum(heights) + 0.9), layout="constrained")
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for ax, (quantity, quantiles) in zip(axes, bands.items(), strict=False):
        _fan_panel(ax, t, quantity, quantiles, limits.get(quantity, math.inf))
    _survivors(axes[-1], t, lost_at, stalled)
    end = np.max(lost_at, initial=t[-1], where=np.isfinite(lost_at))
    if t[-1] > t[0]:
        axes[-1].set_xlim(t[0], end)
    axes[-1].set_xlabel("time (s)", fontsize=9)
    figure.align_ylabels(axes)
    figure.suptitle(title, fontsize=11)
    handles = {label: h for ax in axes for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return figure


def _fan_panel(ax: Axes, t: np.ndarray, quantity: str, quantiles: Mapping[float, np.ndarray], limit: float) -> None:
    label, unit = QUANTITIES[quantity]
    percents = sorted(quantiles)
    curves = [quantiles[percent] for percent in percents]
    low, high, beyond = _reach(curves)
    factor, unit = prefix_of(unit, max(abs(low), abs(high)))
    pairs = len(percents) // 2
    for k in range(pairs):
        x, lower, upper = envelope(t, curves[k], curves[-1 - k])
        name = f"{percents[k]:g} to {percents[-1 - k]:g} %"
        ax.fill_between(x, factor * lower, factor * upper, color=_tint(k, pairs), linewidth=0, label=name)
    if len(percents) % 2:
        # Not smoothed: the members share loads and a speed, so that a fast median can be a motion of all of them.
        ax.plot(*thin(t, factor * curves[pairs]), color=INK, linewidth=0.8, label="median")
    # near: the largest value is at least three quarters of the limit
    near = [value for value, peak in ((limit, high), (-limit, -low)) if limit <= 1.33 * peak]
    margin = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    low, high = min([low - margin, *(1.08 * value for value in near)]), max([high + margin, *(1.08 * v for v in near)])
    for value in near:
        ax.axhline(factor * value, color=RED, linestyle="--", linewidth=1.1, label="limit")
    ax.set_ylim(factor * low, factor * high)
    if beyond > 0:
        words = f"the {percents[0]:g} to {percents[-1]:g} % band reaches {digits(factor * beyond)} {unit}"
        ax.set_title(f"{words}, beyond this axis", fontsize=7, loc="right", pad=2, color=INK)
    style_axes(ax, f"{label}\n({unit})")


def _tint(k: int, pairs: int) -> tuple[float, ...]:
    """Return the blue of the k-th of `pairs` nested bands, counted from outside. Inner bands are darker."""
    strength = 0.2 + 0.45 * k / max(pairs - 1, 1)
    return tuple(1 - strength * (1 - part) for part in to_rgb(BLUE))


def _reach(curves: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """Return the lowest and highest value to show, and the largest |value| if it lies far beyond them (else 0)."""
    values, inner = np.concatenate(curves), curves[1:-1] or curves
    lower, upper = inner[0][np.isfinite(inner[0])], inner[-1][np.isfinite(inner[-1])]
    values = values[np.isfinite(values)]
    if not (lower.size and upper.size):
        return 0.0, 0.0, 0.0
    low, high = float(values.min()), float(values.max())
    bottom, top = float(np.quantile(lower, 0.05)), float(np.quantile(upper, 0.95))
    span = top - bottom
    if span > 0 and high - low > 8 * span:
        return max(bottom - 0.5 * span, low), min(top + 0.5 * span, high), max(abs(low), abs(high))
    return low, high, 0.0


def _survivors(ax: Axes, t: np.ndarray, lost_at: np.ndarray, stalled: np.ndarray) -> None:
    """Draw the share of survivors over time, with a tick at each time at which a member is lost or stalls."""
    ended = np.isfinite(lost_at)
    at, many = np.unique(lost_at[ended], return_counts=True)
    dead = np.concatenate([[0], np.cumsum(many), [many.sum()]])
    share = 100 * (1 - dead / max(len(lost_at), 1))
    x = np.concatenate([t[:1], at, [np.max(at, initial=t[-1])]])
    ax.step(*thin(x, share), where="post", color=INK, linewidth=1.2)
    floor = max(0.0, 100 - 1.6 * max(100 - share[-1], 5.0))
    top = 100 + 0.12 * (100 - floor)
    ax.set_ylim(floor - 0.12 * (100 - floor), top)
    if len(at):
        ticks, _ = thin(at, at)
        look = {"color": RED, "markersize": 7, "label": "a member is lost or stalls"}
        ax.plot(ticks, np.full(len(ticks), 0.08), "|", transform=ax.get_xaxis_transform(), **look)
    lost, open_ = int(ended.sum()), int(np.sum(np.asarray(stalled, bool) & ended))
    words = f"{len(lost_at) - lost} of {len(lost_at)} survive ({share[-1]:.4g} %)"
    words += f", {statuses(lost - open_, open_)}" * bool(lost)
    ax.set_title(words, fontsize=8, loc="right", pad=2, color=INK)
    ax.yaxis.set_major_locator(MaxNLocator(3))
    style_axes(ax, "survivors\n(%)")


def statuses(lost: int, stalled: int) -> str:
    """Return in words the numbers of lost and of stalled members."""
    return f"{lost} lost" + f", {stalled} not decided" * bool(stalled)


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
