"""The table [tune] of a case file: the gains to tune, the loss and its limits, and the size of the search."""

import dataclasses
import math
import pathlib
from typing import Any

import numpy as np

from ambjax.cases.reader import Case, case_from, load
from ambjax.cases.table import Table, one_line, show
from ambjax.ensemble.spread import require_path
from ambjax.extend import GAINS, leaf
from tuning.objective.limits import DEFAULT_SHARE, KINDS, LEAST_MARGIN, Limit
from tuning.objective.loss import TERMS
from tuning.objective.risk import CVaR, Mean, Risk, SoftWorst
from tuning.optimisers import BFGS, NAMES
from tuning.space import CLOSEST, Gain, Space, tunable

WEIGHTS = {"tracking": 1.0, "peak": 0.0, "effort": 0.1, "chatter": 0.1, "clearance": 1e-3, "survival": 1.0}
WORDS = ["gains", "bounds", "weights", "limits", "risk", "alpha", "optimiser"]
# Defaults and bounds of the numbers of [tune]. The bounds are decades wider than useful values.
NUMBERS: dict[str, dataclasses.Field] = {
    "conditions_margin": leaf(0.1, at_least=0, at_most=1e3),
    "early": leaf(0.0, at_least=0, at_most=1e6),
    "stress": leaf(1.2, above=0, at_most=1e6),
    "gain_margin": leaf(1.25, above=0, at_most=1e6),
    "learning_rate": leaf(0.1, above=0, at_most=1e3),
}
WEIGHT: dataclasses.Field = leaf(at_least=0, at_most=1e9)
LIMIT: dataclasses.Field = leaf(at_least=1e-12, at_most=1e12, infinite=True)
SHARES: dict[str, dataclasses.Field] = dict.fromkeys(("clearance_used", "survival"), leaf(above=0, at_most=1))
LENGTH: dataclasses.Field = leaf(at_least=1e-12, at_most=1.0, unit="m")
# Largest whole numbers; smaller for members and points, which are in memory at once.
MOST_WHOLE, MOST_MEMBERS = 2**31 - 1, 2**20
# Default band of the settling time, as a share of the clearance.
BAND = 0.01


@dataclasses.dataclass(frozen=True)
class Budget:
    """Size of the search."""

    members: int = leaf(32, at_least=1, at_most=MOST_MEMBERS, whole=True)
    """ordinary members of the training ensemble"""
    stressed: int = leaf(8, at_least=0, at_most=MOST_MEMBERS, whole=True)
    """stressed members of the training ensemble, for which only the loss of the rotor counts: `stress` times the noise,
    and each gain multiplied or divided by `gain_margin`"""
    validation: int = leaf(2000, at_least=0, at_most=MOST_MEMBERS, whole=True)
    """members of the validation ensemble; lost ones join the stressed members, and the search continues"""
    held_out: int = leaf(1000, at_least=0, at_most=MOST_MEMBERS, whole=True)
    """members of the ensemble that judges the gains"""
    seed: int = leaf(1, at_least=0, at_most=MOST_WHOLE, whole=True)
    """seed of the training ensemble and of the screen; the seeds of the other ensembles follow from it (`seeds`)"""
    screen: int = leaf(128, at_least=0, at_most=MOST_MEMBERS, whole=True)
    """points of the first screen; 0: start from the case's gains alone"""
    starts: int = leaf(4, at_least=1, at_most=MOST_WHOLE, whole=True)
    """number of points that are refined"""
    iterations: int = leaf(40, at_least=1, at_most=MOST_WHOLE, whole=True)
    """largest number of iterations of each phase of the refinement"""
    substeps: int = leaf(3, at_least=1, at_most=MOST_WHOLE, whole=True)
    """steps per sample"""


@dataclasses.dataclass(frozen=True)
class LimitSettings:
    """The table [tune.limits]."""

    each: tuple[Limit, ...] = ()
    """the limits, in the order of their names"""
    survival: float = 1.0
    """share of the held-out members that must be held"""
    band: float = 0.0
    """band of the settling time, m"""

    def may_lose(self, members: int) -> int:
        """Return the largest number of `members` that may be lost."""
        return math.floor((1 - self.survival) * members + 1e-9)


