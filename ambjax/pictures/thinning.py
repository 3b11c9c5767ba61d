"""Curves of many samples drawn with few points: ends, extremes and gaps of the data stay."""

import numpy as np

# Bins of a curve that is thinned: more than a picture has pixels across.
BINS = 2000


def thin(t: np.ndarray, y: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Samples [K] of the curve y(t) [T] that look like all of them; up to 4 `bins` samples are returned as they are.

    Keeps the first and the last sample, the minimum and maximum of each bin (the last partial bin included), and the
    samples on both sides of every border between finite values and NaN, so that a gap begins and ends where it does
    in the data.
    """
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
    """Index of the first sample of each of `bins` bins, [bins]; their sizes differ by one sample at most."""
    return np.arange(bins) * samples // bins


def smoothed(t: np.ndarray, y: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Means of y over each of `bins` bins of samples, at the mean time of each.

    The first mean extends to the first sample, the last to the last: [bins + 2].
    """
    starts = _bin_starts(len(t), bins)
    centres, means = (np.add.reduceat(values, starts) / np.diff(starts, append=len(t)) for values in (t, y))
    return np.concatenate([t[:1], centres, t[-1:]]), np.concatenate([means[:1], means, means[-1:]])


def envelope(
    t: np.ndarray, low: np.ndarray, high: np.ndarray, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, lower and upper border of a band; up to 4 `bins` samples are returned as they are.

    Of more, each bin has the minimum of `low` and the maximum of `high` from its first sample to that of the next bin,
    the last bin to the last sample. NaN is left out; a bin of nothing else is NaN.
    """
    if len(t) <= 4 * bins:
        return t, low, high
    starts = _bin_starts(len(t), bins)
    edges = np.append(t[starts], t[-1])
    x = np.stack([edges[:-1], edges[1:]], 1).ravel()
    return x, np.fmin.reduceat(low, starts).repeat(2), np.fmax.reduceat(high, starts).repeat(2)


def stretch_of(t: np.ndarray, low: float, high: float) -> slice:
    """The samples from `low` to `high`, s, and where these lie between samples the neighbour outside as well.

    So a curve reaches both ends of its axis, and a bound that rounding puts beside its sample does not drop it.
    """
    return slice(max(int(np.searchsorted(t, low, "right")) - 1, 0), int(np.searchsorted(t, high, "left")) + 1)
