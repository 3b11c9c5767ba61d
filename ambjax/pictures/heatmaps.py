"""Heat maps of survival and error over a grid of two quantities."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from ambjax.ensemble.maps import Map
from ambjax.pictures.figures import INK
from ambjax.pictures.scales import axis_of, edges, label_of, log_ticks, own_style, size_of

CONTOUR = 0.95
# Widths of the contours of survival and of the bounds of its interval; the last is drawn on top.
LINES = {"low": 0.8, "high": 0.8, "survival": 2.2}
# Both colour maps run evenly from dark to light, so that light means good in grey print too.
SURVIVAL, ERROR = "cividis", "viridis_r"
# A cell that is held but not stable.
UNSTABLE_CELL = {"facecolor": "none", "edgecolor": "#D55E00", "hatch": "xxxx", "linewidth": 0.0}
EMPTY_CELL = {"facecolor": "#d4d4d4", "edgecolor": "#8a8a8a", "hatch": "////", "linewidth": 0.0}


@own_style
def map_figure(maps: Sequence[Map], titles: Sequence[str], units: Sequence[str]) -> Figure:
    """Return heat maps side by side: survival above, the error below. `titles`: of each map. `units`: of x and y, SI.

    The bounds of the confidence interval are drawn if a map is decisive; without them the contour encloses the cells in
    which all runs survive, instead of those in which a share of CONTOUR survives. All maps of a row share the colours.
    """
    figure = Figure(figsize=(max(3.9 * len(maps) + 1.4, 6.5), 7.7), layout="constrained")
    axes = figure.subplots(2, len(maps), squeeze=False)
    norm = Normalize(0, 100)
    for ax, one, title in zip(axes[0], maps, titles, strict=True):
        _cells(ax, one, 100 * one.survival, norm, SURVIVAL, units)
        ax.set_title(f"{title}\n{_range(one)}", fontsize=10)
    figure.colorbar(ScalarMappable(norm, SURVIVAL), ax=list(axes[0]), label="survival (%)", pad=0.02)
    _errors(figure, axes[1], maps, units)
    keys: list[Any] = [Line2D([], [], color=INK, linewidth=LINES["survival"], label=_contour_words(maps))]
    if any(one.decisive for one in maps):
        words = "bounds of the confidence interval at 95 %"
        keys.append(Line2D([], [], color=INK, linewidth=LINES["low"], label=words))
    if any(np.any(one.unstable) for one in maps):
        keys.append(Patch(label="held, but not stable", **UNSTABLE_CELL))
    if not all(np.isfinite(one.error).all() for one in maps):
        keys.append(Patch(label="no survivor", **EMPTY_CELL))
    figure.legend(handles=keys, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _errors(figure: Figure, axes: Sequence[Axes], maps: Sequence[Map], units: Sequence[str]) -> None:
    values = np.concatenate([np.ravel(one.error) for one in maps])
    values = values[np.isfinite(values) & (values > 0)]
    factor, words, unit = axis_of("settled_max_abs_error_m", size_of(values, log=True))
    low, high = (factor * values.min(), factor * values.max()) if values.size else (1.0, 1.0)
    if high < 2 * low:  # a constant needs a range too
        low, high = low / 1.5, high * 1.5
    norm = LogNorm(low, high)
    for ax, one in zip(axes, maps, strict=True):
        error = factor * one.error
        _cells(ax, one, np.where(error == 0, low, error), norm, ERROR, units)
    if values.size:
        bar = figure.colorbar(ScalarMappable(norm, ERROR), ax=list(axes), label=f"{words} ({unit})", pad=0.02)
        log_ticks(bar.ax.yaxis, low, high)
        bar.ax.minorticks_off()


def _cells(ax: Axes, one: Map, values: np.ndarray, norm: Normalize, colours: str, units: Sequence[str]) -> None:
    """Draw one heat map with its axes and contours. Cells that are not finite show the hatched background."""
    (x_path, x, x_log), (y_path, y, y_log) = one.x, one.y
    x_factor, x_label = label_of(x_path, units[0], size_of(x, x_log))
    y_factor, y_label = label_of(y_path, units[1], size_of(y, y_log))
    x_edges, y_edges = edges(x_factor * x, x_log), edges(y_factor * y, y_log)
    ax.patch.set(**EMPTY_CELL)
    ax.set(xscale="log" if x_log else "linear", yscale="log" if y_log else "linear")
    ax.pcolormesh(x_edges, y_edges, np.ma.masked_invalid(values), norm=norm, cmap=colours)
    for row, column in np.argwhere(one.unstable):
        left, right, low, high = (float(x) for x in (*x_edges[column : column + 2], *y_edges[row : row + 2]))
        ax.add_patch(Rectangle((left, low), right - left, high - low, **UNSTABLE_CELL))
    level = CONTOUR if one.decisive else 1.0
    for name, width in LINES.items() if one.decisive else [("survival", LINES["survival"])]:
        _outline(ax, x_edges, y_edges, getattr(one, name) >= level, width)
    ax.set(xlim=x_edges[[0, -1]], ylim=y_edges[[0, -1]])
    for axis, ends, log in ((ax.xaxis, x_edges, x_log), (ax.yaxis, y_edges, y_log)):
        if log:
            log_ticks(axis, ends[0], ends[-1])
    ax.set_xlabel(x_label, fontsize=9)
    ax.set_ylabel(y_label, fontsize=9)
    ax.tick_params(labelsize=8)


def _outline(ax: Axes, x_edges: np.ndarray, y_edges: np.ndarray, inside: np.ndarray, width: float) -> None:
    """Draw the edges between the cells inside and outside."""
    row, column = np.nonzero(inside[:, 1:] != inside[:, :-1])
    at = x_edges[column + 1]
    upright = np.stack([np.stack([at, y_edges[row]], 1), np.stack([at, y_edges[row + 1]], 1)], 1)
    row, column = np.nonzero(inside[1:] != inside[:-1])
    at = y_edges[row + 1]
    level = np.stack([np.stack([x_edges[column], at], 1), np.stack([x_edges[column + 1], at], 1)], 1)
    # a white seam below the whole line makes it visible on dark cells
    for colour, stroke in (("white", width + 1.4), (INK, width)):
        lines = LineCollection([*upright, *level], colors=colour, linewidths=stroke, capstyle="projecting")
        ax.add_collection(lines, autolim=False)


def _contour_words(maps: Sequence[Map]) -> str:
    decisive = [one.decisive for one in maps]
    if all(decisive):
        return "95 % survival"
    return "95 % survival, or all runs survive" if any(decisive) else "all runs survive"


def _range(one: Map) -> str:
    """Return in words in how many cells enough runs survive. Without a contour, this tells whether all or none do."""
    words, level = ("95 % or more survive", CONTOUR) if one.decisive else ("all runs survive", 1)
    return f"{words} in {np.sum(one.survival >= level)} of {one.survival.size} cells"
