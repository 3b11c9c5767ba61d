"""Estimates from an ensemble, with confidence intervals.

- Probability: Wilson's interval (J. Am. Stat. Assoc. 22, 1927).
- Quantile: the interval between two order statistics, whose ranks follow from the binomial distribution. Its coverage
  is at least the confidence for every distribution of the values. An end is infinite if the ensemble is too small
  (David and Nagaraja, Order Statistics, section 7.1).
- Mean, standard deviation, CVaR: the studentised bootstrap (Efron and Tibshirani, An Introduction to the Bootstrap,
  section 12.5), which divides the deviation of each resample by the standard error of that resample. The simpler
  percentile intervals omit this division, and end too low if the values have a heavy upper tail.

The cost of a resample grows only with log N. The sorted values are divided into groups. The width of a group is about
1/512 of its rank, counted from the nearer end: each value is a group of its own up to N = 2,048, and there are about
1,024 (2 + log(N/2,048)) groups for larger N.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

REPLICATES = 1000
STATISTICS = ("mean", "std", "cvar")
# The width of a group is its rank, counted from the nearer end, divided by this number.
WIDTH = 512
# With at least this many values in the tail, the largest value bounds the CVaR (`bootstrap`).
TAIL = 10
# Probability that the alpha-quantile is below the value by which it bounds the CVaR from below.
SURE = 1e-4
# Largest number of counts in one array: 16 MB.
MOST_COUNTS = 2_000_000
# Variance in the tail, relative to the square of the largest deviation, below which the standard error of a CVaR is 0.
ROUNDING = 1e-13


class Estimate(NamedTuple):
    """An estimate, a number or an array, and the lower and upper end of its interval."""

    value: Any
    low: Any
    high: Any


def wilson(successes: ArrayLike, n: ArrayLike, confidence: float = 0.95) -> Estimate:
    """Compute the share of `successes` in `n` trials, numbers or arrays, with Wilson's interval.

    Raises ValueError unless 0 <= successes <= n and n >= 1.
    """
    from scipy.special import ndtri

    k, n = np.asarray(successes, float), np.asarray(n, float)
    if not (np.all(n >= 1) and np.all(k >= 0) and np.all(k <= n)):
        raise ValueError(f"successes = {successes}, n = {n}: n must be at least 1, and successes from 0 to n.")
    z2, share = ndtri((1 + confidence) / 2) ** 2, k / n
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 / n * (share * (1 - share) + z2 / (4 * n))) / (1 + z2 / n)
    return Estimate(share, np.where(k == 0, 0.0, centre - half)[()], np.where(k == n, 1.0, centre + half)[()])


def quantile(values: np.ndarray, q: npt.ArrayLike, confidence: float = 0.95) -> Estimate:
    """Compute the q-quantile of values [N], the value of rank ceil(q N), with its interval. q: a number or an array.

    An end is -inf or +inf if N is too small. Values of +inf are allowed. Raises ValueError for a q outside of 0 to 1,
    and as `column_of` does.
    """
    from scipy.stats import binom

    x, q = np.sort(column_of(values)), np.asarray(q)
    if q.dtype.kind not in "iuf" or not np.all((q >= 0) & (q <= 1)):
        raise ValueError(f"q = {q}: it must be from 0 to 1.")
    n, tail = len(x), (1 - confidence) / 2
    # A product may round to just above an integer: 0.07 * 100 is 7.000000000000001.
    rank = np.clip(np.ceil(q * n - 1e-9 * n), 1, n).astype(int)
    padded = np.concatenate([[-np.inf], x, [np.inf]])
    low, high = binom.ppf(tail, n, q), binom.ppf(1 - tail, n, q) + 1
    return Estimate(padded[rank], padded[low.astype(int)], padded[high.astype(int)])


def cvar(values: np.ndarray, alpha: float = 0.95, confidence: float = 0.95, seed: int = 0) -> Estimate:
    """Compute the conditional value at risk of values [N], with its bootstrap interval.

    CVaR is the mean of the largest share 1 - alpha of the values. A value at the edge of that share has a fractional
    weight (Rockafellar and Uryasev, J. Bank. Finance 26, 2002). Raises ValueError as `bootstrap` does.
    """
    moments = bootstrap([column_of(values)], alpha, confidence, seed)["cvar"]
    return Estimate(*(float(x[0]) for x in moments))


def bootstrap(
    columns: Sequence[np.ndarray], alpha: float = 0.95, confidence: float = 0.95, seed: int = 0
) -> dict[str, Estimate]:
    """Estimate "mean", standard deviation ("std") and CVaR ("cvar") of finite columns [N], with their intervals.

    Returns one Estimate per statistic; its fields are arrays [columns]. An end is infinite if the ensemble is too small
    to bound it.

    Measured coverage of 95 % intervals from 200 members: 93 to 97 % for the CVaR of normal, lognormal and bounded
    values, and for the standard deviation of normal and bounded values. It is 87 % for the standard deviation of
    lognormal values, because 200 members do not determine their fourth moment; `summary` reports such columns.

    The lower end of a CVaR is at least a value that the alpha-quantile exceeds, but for 1 in 10,000 ensembles. The
    upper end is never a finite number above the largest value of the column. With TAIL or more values in
    the tail, the end is at most the largest value; slow tests check the coverage. With fewer values the true CVaR
    exceeds the largest value too often (for 37 % of samples of 50 normal values). An end above that value is then inf.

    Raises ValueError for a column that is empty or not finite, and unless 0 <= alpha < 1.
    """
    from scipy.stats import binom

    if not 0 <= alpha < 1:
        raise ValueError(f"alpha = {alpha:g}: it must be at least 0 and below 1.")
    n = len(columns[0])
    edges, tail = _group_edges(n), (1 - alpha) * n
    rank = int(binom.ppf(SURE, n, alpha))
    sizes, powers, columnwise = np.diff(edges), [], []
    for column in columns:
        x = np.sort(column_of(column))
        if not np.isfinite(x[[0, -1]]).all():
            raise ValueError("a column is not finite: there is no mean to resample.")
        centre = x.mean()
        scale = np.abs(x[[0, -1]] - centre).max() or 1.0
        y = (x - centre) / scale
        powers.append([np.add.reduceat(y**k, edges[:-1]) / sizes for k in (1, 2, 3, 4)])
        worst = min(_tail_counts(np.ones((1, n)), tail)[0] @ x / tail, x[-1])  # not above it by rounding
        columnwise.append((centre, scale, x.std(ddof=min(n - 1, 1)), worst, x[-1], x[rank - 1] if rank else -np.inf))
    G = np.moveaxis(np.array(powers), 0, -1)
    batches = [_moments(counts, G, n, tail) for counts in _resamples(n, sizes, seed)]
    resamples = {kind: [np.concatenate([batch[kind][k] for batch in batches]) for k in (0, 1)] for kind in STATISTICS}
    whole = _moments(sizes[None].astype(float), G, n, tail)
    centre, scale, std, worst, largest, quantiles = np.array(columnwise).T
    ends = {kind: _studentised_ends(whole[kind], resamples[kind], confidence) for kind in STATISTICS}
    nothing = np.full(len(std), -np.inf), np.full(len(std), np.inf)
    few = n < 3 or tail <= 1 + 1e-9  # rounding: the tail of 20 values is 1.0000000000000009
    ends |= {kind: nothing for kind in STATISTICS if n < 3 or (kind == "cvar" and few)}  # no standard error
    unbiased = (n / max(n - 1, 1)) ** 0.5
    low, high = (scale * end + centre for end in ends["cvar"])
    low = low if few else np.maximum(low, quantiles)
    with np.errstate(over="ignore"):  # with few members the exponential may overflow to inf
        stds = [scale * unbiased * np.exp(end) for end in ends["std"]]
    return {
        "mean": Estimate(centre, *(scale * end + centre for end in ends["mean"])),
        "std": Estimate(std, *stds),
        "cvar": Estimate(worst, low, _bounded(high, largest, scale, tail)),
    }


def _bounded(high: np.ndarray, largest: np.ndarray, scale: np.ndarray, tail: float) -> np.ndarray:
    """Replace upper ends [columns] of a CVaR above the largest value: by inf if tail < TAIL, else by that value."""
    beyond = high - largest > 1e-9 * scale  # more than rounding
    unknown = np.isinf(high) | (beyond & (tail < TAIL * (1 - 1e-9)))
    return np.where(unknown, np.inf, np.minimum(high, largest))


def _moments(counts: np.ndarray, G: np.ndarray, n: int, tail: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return mean, log of the standard deviation, and CVaR, each with its standard error: [replicates, columns].

    `G` [4, groups, columns] holds the mean of the powers 1 to 4 in each group. Standard errors come from influence
    functions: (x - q)/(1 - alpha) for the CVaR, of values x above the threshold q; for the
    standard deviation, that of the second moment.
    """
    mean, r2, r3, r4 = (counts @ power / n for power in G)
    m2 = np.maximum(r2 - mean**2, 0)
    m4 = r4 - 4 * mean * r3 + 6 * mean**2 * r2 - 3 * mean**4
    with np.errstate(divide="ignore", invalid="ignore"):  # division by zero if all values are equal
        log_std, log_error = 0.5 * np.log(m2), np.sqrt(np.maximum(m4 - m2**2, 0) / n) / (2 * m2)
    tails = _tail_counts(counts, tail)
    first, second, q = tails @ G[0], tails @ G[1], G[0][np.argmax(tails > 0, axis=1)]
    beyond, squared = (first - q * tail) / n, (second - 2 * q * first + q**2 * tail) / n
    varying = squared - beyond**2
    error = np.sqrt(np.where(varying > ROUNDING, varying, 0) * n) / tail
    return {"mean": (mean, np.sqrt(m2 / n)), "std": (log_std, np.nan_to_num(log_error)), "cvar": (first / tail, error)}


