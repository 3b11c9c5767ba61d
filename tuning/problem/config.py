"""The table [tune] of a case file: the gains to tune, the loss and its limits, and the size of the search."""

import dataclasses
import math
import pathlib
from typing import Any

import numpy as np

from ambjax.cases.reader import Case, case_from, load
from ambjax.cases.table import Table, one_line
from ambjax.cases.tune_table import (
    BUDGET,
    NUMBERS,
    OBJECTIVES,
    RISKS,
    SETTLING_BAND,
    SURVIVAL,
    SURVIVING,
    VOLTAGE_SHARE,
    WEIGHTS,
    Budget,
)
from ambjax.extend import leaf
from ambjax.host.extensions import NothingToTuneError
from tuning.problem.gains_table import space_from
from tuning.problem.goal import CVaR
from tuning.problem.limits import Limit
from tuning.problem.loss import TERMS
from tuning.problem.quantities import KINDS
from tuning.problem.space import Space
from tuning.problem.unbreakable import bounds_of

# Keys of [tune] that are neither in NUMBERS nor in BUDGET.
OTHER_KEYS = ["objective", "gains", "bounds", "weights", "limits", "risk"]
# Keys of [tune] that depend on the laws of the case.
KEYS_OF_LAWS = ("gains", "bounds")
# Allowed range of each limit: OTHER_RANGES by name, LIMIT_RANGE for all others. BAND_RANGE: that of settling_band_m.
LIMIT_RANGE: dataclasses.Field = leaf(at_least=1e-12, at_most=1e12, infinite=True)
OTHER_RANGES: dict[str, dataclasses.Field] = {
    "clearance_used": leaf(above=0, at_most=1),
    "survival": SURVIVAL,
    "sensitivity": leaf(at_least=1, at_most=1e12, infinite=True),
    "delay_margin_s": leaf(above=0, at_most=1e6, unit="s"),
}
# The search accepts a judged value beyond `Limit.allowed` by up to half of the margin. The other half is the reserve
# for the held-out ensemble; with a smaller margin it would be too small.
MARGIN_RANGE: dataclasses.Field = leaf(at_least=0.002, at_most=0.49)
BAND_RANGE: dataclasses.Field = leaf(at_least=1e-12, at_most=1.0, unit="m")


@dataclasses.dataclass(frozen=True)
class LimitSettings:
    """The table [tune.limits].

    `each`: the limits, in the order of their names. `survival`: share of the held-out members that must be held.
    `band`: of the settling time, m. `unbreakable`: limits that are left out because they cannot be broken, with the
    reason of each.
    """

    each: tuple[Limit, ...] = ()
    survival: float = SURVIVING
    band: float = 0.0
    unbreakable: tuple[tuple[Limit, str], ...] = ()

    def may_lose(self, members: int) -> int:
        """Return how many of `members` members may be lost."""
        return math.floor((1 - self.survival) * members + 1e-9)


@dataclasses.dataclass(frozen=True)
class Tune:
    """The table [tune]; its numbers are described in `ambjax.cases.tune_table`.

    `objective`: "knee" or "least_error". `space`: the gains to tune, with their bounds. `weights`: of the terms of the
    loss, in the order of TERMS.
    """

    objective: str
    space: Space
    weights: tuple[float, ...]
    limits: LimitSettings
    early: float
    stress: float
    gain_margin: float
    risk: CVaR
    minutes: float
    budget: Budget


def read_tune(
    path: str | pathlib.Path,
    settings_of: str | pathlib.Path | None = None,
    loaded: tuple[dict[str, Any], str] | None = None,
    known: Case | None = None,
) -> tuple[Case, Tune, dict[str, Any]]:
    """Return the case, [tune] and the raw document of a case file.

    `settings_of`: a case file whose [tune] replaces that of the case, except for the keys `gains` and `bounds`.
    `loaded`: document and text of the file; None: they are read. `known`: a case that names the same files. Raises
    ValueError with a message of one line for an invalid file.
    """
    raw, text = loaded or load(path)
    name = pathlib.Path(path).stem
    raw = with_settings_of(raw, settings_of)
    try:
        case = case_from(raw, name, text, pathlib.Path(path).parent, known)
        return case, tune_from(Table(raw).table("tune"), case), raw
    except ValueError as error:
        kind = NothingToTuneError if isinstance(error, NothingToTuneError) else ValueError
        raise kind(one_line(f"{path}: {error}")) from None


def with_settings_of(raw: dict[str, Any], settings_of: str | pathlib.Path | None) -> dict[str, Any]:
    """Return a document with [tune] of another case file, but its own gains and bounds. None: there is no other."""
    own, other = raw.get("tune", {}), {} if settings_of is None else load(settings_of)[0].get("tune", {})
    if settings_of is None or not (isinstance(own, dict) and isinstance(other, dict)):
        return raw
    kept = {key: value for key, value in own.items() if key in KEYS_OF_LAWS}
    return {**raw, "tune": kept | {key: value for key, value in other.items() if key not in KEYS_OF_LAWS}}


