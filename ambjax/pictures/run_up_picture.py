"""Pictures of a run-up or run-down, of a machine and of one axis."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ambjax.pictures.machine_pictures import orbit_axes, orbits_of
from ambjax.pictures.scales import own_style
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.rotation import Rotation

# Number of windows of a run, and the share of the run that each of them covers.
WINDOWS, SHARE = 120, 1 / 12
# Highest shown frequency: a multiple of the speed, and at least LOWEST_END, Hz.
HARMONICS, LOWEST_END = 4.0, 250.0
# Range of the shown amplitudes, and the number of orbits of a bearing.
RANGE, ORBITS = 3e-4, 7
# Factor by which zeros lengthen each window, for a smooth spectrum.
PADDED = 4


def waterfall(x: np.ndarray, speed: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the spectra of a signal `x` [N] in W windows of a run. `speed` [N]: rpm. `period`: between samples, s.

    Results: speed at the middle of each window [W], rpm; frequency [F], Hz; amplitude of a sine [W, F], in the unit of
    the signal.
    """
    length = max(int(SHARE * len(x)), 16)
    window = np.hanning(length)
    starts = np.unique(np.linspace(0, len(x) - length, WINDOWS).astype(int))
    parts = np.stack([x[k : k + length] - np.mean(x[k : k + length]) for k in starts])
    amplitude = 2 * np.abs(np.fft.rfft(parts * window, PADDED * length)) / window.sum()
    return speed[starts + length // 2], np.fft.rfftfreq(PADDED * length, period), amplitude


def last_turn(turns: np.ndarray, end: int) -> slice:
    """Return the samples of the last whole turn before the sample `end`, or all before it if there is none.

    `turns`: angle of the rotor at each sample, in turns.
    """
    before = np.flatnonzero(np.abs(turns[:end] - turns[end]) >= 1 - 1e-9)
    return slice(int(before[-1]) if before.size else 0, end + 1)


@own_style
def run_up_picture(case: Any, signals: dict[str, np.ndarray]) -> Figure:
    """Return the waterfall and the orbits of each radial bearing, and largest currents and voltages against speed."""
    alive = signals["t"] < float(signals["lost_at"])
    t, speed = signals["t"][alive], signals["speed_rpm"][alive]
    turns = np.asarray(case.machine.rotor.rotation.turns(t))
    pairs, period = orbits_of([str(name) for name in signals["axes"]])[:3], float(t[1] - t[0])
    figure = Figure(figsize=(13.0, 3.6 * (len(pairs) + 1)), layout="constrained")
    grid = figure.add_gridspec(len(pairs) + 1, 2, width_ratios=[2.2, 1])
    for row, (name, x, y) in enumerate(pairs):
        speeds, frequency, amplitude = waterfall(signals["z_measured"][alive, x], speed, period)
        end = min(max(HARMONICS * np.abs(speed).max() / 60, LOWEST_END), frequency[-1])
        shown = frequency <= end
        size = 1e6 * amplitude[:, shown].T
        ax = figure.add_subplot(grid[row, 0])
        norm = LogNorm(RANGE * size.max(), size.max())
        order = np.argsort(speeds)
        speeds, clipped = speeds[order], np.maximum(size[:, order], RANGE * size.max())
        look = {"norm": norm, "cmap": "magma", "shading": "nearest", "rasterized": True}
        image = ax.pcolormesh(speeds, frequency[shown], clipped, **look)
        ax.plot(speeds, np.abs(speeds) / 60, "c--", linewidth=0.8)
        ax.annotate("1x", (speeds[-1], np.abs(speeds[-1]) / 60), color="c")
        title = f"reading of {signals['axes'][x]}"
        ax.set(ylim=(0, end), title=title, xlabel="speed, rpm", ylabel="frequency, Hz")
        figure.colorbar(image, ax=ax, pad=0.01, label="amplitude, µm")
        orbits = figure.add_subplot(grid[row, 1])
        for place in np.linspace(0.02, 1.0, ORBITS):
            end_of = int(place * (len(t) - 1))
            part = last_turn(turns, end_of)
            u, v = (1e6 * (signals["z"][alive, k][part]) for k in (x, y))
            orbits.plot(u, v, linewidth=0.9, label=f"{speed[end_of]:.0f} rpm")
        orbit_axes(orbits, f"orbits of {name}: one turn each")
        orbits.legend(fontsize="xx-small", loc="upper right")
    _limits(figure.add_subplot(grid[-1, :]), case, signals, alive)
    figure.suptitle(f"{case.name}: {speed[0]:.0f} to {speed[-1]:.0f} rpm")
    return figure


def _limits(ax: Any, case: Any, signals: dict[str, np.ndarray], alive: np.ndarray) -> None:
    """Draw the largest current and voltage of each part of the run, as shares of their limits."""
    speed = signals["speed_rpm"][alive]
    for k, (axis, one) in enumerate(zip(case.axes, case.cases, strict=True)):
        scenario = one.scenario
        bounds = {"i": float(scenario.plant.i_0), "u": float(scenario.voltage_limit)}
        for name, style in (("i", "-"), ("u", ":")):
            parts = np.array_split(np.abs(signals[name][alive, k]) / bounds[name], WINDOWS)
            middle = [float(np.mean(part)) for part in np.array_split(speed, WINDOWS)]
            label = {"i": f"{axis}: current", "u": "its voltage"}[name]
            ax.plot(middle, [float(np.max(part)) for part in parts], style, color=f"C{k}", linewidth=1.1, label=label)
    ax.axhline(1.0, color="r", linewidth=0.9, linestyle="--")
    ax.set_ylim(bottom=0)
    title = "largest |i| as a share of the bias, largest |u| as a share of the supply"
    ax.set(title=title, xlabel="speed, rpm", ylabel="share of the limit")
    ax.grid(True, alpha=0.3)
    ax.legend(fontsize="small", ncols=4, loc="upper right")


# Signals, and their names, units and scales in the picture.
SHOWN = {"z": ("position", "µm", 1e6), "i": ("current", "mA", 1e3)}


def once_per_turn(x: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return the amplitude [N] of a signal `x` at the speed, in each of its N whole turns.

    `turns`: angle of the rotor at each sample, in turns.
    """
    number = np.floor(np.abs(turns - turns[0]) + 1e-9).astype(int)
    found = []
    for n in range(number[-1]):
        part = number == n
        angle = 2 * np.pi * turns[part]
        basis = np.stack([np.ones(angle.size), angle, np.cos(angle), np.sin(angle)], 1)
        found.append(np.hypot(*np.linalg.lstsq(basis, x[part], rcond=None)[0][2:]))
    return np.array(found)


@own_style
def order_picture(trajectory: Trajectory, rotor: Rotation, title: str) -> Figure:
    """Return the amplitudes of position and current once per revolution against speed, one point for each turn."""
    rows = trajectory.rows
    alive = np.asarray(rows.alive, bool)
    t = jnp.asarray(rows.t)[alive]
    turns, speed = (np.asarray(one(t)) for one in (rotor.turns, rotor.rpm))
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    axes = figure.subplots(len(SHOWN), sharex=True)
    for ax, (name, (words, unit, scale)) in zip(axes, SHOWN.items(), strict=True):
        found = once_per_turn(np.asarray(getattr(rows, name))[alive], turns)
        middle = np.interp(np.arange(len(found)) + 0.5, np.abs(turns - turns[0]), np.abs(speed))
        ax.plot(middle, scale * found, linewidth=1.1)
        ax.set_ylabel(f"{words} at 1x, {unit}")
        ax.set_ylim(bottom=0)
        ax.grid(True, alpha=0.3)
    axes[-1].set_xlabel("speed, rpm")
    figure.suptitle(title)
    return figure
