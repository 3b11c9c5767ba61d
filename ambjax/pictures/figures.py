"""Pictures of trajectories: panels of signals, the paper's Figures 3 to 6, readings, phase plane; thinned curves."""

import textwrap
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ambjax.pictures.scales import own_style, prefix_of
from ambjax.simulation.trajectory import STALLED, Row, Trajectory

# Okabe and Ito's colours: distinct in print and to colour-blind readers.
INK, BLUE, ORANGE, GREEN, RED = "#222222", "#0072B2", "#E69F00", "#009E73", "#D55E00"
# Bins of a thinned curve: more than the width of a picture in pixels.
BINS = 2000
# A panel of a part of the run (a stretch) with more than 4 PIXELS samples is divided into PIXELS columns.
PIXELS = 500
# Smallest vertical range of a panel of a stretch, as a share of the range over the whole run.
FLAT = 0.005


class Curve(NamedTuple):
    """A signal of a Row, its label, its colour and its line style."""

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
COILS = Panel("coil currents", "A", 1.0, (Curve("i_1", "$i_1$"), Curve("i_2", "$i_2$", ORANGE)))
MAGNETIC = Panel("magnetic force", "N", 1.0, (Curve("force", "$F$"),))
FORCE_ERROR = Panel("force error $\\tilde v$", "A²/m²", 1.0, (Curve("v_tilde", "$\\tilde v$"),))
VOLTAGE = Panel("voltage $u$", "V", 1.0, (Curve("u", "$u$"),))
# Under noise u jumps at each sample; the voltage of a drive is close to the average over the sample.
AVERAGED = Panel("voltage $u$,\naveraged", "V", 1.0, (Curve("u_mean", "$u$"),))
CURRENT_DISTURBANCE = Panel("disturbance $q_i$", "A/s", 1.0, (Curve("q_i", "$q_i$"),))
MEASUREMENT = Panel("measured position", "mm", 1e3, (Curve("z_measured", "$z$ measured", GREEN), Curve("z", "$z$")))

MOTION = (POSITION, CURRENT, SLIDING, DISTURBANCE)
FORCES = (FORCE, FORCE_ERROR, VOLTAGE)
# The paper's Figures 3 to 6: scenario and panels, top to bottom.
PAPER_FIGURES = {3: ("regulation", MOTION), 4: ("regulation", FORCES), 5: ("tracking", MOTION), 6: ("tracking", FORCES)}


@own_style
def paper_figure(number: int, trajectory: Trajectory, title: str) -> Figure:
    """Return the paper's Figure `number`, drawn from a trajectory of its scenario."""
    _, panels = PAPER_FIGURES[number]
    height = 1.6 * len(panels) + 0.9
    figure = Figure(figsize=(7.0, height))
    axes = figure.subplots(len(panels), 1, sharex=True)
    # The margins are fixed (in inches over the height), because a layout engine draws everything twice.
    figure.subplots_adjust(0.15, 0.5 / height, 0.97, 1 - 0.5 / height, hspace=0.2)
    for ax, panel in zip(axes, panels, strict=True):
        draw_panel(ax, panel, trajectory)
        if panel is FORCE_ERROR and not np.isfinite(trajectory.lost_at):
            _first_moments(ax, trajectory)
    axes[-1].set_xlabel("time (s)")
    figure.align_ylabels(axes)
    figure.suptitle(title, fontsize=11, y=1 - 0.12 / height)
    return figure


@own_style
def readings(trajectories: dict[str, Trajectory], title: str, settle: float) -> Figure:
    """Return one picture of a scenario in all readings, one column each: position above, error below."""
    figure = Figure(figsize=(4.0 * len(trajectories), 4.9), layout="constrained")
    axes = figure.subplots(2, len(trajectories), squeeze=False)
    position = POSITION._replace(curves=(Curve("z_measured", "$z$ measured", "#bbbbbb"), *POSITION.curves))
    for (name, trajectory), (upper, lower) in zip(trajectories.items(), axes.T, strict=True):
        draw_panel(upper, position, trajectory, first=True)
        draw_panel(lower, ERROR, trajectory)
        upper.set_title(name, loc="left", fontsize=10, fontweight="bold", pad=18)  # above the legend
        lower.set_xlabel("time (s)", fontsize=9)
        if not np.isfinite(trajectory.lost_at):
            late = np.abs(signal_of(trajectory.rows, "e_z")[np.asarray(trajectory.rows.t) >= settle]).max()
            words = f"at most {1e6 * late:.2g} µm after {settle:g} s"
            lower.annotate(words, (0.98, 0.06), xycoords="axes fraction", ha="right", fontsize=9, color=INK)
    figure.suptitle(title, fontsize=11)
    return figure


