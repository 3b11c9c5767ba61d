"""The table [spread] of a case file: a distribution for each dotted path."""

from collections.abc import Callable
from typing import Any

from ambjax.cases.table import Table, quoted, show
from ambjax.control.cascade import Cascade
from ambjax.ensemble.design import DESIGNS
from ambjax.ensemble.distributions import SHAPES, Choice, Distribution, LogUniform, Normal, Percent, Uniform
from ambjax.ensemble.paths import places
from ambjax.ensemble.spread import Spread, check_spread, require_path
from ambjax.world.scenario import Scenario

LIST = "a list of numbers, as in [1.0, 2.0]"


def _pair(table: Table, key: str) -> list[float]:
    values = table.column(key, LIST)
    if len(values) != 2:
        raise table.refuse(key, "it must be [low, high], two numbers.")
    return values


# Constructors of the distributions, by the key in the case file: `percent` in plant.m = { percent = 10 }. A new
# distribution needs one row here.
DISTRIBUTIONS: dict[str, Callable[[Table], Distribution]] = {
    "percent": lambda t: Percent(t.number("percent", None), t.choice("shape", list(SHAPES), SHAPES[0])),
    "normal": lambda t: Normal(t.number("normal", None)),
    "uniform": lambda t: Uniform(*_pair(t, "uniform")),
    "log-uniform": lambda t: LogUniform(*_pair(t, "log-uniform")),
    "choices": lambda t: Choice(tuple(t.column("choices", LIST))),
}


def spread_from(top: Table, cascade: Cascade, scenario: Scenario) -> Spread:
    """Return the spread of a case with this cascade and scenario; empty if the table [spread] is left out."""
    table = top.table("spread")
    design = table.choice("design", list(DESIGNS), Spread.design)
    known = list(places(cascade, scenario))
    entries = entries_of({key: value for key, value in table.raw.items() if key != "design"}, "", known)
    spread = Spread(tuple(entries), design)
    _refuse_nothing_in_two_units(spread, top)
    check_spread(spread, cascade, scenario)
    return spread


def is_distribution(value: object) -> bool:
    """Return whether a value of [spread] is a distribution, and not a table of further paths."""
    return not isinstance(value, dict) or not value or bool(set(value) & {*DISTRIBUTIONS, "shape"})


def entries_of(raw: dict[str, Any], prefix: str, known: list[str]) -> list[tuple[str, Distribution]]:
    """Return the paths and distributions of a nested table. `prefix`: its path. `known`: all paths that there are."""
    entries = []
    for key, value in raw.items():
        path = prefix + key
        if path in known:
            entries.append((path, _distribution(value, path)))
        elif not is_distribution(value):
            entries += entries_of(value, path + ".", known)
        else:
            require_path(path, known, show(value))
    return entries


def _distribution(raw: object, path: str) -> Distribution:
    where = f"spread.{path}"
    if not isinstance(raw, dict):
        raise ValueError(f"{where} = {show(raw)}: it must be a distribution, as in {path} = {{ percent = 10 }}.")
    table = Table(raw, where)
    kinds = [kind for kind in DISTRIBUTIONS if kind in raw]
    table.only(["percent", "shape"] if kinds == ["percent"] else kinds or list(DISTRIBUTIONS))
    if len(kinds) != 1:
        raise ValueError(f"{where} = {show(raw)}: give exactly one of {quoted(list(DISTRIBUTIONS))}.")
    return DISTRIBUTIONS[kinds[0]](table)


def _refuse_nothing_in_two_units(spread: Spread, top: Table) -> None:
    """Raise ValueError if the value of a constant q_z is spread, is 0, and has another unit than m/s^2.

    A constant 0 counts as no disturbance, so its unit is ignored, and the spread values would be taken in m/s^2.
    """
    path = "disturbance.q_z.value"
    signal = top.raw.get("disturbance", {}).get("q_z", {})
    unit = signal.get("unit", "m/s^2") if isinstance(signal, dict) else "m/s^2"
    if path in spread.paths and unit != "m/s^2" and signal.get("value", 0) == 0:
        raise ValueError(f'spread.{path}: a value of 0 with unit = "{unit}" cannot be spread. Use unit = "m/s^2".')