@dataclasses.dataclass(frozen=True)
class Tune:
    """The table [tune]. `weights` are in the order of TERMS; `conditions` is the weight of the conditions."""

    space: Space
    weights: tuple[float, ...]
    limits: LimitSettings
    conditions: float
    margin: float
    early: float
    stress: float
    gain_margin: float
    risk: Risk
    optimiser: str
    learning_rate: float
    budget: Budget


def read_tune(path: str | pathlib.Path) -> tuple[Case, Tune, dict[str, Any]]:
    """Return the case, [tune] and the raw document of a case file. Raises ValueError, one line, for an invalid file."""
    raw, text = load(path)
    name = pathlib.Path(path).stem
    try:
        case = case_from(raw, name, text)
        return case, tune_from(Table(raw).table("tune"), case), raw
    except ValueError as error:
        raise ValueError(one_line(f"{path}: {error}")) from None


def tune_from(table: Table, case: Case) -> Tune:
    """Return [tune] of a case. Missing keys have defaults. Raises ValueError for an invalid table."""
    counts = {field.name: field for field in dataclasses.fields(Budget)}
    table.only([*WORDS, *NUMBERS, *counts])
    budget = Budget(**{name: table.whole(name, field) for name, field in counts.items()})
    weights, conditions = _weights(table.table("weights"))
    optimiser = table.choice("optimiser", list(NAMES), BFGS)
    numbers = {name: table.leaf(name, field, field.default) for name, field in NUMBERS.items()}
    return Tune(
        space=_space(table, case),
        weights=weights,
        limits=_limits(table.table("limits"), case),
        conditions=conditions,
        margin=numbers.pop("conditions_margin"),
        risk=_risk(table),
        optimiser=optimiser,
        budget=budget,
        **numbers,
    )


def _space(table: Table, case: Case) -> Space:
    known = tunable(case.cascade)
    default = tunable(case.cascade, steepness=False) or known
    paths = table.raw.get("gains", default)
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise ValueError(f'{table.at("gains")} = {show(paths)}: give a list of paths, as in ["controller.position.c"].')
    bounds = _flat(table.table("bounds").raw)
    for path in [*paths, *bounds]:
        try:
            require_path(path, known)
        except ValueError as error:
            key = "gains" if path in paths else "bounds"
            text = str(error).removeprefix(f"spread.{path}: ").replace("in this case", "to tune in this case")
            raise ValueError(f"{table.at(key)}: '{path}': {text}") from None
    for path in bounds:
        if path not in paths:
            raise ValueError(f"{table.at('bounds')}: {path} is not in tune.gains. Add it there or leave it out here.")
    clash = [path for path in paths if path in case.spread.paths]
    if clash:
        raise ValueError(f"spread.{clash[0]} varies what tune.gains asks to tune. Remove it from one of them.")
    return Space(tuple(Gain(path, *_bound(bounds.get(path), path, table)) for path in paths))


