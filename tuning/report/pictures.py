"""Pictures of a search and its answer."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ambjax.pictures.figures import AVERAGED, BLUE, ERROR, ORANGE
from ambjax.pictures.overview import overview_figure
from ambjax.pictures.scales import digits, log_ticks, own_style, prefix_of
from ambjax.simulation.trajectory import ALIVE, STALLED, Trajectory
from tuning.problem.goal import shown
from tuning.report.front_table import letter


@own_style
def nominal(run: Trajectory, name: str, settle: float) -> Figure:
    """Draw z - r and u (averaged over each sample) of a run, as in the overview of `ambjax simulate`."""
    return overview_figure(run, name, settle=settle, shown=(ERROR.ylabel, AVERAGED.ylabel))


@own_style
def spectrum(runs: dict[str, Trajectory], settle: float) -> Figure:
    """Draw the amplitude spectrum of u (V, averaged over each sample) of runs by name after `settle` (s)."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    ax, top = figure.subplots(), 0.0
    for name, run in runs.items():
        t, alive = np.asarray(run.rows.t), np.asarray(run.rows.alive)
        frequency, amplitude = amplitudes(np.asarray(run.rows.u_mean)[alive & (t >= settle)], t[1] - t[0])
        why = {ALIVE: "too few samples after", STALLED: "stalled before"}
        label = name if len(amplitude) else f"{name}: {why.get(int(run.lost_code), 'lost before')} {settle:g} s"
        ax.plot(frequency, amplitude, color=ORANGE if name == "before" else BLUE, lw=0.8, label=label)
        top = max(top, amplitude.max(initial=0.0))
    ax.set(xlabel="frequency (Hz)", ylabel="amplitude of u (V)", xscale="log", yscale="log")
    ax.set_ylim(1e-5 * (top or 1.0), 2 * (top or 1.0))
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)
    return figure


def amplitudes(values: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (Hz) above 0 and amplitudes of `values`, with the sample period (s) and a Hann window.

    A sine of amplitude a at one of these frequencies gives a peak of height a, also at half the sampling rate. Both
    arrays are empty for fewer than three samples.
    """
    n, window = len(values), np.hanning(len(values))
    if n < 3:
        return np.zeros(0), np.zeros(0)
    lines = 2 * np.abs(np.fft.rfft(window * (values - values.mean()))) / window.sum()
    if n % 2 == 0:
        lines[-1] /= 2  # above 0, only the line at half the sampling rate has no mirror image
    return np.fft.rfftfreq(n, period)[1:], lines[1:]


@own_style
def convergence(history: dict[str, np.ndarray], paths: list[str]) -> Figure:
    """Draw the goal and the gains of the best point over the iterations."""
    value, gains = history["value"], history["gains"]
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = np.arange(1, len(value) + 1)
    # a lost member raises the goal by about 1e6, and violated limits by up to 1e300, which would hide other values
    cut = np.minimum(value, value.min() + np.log(30))
    left.plot(steps, shown(cut))
    label = "objective" if (cut == value).all() else "objective (cut at 30 times the least)"
    left.set(xlabel="iteration", ylabel=label, yscale="log", title="dotted: the training ensemble changes")
    right.plot(steps, gains / gains[-1], label=[path.removeprefix("controller.") for path in paths])
    right.set(xlabel="iteration", ylabel="gain / its final value", yscale="log", title="gains of the best point")
    right.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))  # beside the curves
    for ax in (left, right):
        for at in np.flatnonzero(np.diff(history["members"])):
            ax.axvline(at + 1.5, color="0.5", ls=":", lw=1)
        ax.grid(alpha=0.3)
    return figure


@own_style
def front(rows: list[dict[str, Any]]) -> Figure:
    """Draw settled rms error against settled rms voltage. A cross marks a point with lost or stalled members.

    The label of each point contains its letter in the table, its error and its voltage.
    """
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    ax = figure.subplots()
    factor, unit = prefix_of("m", min(r["settled_rms_error_m"] for r in rows))
    errors, volts = [factor * r["settled_rms_error_m"] for r in rows], [r["settled_rms_u_V"] for r in rows]
    ax.plot(*zip(*sorted(zip(volts, errors, strict=True)), strict=True), "C0o-", ms=5, mfc="white")
    for n, (x, y) in enumerate(zip(volts, errors, strict=True)):
        words = f"{letter(n)}: {digits(y)} {unit}, {digits(x)} V"
        ax.annotate(words, (x, y), (6, 6), textcoords="offset points", fontsize=8)
    marks = (
        ("C3x", "members lost or not decided", lambda r: r["lost"] or r["stalled"]),
        ("C0o", "selected answer", lambda r: r["taken"]),
    )
    for style, label, chosen in marks:
        if those := [n for n, row in enumerate(rows) if chosen(row)]:
            ax.plot([volts[n] for n in those], [errors[n] for n in those], style, ms=8, label=label)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=8)
    # the axis spans a factor of at least 2.4, also for a front of a single point
    ends = min(min(errors) / 1.2, max(errors) / 2), max(max(errors) * 1.2, min(errors) * 2)
    ax.set(xlabel="settled rms voltage (V)", ylabel=f"settled rms error ({unit})", yscale="log", ylim=ends)
    log_ticks(ax.yaxis, *ends)
    low, high = ax.get_xlim()
    ax.set_xlim(low, high + 0.3 * (high - low))  # space for the text next to the last point
    ax.grid(alpha=0.3, which="both")
    return figure
