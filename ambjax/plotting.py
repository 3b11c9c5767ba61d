"""Pictures of trajectories: the paper's Figures 3 to 6 and an overview of any run."""

import pathlib
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ambjax.trajectory import STALLED, Row, Trajectory

# Okabe and Ito's colours: distinct in print and to colour-blind readers.
INK, BLUE, ORANGE, GREEN, RED = "#222222", "#0072B2", "#E69F00", "#009E73", "#D55E00"
BINS = 2000
# Columns of a panel that are told apart.
PIXELS = 500
# Turns of a chattering voltage that can be followed.
TURNS = 40


class Curve(NamedTuple):
    """A signal of a Row and how to draw it."""

    signal: str
    label: str
    colour: str = BLUE
    style: str = "-"


class Panel(NamedTuple):
    """Curves that share an axis; values are multiplied by `factor` to reach `unit`."""

    ylabel: str
    unit: str
    factor: float
    curves: tuple[Curve, ...]


POSITION = Panel("position", "mm", 1e3, (Curve("z", "$z$"), Curve("r", "$r$", ORANGE, "--")))
ERROR = Panel("$z - r$", "µm", 1e6, (Curve("e_z", "$z - r$"),))
CURRENT = Panel("current", "A", 1.0, (Curve("i", "$i$"), Curve("i_ref", "$i_{ref}$", ORANGE, "--")))
SLIDING = Panel("sliding variable $\\sigma$", "m/s", 1.0, (Curve("sigma", "$\\sigma$"),))
DISTURBANCE = Panel("disturbance $q_z$", "m/s²", 1.0, (Curve("q_z", "$q_z$"),))
FORCE = Panel("scaled force", "A²/m²", 1.0, (Curve("v", "$v$"), Curve("v_star", "$v^*$", ORANGE, "--")))
FORCE_ERROR = Panel("force error $\\tilde v$", "A²/m²", 1.0, (Curve("v_tilde", "$\\tilde v$"),))
VOLTAGE = Panel("voltage $u$", "V", 1.0, (Curve("u", "$u$"),))
CURRENT_DISTURBANCE = Panel("disturbance $q_i$", "A/s", 1.0, (Curve("q_i", "$q_i$"),))

SIGNALS = (POSITION, CURRENT, SLIDING, DISTURBANCE)
INPUTS = (FORCE, FORCE_ERROR, VOLTAGE)
# The paper's Figures 3 to 6: scenario and panels, top to bottom.
PAPER_FIGURES = {
    3: ("regulation", SIGNALS),
    4: ("regulation", INPUTS),
    5: ("tracking", SIGNALS),
    6: ("tracking", INPUTS),
}