def _flat(raw: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested tables with dotted keys, because TOML reads controller.position.c = [1, 2] as nested tables."""
    flat: dict[str, Any] = {}
    for key, value in raw.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _bound(raw: Any, path: str, table: Table) -> tuple[float, float]:
    if raw is None:
        return 0.0, math.inf
    pair = isinstance(raw, list) and len(raw) == 2 and all(type(x) in (int, float) for x in raw)
    ends = pair and 0 <= raw[0] <= GAINS[1] and (raw[1] <= GAINS[1] or raw[1] == math.inf)
    if not ends or not (1 + CLOSEST) * raw[0] < raw[1]:
        words = f"give [low, high] with 0 <= low < high <= {GAINS[1]:g}, apart by a share of {CLOSEST:g} of low or more"
        raise ValueError(f"{table.at('bounds')}.{path} = {show(raw)}: {words}; inf means no upper bound.")
    return float(raw[0]), float(raw[1])


def _weights(table: Table) -> tuple[tuple[float, ...], float]:
    table.only([*TERMS, "conditions"])
    given = {name: table.leaf(name, WEIGHT, WEIGHTS.get(name, 1.0)) for name in [*TERMS, "conditions"]}
    if not any(given[name] > 0 for name in ("tracking", "peak")):
        raise ValueError(
            f"{table.path}.tracking = 0 and {table.path}.peak = 0: nothing asks the rotor to follow its reference, "
            "so every gain that keeps it is as good. Give one of them a weight above 0."
        )
    if given["survival"] == 0:
        raise ValueError(f"{table.path}.survival = 0: losing the rotor would cost nothing. Give it a weight above 0.")
    return tuple(given[name] for name in TERMS), given["conditions"]


def _limits(table: Table, case: Case) -> LimitSettings:
    table.only([*KINDS, "survival", "margin", "settling_band_m"])
    asked = {name: table.leaf(name, SHARES.get(name, LIMIT)) for name in KINDS if name in table.raw}
    u_max, source = float(np.max(np.asarray(case.scenario.u_max))), dict.fromkeys(asked, table.path)
    if "rms_u_V" not in asked and math.isfinite(u_max):
        asked["rms_u_V"], source["rms_u_V"] = (
            DEFAULT_SHARE * u_max,
            f"default, {100 * DEFAULT_SHARE:g} % of actuator.u_max",
        )
    clearance = float(np.min(np.asarray(case.scenario.touchdown)))
    band = table.leaf("settling_band_m", LENGTH, BAND * clearance)
    if "settling_band_m" in table.raw and "settling_s" not in asked:
        raise ValueError(
            f"{table.at('settling_band_m')} has a meaning beside {table.at('settling_s')} only. Give both."
        )
    if band >= clearance:
        raise ValueError(
            f"{table.at('settling_band_m')} = {band:g} m: it must be below the clearance, {clearance:g} m "
            "(run.clearance, by default 0.9 of plant.s_0)."
        )
    share = f"from {LEAST_MARGIN:g} to below 0.5"
    if not LEAST_MARGIN <= table.number("margin", LEAST_MARGIN, f"a number {share}") < 0.5:
        raise ValueError(f"{table.at('margin')} = {table.raw['margin']:g}: it must be {share}, of each limit.")
    each = tuple(
        Limit(name, asked[name], source[name], table.number("margin", KINDS[name].margin))
        for name in sorted(asked)
        if math.isfinite(asked[name])
    )
    return LimitSettings(each, table.leaf("survival", SHARES["survival"], 1.0), band)


def _risk(table: Table) -> Risk:
    name = table.choice("risk", ["mean", "cvar", "soft-worst"], "mean")
    if name != "cvar":
        if "alpha" in table.raw:
            raise ValueError(f'{table.at("alpha")} has a meaning for risk = "cvar" only; risk is "{name}". Remove one.')
        return Mean() if name == "mean" else SoftWorst()
    alpha = table.number("alpha", 0.9, "a number from 0 to below 1")
    if not 0 <= alpha < 1:
        raise ValueError(f"{table.at('alpha')} = {alpha:g}: it must be at least 0 and below 1.")
    return CVaR(alpha)


def settings(tune: Tune) -> dict[str, Any]:
    """Return [tune] as plain data, for the report and the fingerprint of a checkpoint."""
    facts = {
        "gains": tune.space.paths,
        "bounds": {gain.path: [gain.low, gain.high] for gain in tune.space.gains},
        "weights": dict(zip(TERMS, tune.weights, strict=True)) | {"conditions": tune.conditions},
        "limits": {limit.name: {"asked": limit.asked, "margin": limit.margin} for limit in tune.limits.each},
        "survival": tune.limits.survival,
        "settling_band_m": tune.limits.band,
        "risk": str(tune.risk),
    }
    rest = {
        name: getattr(tune, name) for name in ("margin", "early", "stress", "gain_margin", "optimiser", "learning_rate")
    }
    return facts | rest | dataclasses.asdict(tune.budget)


def seeds(budget: Budget) -> tuple[int, int, int]:
    """Return the seeds of the training, the validation and the held-out ensemble."""
    return budget.seed, int(np.uint32(budget.seed + 2_000_003)), int(np.uint32(budget.seed + 1_000_001))
