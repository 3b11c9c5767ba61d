"""Fan charts of ensembles, from arrays in SI units."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ambjax.pictures.figures import BLUE, INK, RED, envelope, thin
from ambjax.pictures.scales import digits, own_style, prefix_of, style_axes

# Quantities of a fan chart: label and SI unit.
QUANTITIES = {
    "z - r": ("$z - r$", "m"),
    "z": ("position $z$", "m"),
    "sigma": (r"sliding variable $\sigma$", "m/s"),
    "u": ("voltage $u$", "V"),
    "i": ("current $i$", "A"),
    "variation of u": ("variation of $u$", "V/s"),
    "v_tilde": (r"force error $\tilde v$", "A²/m²"),
}


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