def thin(t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most 2 * BINS points that keep every extreme: the least and the largest of each bin."""
    if len(t) <= 4 * BINS:
        return t, y
    width = len(t) // BINS
    whole = width * BINS
    bins = y[:whole].reshape(BINS, width)
    at = np.sort(np.stack([bins.argmin(1), bins.argmax(1)], 1), 1) + width * np.arange(BINS)[:, None]
    at = np.append(at.ravel(), len(t) - 1)
    return t[at], y[at]


def paper_figure(number: int, trajectory: Trajectory, title: str, path: pathlib.Path) -> None:
    """Write the paper's Figure `number` for a trajectory of its scenario."""
    _, panels = PAPER_FIGURES[number]
    height = 1.6 * len(panels) + 0.9
    figure = Figure(figsize=(7.0, height))
    axes = figure.subplots(len(panels), 1, sharex=True)
    # Fixed margins (in inches over the height): a layout engine would draw everything twice.
    figure.subplots_adjust(0.15, 0.5 / height, 0.97, 1 - 0.5 / height, hspace=0.2)
    for ax, panel in zip(axes, panels, strict=True):
        _draw(ax, panel, trajectory)
        if panel is FORCE_ERROR and not np.isfinite(trajectory.lost_at):
            _first_moments(ax, trajectory)
    axes[-1].set_xlabel("time (s)")
    figure.align_ylabels(axes)
    figure.suptitle(title, fontsize=11, y=1 - 0.12 / height)
    figure.savefig(path, dpi=150)


def overview(trajectory: Trajectory, title: str, path: pathlib.Path, window: tuple[float, float] | None = None) -> None:
    """Write one page with every signal of a run: the whole of it, and enlarged how it starts and how it ends.

    `window` (s): that stretch of it instead.
    """
    panels = (POSITION, ERROR, SLIDING, DISTURBANCE, CURRENT, FORCE, FORCE_ERROR, VOLTAGE)
    if np.any(np.asarray(trajectory.rows.q_i)):
        panels = (*panels, CURRENT_DISTURBANCE, _measured(trajectory))
    if window is None:
        columns, grid = _stretches(trajectory), [[panel] * 3 for panel in panels]
    else:
        half = len(panels) // 2
        columns = [(_fate(trajectory), *window), ("", *window)]
        grid = list(zip(panels[:half], panels[half:], strict=True))
    # the whole run has as much room as the two others
    figure = Figure(figsize=(13.0, 1.55 * len(grid) + 0.9), layout="constrained")
    ratios = [2, 1, 1] if window is None else [1, 1]
    axes = figure.subplots(len(grid), len(columns), sharex="col", squeeze=False, width_ratios=ratios)
    for row, (line, drawn) in enumerate(zip(axes, grid, strict=True)):
        for n, (ax, panel, (words, *stretch)) in enumerate(zip(line, drawn, columns, strict=True)):
            _draw(ax, panel, trajectory, stretch=(stretch[0], stretch[1]))
            if window is None and n:
                ax.set_ylabel("")
            if row == 0:
                ax.set_title(words, fontsize=10, loc="left", pad=16)
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(title, fontsize=12)
    figure.savefig(path, dpi=130)


def _stretches(trajectory: Trajectory) -> list[tuple[str, float, float]]:
    """The whole run up to shortly after a loss, its start, and its last moments: words, from, to (s)."""
    t, lost_at = np.asarray(trajectory.rows.t, float), float(trajectory.lost_at)
    ended = bool(np.isfinite(lost_at))
    begin, end = t[0], min(lost_at, t[-1])
    least = t[1] - t[0] if len(t) > 1 else 1e-9  # a loss at the first sample leaves nothing to enlarge
    start = max(_transient(trajectory, end, ended), least)
    last = max(_last_moments(trajectory, end), least)
    beyond = end + 0.15 * (end - begin) * ended
    return [
        (_fate(trajectory), begin, max(beyond, begin + least)),
        (f"the first {_short(start)}", begin, begin + start),
        (f"the last {_short(last)}", end - last, end + 0.15 * last * ended),
    ]


def _fate(trajectory: Trajectory) -> str:
    lost_at = float(trajectory.lost_at)
    if not np.isfinite(lost_at):
        return ""
    return (
        f"{'not decided from' if trajectory.lost_code == STALLED else 'lost at'} {lost_at:.4g} s: {trajectory.lost_why}"
    )


def _short(seconds: float) -> str:
    return f"{1e3 * seconds:.2g} ms" if seconds < 0.1 else f"{seconds:.2g} s"


def _last_moments(trajectory: Trajectory, end: float) -> float:
    """How much of the end to enlarge, s: 20 ms, a fifth of the run at most, and no more than some turns of the voltage."""
    t = np.asarray(trajectory.rows.t, float)
    longest = min(0.02, (end - t[0]) / 5)
    late = (t >= end - longest) & (t < end)
    turning = np.flatnonzero(np.diff(np.sign(np.diff(_signal(trajectory.rows, "u")[late]))))
    return longest if turning.size <= TURNS else float(end - t[late][turning[-TURNS]])


def _transient(trajectory: Trajectory, end: float, ended: bool) -> float:
    """How much of the start to enlarge, s: thrice what the errors take to come down, at most a 20th of all (lost: a 3rd)."""
    t = np.asarray(trajectory.rows.t, float)
    alive = t < max(end, t[min(1, len(t) - 1)])
    t, most = t[alive] - t[0], (end - t[0]) / (3 if ended else 20)
    slowest = 0.0
    for name in ("e_z", "sigma", "v_tilde", "e"):
        size = np.abs(_signal(trajectory.rows, name)[alive])
        down = size <= max(0.02 * size.max(), 1.5 * size[len(size) // 2 :].max())
        slowest = max(slowest, t[np.argmax(down)])
    return min(max(3 * slowest, 20 * (t[1] - t[0]) if len(t) > 1 else 0.0, most / 10), most)


def readings(trajectories: dict[str, Trajectory], title: str, settle: float, path: pathlib.Path) -> None:
    """Write one picture of a scenario under each reading, a column each: position above, error below."""
    figure = Figure(figsize=(4.0 * len(trajectories), 4.9), layout="constrained")
    axes = figure.subplots(2, len(trajectories), squeeze=False)
    position = POSITION._replace(curves=(Curve("z_measured", "$z$ measured", "#bbbbbb"), *POSITION.curves))
    for (name, trajectory), (upper, lower) in zip(trajectories.items(), axes.T, strict=True):
        _draw(upper, position, trajectory, first=True)
        _draw(lower, ERROR, trajectory)
        upper.set_title(name, loc="left", fontsize=10, fontweight="bold")
        lower.set_xlabel("time (s)", fontsize=9)
        if not np.isfinite(trajectory.lost_at):
            late = np.abs(_signal(trajectory.rows, "e_z")[np.asarray(trajectory.rows.t) >= settle]).max()
            words = f"at most {1e6 * late:.2g} µm after {settle:g} s"
            lower.annotate(words, (0.98, 0.06), xycoords="axes fraction", ha="right", fontsize=9, color=INK)
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=130)


def _measured(trajectory: Trajectory) -> Panel:
    return Panel("measured position", "mm", 1e3, (Curve("z_measured", "$z$ measured", GREEN), Curve("z", "$z$")))


def _draw(
    ax: Axes,
    panel: Panel,
    trajectory: Trajectory,
    first: bool = False,
    stretch: tuple[float, float] | None = None,
) -> None:
    """A panel of the whole run, or of a stretch of it (s): there, what is too fast to see is a band with its mean."""
    rows, lost_at = trajectory.rows, float(trajectory.lost_at)
    t = np.asarray(rows.t)
    low, high = (t[0], t[-1]) if stretch is None else stretch
    shown = (t < lost_at) & (t >= low) & (t <= high)
    for curve in panel.curves:
        x, y = t[shown], panel.factor * _signal(rows, curve.signal)[shown]
        if stretch is None:
            x, y = thin(x, y)
        else:
            x, y = _band(ax, x, y, curve.colour)
        ax.plot(x, y, curve.style, color=curve.colour, linewidth=1.2, label=curve.label)
    ax.set_ylabel(f"{panel.ylabel}\n({panel.unit})", fontsize=9)
    ax.set_xlim(low, high)
    ax.grid(alpha=0.3, linewidth=0.5)
    ax.tick_params(labelsize=8)
    ax.margins(y=0.12)
    if len(panel.curves) > 1:
        # Above the panel: inside, it would hide a peak of some run or other.
        above = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.97), "frameon": False, "borderaxespad": 0.1}
        ax.legend(fontsize=8, ncols=len(panel.curves), **above)
    if np.isfinite(lost_at):
        if stretch is None:
            ax.set_xlim(0, min(t[-1], max(1.6 * lost_at, 1e-3)))
        _mark_loss(ax, trajectory, first=first or (stretch is None and panel in (POSITION, FORCE)))


