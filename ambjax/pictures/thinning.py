"""Reduction of curves with many samples to few points: thinned curves, means over bins, and envelopes."""

import numpy as np

# Bins of a thinned curve: more than the width of a picture in pixels.
BINS = 2000


def thin(t: np.ndarray, y: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Return K of the T samples of the curve y(t), enough to draw it; up to 4 `bins` samples are returned unchanged."""
    n = len(t)
    if n <= 4 * bins:
        return t, y
    width = -(-n // bins)
    finite, rows = np.isfinite(y), -(-n // width)
    padded = np.full((2, rows * width), np.inf)
    padded[:, :n] = np.where(finite, [y, -y], np.inf)
    extremes = padded.reshape(2, rows, width).argmin(2) + width * np.arange(rows)
    border = np.flatnonzero(np.diff(finite))
    at = np.unique(np.concatenate([extremes.ravel(), border, border + 1, [0, n - 1]]))
    return t[at], y[at]


def _bin_starts(samples: int, bins: int) -> np.ndarray:
    """Return the index of the first sample of each bin, [bins]. The sizes of the bins differ by at most one sample."""
    return np.arange(bins) * samples // bins


def smoothed(t: np.ndarray, y: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean times and means of y over `bins` bins of samples, [bins + 2]."""
    starts = _bin_starts(len(t), bins)
    centres, means = (np.add.reduceat(values, starts) / np.diff(starts, append=len(t)) for values in (t, y))
    return np.concatenate([t[:1], centres, t[-1:]]), np.concatenate([means[:1], means, means[-1:]])


def envelope(
    t: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, lower and upper border of a band; up to 4 `bins` samples are returned unchanged."""
    if len(t) <= 4 * bins:
        return t, low, high
    starts = _bin_starts(len(t), bins)
    edges = np.append(t[starts], t[-1])
    x = np.stack([edges[:-1], edges[1:]], 1).ravel()
    return x, np.fmin.reduceat(low, starts).repeat(2), np.fmax.reduceat(high, starts).repeat(2)


def stretch_of(t: np.ndarray, low: float, high: float) -> slice:
    """Return the samples from `low` to `high`, s, with the outer neighbour of a bound that lies between two samples."""
    return slice(max(int(np.searchsorted(t, low, "right")) - 1, 0), int(np.searchsorted(t, high, "left")) + 1)
