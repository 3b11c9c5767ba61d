"""The picture of a comparison: sensitivity, control effort, distribution of the error, and error against voltage."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ambjax.linear.state_space import StateSpace
from ambjax.pictures.figures import BLUE, GREEN, INK, ORANGE, RED
from ambjax.pictures.frequency import POINTS, shade_zones
from ambjax.pictures.scales import prefix_of
from ambjax.pictures.style import own_style

COLOURS, STYLES = (BLUE, ORANGE, GREEN, RED), ("-", "--")


class Contender(NamedTuple):
    """A case of a comparison.

    - `held`: whether each member keeps its rotor [N].
    - `error`, `voltage`: settled rms error (m) and settled rms voltage (V) of each member [N].
    - `system`: the linearised loop; None: not stable, or no equilibrium. Then |S| and |KS| are not drawn.
    - `channel`, `command`: numbers of the drawn reading and voltage among the outputs of `system`; the reading has the
      number of its test signal. `where`: axis and speed of a machine in the legend.
    """

    name: str
    held: np.ndarray
    error: np.ndarray
    voltage: np.ndarray
    system: StateSpace | None
    channel: int = 0
    command: int = 2
    where: str = ""


@own_style
def comparison_figure(cases: Sequence[Contender], limits: Sequence[float], span: tuple[float, float]) -> Figure:
    """Return a picture: |S| with zones, |KS|, share of members below an rms error, rms error against rms voltage.

    `limits`: upper limits of the zones A, B and C. `span`: lowest and highest frequency, Hz; a curve ends at half the
    sampling rate of its case. A member that is lost has
    no error: the curve of a case that loses members ends below 1. At most 8 cases are drawn.
    """
    figure = Figure(figsize=(12, 8.5), layout="constrained")
    (S_axes, error_axes), (KS_axes, effort_axes) = figure.subplots(2, 2)
    grid = np.geomspace(*span, POINTS)
    finite = [case.error[case.held] for case in cases if case.held.any()]
    factor, unit = prefix_of("m", float(max((x.max() for x in finite), default=1e-6)))
    looks = [(colour, style) for style, colour in itertools.product(STYLES, COLOURS)]
    for case, (colour, style) in zip(cases, looks, strict=False):
        look = {"color": colour, "linestyle": style, "linewidth": 1.5, "label": case.name}
        if case.system is not None:
            period = case.system.period
            f = grid if period is None else grid[grid <= 0.5 / float(period)]
            H, k = np.asarray(case.system.response(f)), case.channel
            S_axes.loglog(f, np.abs(H[:, k, k]), **look | {"label": f"{case.name}: {case.where}"})
            KS_axes.loglog(f, np.abs(H[:, case.command, k]), **look)
        errors, lost = factor * np.sort(case.error[case.held]), int(np.sum(~case.held))
        label = f"{case.name} ({lost} lost)" if lost else case.name
        error_axes.step(errors, np.arange(1, errors.size + 1) / case.held.size, where="post", **look | {"label": label})
        mark = {"color": colour, "marker": "o" if style == "-" else "x", "linestyle": "", "markersize": 3, "alpha": 0.4}
        effort_axes.plot(case.voltage[case.held], factor * case.error[case.held], **mark)
    shade_zones(S_axes, limits)
    _label(S_axes, "frequency, Hz", "|S|", "sensitivity at the position sensor, with zones")
    _label(KS_axes, "frequency, Hz", "|KS|, V/m", "voltage per error of the position sensor")
    _label(error_axes, f"settled rms error, {unit}", "share of all members", "members with at most this error")
    _label(effort_axes, "settled rms voltage, V", f"settled rms error, {unit}", "one point per member")
    error_axes.set_ylim(0, 1.02)
    error_axes.legend(fontsize=8, loc="lower right")
    if any(case.system is not None and case.where for case in cases):
        S_axes.legend(fontsize=8, loc="lower right")
    for ax in (S_axes, KS_axes):
        ax.set_xlim(span)
    return figure


def _label(ax: Axes, x: str, y: str, title: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.set_title(title, fontsize=10, color=INK)
    ax.grid(True, which="major", color="#dddddd", linewidth=0.6)