def _band(ax: Axes, t: np.ndarray, y: np.ndarray, colour: str) -> tuple[np.ndarray, np.ndarray]:
    """The curve to draw: y itself, or where samples are far more than pixels its mean, over a band of its extremes."""
    if len(t) <= 4 * PIXELS:
        return t, y
    starts = np.linspace(0, len(t), PIXELS, endpoint=False).astype(int)
    middle = np.add.reduceat(t, starts) / np.diff([*starts, len(t)])
    ends = np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
    ax.fill_between(middle, *ends, color=colour, alpha=0.35, linewidth=0)
    return middle, np.add.reduceat(y, starts) / np.diff([*starts, len(t)])


def _first_moments(ax: Axes, trajectory: Trajectory, until: float = 0.01) -> None:
    """The first 10 ms, in which the paper's inversion error reaches zero, enlarged."""
    early = np.asarray(trajectory.rows.t) <= until
    inset = ax.inset_axes((0.32, 0.3, 0.4, 0.6))
    inset.plot(1e3 * np.asarray(trajectory.rows.t)[early], _signal(trajectory.rows, "v_tilde")[early], color=BLUE)
    inset.set_title("first 10 ms (time in ms)", fontsize=7, pad=2)
    inset.tick_params(labelsize=7)
    inset.grid(alpha=0.3, linewidth=0.5)


def _mark_loss(ax: Axes, trajectory: Trajectory, first: bool) -> None:
    """Shade what follows the loss, and say why."""
    lost_at, end = float(trajectory.lost_at), float(np.asarray(trajectory.rows.t)[-1])
    ax.axvspan(lost_at, max(end, ax.get_xlim()[1]), color=RED, alpha=0.12, linewidth=0)
    ax.axvline(lost_at, color=RED, linewidth=1.0)
    if first:
        why = trajectory.lost_why.replace(": ", ":\n").replace(" reached ", "\nreached ")
        words = f"lost at {lost_at:.4g} s\n{why}"
        ax.annotate(words, (0.99, 0.06), xycoords="axes fraction", ha="right", va="bottom", fontsize=7, color=INK)


def _signal(rows: Row, name: str) -> Any:
    return np.asarray(getattr(rows, name), float)
