"""Tornado charts: the share of a metric's variation that each spread quantity explains."""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ambjax.pictures.figures import BLUE, INK, ORANGE
from ambjax.pictures.scales import axis_of, style_axes
from ambjax.pictures.style import own_style

MOST_DRIVERS = 12
TRENDS = {"grows with it": BLUE, "falls with it": ORANGE, "no steady trend": "#8a8a8a"}


class Bar(NamedTuple):
    """A driver: its dotted path, the share it explains with its interval, and its rank correlation with the metric."""

    path: str
    share: float
    low: float
    high: float
    rho: float


@own_style
def tornado(drivers: Sequence[Bar], metric: str, says: str) -> Figure:
    """Return a chart with the share of a metric's variation that each driver explains, the largest on top.

    The chart has at most MOST_DRIVERS bars, coloured by the trend, with whiskers from low to high. `says`: the text
    below the title. Raises ValueError without drivers.
    """
    if not drivers:
        raise ValueError("tornado: there are no drivers. Only an ensemble with [spread] has drivers.")
    ranking = sorted(drivers, key=lambda driver: -driver.share)
    bars = ranking[:MOST_DRIVERS]
    figure = Figure(figsize=(7.5, 0.36 * len(bars) + 2.2), layout="constrained")
    ax = figure.subplots()
    for row, one in enumerate(bars):
        ax.barh(row, 100 * one.share, height=0.62, color=TRENDS[_trend(one)])
        ax.plot([100 * one.low, 100 * one.high], [row, row], color=INK, linewidth=1.2, marker="|", markersize=7)
        words = f"{100 * one.share:.0f} %"
        ax.text(100 * max(one.share, one.high) + 1.5, row, words, fontsize=8, va="center", color=INK)
    ax.set_yticks(range(len(bars)), [one.path for one in bars])
    ax.set_ylim(len(bars) - 0.4, -0.6)
    ax.set_xlim(0, 112)
    ax.set_xticks(np.linspace(0, 100, 6))
    more = len(ranking) - len(bars)
    words = "share of the variation of the rank explained alone, %; whiskers: 95 % interval"
    ax.set_xlabel(words + (f"; {more} weaker not shown" if more else ""), fontsize=9)
    figure.suptitle(f"Drivers of {axis_of(metric, 0.0)[1]}", fontsize=11)
    ax.set_title(textwrap.fill(says, 95), fontsize=8)
    style_axes(ax, "")
    trends = dict.fromkeys(_trend(one) for one in bars)
    keys = [Patch(color=TRENDS[trend], label=trend) for trend in TRENDS if trend in trends]
    figure.legend(handles=keys, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _trend(one: Bar) -> str:
    """Return the trend of the metric. A monotonic trend must explain at least half of the share."""
    rising, falling, neither = TRENDS
    if one.share <= 0 or one.rho**2 < 0.5 * one.share:
        return neither
    return rising if one.rho > 0 else falling
