"""The overview of a run: its main signals, over the whole run, and enlarged at its start and at its end."""

import itertools
from collections.abc import Collection

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ambjax.pictures import figures
from ambjax.pictures.scales import own_style, prefix_of
from ambjax.simulation.trajectory import STALLED, Trajectory

# Largest number of reversals of a chattering voltage in the enlarged end of a run.
TURNS = 40


@own_style
def overview_figure(
    trajectory: Trajectory,
    title: str,
    window: tuple[float, float] | None = None,
    settle: float = 0.0,
    shown: Collection[str] = (),
) -> Figure:
    """Return one page with the main signals of a run, over the whole run, and enlarged at its start and at its end.

    `window`: begin and end, s; the page then shows only this stretch. `settle` (s): the vertical scales of the panels
    of the whole run fit the signals from this time on, unless the rotor is lost. The start has panels of its own.
    `shown`: labels of the panels; empty: all panels.
    """
    panels = [panel for panel in _panels(trajectory) if not shown or panel.ylabel in shown]
    if window is None:
        columns, grid = _stretches(trajectory, settle), [[panel] * 3 for panel in panels]
    else:
        half = -(-len(panels) // 2)
        columns = [(_status(trajectory), *window), ("", *window)]
        grid = list(itertools.zip_longest(panels[:half], panels[half:]))
    # the whole run is as wide as the two enlargements together
    width, height = 13.0, 1.55 * len(grid) + 1.2
    figure = Figure(figsize=(width, height))
    # The margins are fixed, in inches, because a layout engine would double the time.
    figure.subplots_adjust(1.25 / width, 0.5 / height, 1 - 0.2 / width, 1 - 0.85 / height, wspace=0.24, hspace=0.24)
    ratios = [2, 1, 1] if window is None else [1, 1]
    axes = figure.subplots(len(grid), len(columns), sharex="col", squeeze=False, width_ratios=ratios)
    for row, (line, column) in enumerate(zip(axes, grid, strict=True)):
        for n, (ax, panel, (words, *stretch)) in enumerate(zip(line, column, columns, strict=True)):
            if panel is None:
                ax.set_axis_off()
                continue
            figures.draw_panel(ax, panel, trajectory, stretch=(stretch[0], stretch[1]))
            if window is None and n == 0 and _scales_late(trajectory, settle):
                _fit(ax, panel, trajectory, settle)
            if window is None and n:
                ax.set_ylabel("")
            if row == 0:
                ax.set_title(words, fontsize=10, loc="left", pad=16)
    for n, line in enumerate(axes.T):
        lowest = [ax for ax in line if ax.axison][-1]
        if window is None and n:
            lowest.xaxis.set_major_locator(MaxNLocator(4))  # more labels than that touch each other
        lowest.tick_params(labelbottom=True)
        lowest.set_xlabel("time (s)")
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(title, fontsize=12, y=1 - 0.15 / height, va="top")
    return figure


def _panels(trajectory: Trajectory) -> tuple[figures.Panel, ...]:
    """Return the panels of a run; those of q_i and of the measured position only if they differ from 0 and from z."""
    rows = trajectory.rows
    panels = (_prefixed(figures.POSITION, trajectory), _prefixed(figures.ERROR, trajectory))
    panels = (*panels, figures.SLIDING, figures.DISTURBANCE, figures.CURRENT, figures.COILS, figures.MAGNETIC)
    panels = (*panels, figures.FORCE_ERROR, figures.AVERAGED)
    if np.any(np.asarray(rows.q_i)):
        panels = (*panels, figures.CURRENT_DISTURBANCE)
    measured = _prefixed(figures.MEASUREMENT, trajectory)
    return (*panels, measured) if np.any(np.asarray(rows.z_measured) != np.asarray(rows.z)) else panels


def _prefixed(panel: figures.Panel, trajectory: Trajectory) -> figures.Panel:
    """Return a panel of lengths in the prefix of metres that suits its first signal."""
    held = np.asarray(trajectory.rows.t) < float(trajectory.lost_at)
    values = np.abs(figures.signal_of(trajectory.rows, panel.curves[0].signal)[held])
    factor, unit = prefix_of("m", float(values.max(initial=0.0)))
    return panel._replace(unit=unit, factor=factor)


def _scales_late(trajectory: Trajectory, settle: float) -> bool:
    """Return whether the vertical scales of the whole run are those from `settle` (s) on."""
    t = np.asarray(trajectory.rows.t, float)
    return not np.isfinite(float(trajectory.lost_at)) and t[0] < settle < t[-1]


def _fit(ax: Axes, panel: figures.Panel, trajectory: Trajectory, settle: float) -> None:
    """Set the vertical scale of a panel to its signals from `settle` (s) on, with a margin of 12 %."""
    late = np.asarray(trajectory.rows.t) >= settle
    values = [panel.factor * figures.signal_of(trajectory.rows, curve.signal)[late] for curve in panel.curves]
    low, high = float(np.min(values)), float(np.max(values))
    if high > low:
        margin = 0.12 * (high - low)
        ax.set_ylim(low - margin, high + margin)


def _stretches(trajectory: Trajectory, settle: float) -> list[tuple[str, float, float]]:
    """Return title, begin and end (s) of each column: the run up to shortly after a loss, its start, and its end."""
    t, lost_at = np.asarray(trajectory.rows.t, float), float(trajectory.lost_at)
    loss = bool(np.isfinite(lost_at))
    begin, end = t[0], min(lost_at, t[-1])
    least = t[1] - t[0] if len(t) > 1 else 1e-9  # a loss at the first sample leaves nothing to enlarge
    start = max(_transient(trajectory, end, loss), least)
    last = max(_last_moments(trajectory, end), least)
    beyond = end + 0.15 * (end - begin) * loss
    words = f"whole run (axis: values after {settle:g} s)" if _scales_late(trajectory, settle) else ""
    return [
        (_status(trajectory) or words, begin, max(beyond, begin + least)),
        (f"the first {_short(start)}", begin, begin + start),
        (f"the last {_short(last)}", end - last, end + 0.15 * last * loss),
    ]


def _status(trajectory: Trajectory) -> str:
    lost_at = float(trajectory.lost_at)
    if not np.isfinite(lost_at):
        return ""
    status = "not decided from" if trajectory.lost_code == STALLED else "lost at"
    return f"{status} {lost_at:.4g} s: {trajectory.lost_why}"


def _short(seconds: float) -> str:
    return f"{1e3 * seconds:.2g} ms" if seconds < 0.1 else f"{seconds:.2g} s"


def _last_moments(trajectory: Trajectory, end: float) -> float:
    """Return the length of the enlarged end, s: the shortest of 20 ms, a fifth of the run, and TURNS reversals of u."""
    t = np.asarray(trajectory.rows.t, float)
    longest = min(0.02, (end - t[0]) / 5)
    late = (t >= end - longest) & (t < end)
    turning = np.flatnonzero(np.diff(np.sign(np.diff(figures.signal_of(trajectory.rows, "u_mean")[late]))))
    return longest if turning.size <= TURNS else float(end - t[late][turning[-TURNS]])


def _transient(trajectory: Trajectory, end: float, loss: bool) -> float:
    """Return the length of the enlarged start, s: three times the time in which the errors decay."""
    t = np.asarray(trajectory.rows.t, float)
    alive = t <= max(end, t[min(1, len(t) - 1)])
    t, most = t[alive] - t[0], (end - t[0]) / (3 if loss else 20)
    slowest = 0.0
    for name in ("e_z", "sigma", "v_tilde", "e"):
        size = np.abs(figures.signal_of(trajectory.rows, name)[alive])
        down = size <= max(0.02 * size.max(), 1.5 * size[len(size) // 2 :].max())
        slowest = max(slowest, t[np.argmax(down)])
    return min(max(3 * slowest, 20 * (t[1] - t[0]) if len(t) > 1 else 0.0, most / 10), most)