def _studentised_ends(
    whole: Sequence[np.ndarray], resamples: Sequence[np.ndarray], confidence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the studentised interval [columns].

    - `whole`: the estimate and its standard error, each [1, columns].
    - `resamples`: the same of each resample, [replicates, columns].

    A resample with standard error 0 (its values, or those of its tail, are equal) counts as infinitely far from an
    estimate that differs from it. If the standard error of the estimate is 0, the percentile interval is returned.
    """
    (value,), (error,) = whole
    values, errors = resamples
    with np.errstate(divide="ignore", invalid="ignore"):
        off = values - value
        far = np.sort(np.where(np.abs(off) <= 1e-12 * error, 0.0, off / errors), axis=0)
        plain, outside = np.sort(values, axis=0), math.floor((1 - confidence) / 2 * (len(far) + 1)) - 1
        low, high = (np.where(error > 0, value - far[k] * error, plain[-1 - k]) for k in (-1 - outside, outside))
    return low, high


def _group_edges(n: int) -> np.ndarray:
    """Return the ranks at which the groups of n sorted values begin, followed by n."""
    inwards, at = [0], 0
    while at < n // 2:
        at = min(at + max(at // WIDTH, 1), n // 2)
        inwards.append(at)
    return np.unique(np.concatenate([inwards, n - np.array(inwards)]))


def _resamples(n: int, sizes: np.ndarray, seed: int) -> Iterator[np.ndarray]:
    """Yield counts [replicates, groups] of resamples of n values, batch by batch."""
    rng, left = np.random.default_rng(seed), REPLICATES
    while left:
        batch = min(left, max(MOST_COUNTS // len(sizes), 1))
        yield rng.multinomial(n, sizes / n, size=batch).astype(float)
        left -= batch


def _tail_counts(counts: np.ndarray, tail: float) -> np.ndarray:
    """Return the part of each count that belongs to the largest `tail` values."""
    above = np.cumsum(counts[:, ::-1], axis=1)[:, ::-1] - counts
    return np.clip(tail - above, 0.0, counts)


def column_of(values: npt.ArrayLike) -> np.ndarray:
    """Return the values as floats [N]. Raises ValueError unless they are one-dimensional, non-empty and free of NaN."""
    x = np.asarray(values, float)
    if x.ndim != 1 or not x.size or np.isnan(x).any():
        raise ValueError(f"a column must be numbers, one for each member, none of them NaN; this has shape {x.shape}.")
    return x