def draw_panel(
    ax: Axes, panel: Panel, trajectory: Trajectory, first: bool = False, stretch: tuple[float, float] | None = None
) -> None:
    """Draw a panel of the whole run, or of `stretch` (begin and end, s), up to the loss of the rotor.

    If a stretch has more than 4 PIXELS samples, the panel shows means over PIXELS columns, and the extremes as a band.
    `first`: write the cause of a loss into this panel. POSITION and FORCE of a whole run always contain it.
    """
    rows, lost_at = trajectory.rows, float(trajectory.lost_at)
    t = np.asarray(rows.t)
    low, high = (t[0], t[-1]) if stretch is None else stretch
    # with the outer neighbour of a bound that lies between two samples
    part = slice(max(int(np.searchsorted(t, low, "right")) - 1, 0), int(np.searchsorted(t, high, "left")) + 1)
    held = t[part] < lost_at
    for curve in panel.curves:
        x, y = t[part][held], panel.factor * signal_of(rows, curve.signal)[part][held]
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
    if stretch is not None:
        _keep_scale(ax, [panel.factor * signal_of(rows, curve.signal)[t < lost_at] for curve in panel.curves])
    if len(panel.curves) > 1:
        # Above the panel, because inside it could hide a peak.
        above = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.97), "frameon": False, "borderaxespad": 0.1}
        ax.legend(fontsize=8, ncols=len(panel.curves), **above)
    if np.isfinite(lost_at):
        if stretch is None:
            # the loss may come after the last sample
            ax.set_xlim(0, max(lost_at, min(t[-1], max(1.6 * lost_at, 1e-3))))
        _mark_loss(ax, trajectory, first=first or (stretch is None and panel in (POSITION, FORCE)))


def _keep_scale(ax: Axes, whole: list[np.ndarray]) -> None:
    """Limit the vertical magnification, so that rounding in a settled signal does not look like an event."""
    values = np.concatenate(whole)
    (low, high), least = ax.get_ylim(), FLAT * np.ptp(values) if values.size else 0.0
    if high - low < least:
        ax.set_ylim((low + high - least) / 2, (low + high + least) / 2)


def _band(ax: Axes, t: np.ndarray, y: np.ndarray, colour: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the curve to draw: y or, with many samples, the mean in each column. Draw the extremes as a band."""
    if len(t) <= 4 * PIXELS:
        return t, y
    x, low, high = envelope(t, y, y, PIXELS)
    ax.fill_between(x, low, high, color=colour, alpha=0.35, linewidth=0)
    return smoothed(t, y, PIXELS)


def _first_moments(ax: Axes, trajectory: Trajectory) -> None:
    """Draw an inset of the first 10 ms, in which the paper's inversion error reaches zero."""
    early = np.asarray(trajectory.rows.t) <= 0.01
    inset = ax.inset_axes((0.32, 0.3, 0.4, 0.6))
    inset.plot(1e3 * np.asarray(trajectory.rows.t)[early], signal_of(trajectory.rows, "v_tilde")[early], color=BLUE)
    inset.set_title("first 10 ms (time in ms)", fontsize=7, pad=2)
    inset.tick_params(labelsize=7)
    inset.grid(alpha=0.3, linewidth=0.5)


def _mark_loss(ax: Axes, trajectory: Trajectory, first: bool) -> None:
    """Shade the time after the loss or the stall. `first`: write the cause too."""
    lost_at, end = float(trajectory.lost_at), float(np.asarray(trajectory.rows.t)[-1])
    ax.axvspan(lost_at, max(end, ax.get_xlim()[1]), color=RED, alpha=0.12, linewidth=0)
    ax.axvline(lost_at, color=RED, linewidth=1.0)
    if first:
        status = "not decided from" if trajectory.lost_code == STALLED else "lost at"
        reason = textwrap.fill(trajectory.lost_reason, 24)
        words = f"{status} {lost_at:.4g} s\n{trajectory.lost_event}:\n{reason}"
        paper = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1}  # a curve may pass behind the text
        ax.text(0.99, 0.06, words, transform=ax.transAxes, ha="right", va="bottom", fontsize=7, color=INK, bbox=paper)


