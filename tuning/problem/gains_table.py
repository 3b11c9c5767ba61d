"""The keys `gains` and `bounds` of [tune]: the gains to tune, and the bounds of each."""

import math
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from ambjax.cases.reader import Case
from ambjax.cases.table import Table, show
from ambjax.control.cascade import Cascade
from ambjax.ensemble.spread import no_such_number
from ambjax.extend import GAINS
from ambjax.host.extensions import NothingToTuneError
from ambjax.host.sealed import flat
from tuning.problem.space import CLOSEST, Gain, Space, knots, read, tunable


def space_from(table: Table, case: Case) -> Space:
    """Return the search space of a case from its table [tune].

    By default, all gains are tuned, but without those that switch a term off, 0 or p = inf, and without the
    steepnesses in continuous time: a steeper sign makes the equations stiffer. Raises NothingToTuneError if there are
    no gains, and ValueError as `chosen` does and for a gain that is in [spread] too.
    """
    cascade = case.cascade
    known = tunable(cascade)
    if not known:
        raise NothingToTuneError("the laws of this case have no gains to tune.")
    default = _usable(cascade, steepness=cascade.sampled) or known
    stems = dict.fromkeys(path.rpartition(".")[0] for path in known if path.count(".") > 2)
    whole = {stem: knots(cascade, stem) for stem in stems}
    space = chosen(table, dict.fromkeys(known, (0.0, math.inf)), default, off(cascade), "case", whole)
    if clash := [path for path in space.paths if path in case.spread.paths]:
        raise ValueError(f"spread.{clash[0]} is in tune.gains too. Remove it from one of them.")
    return space


def chosen(
    table: Table,
    known: Mapping[str, tuple[float, float]],
    default: list[str],
    unusable: Collection[str],
    where: str,
    whole: Mapping[str, list[str]] = MappingProxyType({}),
) -> Space:
    """Return the search space of the table [tune]. `known`: bounds by path. `default`: the paths if it names none.

    `unusable`: paths at which a search cannot begin. `where`: "case" or "machine". `whole`: paths of scheduled gains,
    each of which stands for all its knots. Raises ValueError for an unknown or unusable path, and for an invalid bound.
    """
    paths = table.raw.get("gains", default)
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise ValueError(f'{table.at("gains")} = {show(paths)}: give a list of paths, as in ["controller.position.c"].')
    bounds = flat(table.table("bounds").raw)
    paths = [one for path in paths for one in whole.get(path, [path])]
    bounds = {one: ends for path, ends in bounds.items() for one in whole.get(path, [path])}
    for path in [*paths, *bounds]:
        if path not in known:
            key = "gains" if path in paths else "bounds"
            raise ValueError(f"{table.at(key)}: '{path}': {no_such_number(path, known, f'to tune in this {where}')}")
    if path := next((path for path in bounds if path not in paths), None):
        raise ValueError(f"{table.at('bounds')}: {path} is not in tune.gains. Add it there or leave it out here.")
    if path := next((path for path in paths if path in unusable), None):
        raise ValueError(
            f"{table.at('gains')}: {path} is 0 or inf in this {where}, and the search, in logarithms, cannot begin "
            f"there. Give {path} a finite value above 0, or leave it out of tune.gains."
        )
    ends = {path: bound_of(bounds[path], path, table) if path in bounds else known[path] for path in paths}
    return Space(tuple(Gain(path, *ends[path]) for path in paths))


def off(cascade: Cascade) -> list[str]:
    """Return the paths of the gains that are 0. The search, in logarithms, cannot begin at them."""
    return [path for path in tunable(cascade) if np.any(np.asarray(read(cascade, path)) == 0)]


def left_out(space: Space, cascade: Cascade) -> list[str]:
    """Return the paths of the gains that a search could tune, but that are not in the space."""
    return [path for path in _usable(cascade) if path not in space.paths]


def _usable(cascade: Cascade, steepness: bool = True) -> list[str]:
    """Return the paths of the gains that are neither 0 nor infinite. `steepness`: as for `tunable`."""
    found, idle = tunable(cascade, steepness=steepness), off(cascade)
    return [path for path in found if path not in idle and np.all(np.isfinite(read(cascade, path)))]


def bound_of(raw: Any, path: str, table: Table) -> tuple[float, float]:
    """Return the bounds of a gain from its value in tune.bounds."""
    pair = isinstance(raw, list) and len(raw) == 2 and all(type(x) in (int, float) for x in raw)
    ends = pair and 0 <= raw[0] <= GAINS[1] and (raw[1] <= GAINS[1] or raw[1] == math.inf)
    if not ends or not (1 + CLOSEST) * raw[0] < raw[1]:
        words = f"give [low, high] with 0 <= low < high <= {GAINS[1]:g} and high above {1 + CLOSEST:.7g} times low"
        raise ValueError(f"{table.at('bounds')}.{path} = {show(raw)}: {words}; inf means no upper bound.")
    return float(raw[0]), float(raw[1])
