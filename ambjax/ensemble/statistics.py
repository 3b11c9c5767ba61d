"""Statistics of an ensemble: numbers with intervals, what drives them, and the members that fare worst.

Intervals of a probability are Wilson's (J. Am. Stat. Assoc. 22, 1927). All others are percentile intervals of the
bootstrap (Efron and Tibshirani, An Introduction to the Bootstrap, 1993): how far another ensemble as large may differ.

The bootstrap is bounded for any N. A resampled quantile is an order statistic whose rank is a function of a beta
variate, so the interval of a quantile needs no resampling at all. For mean, standard deviation and CVaR the sorted
values are put into groups, about 1/512 of their rank from the nearer end wide: single values up to N = 2,048, some
1,024 (2 + log(N/2,048)) groups beyond. The counts of a resample in these groups are multinomial, one draw serves
all columns, and its sums are matrix products.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

REPLICATES = 1000
# A group is this part of its rank, from the nearer end, wide.
WIDTH = 512
# Counts held at once: 16 MB an array.
MOST_COUNTS = 2_000_000
# The metric by which members are ranked once all lost ones are named.
DECIDING = "settled_max_abs_error_m"
# Columns that are no metrics.
FATE = ("index", "lost_at", "lost", "stalled", "lost_at_s")
SPREAD = "spread."


class Estimate(NamedTuple):
    """A number, or array of numbers, and its interval."""

    value: Any
    low: Any
    high: Any


class Correlation(NamedTuple):
    """Spearman's rho, and the probability that unrelated columns show as much."""

    rho: np.ndarray
    p: np.ndarray


def wilson(successes: Any, n: Any, confidence: float = 0.95) -> Estimate:
    """Share of `successes` out of `n`, numbers or arrays, with Wilson's interval.

    Raises ValueError unless 0 <= successes <= n and n >= 1.
    """
    from scipy.special import ndtri

    k, n = np.asarray(successes, float), np.asarray(n, float)
    if not (np.all(n >= 1) and np.all(k >= 0) and np.all(k <= n)):
        raise ValueError(f"successes = {successes}, n = {n}: there must be at least 1 trial and no more successes.")
    z2, share = ndtri((1 + confidence) / 2) ** 2, k / n
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 / n * (share * (1 - share) + z2 / (4 * n))) / (1 + z2 / n)
    return Estimate(share, np.where(k == 0, 0.0, centre - half)[()], np.where(k == n, 1.0, centre + half)[()])


def quantile(values: np.ndarray, q: Any, confidence: float = 0.95) -> Estimate:
    """The q-quantile, q a number or an array: the value of rank ceil(q N), with its bootstrap interval.

    The rank in the sample of a resample's r-th value is ceil(N U), U of the beta distribution (r, N - r + 1). Exact,
    whatever the values; +inf is a value like any other.
    """
    from scipy.special import betaincinv

    x = np.sort(_column(values))
    n, tail = len(x), (1 - confidence) / 2
    # a product as 0.1 * 30 may round to just above a whole number
    rank = np.clip(np.ceil(np.asarray(q) * n - 1e-9 * n), 1, n)

    def of(share: float) -> np.ndarray:
        return x[np.clip(np.ceil(n * betaincinv(rank, n - rank + 1, share)), 1, n).astype(int) - 1]

    return Estimate(x[rank.astype(int) - 1], of(tail), of(1 - tail))


def cvar(values: np.ndarray, alpha: float = 0.95, confidence: float = 0.95, seed: int = 0) -> Estimate:
    """Conditional value at risk: the mean of the largest 1 - alpha of the values, with its bootstrap interval.

    A value at the edge of that share counts in part (Rockafellar and Uryasev, J. Bank. Finance 26, 2002).
    """
    moments = bootstrap([_column(values)], alpha, confidence, seed)["cvar"]
    return Estimate(*(float(x[0]) for x in moments))


