"""Pictures of a machine: its axes over time and its orbits, and its sensitivity and poles against speed."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ambjax.linear.margins import BAND
from ambjax.linear.rotor_modes import LIGHT
from ambjax.pictures.scales import own_style

# Largest number of points of a drawn curve.
MOST_POINTS = 4000
# Share of a limit from which on the limit is drawn.
NEAR = 0.5


@own_style
def machine_figure(case: Any, signals: dict[str, np.ndarray], title: str) -> Figure:
    """Return one page: displacement, current and voltage of every axis over time, and the orbit of each radial bearing.

    The orbits show the time from run.settle on, at the magnets, or the whole run of a rotor that is lost before. If the
    stops have places of their own, displacements and orbits are those at the stops.
    """
    axes, t = [str(name) for name in signals["axes"]], signals["t"]
    place = "stop" if "z_stop" in signals else "magnet"
    signals = signals | {"z": signals.get("z_stop", signals["z"])}
    step = max(len(t) // MOST_POINTS, 1)
    pairs = orbits_of(axes)
    figure = Figure(figsize=(13.0, 8.2), layout="constrained")
    grid = figure.add_gridspec(3, 2 + bool(pairs), width_ratios=[2, 2, 1.3][: 2 + bool(pairs)])
    end = min(t[-1], float(signals["lost_at"]))
    early = t <= min(end, max(0.02, 0.1 * t[-1]))
    begin = case.settle if case.settle < end else 0.0
    settled = (t >= begin) & (t <= end)
    rows = (("z", 1e6, f"displacement at the {place}, µm"), ("i", 1.0, "current, A"), ("u", 1.0, "voltage, V"))
    for row, (name, scale, words) in enumerate(rows):
        for column, shown in enumerate((slice(None, None, step), early)):
            ax = figure.add_subplot(grid[row, column])
            for k, axis in enumerate(axes):
                ax.plot(t[shown], scale * signals[name][shown, k], label=axis, linewidth=0.9)
            _limit_lines(ax, case, name, scale)
            part = ("whole run", "start of the run")[column] if row == 0 else ""
            ax.set(xlabel="time, s" if row == 2 else "", ylabel=words if column == 0 else "", title=part)
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.grid(True, alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(axes), fontsize="small", loc="outside lower center")
    for row, (name, x, y) in enumerate(pairs[:3]):
        ax = figure.add_subplot(grid[row, 2])
        orbit = 1e6 * signals["z"][settled][:, [x, y]]
        ax.plot(*orbit.T, linewidth=0.7)
        radius = 1e6 * float(case.cases[x].scenario.touchdown)
        if np.max(np.abs(orbit)) >= NEAR * radius:  # the stop around an orbit that is near it
            angle = np.linspace(0, 2 * np.pi, 181)
            ax.plot(radius * np.cos(angle), radius * np.sin(angle), "r--", linewidth=0.8)
        orbit_axes(ax, f"orbit of {name}, from {begin:g} s on")
    ended = str(signals["lost_why"])
    figure.suptitle(f"{title}: {ended}" if ended else title)
    return figure


def _limit_lines(ax: Any, case: Any, name: str, scale: float) -> None:
    """Draw the limits of a signal if they are near what is shown: the stops, the bias current, and the supply."""
    scenario, stops = case.cases[0].scenario, {float(one.scenario.touchdown) for one in case.cases}
    limits = {"z": sorted(stops), "i": [scenario.plant.i_0], "u": [scenario.voltage_limit]}
    words, edges = {"z": "stop", "i": "bias", "u": "limit"}[name], ax.get_ylim()
    for limit in limits[name]:
        for edge, bound in zip(edges, (-scale * float(limit), scale * float(limit)), strict=True):
            if NEAR * abs(bound) <= abs(edge):
                ax.axhline(bound, color="r", linewidth=0.8, linestyle="--")
                ax.annotate(words, (0.01, bound), xycoords=("axes fraction", "data"), color="r", fontsize="x-small")


def orbit_axes(ax: Any, title: str) -> None:
    """Set scale, title and labels of a panel with orbits in µm."""
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(title=title, xlabel="x axis, µm", ylabel="y axis, µm")
    ax.grid(True, alpha=0.3)


def orbits_of(axes: Sequence[str]) -> list[tuple[str, int, int]]:
    """Return the radial bearings with two axes, and the positions of these in the list of axes."""
    names = [name.removesuffix(".x") for name in axes if name.endswith(".x") and f"{name[:-1]}y" in axes]
    return [(name, list(axes).index(f"{name}.x"), list(axes).index(f"{name}.y")) for name in names]


@own_style
def machine_sensitivity_picture(
    points: Sequence[Any],
    limits: Sequence[float],
    title: str,
    measured: Mapping[float, Sequence[Any]] = MappingProxyType({}),
) -> Figure:
    """Return |S_kk| of every axis and the largest singular value over frequency, a panel for each speed."""
    shown = list(points)[:4]
    figure = Figure(figsize=(13.0, 4.6 if len(shown) < 3 else 8.2), layout="constrained")
    grid = figure.subplots(1 + (len(shown) > 2), min(len(shown), 2), squeeze=False, sharex=True, sharey=True)
    for ax in list(grid.flat)[len(shown) :]:
        ax.set_axis_off()
        grid[0, 1].tick_params(labelbottom=True)
    for ax, point in zip(grid.flat, shown, strict=False):
        ax.set_title(f"{point.speed:g} rpm{'' if point.stable else ': not stable'}")
        if not point.linear:
            continue
        end = 5e3 if point.system.period is None else BAND / float(point.system.period)
        f = np.geomspace(1.0, end, 800)
        c = len(point.axes)
        S = np.asarray(point.system.response(f))[:, :c]
        for k, axis in enumerate(point.axes):
            label, look = f"{axis.name}: {axis.S.height:.3g}", ("-", "--")[k % 2]
            (line,) = ax.loglog(f, np.abs(S[:, k, k]), look, label=label, linewidth=1.0)
            one = measured[point.speed][k] if point.speed in measured else None
            if one is not None and one.S is not None:
                label = "injected" if k == len(point.axes) - 1 else None
                ax.loglog(one.frequency, np.abs(one.S), ".", color=line.get_color(), markersize=4, label=label)
        label = f"largest singular value: {point.sigma.height:.3g}"
        ax.loglog(f, np.linalg.norm(S, 2, axis=(1, 2)), "k--", label=label)
        top = max(2 * limits[-1], 1.3 * point.sigma.height)
        bounds = [1e-2, *limits, top]
        zones = zip(bounds[:-1], bounds[1:], ("g", "y", "orange", "r"), "ABCD", (0.96, 0.985) * 2, strict=True)
        for low, high, colour, name, x in zones:  # thin zones are neighbours, with names side by side
            ax.axhspan(low, high, color=colour, alpha=0.08)
            at = x, np.sqrt(max(low, 0.5) * high)
            ax.text(*at, name, transform=ax.get_yaxis_transform(), ha="center", va="center", fontsize="small")
        ax.set(ylim=(1e-2, top), xlabel="frequency, Hz", ylabel="|S|")
        ax.grid(True, alpha=0.3)
        ax.legend(fontsize="small", loc="lower right")
    figure.suptitle(title)
    return figure


@own_style
def campbell_picture(title: str, speeds: np.ndarray, modes: Sequence[Sequence[Any]]) -> Figure:
    """Return the frequencies of the modes against speed, coloured by their damping ratio, with the line of the speed.

    Triangles up are forward modes, triangles down backward ones; unstable modes are red crosses.
    """
    figure = Figure(figsize=(11.0, 6.8), layout="constrained")
    ax = figure.add_subplot()
    points = [(speed, mode) for speed, own in zip(speeds, modes, strict=True) for mode in own]
    shown, stable = None, [(speed, mode) for speed, mode in points if mode.damping > 0]
    for whirls, marker in ((("forward",), "^"), (("backward",), "v"), (("planar", ""), "o")):
        own = [(speed, mode.frequency, np.log10(mode.damping)) for speed, mode in stable if mode.whirl in whirls]
        x, y, ratio = np.reshape(own, (-1, 3)).T
        shown = ax.scatter(x, y, c=ratio, s=16, marker=marker, cmap="viridis", vmin=-3, vmax=0)
        ax.plot([], [], marker, color="0.4", label=whirls[0])
    wrong = [(speed, mode.frequency) for speed, mode in points if mode.damping <= 0]
    if wrong:
        ax.scatter(*zip(*wrong, strict=True), c="r", marker="x", s=30, label="unstable")
    ax.plot(speeds, speeds / 60, "k--", linewidth=0.8, label="1x: the speed")
    light = [mode for mode in modes[-1] if mode.damping < LIGHT]
    top = 1.1 * max([mode.frequency for own in modes for mode in own if mode.damping < LIGHT] + [speeds[-1] / 60])
    ax.set_ylim(0, top)
    below = -np.inf
    for mode in light:  # the names of close modes are moved apart
        below = max(mode.frequency, below + top / 45)
        at, beside = (speeds[-1], mode.frequency), (1.02 * speeds[-1], below)
        ax.annotate(mode.label, at, beside, fontsize="x-small", va="center")
    ax.set_xlim(right=1.2 * speeds[-1])
    ax.set(xlabel="speed, rpm", ylabel="frequency of the mode, Hz", title=f"{title}: modes of the closed loops")
    bar = figure.colorbar(shown, ticks=[-3, -2, -1, 0])
    bar.ax.set_yticklabels(["0.001", "0.01", "0.1", "1"])
    bar.set_label("damping ratio")
    ax.grid(True, alpha=0.3)
    figure.legend(fontsize="small", loc="outside lower center", ncols=5)
    return figure