def signal_of(rows: Row, name: str) -> np.ndarray:
    """Return the signal of this name, floats [T]."""
    return np.asarray(getattr(rows, name), float)


@own_style
def phase_plane(trajectory: Trajectory, title: str, settle: float = 0.0) -> Figure:
    """Return the velocity z_dot against the displacement z, the whole run and the run from `settle` (s) on.

    The colour is the time. A circle marks the start; a cross marks the loss of the rotor. The settled part has a panel
    of its own if the rotor is held and `settle` lies within the run.
    """
    rows, lost_at = trajectory.rows, float(trajectory.lost_at)
    t, z, z_dot = (np.asarray(x, float) for x in (rows.t, rows.z, rows.z_dot))
    held = t <= lost_at
    parts = [("the whole run", held)]
    if not np.isfinite(lost_at) and t[0] < settle < t[-1]:
        parts.append((f"from {settle:g} s on", t >= settle))
    figure = Figure(figsize=(5.2 * len(parts) + 1.2, 4.6), layout="constrained")
    axes = figure.subplots(1, len(parts), squeeze=False)[0]
    for ax, (words, part) in zip(axes, parts, strict=True):
        largest = [float(np.abs(x[part]).max(initial=0.0)) for x in (z, z_dot)]
        (by_z, unit), (by_rate, rate) = map(prefix_of, ("m", "m/s"), largest)
        points = np.column_stack([by_z * z[part], by_rate * z_dot[part]])
        segments = list(np.stack([points[:-1], points[1:]], 1))
        lines = LineCollection(segments, cmap="viridis", array=t[part][:-1], linewidth=1)
        ax.add_collection(lines)
        ax.plot(points[0, 0], points[0, 1], "o", color=INK, markersize=5)
        if np.isfinite(lost_at):
            ax.plot(points[-1, 0], points[-1, 1], "x", color=INK, markersize=8)
        ax.margins(0.08)
        ax.autoscale_view()
        ax.set(xlabel=f"displacement z ({unit})", ylabel=f"velocity dz/dt ({rate})")
        ax.set_title(words, fontsize=10)
        figure.colorbar(lines, ax=ax, label="time (s)")
    figure.suptitle(title, fontsize=12)
    return figure


def thin(t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return K of the T samples of the curve y(t), enough to draw it; up to 4 BINS samples are returned unchanged."""
    n = len(t)
    if n <= 4 * BINS:
        return t, y
    width = -(-n // BINS)
    finite, rows = np.isfinite(y), -(-n // width)
    padded = np.full((2, rows * width), np.inf)
    padded[:, :n] = np.where(finite, [y, -y], np.inf)
    extremes = padded.reshape(2, rows, width).argmin(2) + width * np.arange(rows)
    border = np.flatnonzero(np.diff(finite))
    at = np.unique(np.concatenate([extremes.ravel(), border, border + 1, [0, n - 1]]))
    return t[at], y[at]


def _bin_starts(samples: int, bins: int) -> np.ndarray:
    """Return the index of the first sample of each bin, [bins]. The sizes of the bins differ by at most one sample."""
    return np.arange(bins) * samples // bins


def smoothed(t: np.ndarray, y: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean times and means of y over `bins` bins of samples, [bins + 2]."""
    starts = _bin_starts(len(t), bins)
    centres, means = (np.add.reduceat(values, starts) / np.diff(starts, append=len(t)) for values in (t, y))
    return np.concatenate([t[:1], centres, t[-1:]]), np.concatenate([means[:1], means, means[-1:]])


def envelope(
    t: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, lower and upper border of a band; up to 4 `bins` samples are returned unchanged."""
    if len(t) <= 4 * bins:
        return t, low, high
    starts = _bin_starts(len(t), bins)
    edges = np.append(t[starts], t[-1])
    x = np.stack([edges[:-1], edges[1:]], 1).ravel()
    return x, np.fmin.reduceat(low, starts).repeat(2), np.fmax.reduceat(high, starts).repeat(2)