def bootstrap(
    columns: Sequence[np.ndarray], alpha: float = 0.95, confidence: float = 0.95, seed: int = 0
) -> dict[str, Estimate]:
    """Mean, standard deviation ("std") and CVaR ("cvar") of finite columns, arrays [N], as arrays over columns.

    Raises ValueError for a column that is empty or not finite, and unless 0 <= alpha < 1.
    """
    if not 0 <= alpha < 1:
        raise ValueError(f"alpha = {alpha:g}: it must be at least 0 and below 1.")
    n = len(columns[0])
    edges = _group_edges(n)
    sizes, tail, unbiased = np.diff(edges), (1 - alpha) * n, n / max(n - 1, 1)
    means, squares, exact = [], [], []
    for column in columns:
        x = np.sort(_column(column))
        if not np.isfinite(x[[0, -1]]).all():
            raise ValueError("a column is not finite: there is no mean to resample.")
        centre, scale = x.mean(), max(np.abs(x[[0, -1]]).max(), np.finfo(float).tiny)
        means.append(np.add.reduceat((x - centre) / scale, edges[:-1]) / sizes)
        squares.append(np.add.reduceat(((x - centre) / scale) ** 2, edges[:-1]) / sizes)
        exact.append((centre, scale, x.std() * unbiased**0.5, _taken(np.ones((1, n)), tail)[0] @ x / tail))
    G, G2 = np.array(means).T, np.array(squares).T
    drawn: dict[str, list[np.ndarray]] = {"mean": [], "std": [], "cvar": []}
    for counts in _resamples(n, sizes, seed):
        mean = counts @ G / n
        drawn["mean"].append(mean)
        drawn["std"].append(np.sqrt(np.maximum(counts @ G2 / n - mean**2, 0) * unbiased))
        drawn["cvar"].append(_taken(counts, tail) @ G / tail)
    centre, scale, std, worst = np.array(exact).T
    shares = [(1 - confidence) / 2, (1 + confidence) / 2]
    ends = {kind: np.quantile(np.concatenate(parts), shares, axis=0) * scale for kind, parts in drawn.items()}
    return {
        "mean": Estimate(centre, *(ends["mean"] + centre)),
        "std": Estimate(std, *ends["std"]),
        "cvar": Estimate(worst, *(ends["cvar"] + centre)),
    }


