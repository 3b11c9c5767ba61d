"""The style of every picture, and its axes: units, SI prefixes, ticks of logarithmic axes, edges of cells."""

import math
import pathlib
import re
from typing import Any

import matplotlib
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from ambjax.simulation import response
from ambjax.simulation.metrics import UNITS

# Matplotlib's default without offsets of axes, independent of any matplotlibrc file.
_STYLE: Any = {k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"}
# Decorator of every function that draws.
own_style = matplotlib.rc_context(_STYLE | {"axes.formatter.useoffset": False})
# Labels of metrics without their units.
LABELS = {
    "max_abs_error_m": "max |error|",
    "rms_error_m": "rms error",
    "settled_max_abs_error_m": "settled max |error|",
    "settled_rms_error_m": "settled rms error",
    "settled_max_abs_sigma_m_per_s": r"settled max |$\sigma$|",
    "settled_max_abs_v_tilde_A2_per_m2": r"settled max |$\tilde v$|",
    "settled_max_abs_current_error_A": "settled max |current error|",
    "sigma_reached_s": r"$\sigma$ reached",
    "v_tilde_reached_s": r"$\tilde v$ reached",
    "current_error_reached_s": "current error reached",
    "max_abs_u_V": "max |$u$|",
    "rms_u_V": "rms $u$",
    "settled_rms_u_V": "settled rms $u$",
    "chatter_V": "chatter",
    "max_abs_i_A": "max |$i$|",
    "rms_i_A": "rms $i$",
    "rms_i_1_A": "rms $i_1$",
    "rms_i_2_A": "rms $i_2$",
    "copper_loss_W": "copper loss",
    "max_flux_T": "max flux density",
    "max_abs_force_N": "max |force|",
    "force_used": "force used",
    "clearance_used": "clearance used",
    "settled_clearance_used": "settled clearance used",
    "refused": "refused readings",
    "lost_at_s": "lost at",
    "singular_at_s": "singular at",
}
for _name, _unit in response.UNITS.items():
    _signal, _order, _ = _name.split("_")
    LABELS[_name] = f"{'phase' if _unit == 'deg' else 'amplitude'} of {_signal} at {_order}"
# Metrics that are shown in another unit than that of `UNITS`: the factor to this unit, and the unit.
AXIS_UNITS = {
    "clearance_used": (100.0, "%"),
    "settled_clearance_used": (100.0, "%"),
    "force_used": (100.0, "%"),
    "refused": (1.0, "samples"),
}
# Units that take an SI prefix, alone or at the start of a quotient; lengths and times take no prefix above 1.
PREFIXED = re.compile(r"(?P<length>m|s)(/.*)?|(V|A|W|N|H|T|Hz|Ω)(/.*)?")
LEAST_POWER, MOST_POWER = -9, 9


def prefix_of(unit: str, size: float) -> tuple[float, str]:
    """Return the factor from an SI unit to a prefixed one in which `size` lies in [1, 1000), and the prefixed unit.

    For example, 2e-5 m is 20 µm. Only units that begin with a plain m, s, V, A, W, N, H, T, Hz or Ω take a prefix (not
    A²/m², kg, 1/s); lengths and times take no prefix above 1. A size that is zero or not finite keeps the unit.
    """
    match = PREFIXED.fullmatch(unit)
    if not match or not 0 < size < np.inf:
        return 1.0, unit
    # 0.9995 prints as 1 with three digits
    power = 3 * math.floor(math.log10(size / 0.9995) / 3)
    power = max(LEAST_POWER, min(power, 0 if match["length"] else MOST_POWER))
    return 1 / float(f"1e{power}"), ticker.EngFormatter.ENG_PREFIXES[power] + unit


def size_of(values: np.ndarray, log: bool = False) -> float:
    """Return the size from which an axis gets its prefix: the largest |value|, or the geometric middle on a log axis.

    0 if no value is finite and not zero.
    """
    sizes = np.abs(np.asarray(values, float))
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if not sizes.size:
        return 0.0
    return float(np.sqrt(sizes.min()) * np.sqrt(sizes.max()) if log else sizes.max())


def axis_of(metric: str, size: float) -> tuple[float, str, str]:
    """Return factor, label and unit of a metric's axis: (1e6, "rms error", "µm") for rms_error_m of size 2e-5."""
    factor, unit = AXIS_UNITS[metric] if metric in AXIS_UNITS else prefix_of(_typeset(UNITS.get(metric, "")), size)
    return factor, LABELS.get(metric, metric), unit


def _typeset(unit: str) -> str:
    """Return a unit with raised powers and Ω: "m²" for "m^2"."""
    return re.sub(r"\^(2|3)(?![.\d])", lambda power: "²³"[int(power[1]) - 2], unit).replace("ohm", "Ω")


def label_of(path: str, unit: str, size: float) -> tuple[float, str]:
    """Return factor and label of an axis: (1e6, "initial.z (µm)") for m of size 2e-5. The unit 1 is omitted."""
    factor, unit = prefix_of(_typeset(unit), size)
    return factor, path if unit in ("", "1") else f"{path} ({unit})"


def digits(value: float) -> str:
    """Return a number as text with three digits, or with all digits before the point: 12.3, 7000, 1.2e-05."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def edges(centres: np.ndarray, log: bool) -> np.ndarray:
    """Return the n + 1 edges halfway between n ascending centres, n > 1, on a logarithmic scale if `log`."""
    c = np.log(centres) if log else centres
    middle = (c[1:] + c[:-1]) / 2
    bounds = np.concatenate([[2 * c[0] - middle[0]], middle, [2 * c[-1] - middle[-1]]])
    return np.exp(bounds) if log else bounds


def style_axes(ax: Axes, y_label: str) -> None:
    """Set the label and the style that all charts share."""
    ax.set_ylabel(y_label, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.3, linewidth=0.5)
    ax.set_axisbelow(True)


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Set ticks in plain numbers on a logarithmic axis; fewer decades have more ticks each."""
    decades = math.log10(high / low)
    if decades < 0.8:
        at = ticker.MaxNLocator(5).tick_values(low, high)
    else:
        subs = (1, 2, 5) if decades < 2.2 else (1, 3) if decades < 4 else (1,)
        at = ticker.LogLocator(subs=subs, numticks=8).tick_values(low, high)
    axis.set_major_locator(ticker.FixedLocator([value for value in np.asarray(at) if low <= value <= high]))
    powers = ticker.LogFormatterSciNotation(labelOnlyBase=False)
    axis.set_major_formatter(lambda value, _: f"{value:g}" if 1e-3 <= value < 1e5 else powers(value))
    axis.set_minor_formatter(ticker.NullFormatter())


@own_style
def save(figure: Figure, path: pathlib.Path, dpi: int = 130) -> None:
    """Write a picture to a file."""
    figure.savefig(path, dpi=dpi)
