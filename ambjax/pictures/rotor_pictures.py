"""Pictures of a turning machine: its rotor with mode shapes, its critical speeds, and its response to unbalance."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ambjax.linear.rotor_modes import planes_of
from ambjax.linear.unbalance_response import a1_limit
from ambjax.pictures.scales import own_style

# Marks of the planes: letter, colour, and side of the rotor (1: above).
PLANES = {
    "magnet": ("M", "tab:blue", 1),
    "sensor": ("S", "tab:green", -1),
    "unbalance": ("U", "tab:red", 1),
    "stop": ("T", "tab:purple", -1),
}
# Largest number of mode shapes.
SHAPES = 6


@own_style
def unbalance_picture(case: Any, found: Any, criticals: Sequence[Any], operating: tuple[float, float]) -> Figure:
    """Return displacement, current and command of every radial axis against speed."""
    speeds = found.speeds
    radial = [k for k, axis in enumerate(case.axes) if not axis.endswith(".z")]
    drive = case.cases[0].scenario.drive
    figure = Figure(figsize=(11.0, 9.0), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=[2, 1, 1])
    for k in radial:
        look = ("-", "--")[k % 2]  # x and y of a bearing often agree
        line = top.semilogy(speeds, 2e6 * np.abs(found.sensors[:, k]), look, label=f"{case.axes[k]}, sensor")[0]
        if not np.allclose(found.sensors[:, k], found.magnets[:, k], equal_nan=True):
            top.semilogy(speeds, 2e6 * np.abs(found.magnets[:, k]), ":", color=line.get_color(), label="at its magnet")
        middle.plot(speeds, np.abs(found.current[:, k]), look, label=case.axes[k])
        bottom.plot(speeds, np.abs(found.command[:, k]), look)
    sizes = 2e6 * np.abs(found.sensors[1:, radial])
    largest = float(sizes.max(where=np.isfinite(sizes), initial=1e-3))
    top.set_ylim(largest * 1e-3, max(3 * largest, 40.0))
    top.semilogy(speeds[1:], 1e6 * a1_limit(speeds[1:]), "k--", linewidth=1.0, label="A1 of API 684")
    for one in criticals:
        top.annotate(
            f"{one.speed:.0f} rpm\nAF {one.amplification:.2g}", (one.speed, min(1e6 * one.peak_to_peak, largest)),
            ha="center", xytext=(0, 6), textcoords="offset points", fontsize="small", zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1},
        )  # fmt: skip
    for ax in (top, middle, bottom):
        ax.grid(True, alpha=0.3, which="both")
        ax.set_xlim(0, speeds[-1])
        ax.axvspan(operating[0], max(operating[1], operating[0] + 2e-3 * speeds[-1]), color="g", alpha=0.12)
    top.set_ylabel("displacement, µm peak to peak")
    middle.set_ylabel("current, A (amplitude)")
    bottom.set_ylabel("voltage, V (amplitude)" if drive == "voltage" else "commanded current, A")
    bottom.set_xlabel("speed, rpm")
    handles, labels = top.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize="small", ncols=5, loc="outside lower center")
    figure.suptitle(f"{case.name}: response to the unbalance, all loops closed (green: operating speeds)")
    return figure


@own_style
def rotor_picture(
    title: str, drawing: Any, modes: Sequence[Any], criticals: tuple[np.ndarray, list[np.ndarray], float], speed: float
) -> Figure:
    """Return the rotor from the side with its planes, mode shapes of the closed loops, and the critical-speed map.

    `drawing`: a `RotorDrawing`. `modes`: those whose shapes are drawn. `criticals`: stiffnesses (N/m), undamped
    critical speeds (rpm) at each, and |k_s| of the magnets. `speed`: rpm, with sign.
    """
    shown = list(modes)[:SHAPES]
    figure = Figure(figsize=(13.0, 9.0), layout="constrained")
    grid = figure.add_gridspec(1 + -(-len(shown) // 2), 3, width_ratios=[1, 1, 1.1])
    side = figure.add_subplot(grid[0, :2])
    _rotor(side, drawing)
    for k, mode in enumerate(shown):
        ax = figure.add_subplot(grid[1 + k // 2, k % 2], sharex=side)
        _shape(ax, drawing, mode, -1 if speed < 0 else 1)
        ax.set_xlabel("place from the centre of mass, m" if k >= len(shown) - 2 else "")
    _critical_map(figure.add_subplot(grid[:, 2]), *criticals, abs(speed))
    figure.suptitle(f"{title}: rotor, and modes of the closed loops at {speed:g} rpm")
    return figure


def _rotor(ax: Axes, drawing: Any) -> None:
    size = max((d for _, _, d in drawing.sections), default=0.02 * (float(np.ptp(drawing.at)) or 1.0))
    reach = 4 * size
    for begin, end, d in drawing.sections:
        ax.fill_between([begin, end], -d / 2, d / 2, color="0.6", step="mid", linewidth=0)
    if not drawing.sections:
        ax.plot([drawing.at.min(), drawing.at.max()], [0, 0], color="0.6", linewidth=6, solid_capstyle="round")
    for at in drawing.discs:
        ax.plot([at, at], [-2.5 * size, 2.5 * size], color="0.4", linewidth=7)
    for kind, at in drawing.planes:
        letter, colour, way = PLANES[kind]
        ax.plot([at, at], [0, way * reach], color=colour, linewidth=1.0, linestyle="--")
        height = way * reach * (1.25 if kind in ("magnet", "sensor") else 1.6)
        ax.text(at, height, letter, color=colour, ha="center", va="center")
    ax.plot(0.0, 0.0, "k+", markersize=10)
    ax.set(ylim=(-2 * reach, 2 * reach), yticks=[])
    ax.set_title("M magnet, S sensor, T stop, U unbalance, + centre of mass, dark: disc", fontsize="medium")


def _shape(ax: Axes, drawing: Any, mode: Any, way: int) -> None:
    """Draw the shape of a mode: the circular part of its orbit along the shaft, in phase and 90 degrees behind.

    `way`: sign of the speed.
    """
    pairs = planes_of(mode.shape)
    turn = -1j if mode.whirl == "backward" else 1j
    parts = pairs[:, 0] + way * turn * pairs[:, 1]
    if mode.whirl == "planar":
        parts = pairs[:, int(np.argmax(np.sum(np.abs(pairs) ** 2, 0)))]
    along = np.column_stack([np.ones_like(drawing.at), drawing.at, drawing.shapes])
    motion = along @ parts
    motion = motion / motion[np.argmax(np.abs(motion))]
    marker = "" if drawing.sections else "o"
    ax.plot(drawing.at, motion.real, color="tab:blue", marker=marker)
    ax.plot(drawing.at, motion.imag, color="tab:blue", linewidth=0.8, alpha=0.4)
    for kind, at in drawing.planes:
        ax.axvline(at, color=PLANES[kind][1], linewidth=0.8, linestyle="--", alpha=0.7)
    ax.axhline(0, color="0.7", linewidth=0.8)
    ax.set_ylim(-1.15, 1.15)
    ax.set_title(f"{mode.frequency:.4g} Hz, damping {mode.damping:.2g}: {mode.label}", fontsize="medium")


def _critical_map(ax: Axes, stiffness: np.ndarray, speeds: list[np.ndarray], k_s: float, speed: float) -> None:
    count = max(map(len, speeds))
    for number in range(count):
        line = [own[number] if number < len(own) else np.nan for own in speeds]
        ax.loglog(stiffness, line, label=f"{number + 1}")
    ax.axvline(k_s, color="k", linewidth=0.9, linestyle=":")
    ax.annotate("|k_s| of the magnets", (k_s, 0.01), xycoords=("data", "axes fraction"), rotation=90, ha="right",
                va="bottom", fontsize="small")  # fmt: skip
    if speed > 0:
        ax.axhline(speed, color="k", linewidth=0.9, linestyle="--")
        ax.annotate("1x", (stiffness[-1], speed), fontsize="small", va="bottom", ha="right")
    ax.set_ylim(top=max(20 * speed, 3 * float(np.nanmax([own[0] for own in speeds]))))
    ax.set(xlabel="stiffness of each radial bearing, N/m", ylabel="undamped critical speed, rpm")
    ax.set_title("critical speeds on springs (forward)", fontsize="medium")
    ax.legend(fontsize="small", title="mode")
    ax.grid(True, alpha=0.3, which="both")