def _group_edges(n: int) -> np.ndarray:
    """Ranks at which groups of sorted values begin, and n."""
    inwards, at = [0], 0
    while at < n // 2:
        at = min(at + max(at // WIDTH, 1), n // 2)
        inwards.append(at)
    return np.unique(np.concatenate([inwards, n - np.array(inwards)]))


def _resamples(n: int, sizes: np.ndarray, seed: int) -> Iterator[np.ndarray]:
    """Counts [replicates, groups] of resamples of n values, a batch at a time."""
    rng, left = np.random.default_rng(seed), REPLICATES
    while left:
        batch = min(left, max(MOST_COUNTS // len(sizes), 1))
        yield rng.multinomial(n, sizes / n, size=batch).astype(float)
        left -= batch


def _taken(counts: np.ndarray, tail: float) -> np.ndarray:
    """How much of each count (of ascending values) belongs to the largest `tail` values."""
    above = np.cumsum(counts[:, ::-1], axis=1)[:, ::-1] - counts
    return np.clip(tail - above, 0.0, counts)


def spearman(x: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> Correlation:
    """Rank correlation of every column of x with every column of y, arrays [len(x), len(y)].

    Ties share their mean rank. A column that is the same for all members is related to nothing: rho = 0, p = 1. p is
    from Student's t with N - 2 degrees of freedom, 1 for fewer than three members.
    """
    from scipy.special import stdtr

    rho = np.clip(_standard_ranks(x) @ _standard_ranks(y).T, -1.0, 1.0)
    degrees = len(x[0]) - 2
    if degrees < 1:
        return Correlation(rho, np.ones_like(rho))
    t = np.abs(rho) * np.sqrt(degrees / np.maximum(1 - rho**2, np.finfo(float).eps))
    return Correlation(rho, 2 * stdtr(degrees, -t))


def rho_interval(rho: np.ndarray, n: int, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Interval of Spearman's rho from n members: normal in artanh(rho), variance 1.06/(n - 3).

    Fieller, Hartley and Pearson, Biometrika 44 (1957) 470-481. (-1, 1) below 4 members.
    """
    from scipy.special import ndtri

    half = ndtri((1 + confidence) / 2) * np.sqrt(1.06 / (n - 3)) if n > 3 else np.inf
    centre = np.arctanh(np.clip(rho, -1 + 1e-15, 1 - 1e-15))
    return np.tanh(centre - half), np.tanh(centre + half)


def _standard_ranks(columns: Sequence[np.ndarray]) -> np.ndarray:
    from scipy.stats import rankdata

    ranks = np.stack([rankdata(_column(c)) - (len(c) + 1) / 2 for c in columns])
    norm = np.sqrt(np.sum(ranks**2, axis=1, keepdims=True))
    return ranks / np.where(norm == 0, 1.0, norm)


def _column(values: Any) -> np.ndarray:
    x = np.asarray(values, float)
    if x.ndim != 1 or not x.size or np.isnan(x).any():
        raise ValueError(f"a column must be numbers, one for each member, none of them NaN; this has shape {x.shape}.")
    return x


def summary(
    columns: Mapping[str, np.ndarray],
    spread_names: Sequence[str],
    seed: int,
    confidence: float = 0.95,
    *,
    deciding: str = DECIDING,
    worst: int = 10,
) -> dict[str, Any]:
    """What an ensemble says, ready for JSON: no arrays, and None for what is infinite.

    `columns` are those of members.npz, arrays [N]: index, lost_at (s, +inf: never), the metrics, and "spread." + path
    for each of `spread_names`. Statistics count every member, lost ones too. Of a metric that is infinite for some (a
    time never reached) there are quantiles, but no mean, standard deviation or CVaR; `finite` counts the others.
    `drivers` ranks the spread quantities by |rho|, for each metric and for lost_at_s. `worst` names members: lost
    ones by when, then by `deciding`.
    """
    lost_at = _column(columns["lost_at"])
    metrics = {k: _column(v) for k, v in columns.items() if k not in FATE and not k.startswith(SPREAD)}
    if deciding not in metrics:
        raise ValueError(f"there is no metric {deciding} to rank members by.")
    kept = int(np.sum(~np.isfinite(lost_at)))
    return {
        "members": len(lost_at),
        "survivors": kept,
        "lost": int(np.sum(columns["lost"])),
        "stalled": int(np.sum(columns["stalled"])),
        "survival": _plain(wilson(kept, len(lost_at), confidence)),
        "confidence": confidence,
        "seed": int(seed),
        "metrics": _metrics(metrics, seed, confidence),
        "drivers": _drivers(
            {path: columns[SPREAD + path] for path in spread_names}, metrics | {"lost_at_s": lost_at}, confidence
        ),
        "worst": _worst(np.asarray(columns["index"]), lost_at, deciding, metrics[deciding], worst),
    }


def _number(x: Any) -> float | None:
    return float(x) if np.isfinite(x) else None


def _plain(estimate: Estimate) -> dict[str, float | None]:
    return {"estimate": _number(estimate.value), "low": _number(estimate.low), "high": _number(estimate.high)}


def _metrics(metrics: Mapping[str, np.ndarray], seed: int, confidence: float) -> dict[str, Any]:
    finite = [name for name, x in metrics.items() if np.isfinite(x).all()]
    found = bootstrap([metrics[name] for name in finite], 0.95, confidence, seed) if finite else {}
    nothing = Estimate(np.inf, np.inf, np.inf)
    out = {}
    for name, x in metrics.items():
        at = finite.index(name) if name in finite else None
        mean, std, worst = (
            nothing if at is None else Estimate(*(part[at] for part in found[kind])) for kind in ("mean", "std", "cvar")
        )
        q05, median, q95 = (Estimate(*row) for row in zip(*quantile(x, [0.05, 0.5, 0.95], confidence), strict=True))
        estimates = {"mean": mean, "std": std, "median": median, "q05": q05, "q95": q95, "cvar_95": worst}
        out[name] = {k: _plain(v) for k, v in estimates.items()}
        out[name] |= {"max": _number(x.max()), "finite": int(np.isfinite(x).sum())}
    return out


def _drivers(
    spread: Mapping[str, np.ndarray], metrics: Mapping[str, np.ndarray], confidence: float
) -> dict[str, list[dict[str, Any]]]:
    if not spread:
        return {name: [] for name in metrics}
    rho, p = spearman(list(spread.values()), list(metrics.values()))
    low, high = rho_interval(rho, len(next(iter(spread.values()))), confidence)
    return {
        name: [
            {"path": path, "rho": float(rho[row, n]), "low": low[row, n], "high": high[row, n], "p": float(p[row, n])}
            for row, path in sorted(enumerate(spread), key=lambda item: -abs(rho[item[0], n]))
        ]
        for n, name in enumerate(metrics)
    }


def _worst(index: np.ndarray, lost_at: np.ndarray, name: str, values: np.ndarray, count: int) -> list[dict[str, Any]]:
    order = np.lexsort((index, -values, lost_at))[:count]
    return [{"index": int(index[k]), name: _number(values[k]), "lost_at_s": _number(lost_at[k])} for k in order]
