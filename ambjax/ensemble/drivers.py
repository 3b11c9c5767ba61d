"""Global sensitivity of a metric: the share of its variation that each number of [spread] (spread quantity) explains.

The share is Sobol's first-order index Var(E[y | x])/Var(y), where x is the quantity and y the rank of the metric. The
relation of y to x may have any shape, for example a line or a V. Ranks limit the influence of a few lost rotors and of
times that are never reached (+inf).

E[y | x] is estimated by a least-squares fit of cosines of the rank of x, as in Plischke's EASI (Reliab. Eng. Syst. Saf.
95, 2010, 354-360). The bias of the share is removed as in Tissot and Prieur (Reliab. Eng. Syst. Saf. 107, 2012,
205-213). Spearman's rank correlation gives the sign of the trend.

Existing implementations are not suitable. SALib's `rbd_fast` is the same estimator, but it ranks equal values in member
order. A quantity with only two values is then treated as a ramp, and a constant appears to have an influence.
`rbd_fast` computes its intervals from half the members. It computes neither p-values nor shares of pairs. SciPy's
`sobol_indices` evaluates the model at its own points, so it cannot use the members of an ensemble.
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

# Number of cosines fitted to a metric. Six of them explain a V-shaped relation, or one period of a sine, to 1 %.
TERMS = 6
# Minimum number of members per cosine. Members with the most frequent value of the metric do not count.
PER_TERM = 4
# Number of cosines of each quantity of a pair, and largest number of members used to find pairs.
PAIR_TERMS, PAIR_MEMBERS = 2, 16_384


class Shares(NamedTuple):
    """Shares of variation, and the ends of their intervals.

    `p`: probability of a share of at least this size if x and y are unrelated.
    """

    share: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


def shares(x: Sequence[np.ndarray], y: Sequence[np.ndarray], confidence: float = 0.95) -> Shares:
    """Compute the share of the variation of each column of y [N] that each column of x [N] explains alone.

    The values of y are used as they are; pass ranks to get shares of the variation of the rank. Intervals come from the
    delta method. The share is 0, with interval (0, 1) and p = 1, if the column of x or of y is constant, or if fewer
    than PER_TERM members differ from the most frequent value of y.

    Returns arrays [len(x), len(y)]. Raises ValueError if a column of y is not finite.
    """
    columns = [np.asarray(column, float) for column in y]
    if not all(np.isfinite(column).all() for column in columns):
        raise ValueError("a column of y is not finite, so its variance is undefined. Pass its ranks instead.")
    Y = np.stack([standard(column) for column in columns])
    terms = _terms(columns)
    results = [_explanation(_cosines(column, TERMS), Y, terms, confidence) for column in x]
    return Shares(*(np.array(part) for part in zip(*results, strict=True)))


def drivers(
    spread: Mapping[str, np.ndarray], metrics: Mapping[str, np.ndarray], confidence: float = 0.95
) -> tuple[dict[str, list[dict[str, object]]], dict[str, dict[str, object]]]:
    """For each metric, rank the spread quantities by the share of its variation that they explain, with a summary.

    - `spread`: columns [N] of the spread quantities, by dotted path.
    - `metrics`: columns [N] of the metrics, by name.

    Returns two dicts by metric. The first holds a list of quantities in descending order of their share, each with
    "path", "share", "low", "high", "p" and "rho" (the rank correlation, which gives the sign of the trend). The second
    holds "alone", the sum of the significant shares; "pair", the pair of quantities whose interaction has the largest
    significant share (None: no pair is significant); and "says", a sentence. Significance is at the level
    1 - confidence for all tests of a metric together (Bonferroni's correction).
    """
    empty = not all(len(column) for column in metrics.values())
    if empty or not spread:
        says = "no member survives" if empty else "the case has no spread"
        return {name: [] for name in metrics}, {name: _account(0.0, None, says) for name in metrics}
    x, ranks = list(spread.values()), list(_standard_ranks(list(metrics.values())))
    parts, paths = shares(x, ranks, confidence), list(spread)
    rho = np.clip(_standard_ranks(x) @ np.stack(ranks).T / len(x[0]), -1.0, 1.0)
    pairs = _pairs(dict(spread), ranks, confidence)
    ranking, accounts = {}, {}
    for n, name in enumerate(metrics):
        rows: list[dict[str, Any]] = [
            {"path": path} | {k: float(v[row, n]) for k, v in parts._asdict().items()} | {"rho": float(rho[row, n])}
            for row, path in enumerate(paths)
        ]
        ranking[name] = sorted(rows, key=lambda row: -row["share"])
        clear = 2 * len(paths) * parts.p[:, n] < 1 - confidence
        alone = float(min(parts.share[clear, n].sum(), 1.0))
        accounts[name] = _account(alone, pairs[n], _words(ranks[n], alone, pairs[n], bool(np.all(parts.p[:, n] == 1))))
    return ranking, accounts


def _account(alone: float, pair: dict[str, Any] | None, says: str) -> dict[str, object]:
    return {"alone": alone, "pair": pair, "says": says}


def _words(ranks: np.ndarray, alone: float, pair: dict[str, Any] | None, unknown: bool) -> str:
    """Return a sentence about the explained share of the variation of one metric."""
    if np.ptp(ranks) == 0:
        return "it is the same for all members"
    if unknown:
        return "too few members differ to identify its causes"
    if not alone and pair is None:
        return "no quantity and no pair of quantities explains it; it is noise or an effect of three or more quantities"
    together = ""
    if pair is not None:  # the sum of the estimates may exceed 1
        more = 100 * min(pair["share"], 1.0 - alone)
        amount = f"{more:.0f} % more" if more >= 1 else "a little more"
        together = f"; {' with '.join(pair['paths'])} together explain {amount}"
    left = alone + (0.0 if pair is None else pair["share"]) < 0.995
    rest = "; the rest is noise or an effect of three or more quantities" * left
    return f"single quantities explain {100 * alone:.0f} % of the variation of its rank{together}{rest}"


def _pairs(
    spread: dict[str, np.ndarray], ranks: Sequence[np.ndarray], confidence: float
) -> list[dict[str, Any] | None]:
    """Return, for each metric, the pair whose interaction has the largest significant share; None: there is none."""
    sample = slice(0, PAIR_MEMBERS)
    Y = np.stack([standard(column[sample]) for column in ranks])
    waves = {path: _cosines(x[sample], PAIR_TERMS) for path, x in spread.items()}
    enough = [PAIR_TERMS**2 * (terms >= PAIR_TERMS**2) for terms in _terms(list(Y), PAIR_TERMS**2)]
    couples = list(itertools.combinations(spread, 2))
    best: list[dict[str, Any] | None] = [None] * len(ranks)
    for couple in couples:
        products = (waves[couple[0]][:, None] * waves[couple[1]][None]).reshape(-1, Y.shape[1])
        share, _, _, p = _explanation(products, Y, enough, confidence)
        for n, before in enumerate(best):
            if 2 * len(couples) * p[n] < 1 - confidence and (before is None or share[n] > before["share"]):
                best[n] = {"paths": list(couple), "share": float(share[n]), "p": float(p[n])}
    return best


def _explanation(waves: np.ndarray, Y: np.ndarray, terms: Sequence[int], confidence: float) -> tuple[np.ndarray, ...]:
    """Return share, low, high and p of each row of Y [columns, N], which has mean 0 and mean square 1.

    Row k is fitted with the first terms[k] rows of `waves` [., N].
    """
    from scipy.special import fdtrc, ndtri

    n = Y.shape[1]
    waves = waves - waves.mean(axis=1, keepdims=True)
    gram, b = waves @ waves.T / n, waves @ Y.T / n
    out = np.tile([[0.0], [0.0], [1.0], [1.0]], len(Y))
    for column, count in enumerate(terms):
        gain = np.linalg.pinv(gram[:count, :count], rcond=1e-9, hermitian=True) @ b[:count, column]
        fit, rank = float(b[:count, column] @ gain), int(np.linalg.matrix_rank(gram[:count, :count], 1e-9, True))
        rest = n - 1 - rank
        if rank == 0 or rest < 1 or not Y[column].any():
            continue
        fit = min(fit, 1.0)
        share = fit - rank / rest * (1 - fit)
        f, y = gain @ waves[:count], Y[column]
        # The influence of a member on the fit is 2 f y - fit y^2 - fit. The term of `half` that contains `rank` is the
        # noise of the coefficients, which dominates if the true share is 0.
        influence = np.mean((2 * f * y - fit * y**2 - fit) ** 2) / n
        half = ndtri((1 + confidence) / 2) * np.sqrt(influence + 2 * rank * (1 - fit) ** 2 / n**2)
        p = fdtrc(rank, rest, fit / rank / max((1 - fit) / rest, np.finfo(float).tiny))
        out[:, column] = max(share, 0.0), max(share - half, 0.0), min(max(share, 0.0) + half, 1.0), p
    return tuple(out)


def _terms(columns: Sequence[np.ndarray], most: int = TERMS) -> list[int]:
    """Return the number of cosines for each column, from its members beside the most frequent value."""
    differing = [len(column) - int(np.unique(column, return_counts=True)[1].max()) for column in columns]
    return [min(most, count // PER_TERM) for count in differing]


def _cosines(column: np.ndarray, terms: int) -> np.ndarray:
    """Return sqrt(2) cos(pi k u), k = 1 to `terms`, [terms, N]; u in 0..1 is the relative rank of each member."""
    from scipy.stats import rankdata

    u = (rankdata(column) - 0.5) / len(column)
    return np.sqrt(2) * np.cos(np.pi * np.arange(1, terms + 1)[:, None] * u)


def _standard_ranks(columns: Sequence[np.ndarray]) -> np.ndarray:
    from scipy.stats import rankdata

    return np.stack([standard(rankdata(column)) for column in columns])


def standard(column: np.ndarray) -> np.ndarray:
    """Scale a column to mean 0 and mean square 1; return zeros if all values are equal."""
    x = column - column.mean()
    size = np.abs(x).max()
    return x / size / np.sqrt(np.mean((x / size) ** 2)) if size > 1e-14 * np.abs(column).max() else np.zeros(len(x))
