"""Pictures over frequency: sensitivity functions, Nyquist curve, Bode plot, stiffness, and a comparison of cases."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ambjax.pictures.figures import BLUE, GREEN, INK, ORANGE, RED
from ambjax.pictures.scales import own_style, prefix_of

# Colour and style of each loop; later ones are dashed, so that equal curves stay visible.
LINES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, ":"), (RED, "-."))
# Styles of the cases of a comparison, each with four colours.
STYLES = ("-", "--")
ZONES = (("A", "#e5f2ea"), ("B", "#f6f3d8"), ("C", "#fae3cf"), ("D", "#f6d5d5"))
POINTS = 1200
# Lowest |S| shown.
LOWEST = 0.01
# Half width of the Nyquist panel around the point -1.
WINDOW = 3.0


@own_style
def frequency_figure(
    title: str, loops: Sequence[Any], limits: Sequence[float], span: tuple[float, float], measured: Any = None
) -> Figure:
    """Return a picture: |S| with zones, |T|, |KS|, dynamic stiffness, Nyquist curve with the disk, Bode plot of L.

    `loops`: stable loops, as `OperatingPoint`. `limits`: upper limits of the zones A, B and C. `span`: lowest and
    highest frequency, Hz. `measured`: an `Injection` into the nominal loop with S, T and KS; its points are drawn with
    the curves. Only the first len(LINES) loops are drawn. Without a loop, because none is stable, there are no zones.
    """
    figure = Figure(figsize=(12, 11), layout="constrained")
    left = figure.add_gridspec(4, 2)
    S_axes, T_axes, KS_axes, stiffness_axes = (figure.add_subplot(left[row, 0]) for row in range(4))
    nyquist_axes = figure.add_subplot(left[:2, 1])
    gain_axes, phase_axes = (figure.add_subplot(left[row, 1]) for row in (2, 3))
    f = np.geomspace(*span, POINTS)
    for loop, (colour, line) in zip(loops, LINES, strict=False):
        H = np.asarray(loop.system.response(f))
        S = H[:, 0, 0]
        L = 1 / S - 1
        style = {"color": colour, "linestyle": line, "linewidth": 1.4, "label": loop.name}
        S_axes.loglog(f, np.abs(S), **style)
        T_axes.loglog(f, np.abs(S - 1), **style)
        KS_axes.loglog(f, np.abs(H[:, 2, 0]), **style)
        stiffness_axes.loglog(f, loop.m / np.abs(H[:, 3, 2]), **style)
        nyquist_axes.plot(L.real, L.imag, **style)
        gain_axes.loglog(f, np.abs(L), **style)
        phase_axes.semilogx(f, np.degrees(np.unwrap(np.angle(L))), **style)
    if measured is not None:
        L = 1 / measured.S - 1
        points = {"color": INK, "marker": "o", "markersize": 3, "linestyle": "", "label": "injected"}
        for ax, x in ((S_axes, measured.S), (T_axes, measured.T), (KS_axes, measured.KS), (gain_axes, L)):
            ax.loglog(measured.frequency, np.abs(x), **points)
        nyquist_axes.plot(L.real, L.imag, **points)
        phase = _near(np.degrees(np.angle(L)), measured.frequency, phase_axes)
        phase_axes.semilogx(measured.frequency, phase, **points)
    if loops:
        shade_zones(S_axes, limits)
    else:
        S_axes.text(0.5, 0.5, "the loop is not stable", transform=S_axes.transAxes, ha="center", va="center")
    _nyquist(nyquist_axes, loops)
    gain_axes.axhline(1.0, color=INK, linewidth=0.8)
    labels = {
        S_axes: "|S|",
        T_axes: "|T|",
        KS_axes: "|KS|, V/m",
        stiffness_axes: "dynamic stiffness, N/m",
        gain_axes: "|L|",
        phase_axes: "phase of L, degrees",
    }
    for ax, label in labels.items():
        ax.set(xlim=span, ylabel=label)
        ax.grid(True, which="major", color="#dddddd", linewidth=0.6)
    for ax in (stiffness_axes, phase_axes):
        ax.set_xlabel("frequency, Hz")
    if loops:
        S_axes.legend(fontsize=8, loc="best")
    figure.suptitle(f"{title}: sensitivity at the position sensor", fontsize=12)
    return figure


def _near(phase: np.ndarray, f: np.ndarray, ax: Axes) -> np.ndarray:
    """Return phases [L] (degrees), shifted by whole turns to be near the first curve of the axes, if there is one."""
    if not (curves := ax.get_lines()):
        return phase
    there = np.interp(f, *np.asarray(curves[0].get_xydata()).T)
    return phase + 360 * np.round((there - phase) / 360)


def shade_zones(ax: Axes, limits: Sequence[float]) -> None:
    """Shade the zones of |S|, and name each at the right edge."""
    low, high = max(ax.get_ylim()[0], LOWEST), max(ax.get_ylim()[1], 1.6 * limits[-1])
    edges = [low, *limits, high]
    for (name, colour), bottom, top in zip(ZONES, edges, edges[1:], strict=False):
        ax.axhspan(bottom, top, color=colour, zorder=0)
        middle = np.sqrt(max(bottom, top / 2) * top)
        x = 1.01 if name in "AC" else 1.03  # two columns, because a zone may be less high than a letter
        ax.text(x, middle, name, transform=ax.get_yaxis_transform(), fontsize=8, va="center", color=INK)
    ax.set_ylim(low, high)


def _nyquist(ax: Axes, loops: Sequence[Any]) -> None:
    """Mark -1, and shade the disk of the disk margin of the first loop, which its Nyquist curve touches."""
    if loops:
        # the disk with the diameter from -(2 + d)/(2 - d) to its inverse
        d = min(loops[0].analysis.margins_at.reading.dm, 1.999)
        far, near = (2 + d) / (2 - d), (2 - d) / (2 + d)
        ax.add_patch(Circle((-(far + near) / 2, 0), (far - near) / 2, color="#f6d5d5", zorder=0, linewidth=0))
    ax.plot([-1], [0], marker="+", color=INK, markersize=10)
    ax.set(xlim=(-1 - WINDOW, -1 + WINDOW), ylim=(-WINDOW, WINDOW))
    ax.set(xlabel="real part of L", ylabel="imaginary part of L")
    ax.set_aspect("equal", adjustable="box")
    ax.grid(True, color="#dddddd", linewidth=0.6)
    ax.set_title("Nyquist curve; shaded: disk margin of the first loop", fontsize=9)


@own_style
def comparison_figure(cases: Sequence[Any], limits: Sequence[float], span: tuple[float, float]) -> Figure:
    """Return a picture: |S| with zones, |KS|, share of members below an rms error, rms error against rms voltage.

    `cases`: results of cases, as `Compared`; |S| and |KS| of a loop that is not stable are not drawn. `limits`: upper
    limits of the zones A, B and C. `span`: lowest and highest frequency, Hz; a curve ends at half the sampling rate of
    its case. A member that is lost has no error: the curve of a case that loses members ends below 1. At most 8 cases
    are drawn.
    """
    figure = Figure(figsize=(12, 8.5), layout="constrained")
    (S_axes, error_axes), (KS_axes, effort_axes) = figure.subplots(2, 2)
    grid = np.geomspace(*span, POINTS)
    errors = [one.columns["settled_rms_error_m"][one.held] for one in cases]
    factor, unit = prefix_of("m", float(max((x.max() for x in errors if x.size), default=1e-6)))
    looks = [(colour, style) for style, colour in itertools.product(STYLES, (BLUE, ORANGE, GREEN, RED))]
    for one, error, (colour, style) in zip(cases, errors, looks, strict=False):
        name, loop = one.case.name, one.loop
        look = {"color": colour, "linestyle": style, "linewidth": 1.5, "label": name}
        if loop.system is not None:
            period = loop.system.period
            f = grid if period is None else grid[grid <= 0.5 / float(period)]
            H, k = np.asarray(loop.system.response(f)), loop.channel
            S_axes.loglog(f, np.abs(H[:, k, k]), **look | {"label": f"{name}: {loop.numbers.get('worst_at', '')}"})
            KS_axes.loglog(f, np.abs(H[:, loop.command, k]), **look)
        lost, share = int(np.sum(~one.held)), np.arange(1, error.size + 1) / one.held.size
        label = f"{name} ({lost} lost)" if lost else name
        error_axes.step(factor * np.sort(error), share, where="post", **look | {"label": label})
        mark = {"color": colour, "marker": "o" if style == "-" else "x", "linestyle": "", "markersize": 3, "alpha": 0.4}
        effort_axes.plot(one.columns["settled_rms_u_V"][one.held], factor * error, **mark)
    shade_zones(S_axes, limits)
    labels = {
        S_axes: ("frequency, Hz", "|S|", "sensitivity at the position sensor, with zones"),
        KS_axes: ("frequency, Hz", "|KS|, V/m", "voltage per error of the position sensor"),
        error_axes: (f"settled rms error, {unit}", "share of all members", "members with at most this error"),
        effort_axes: ("settled rms voltage, V", f"settled rms error, {unit}", "one point per member"),
    }
    for ax, (x, y, title) in labels.items():
        ax.set(xlabel=x, ylabel=y)
        ax.set_title(title, fontsize=10, color=INK)
        ax.grid(True, which="major", color="#dddddd", linewidth=0.6)
    error_axes.set_ylim(0, 1.02)
    error_axes.legend(fontsize=8, loc="lower right")
    if any(one.loop.system is not None and one.loop.numbers.get("worst_at") for one in cases):
        S_axes.legend(fontsize=8, loc="lower right")
    for ax in (S_axes, KS_axes):
        ax.set_xlim(span)
    return figure
