"""Statistics of an ensemble: its status, its metrics with intervals, what drives them, and who fares worst."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambjax.ensemble.drivers import drivers
from ambjax.ensemble.intervals import STATISTICS, TAIL, Estimate, bootstrap, column_of, quantile, wilson

# The share of members that CVaR leaves out.
ALPHA = 0.95
# From this kurtosis on, an exponential's, a tail is heavy (a normal's is 3), and how many of the 95 % intervals of a
# lognormal's standard deviation cover it then, in per cent, by members (measured over 600 to 2,000 ensembles).
HEAVY, COVERED = 9.0, {50: 83, 200: 87, 1000: 90, 5000: 92}
# The metric by which members are ranked once all lost ones are named.
DECIDING = "settled_max_abs_error_m"
# Of whom a summary's metrics and their drivers are.
OF = "survivors"
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
    """Statistics of an ensemble, ready for JSON: no arrays, and None for what is infinite or unknown.

    `columns` are those of members.npz, arrays [N]: index, lost_at (s, +inf: ran to the end), stalled, the metrics, and
    "spread." + path for each of `spread_names`. A member survives, is lost, or is stalled: the integrator gave up, and
    its status is not known.

    The metrics and what drives them are statistics of the survivors (`metrics_of`): a rotor that is lost is frozen, and
    from then on its voltage, current and chatter are 0. Lost and stalled members count in `survival`, in the drivers of
    lost_at_s and in `worst`. Of a metric that is infinite for some survivors (a time never reached) there are
    quantiles, but no mean, standard deviation or CVaR; `finite` counts the others. Without survivors every statistic is
    None. `drivers` and `explained` are those of `ensemble.drivers.drivers`. `worst` lists lost and stalled members by
    time, then survivors by `deciding`. `notes` name the statistics for which this ensemble is too small.

    Raises ValueError where there is no column `deciding`, and for columns that are not one number for each member.
    """
    lost_at = column_of(columns["lost_at"])
    metrics = {k: column_of(v) for k, v in columns.items() if k not in FATE and not k.startswith(SPREAD)}
    if deciding not in metrics:
        raise ValueError(f"there is no metric {deciding} to rank members by.")
    ended = np.isfinite(lost_at)
    stalled = ended & np.asarray(columns["stalled"], bool)
    survivors = int(np.sum(~ended))
    held = {name: x[~ended] for name, x in metrics.items()}
    ranking, accounts = _drivers(
        {path: column_of(columns[SPREAD + path]) for path in spread_names}, held, lost_at, confidence
    )
    return {
        "members": len(lost_at),
        "survivors": survivors,
        "lost": int(np.sum(ended & ~stalled)),
        "stalled": int(np.sum(stalled)),
        "survival": _plain(wilson(survivors, len(lost_at), confidence)),
        "confidence": confidence,
        "seed": int(seed),
        "notes": _notes(survivors, held, confidence),
        "metrics_of": OF,
        "metrics": _metrics(held, seed, confidence),
        "drivers": ranking,
        "explained": accounts,
        "worst": _worst(np.asarray(columns["index"]), lost_at, stalled, deciding, metrics[deciding], worst),
    }


def _drivers(
    spread: dict[str, np.ndarray], held: dict[str, np.ndarray], lost_at: np.ndarray, confidence: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What drives each metric among the survivors, and when members are lost among all, as `drivers` returns them."""
    ended = np.isfinite(lost_at)
    if ended.all():
        nothing = {"alone": 0.0, "pair": None, "says": "no member survives"}
        parts = [({name: [] for name in held}, {name: dict(nothing) for name in held})]
    else:
        parts = [drivers({path: x[~ended] for path, x in spread.items()}, held, confidence)]
    parts.append(drivers(spread, {"lost_at_s": lost_at}, confidence))
    ranking, accounts = ({name: x for part in parts for name, x in part[k].items()} for k in (0, 1))
    return ranking, accounts


def _notes(n: int, metrics: Mapping[str, np.ndarray], confidence: float) -> list[str]:
    """For what n survivors are too few: the interval of a CVaR, and that of a standard deviation of heavy tails."""
    if not n:
        return ["no member survives: there are no statistics of the metrics"]
    notes, sure, tail = [], f"{100 * confidence:g} %", (1 - ALPHA) * n
    if tail < TAIL:
        least = math.ceil(TAIL / (1 - ALPHA) - 1e-9)
        rests = f"the mean of the worst 5 % rests on {tail:.3g} survivors"
        notes.append(f"{rests}: its {sure} interval may cover less, or have no upper end; it needs {least}")
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
    finite = [name for name, x in metrics.items() if x.size and np.isfinite(x).all()]
    intervals = bootstrap([metrics[name] for name in finite], ALPHA, confidence, seed) if finite else {}
    nothing = Estimate(np.inf, np.inf, np.inf)
    out = {}
    for name, x in metrics.items():
        at = finite.index(name) if name in finite else None
        mean, std, worst = (
            nothing if at is None else Estimate(*(part[at] for part in intervals[kind])) for kind in STATISTICS
        )
        some = quantile(x, [0.05, 0.5, 0.95], confidence) if x.size else Estimate(*np.full((3, 3), np.inf))
        q05, median, q95 = (Estimate(*row) for row in zip(*some, strict=True))
        estimates = {"mean": mean, "std": std, "median": median, "q05": q05, "q95": q95, "cvar_95": worst}
        out[name] = {k: _plain(v) for k, v in estimates.items()}
        out[name] |= {"max": _number(x.max(initial=-np.inf)), "finite": int(np.isfinite(x).sum())}
    return out


def _worst(
    index: np.ndarray, lost_at: np.ndarray, stalled: np.ndarray, name: str, values: np.ndarray, count: int
) -> list[dict[str, Any]]:
    def status(k: int) -> str:
        return "survives" if np.isinf(lost_at[k]) else "stalled" if stalled[k] else "lost"

    order = np.lexsort((index, -values, lost_at))[:count]
    return [
        {"index": int(index[k]), "status": status(k), name: _number(values[k]), "lost_at_s": _number(lost_at[k])}
        for k in order
    ]
