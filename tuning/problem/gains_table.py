"""The keys `gains` and `bounds` of [tune]: the gains to tune, and the bounds of each."""

import math
from typing import Any

import numpy as np

from ambjax.cases.reader import Case
from ambjax.cases.table import Table, show
from ambjax.control.cascade import Cascade
from ambjax.ensemble.spread import no_such_number
from ambjax.extend import GAINS
from ambjax.host.extensions import NothingToTuneError
from tuning.problem.space import CLOSEST, Gain, Space, knots, read, tunable


def space_from(table: Table, case: Case) -> Space:
    """Return the search space of a case from its table [tune].

    Raises NothingToTuneError if there are no gains, and ValueError for an unknown gain, an invalid bound, a bound of a
    gain that is not tuned, and a gain that is in [spread] too.
    """
    known = tunable(case.cascade)
    if not known:
        raise NothingToTuneError("the laws of this case have no gains to tune.")
    default = _default_gains(case) or known
    paths = table.raw.get("gains", default)
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise ValueError(f'{table.at("gains")} = {show(paths)}: give a list of paths, as in ["controller.position.c"].')
    bounds = flattened(table.table("bounds").raw)
    stems = dict.fromkeys(path.rpartition(".")[0] for path in known if path.count(".") > 2)
    whole = {stem: knots(case.cascade, stem) for stem in stems}  # the path of a scheduled gain stands for all its knots
    paths = [one for path in paths for one in whole.get(path, [path])]
    bounds = {one: ends for path, ends in bounds.items() for one in whole.get(path, [path])}
    for path in [*paths, *bounds]:
        if path not in known:
            key = "gains" if path in paths else "bounds"
            raise ValueError(f"{table.at(key)}: '{path}': {no_such_number(path, known, 'to tune in this case')}")
    for path in bounds:
        if path not in paths:
            raise ValueError(f"{table.at('bounds')}: {path} is not in tune.gains. Add it there or leave it out here.")
    for path in paths:
        if path in off(case.cascade):
            raise ValueError(
                f"{table.at('gains')}: {path} = 0 in this case, which switches its term off, and the search, in "
                f"logarithms, cannot begin there. Give {path} a positive value, or leave it out of tune.gains."
            )
    clash = [path for path in paths if path in case.spread.paths]
    if clash:
        raise ValueError(f"spread.{clash[0]} is in tune.gains too. Remove it from one of them.")
    return Space(tuple(Gain(path, *bound_of(bounds.get(path), path, table)) for path in paths))


def _default_gains(case: Case) -> list[str]:
    """Return the default of tune.gains: all gains, but without the steepnesses in continuous time.

    In continuous time, a steeper sign makes the equations stiffer, so a steepness is tuned only if tune.gains names it.
    Gains that switch a term off, 0 or p = inf, are left out.
    """
    cascade = case.cascade
    return [path for path in tunable(cascade, steepness=cascade.sampled) if not _off(cascade, path)]


def off(cascade: Cascade) -> list[str]:
    """Return the paths of the gains that are 0. The search, in logarithms, cannot begin at them."""
    return [path for path in tunable(cascade) if np.any(np.asarray(read(cascade, path)) == 0)]


def _off(cascade: Cascade, path: str) -> bool:
    value = np.asarray(read(cascade, path), float)
    return bool(np.any(value == 0) or np.isinf(np.max(value)))


def flattened(raw: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested tables to dotted keys. TOML reads controller.position.c = [1, 2] as nested tables."""
    flat: dict[str, Any] = {}
    for key, value in raw.items():
        flat |= flattened(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def bound_of(raw: Any, path: str, table: Table) -> tuple[float, float]:
    """Return the bounds of a gain from its value in tune.bounds; none if `raw` is None."""
    if raw is None:
        return 0.0, math.inf
    pair = isinstance(raw, list) and len(raw) == 2 and all(type(x) in (int, float) for x in raw)
    ends = pair and 0 <= raw[0] <= GAINS[1] and (raw[1] <= GAINS[1] or raw[1] == math.inf)
    if not ends or not (1 + CLOSEST) * raw[0] < raw[1]:
        words = f"give [low, high] with 0 <= low < high <= {GAINS[1]:g} and high above {1 + CLOSEST:.7g} times low"
        raise ValueError(f"{table.at('bounds')}.{path} = {show(raw)}: {words}; inf means no upper bound.")
    return float(raw[0]), float(raw[1])
