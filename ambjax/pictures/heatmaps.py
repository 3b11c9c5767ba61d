"""Heat maps of survival and error over a grid of two quantities."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

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


class MapPanel(NamedTuple):
    """One map of a picture.

    - `x` [nx], `y` [ny]: values of the axes, ascending.
    - `survival` [ny, nx]: shares 0 to 1; NaN: not run.
    - `low`, `high` [ny, nx]: bounds of the confidence interval of the survival. None: not drawn, and the contour
      encloses the cells in which all runs survive, instead of those in which a share of CONTOUR survives.
    - `unstable` [ny, nx]: whether the loop is held but not stable; hatched. None: not known.
    - `error` [ny, nx]: in the unit of the error metric; not finite: not run, or no survivor. None: no map of errors.
    """

    title: str
    x: np.ndarray
    y: np.ndarray
    survival: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None
    error: np.ndarray | None
    unstable: np.ndarray | None = None


@own_style
def map_figure(
    panels: Sequence[MapPanel],
    x_label: str,
    y_label: str,
    x_log: bool,
    y_log: bool,
    error_metric: str = "settled_max_abs_error_m",
) -> Figure:
    """Return heat maps side by side: survival above, and the error below if a panel has one.

    `error_metric`: the metric of the errors, which gives their unit. A label that ends in an SI unit, such as "z (m)",
    gets a prefix. All panels of a row share the colours. Raises ValueError if there are no panels, or if a log axis has
    values that are not positive.
    """
    if not panels:
        raise ValueError("maps: no panels to draw")
    rows = 2 if any(panel.error is not None for panel in panels) else 1
    figure = Figure(figsize=(max(3.9 * len(panels) + 1.4, 6.5), 3.4 * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, len(panels), squeeze=False)
    labels = (x_label, y_label, x_log, y_log)
    norm = Normalize(0, 100)
    for ax, panel in zip(axes[0], panels, strict=True):
        _cells(ax, panel, 100 * np.asarray(panel.survival, float), norm, SURVIVAL, labels)
        ax.set_title(f"{panel.title}\n{_range(panel)}", fontsize=10)
    figure.colorbar(ScalarMappable(norm, SURVIVAL), ax=list(axes[0]), label="survival (%)", pad=0.02)
    if rows == 2:
        _errors(figure, axes[1], panels, error_metric, labels)
    keys: list[Any] = [Line2D([], [], color=INK, linewidth=LINES["survival"], label=_contour_words(panels))]
    if any(panel.low is not None for panel in panels):
        words = "bounds of the confidence interval at 95 %"
        keys.append(Line2D([], [], color=INK, linewidth=LINES["low"], label=words))
    if any(panel.unstable is not None and np.any(panel.unstable) for panel in panels):
        keys.append(Patch(label="held, but not stable", **UNSTABLE_CELL))
    if empty := _empty_words(panels):
        keys.append(Patch(label=empty, **EMPTY_CELL))
    figure.legend(handles=keys, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


# Labels of x and y, and whether each axis is logarithmic.
Labels: TypeAlias = tuple[str, str, bool, bool]


def _errors(figure: Figure, axes: Sequence[Axes], panels: Sequence[MapPanel], metric: str, labels: Labels) -> None:
    errors = [panel.error for panel in panels if panel.error is not None]
    values = np.concatenate([np.ravel(np.asarray(error, float)) for error in errors])
    values = values[np.isfinite(values) & (values > 0)]
    factor, words, unit = axis_of(metric, size_of(values, log=True))
    low, high = (factor * values.min(), factor * values.max()) if values.size else (1.0, 1.0)
    if high < 2 * low:  # a constant needs a range too
        low, high = low / 1.5, high * 1.5
    norm = LogNorm(low, high)
    for ax, panel in zip(axes, panels, strict=True):
        if panel.error is None:
            ax.set_axis_off()
            continue
        error = factor * np.asarray(panel.error, float)
        _cells(ax, panel, np.where(error == 0, low, error), norm, ERROR, labels)
    if values.size:
        bar = figure.colorbar(ScalarMappable(norm, ERROR), ax=list(axes), label=f"{words} ({unit})", pad=0.02)
        log_ticks(bar.ax.yaxis, low, high)
        bar.ax.minorticks_off()


def _cells(ax: Axes, panel: MapPanel, values: np.ndarray, norm: Normalize, colours: str, labels: Labels) -> None:
    """Draw one heat map with its axes and contours. Cells that are not finite show the hatched background."""
    x_label, y_label, x_log, y_log = labels
    x, y = np.asarray(panel.x, float), np.asarray(panel.y, float)
    x_factor, x_label = label_of(x_label, size_of(x, x_log))
    y_factor, y_label = label_of(y_label, size_of(y, y_log))
    x_edges, y_edges = edges(x_factor * x, x_log), edges(y_factor * y, y_log)
    ax.patch.set(**EMPTY_CELL)
    ax.set(xscale="log" if x_log else "linear", yscale="log" if y_log else "linear")
    ax.pcolormesh(x_edges, y_edges, np.ma.masked_invalid(values), norm=norm, cmap=colours)
    if panel.unstable is not None:
        for row, column in np.argwhere(panel.unstable):
            left, right, low, high = (float(x) for x in (*x_edges[column : column + 2], *y_edges[row : row + 2]))
            ax.add_patch(Rectangle((left, low), right - left, high - low, **UNSTABLE_CELL))
    for name, width in LINES.items():
        values = getattr(panel, name)
        if values is None:
            continue
        level = 1.0 if panel.low is None else CONTOUR
        _outline(ax, x_edges, y_edges, np.asarray(values, float) >= level, width)
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


def _empty_words(panels: Sequence[MapPanel]) -> str:
    """Return what the hatched cells of the maps show: cells that were not run, cells without a survivor, or both."""
    unrun = [np.isnan(np.asarray(panel.survival, float)) for panel in panels]
    lost = [~np.isfinite(x.error) & ~cells for x, cells in zip(panels, unrun, strict=True) if x.error is not None]
    words = {"not run": unrun, "no survivor": lost}
    return " or ".join(word for word, cells in words.items() if any(one.any() for one in cells))


def _contour_words(panels: Sequence[MapPanel]) -> str:
    """Return what the contour of survival shows. With too few runs in a cell, it shows where all runs survive."""
    decisive = [panel.low is not None for panel in panels]
    if all(decisive):
        return "95 % survival"
    return "95 % survival, or all runs survive" if any(decisive) else "all runs survive"


def _range(panel: MapPanel) -> str:
    """Return in words in how many cells enough runs survive. Without a contour, this tells whether all or none do."""
    share = np.asarray(panel.survival, float)
    cells = share[np.isfinite(share)]
    if not cells.size:
        return "no cell was run"
    if panel.low is None:
        return f"all runs survive in {int(np.sum(cells == 1))} of {cells.size} cells"
    return f"95 % or more survive in {int(np.sum(cells >= CONTOUR))} of {cells.size} cells"