def tune_from(table: Table, case: Case) -> Tune:
    """Return [tune] of a case. A missing key has its default. Raises ValueError for an invalid table."""
    numbers = table.leaves(NUMBERS | BUDGET, OTHER_KEYS, [table.at(f"limits.{name}") for name in KINDS])
    objective, risk = (
        table.choice(key, list(words), words[0]) for key, words in (("objective", OBJECTIVES), ("risk", RISKS))
    )
    weights, alpha = table.table("weights").leaves(WEIGHTS), numbers.pop("alpha")
    if risk == "mean" and "alpha" in table.raw:
        raise ValueError(f'{table.at("alpha")} applies to risk = "cvar" only; risk is "mean". Remove alpha.')
    return Tune(
        objective=objective,
        risk=CVaR(0.0 if risk == "mean" else alpha),
        weights=_weights(weights),
        limits=_limits(table.table("limits"), case),
        space=space_from(table, case),
        budget=Budget(**{name: numbers.pop(name) for name in BUDGET}),
        **numbers,
    )


def _weights(given: dict[str, float]) -> tuple[float, ...]:
    if not any(given[name] > 0 for name in ("tracking", "peak")):
        raise ValueError(
            "tune.weights.tracking = 0 and tune.weights.peak = 0: no term of the loss depends on the error, "
            "and effort and chatter, which multiply the error, have no effect. Give one of the two a weight above 0."
        )
    if given["survival"] == 0:
        raise ValueError("tune.weights.survival = 0: losing the rotor would cost nothing. Give it a weight above 0.")
    return tuple(given[name] for name in TERMS)


def _check_speed(keys: list[str], case: Case) -> None:
    """Raise ValueError if the case has limits at the speed of the rotor, and no such speed."""
    rotor = case.scenario.rotor
    if keys and (rotor is None or not (np.any(rotor.speed) or np.any(rotor.acceleration))):
        raise ValueError(f"{', '.join(keys)}: it is a limit at the speed of the rotor. Give rotor.speed, in rpm.")
    if keys and (spread := [path for path in case.spread.paths if path.startswith("rotor.")]):
        raise ValueError(
            f"{', '.join(keys)}: all members need the same speed. Remove {', '.join(spread)} from [spread]."
        )


def _limits(table: Table, case: Case) -> LimitSettings:
    beside = [*OTHER_KEYS, *NUMBERS, *BUDGET, *(f"weights.{name}" for name in WEIGHTS)]
    table.only([*KINDS, "survival", "margin", "settling_band_m"], [f"tune.{key}" for key in beside])
    thresholds = {name: table.leaf(name, OTHER_RANGES.get(name, LIMIT_RANGE)) for name in KINDS if name in table.raw}
    _check_speed([table.at(name) for name, most in thresholds.items() if "_1x" in name and most < math.inf], case)
    defaults = {
        "rms_u_V": VOLTAGE_SHARE * float(np.max(np.asarray(case.scenario.u_max))),
        "sensitivity": float(case.zones.zone_a),
    }
    sources = {
        "rms_u_V": f"default, {100 * VOLTAGE_SHARE:g} % of actuator.u_max",
        "sensitivity": "default, zone A of [sensitivity]",
    } | dict.fromkeys(thresholds, table.path)
    thresholds = defaults | thresholds
    clearance = float(np.min(np.asarray(case.scenario.touchdown)))
    band = table.leaf("settling_band_m", BAND_RANGE, SETTLING_BAND * clearance)
    if "settling_band_m" in table.raw and "settling_s" not in thresholds:
        raise ValueError(f"{table.at('settling_band_m')} applies only with {table.at('settling_s')}. Give both.")
    if band >= clearance:
        raise ValueError(
            f"{table.at('settling_band_m')} = {band:g} m: it must be below the clearance, {clearance:g} m "
            "(run.clearance, by default 0.9 of plant.s_0)."
        )
    margin = table.leaf("margin", MARGIN_RANGE)
    each = tuple(
        Limit(name, thresholds[name], sources[name], KINDS[name].margin if margin is None else margin)
        for name in sorted(thresholds)
        if math.isfinite(thresholds[name])
    )
    bounds = {name: bound for name, bound in bounds_of(case).items() if thresholds.get(name, 0.0) >= bound.most}
    return LimitSettings(
        tuple(limit for limit in each if limit.name not in bounds),
        table.leaf("survival", SURVIVAL, SURVIVING),
        band,
        tuple((limit, bounds[limit.name].why) for limit in each if limit.name in bounds),
    )


def settings(tune: Tune) -> dict[str, Any]:
    """Return [tune] as plain data, for the report and the fingerprint of a checkpoint."""
    facts = {
        "objective": tune.objective,
        "gains": tune.space.paths,
        "bounds": {gain.path: [gain.low, gain.high] for gain in tune.space.gains},
        "weights": dict(zip(TERMS, tune.weights, strict=True)),
        "limits": {limit.name: {"threshold": limit.threshold, "margin": limit.margin} for limit in tune.limits.each},
        "survival": tune.limits.survival,
        "settling_band_m": tune.limits.band,
        "risk": str(tune.risk),
    }
    rest = {name: getattr(tune, name) for name in ("early", "stress", "gain_margin")}
    return facts | rest | dataclasses.asdict(tune.budget)


def seeds(budget: Budget) -> tuple[int, int, int]:
    """Return the seeds of the training, the validation and the held-out ensemble."""
    return budget.seed, int(np.uint32(budget.seed + 2_000_003)), int(np.uint32(budget.seed + 1_000_001))
