"""The phase plane of a run: velocity against displacement; the colour is the time."""

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from ambjax.pictures.figures import INK
from ambjax.pictures.scales import prefix_of
from ambjax.pictures.style import own_style
from ambjax.simulation.trajectory import Trajectory


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
        (by_z, unit), (by_rate, rate) = (
            prefix_of(one, float(np.abs(x[part]).max(initial=0.0))) for one, x in (("m", z), ("m/s", z_dot))
        )
        points = np.column_stack([by_z * z[part], by_rate * z_dot[part]])
        lines = LineCollection(
            list(np.stack([points[:-1], points[1:]], 1)), cmap="viridis", array=t[part][:-1], linewidth=1
        )
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
