"""Picture of a run-up or run-down of one axis: amplitudes once per revolution against speed."""

import pathlib

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from ambjax.pictures.style import own_style
from ambjax.simulation.trajectory import Trajectory
from ambjax.world.rotation import Rotation

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
def order_picture(trajectory: Trajectory, rotor: Rotation, title: str, path: pathlib.Path) -> None:
    """Write the amplitudes of position and current once per revolution against speed, one point for each turn."""
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
    figure.savefig(path, dpi=130)
