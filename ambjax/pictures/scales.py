"""Axes of pictures: units, SI prefixes, ticks of logarithmic axes, and edges of cells."""

import math
import re

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter

# Units by the suffix of a metric's name, longest first, because _m_per_s ends in _s too.
SUFFIXES = {"_A2_per_m2": "A²/m²", "_m_per_s": "m/s", "_m": "m", "_V": "V", "_A": "A", "_W": "W", "_s": "s"}
SYMBOLS = {"v tilde": r"$\tilde v$", "sigma": r"$\sigma$", "u": "$u$", "i": "$i$"}
SMALL = {1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}
LARGE = {1e9: "G", 1e6: "M", 1e3: "k"}


def prefix_of(unit: str, size: float) -> tuple[float, str]:
    """Return the factor from an SI unit to a prefixed one in which `size` lies in [1, 1000), and the prefixed unit.

    For example, 2e-5 m is 20 µm. Only units that begin with a plain m, s, V, A, W, N, H, T, Hz or Ω take a prefix (not
    A²/m², kg, 1/s); lengths and times take no prefix above 1. A size that is zero or not finite keeps the unit.
    """
    first = unit.split("/")[0]
    small = first in ("m", "s", "V", "A", "W", "N", "H", "T", "Hz", "Ω")
    if not small or not 0 < size < np.inf:
        return 1.0, unit
    scales = (LARGE if first not in ("m", "s") else {}) | SMALL
    # 0.9995 prints as 1 with three digits
    scale = next((scale for scale in scales if size >= 0.9995 * scale), 1e-9)
    return 1 / scale, scales[scale] + unit


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
    if metric.endswith("clearance_used"):
        return 100.0, metric.replace("_", " "), "%"
    if metric == "refused":
        return 1.0, "refused readings", "samples"
    suffix = next((suffix for suffix in SUFFIXES if metric.endswith(suffix)), "")
    factor, unit = prefix_of(SUFFIXES.get(suffix, ""), size)
    words = metric.removesuffix(suffix).replace("_", " ")
    words = re.sub(r"max abs (.*)", r"max |\1|", words)
    for word, symbol in SYMBOLS.items():
        words = re.sub(rf"\b{word}\b", lambda _, symbol=symbol: symbol, words)
    return factor, words, unit


def label_of(label: str, size: float) -> tuple[float, str]:
    """Return factor and label of an axis whose label ends in its SI unit.

    For example, "initial z (m)" of size 2e-5 becomes "initial z (µm)". The power in m/s^2 becomes m/s²; the unit 1 is
    omitted.
    """
    match = re.fullmatch(r"(.*)\(([^()]*)\)\s*", label)
    if not match:
        return 1.0, label
    if match[2] == "1":
        return 1.0, match[1].rstrip()
    unit = re.sub(r"\^(2|3)(?![.\d])", lambda power: "²³"[int(power[1]) - 2], match[2]).replace("ohm", "Ω")
    factor, unit = prefix_of(unit, size)
    return factor, f"{match[1]}({unit})"


def digits(value: float) -> str:
    """Return a number as text with three digits, or with all digits before the point: 12.3, 7000, 1.2e-05."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def edges(centres: np.ndarray, log: bool) -> np.ndarray:
    """Return the n + 1 edges halfway between n ascending centres, on a logarithmic scale if `log`.

    Raises ValueError if a log axis has a centre that is not positive.
    """
    centres = np.asarray(centres, float)
    if log and not np.all(centres > 0):
        raise ValueError(f"a log axis cannot show {centres.min():g}: use positive values, or a linear axis")
    c = np.log(centres) if log else centres
    if len(c) == 1:
        half = 0.5 if log else 0.1 * abs(c[0]) or 1.0
        bounds = np.array([c[0] - half, c[0] + half])
    else:
        middle = (c[1:] + c[:-1]) / 2
        bounds = np.concatenate([[2 * c[0] - middle[0]], middle, [2 * c[-1] - middle[-1]]])
    return np.exp(bounds) if log else bounds


def finish(ax: Axes, y_label: str) -> None:
    """Set the label and the style that all charts share."""
    ax.set_ylabel(y_label, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(alpha=0.3, linewidth=0.5)
    ax.set_axisbelow(True)


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Set ticks in plain numbers on a logarithmic axis; fewer decades have more ticks each."""
    decades = math.log10(high / low)
    if decades < 0.8:
        at = list(MaxNLocator(5).tick_values(low, high))
    else:
        steps = (1, 2, 5) if decades < 2.2 else (1, 3) if decades < 4 else (1,)
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1, max(1, round(decades / 5)))
        at = [step * 10.0**power for power in powers for step in steps]
    axis.set_major_locator(FixedLocator([value for value in at if low <= value <= high]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axis.set_minor_formatter(NullFormatter())


def _plain(value: float) -> str:
    if 1e-3 <= value < 1e5:
        return f"{value:g}"
    power = math.floor(math.log10(value) + 1e-9)
    front = f"{value / 10.0**power:.3g}"
    return f"$10^{{{power}}}$" if front == "1" else rf"${front} \cdot 10^{{{power}}}$"
