"""Statistics of an ensemble: its fate, its metrics with intervals, what drives them, and who fares worst."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambjax.ensemble.drivers import drivers
from ambjax.ensemble.intervals import STATISTICS, Estimate, bootstrap, column_of, quantile, wilson

# The share of members that CVaR leaves out, and how many must be left for its interval to hold (measured).
ALPHA, TAIL = 0.95, 10
# From this kurtosis on, an exponential's, a tail is heavy (a normal's is 3), and how many of the 95 % intervals of a
# lognormal's standard deviation cover it then, in per cent, by members (measured over 600 to 2,000 ensembles).
HEAVY, COVERED = 9.0, {50: 83, 200: 87, 1000: 90, 5000: 92}
# The metric by which members are ranked once all lost ones are named.
DECIDING = "settled_max_abs_error_m"
# Columns that are no metrics.
FATE = ("index", "lost_at", "lost", "stalled", "lost_at_s")
SPREAD = "spread."


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

    `columns` are those of members.npz, arrays [N]: index, lost_at (s, +inf: ran to the end), stalled, the metrics, and
    "spread." + path for each of `spread_names`. A member survives, is lost, or is stalled: the integrator gave up, and
    its fate is not known. Statistics count every member, those too. Of a metric that is infinite for some (a time never
    reached) there are quantiles, but no mean, standard deviation or CVaR; `finite` counts the others. `drivers` and
    `explained` are those of `ensemble.drivers.drivers`, for each metric and for lost_at_s. `worst` names members: lost
    and stalled ones by when, then by `deciding`. `notes` say what this ensemble is too small for.
    """
    lost_at = column_of(columns["lost_at"])
    metrics = {k: column_of(v) for k, v in columns.items() if k not in FATE and not k.startswith(SPREAD)}
    if deciding not in metrics:
        raise ValueError(f"there is no metric {deciding} to rank members by.")
    ended = np.isfinite(lost_at)
    stalled = ended & np.asarray(columns["stalled"], bool)
    survivors = int(np.sum(~ended))
    ranking, accounts = drivers(
        {path: column_of(columns[SPREAD + path]) for path in spread_names}, metrics | {"lost_at_s": lost_at}, confidence
    )
    return {
        "members": len(lost_at),
        "survivors": survivors,
        "lost": int(np.sum(ended & ~stalled)),
        "stalled": int(np.sum(stalled)),
        "survival": _plain(wilson(survivors, len(lost_at), confidence)),
        "confidence": confidence,
        "seed": int(seed),
        "notes": _notes(len(lost_at), metrics, confidence),
        "metrics": _metrics(metrics, seed, confidence),
        "drivers": ranking,
        "explained": accounts,
        "worst": _worst(np.asarray(columns["index"]), lost_at, stalled, deciding, metrics[deciding], worst),
    }


def _notes(n: int, metrics: Mapping[str, np.ndarray], confidence: float) -> list[str]:
    """What an ensemble of n is too small for: a CVaR's interval, and that of a standard deviation of heavy tails."""
    notes, sure, tail = [], f"{100 * confidence:g} %", (1 - ALPHA) * n
    if tail < TAIL:
        least = math.ceil(TAIL / (1 - ALPHA) - 1e-9)
        rests = f"the mean of the worst 5 % rests on {tail:.3g} members"
        notes.append(f"{rests}: its {sure} interval may cover less; take {least} members")
    heavy = [name for name, x in metrics.items() if np.isfinite(x).all() and _kurtosis(x) > HEAVY]
    if heavy:
        which = ", ".join(heavy[:3]) + f" and {len(heavy) - 3} more" * (len(heavy) > 3)
        at = max((k for k in COVERED if k <= n), default=min(COVERED))
        worth = f"{COVERED[at]} % instead of 95 % for a lognormal of {at:,} members"
        notes.append(f"heavy tails ({which}): the {sure} interval of a standard deviation may cover less, {worth}")
    return notes


def _kurtosis(x: np.ndarray) -> float:
    """Fourth central moment over the squared second; 0 where all values are alike."""
    size = np.abs(x - x.mean()).max()
    if size <= 1e-14 * np.abs(x).max():
        return 0.0
    d = (x - x.mean()) / size
    return float(np.mean(d**4) / np.mean(d**2) ** 2)


def _number(x: Any) -> float | None:
    return float(x) if np.isfinite(x) else None


def _plain(estimate: Estimate) -> dict[str, float | None]:
    return {"estimate": _number(estimate.value), "low": _number(estimate.low), "high": _number(estimate.high)}


def _metrics(metrics: Mapping[str, np.ndarray], seed: int, confidence: float) -> dict[str, Any]:
    finite = [name for name, x in metrics.items() if np.isfinite(x).all()]
    intervals = bootstrap([metrics[name] for name in finite], ALPHA, confidence, seed) if finite else {}
    nothing = Estimate(np.inf, np.inf, np.inf)
    out = {}
    for name, x in metrics.items():
        at = finite.index(name) if name in finite else None
        mean, std, worst = (
            nothing if at is None else Estimate(*(part[at] for part in intervals[kind])) for kind in STATISTICS
        )
        q05, median, q95 = (Estimate(*row) for row in zip(*quantile(x, [0.05, 0.5, 0.95], confidence), strict=True))
        estimates = {"mean": mean, "std": std, "median": median, "q05": q05, "q95": q95, "cvar_95": worst}
        out[name] = {k: _plain(v) for k, v in estimates.items()}
        out[name] |= {"max": _number(x.max()), "finite": int(np.isfinite(x).sum())}
    return out


def _worst(
    index: np.ndarray, lost_at: np.ndarray, stalled: np.ndarray, name: str, values: np.ndarray, count: int
) -> list[dict[str, Any]]:
    def fate(k: int) -> str:
        return "survives" if np.isinf(lost_at[k]) else "stalled" if stalled[k] else "lost"

    order = np.lexsort((index, -values, lost_at))[:count]
    return [
        {"index": int(index[k]), "fate": fate(k), name: _number(values[k]), "lost_at_s": _number(lost_at[k])}
        for k in order
    ]
