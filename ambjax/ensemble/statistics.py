"""Statistics of an ensemble: survival, metrics with intervals, sensitivity to the spread, and the worst members."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ambjax.ensemble.drivers import drivers, standard
from ambjax.ensemble.intervals import STATISTICS, TAIL, Estimate, bootstrap, column_of, quantile, wilson

# Level of the CVaR: the mean of the largest values, which are a share of 1 - ALPHA of all values.
ALPHA = 0.95
# HEAVY: kurtosis above which a tail counts as heavy. An exponential distribution has 9, a normal one 3.
# COVERED: coverage, in per cent, of the 95 % interval of the standard deviation of a lognormal distribution, by number
# of members (measured over 600 to 2,000 ensembles).
HEAVY, COVERED = 9.0, {50: 83, 200: 87, 1000: 90, 5000: 92}
# Metric that ranks the surviving members in the list of the worst.
DECIDING = "settled_max_abs_error_m"
# Members that a summary's metrics and drivers describe.
DESCRIBED = "survivors"
# Columns that are not metrics.
STATUS_COLUMNS = ("index", "lost_at", "lost", "stalled", "lost_at_s")
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
    """Compute the statistics of an ensemble, as a dict without arrays, for JSON. Infinite and unknown numbers are None.

    - `columns`: the columns of members.npz, arrays [N]: index, lost_at (s; +inf if the run reached its end), stalled,
      the metrics, and "spread." + path for each path in `spread_names`.
    - `seed`: seed of the bootstrap.
    - `confidence`: level of all intervals.
    - `deciding`: metric that ranks the survivors in the list of the worst members.
    - `worst`: length of that list.

    A member survives, is lost, or is stalled (its integration stopped early, so it is neither held nor lost). Metrics
    and their drivers (the spread quantities that explain them) are computed from the survivors; the key `metrics_of`
    states this. The state of a lost rotor is frozen: its error is that of the frozen state, and its rms voltage, rms
    current and chatter cover only the time before the loss. Lost and stalled members count in `survival`, in the
    drivers of lost_at_s and in `worst`.

    A metric that is infinite for some survivors (a time never reached) has quantiles, but no mean, standard deviation
    or CVaR; `finite` counts its finite values. Without survivors all its statistics are None. `drivers` and `explained`
    are the results of `ensemble.drivers.drivers`. `worst` lists lost and stalled members by time, then survivors by
    `deciding` in descending order. `notes` names the statistics whose intervals are not reliable.

    Raises ValueError if there is no column `deciding`, and as `column_of` does: for a column that is empty, contains
    NaN or is not one-dimensional.
    """
    lost_at = column_of(columns["lost_at"])
    others = {*STATUS_COLUMNS, *(SPREAD + path for path in spread_names)}
    metrics = {name: column_of(column) for name, column in columns.items() if name not in others}
    if deciding not in metrics:
        raise ValueError(f"there is no metric {deciding} to rank members by.")
    ended = np.isfinite(lost_at)
    stalled = ended & np.asarray(columns["stalled"], bool)
    survivors = int(np.sum(~ended))
    held = {name: x[~ended] for name, x in metrics.items()}
    spread = {path: column_of(columns[SPREAD + path]) for path in spread_names}
    alive = {path: x[~ended] for path, x in spread.items()}
    found = drivers(alive, held, confidence), drivers(spread, {"lost_at_s": lost_at}, confidence)
    ranking, accounts = (of_held | of_all for of_held, of_all in zip(*found, strict=True))
    return {
        "members": len(lost_at),
        "survivors": survivors,
        "lost": int(np.sum(ended & ~stalled)),
        "stalled": int(np.sum(stalled)),
        "survival": _as_dict(wilson(survivors, len(lost_at), confidence)),
        "confidence": confidence,
        "seed": int(seed),
        "notes": _notes(survivors, held, confidence),
        "metrics_of": DESCRIBED,
        "metrics": _metrics(held, seed, confidence),
        "drivers": ranking,
        "explained": accounts,
        "worst": _worst(np.asarray(columns["index"]), lost_at, stalled, deciding, metrics[deciding], worst),
    }


def _notes(n: int, metrics: Mapping[str, np.ndarray], confidence: float) -> list[str]:
    """Return notes on statistics that may mislead: of equal members, of the CVaR, and of the std of heavy tails."""
    if not n:
        return ["no member survives: there are no statistics of the metrics"]
    if n > 1 and all(np.all(x == x[0]) for x in metrics.values()):
        return ["all survivors have the same metrics, for lack of noise and [spread]: the intervals have no meaning"]
    notes, level, tail = [], f"{100 * confidence:g} %", (1 - ALPHA) * n
    if tail < TAIL:
        least = math.ceil(TAIL / (1 - ALPHA) - 1e-9)
        notes.append(
            f"the worst 5 % are {tail:.3g} survivors: the {level} interval of their mean may have a lower coverage or "
            f"no upper end; use at least {least} survivors"
        )
    heavy = [name for name, x in metrics.items() if np.isfinite(x).all() and np.mean(standard(x) ** 4) > HEAVY]
    if heavy:
        which = ", ".join(heavy[:3]) + f" and {len(heavy) - 3} more" * (len(heavy) > 3)
        at = max((k for k in COVERED if k <= n), default=min(COVERED))
        covered = f"a 95 % interval covers {COVERED[at]} % for lognormal values of {at:,} members"
        notes.append(f"heavy tails ({which}): the interval of a standard deviation is too short; {covered}")
    return notes


def _number(x: float | np.ndarray) -> float | None:
    """Return x, or None if it is infinite or NaN."""
    return float(x) if np.isfinite(x) else None


def _as_dict(estimate: Estimate) -> dict[str, float | None]:
    return {"estimate": _number(estimate.value), "low": _number(estimate.low), "high": _number(estimate.high)}


def _metrics(metrics: Mapping[str, np.ndarray], seed: int, confidence: float) -> dict[str, object]:
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
        out[name] = {k: _as_dict(v) for k, v in estimates.items()}
        out[name] |= {"max": _number(x.max(initial=-np.inf)), "finite": int(np.isfinite(x).sum())}
    return out


def _worst(
    index: np.ndarray, lost_at: np.ndarray, stalled: np.ndarray, name: str, values: np.ndarray, count: int
) -> list[dict[str, object]]:
    """Return the `count` worst members: lost and stalled ones by time, then survivors by `values`, largest first."""

    def status(k: int) -> str:
        return "survives" if np.isinf(lost_at[k]) else "stalled" if stalled[k] else "lost"

    order = np.lexsort((index, -values, lost_at))[:count]
    return [
        {"index": int(index[k]), "status": status(k), name: _number(values[k]), "lost_at_s": _number(lost_at[k])}
        for k in order
    ]
