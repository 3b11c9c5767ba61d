"""Spreads: which numbers of a case vary from member to member of an ensemble, and how.

Every spread has bounds, and one whose bounds leave what its number allows (a negative mass, a pulse that ends before it
starts, a rotor beyond its stops) is refused, never bent.
"""

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.design import DESIGNS, points
from ambjax.ensemble.distributions import Choice, Distribution, Percent
from ambjax.ensemble.paths import Place, order_pairs, places, with_values
from ambjax.numerics.records import numbers, within
from ambjax.world.scenario import Scenario

# How the paths begin on whose values a step depends: a disturbance has edges at which steps end. Whatever else an
# amplifier or a sensor does is solved exactly.
STEP = ("plant.", "controller.", "actuator.bandwidth", "run.clearance", "disturbance.")


@dataclasses.dataclass(frozen=True)
class Spread:
    """(dotted path, distribution) for each number that varies, and the design by which members are drawn.

    `design`: "random" (independent members), "latin-hypercube" (each number stratified over all members) or "sobol"
    (all numbers together evenly spread; best at a power of 2 of members).
    """

    entries: tuple[tuple[str, Distribution], ...] = ()
    design: str = "random"

    @property
    def paths(self) -> tuple[str, ...]:
        """The dotted paths in order."""
        return tuple(path for path, _ in self.entries)


def draw(
    spread: Spread, cascade: Cascade, scenario: Scenario, seed: int, members: np.ndarray, total: int
) -> dict[str, np.ndarray]:
    """Values by path, float64 [n], of the members (integers [n]) of an ensemble of `total`.

    Member k's values depend on (seed, k) only, for a Latin hypercube also on the total. Raises as `check_spread` does.
    """
    known = check_spread(spread, cascade, scenario)
    u = points(spread.design, seed, len(spread.entries), members, total)
    return {path: kind.quantile(u[:, n], _nominal(known[path])) for n, (path, kind) in enumerate(spread.entries)}


def apply(cascade: Cascade, scenario: Scenario, values: Mapping[str, Any]) -> tuple[Cascade, Scenario]:
    """The cascade and scenario with the numbers at these paths replaced: by arrays [n], an ensemble.

    plant.* moves the true plant alone: the controller keeps believing in its own unless controller.model.* moves too.
    Raises ValueError for a path that does not exist.
    """
    known = places(cascade, scenario)
    for path in values:
        require_path(path, known)
    return with_values(cascade, scenario, values)


def corners(spread: Spread, cascade: Cascade, scenario: Scenario) -> tuple[Cascade, Scenario]:
    """Every combination of the ends of the spreads on which a step depends, each on an axis of its own.

    What is read off an ensemble by its largest slope, the integrator, then holds for every member.
    """
    check_spread(spread, cascade, scenario)
    return ends(spread, cascade, scenario, STEP)


def ends(spread: Spread, cascade: Cascade, scenario: Scenario, under: tuple[str, ...]) -> tuple[Cascade, Scenario]:
    """The numbers whose paths begin so replaced by both ends of their spreads, each on an axis of its own."""
    known = places(cascade, scenario)
    supports = [(p, d.support(_nominal(known[p]))) for p, d in spread.entries if p.startswith(under)]
    shape = [1] * len(supports)
    values = {p: np.reshape(x, [*shape[:n], 2, *shape[n + 1 :]]) for n, (p, x) in enumerate(supports)}
    return with_values(cascade, scenario, values)


def _nominal(place: Place) -> float:
    return math.nan if place.value is None else float(np.asarray(place.value))


def check_spread(spread: Spread, cascade: Cascade, scenario: Scenario) -> dict[str, Place]:
    """Raise ValueError, one line with path, value, what is allowed and the fix, for a spread that makes no sense here.

    Returns the places of all paths.
    """
    if spread.design not in DESIGNS:
        raise ValueError(f"spread.design = {spread.design!r}: it must be one of {', '.join(map(repr, DESIGNS))}.")
    known = places(cascade, scenario)
    for path, kind in spread.entries:
        require_path(path, known)
        if spread.paths.count(path) > 1:
            raise ValueError(f"spread.{path} is given {spread.paths.count(path)} times. Keep one of them.")
        _check_one(path, kind, known[path])
    _check_together(dict(spread.entries), known, cascade, scenario)
    return known


def require_path(path: str, known: Iterable[str], value: str = "") -> None:
    """Raise ValueError for a path that is not among the known ones, naming those that are near it.

    `value` is what it was to be, for the message.
    """
    known = list(known)
    if path in known:
        return
    close = difflib.get_close_matches(path, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    if path.split(".")[0] == "sensor":
        hint = " This case has no sensor noise; add the table [sensor], with std = 0.0 for example."
    stems = [path.rsplit(".", n)[0] for n in range(path.count(".") + 1)]
    near = next((some for stem in stems if (some := [p for p in known if p.startswith(stem + ".")])), known)
    if len(near) > 12:
        near = dict.fromkeys(p.rpartition(".")[0] + ".*" for p in near)
    what = f"spread.{path} = {value}" if value else f"spread.{path}"
    raise ValueError(f"{what}: there is no such number in this case.{hint} There are: {', '.join(near)}.")


def _check_one(path: str, kind: Distribution, place: Place) -> None:
    def refuse(text: str) -> ValueError:
        return ValueError(f"spread.{path} = {kind}: {text}")

    if fault := kind.fault():
        raise refuse(f"{fault}.")
    if np.size(place.value) != 1:
        raise refuse(f"{path} is an array of {np.size(place.value)} already. Spread a single number.")
    nominal = _nominal(place)
    if kind.relative and not math.isfinite(nominal):
        raise refuse(f"{path} has no finite value in this case to spread around. Give it one, or use uniform.")
    if isinstance(kind, Percent) and nominal == 0:
        raise refuse(f"{path} is 0 in this case, and a percentage of 0 is 0. Use normal or uniform.")
    low, high = kind.support(nominal)
    if not within(place.field.metadata | {"whole": False}, np.array([low, high])):
        limit = numbers(place.field)
        raise refuse(f"it reaches from {low:g} to {high:g}, but {path} must be {limit}. Narrow the spread.")
    if place.field.metadata["whole"] and not (
        isinstance(kind, Choice) and within(place.field.metadata, np.array(kind.values))
    ):
        raise refuse(f"{path} must be {numbers(place.field)}. Use choices of such numbers.")


def _check_together(
    kinds: dict[str, Distribution], known: dict[str, Place], cascade: Cascade, scenario: Scenario
) -> None:
    """What two numbers ask of each other: the order of start and stop, the rotor's place within its stops."""

    def reach(path: str) -> tuple[float, float]:
        nominal = _nominal(known[path])
        return kinds[path].support(nominal) if path in kinds else (nominal, nominal)

    def refuse(paths: tuple[str, ...], text: str) -> None:
        path = next((p for p in paths if p in kinds), None)
        if path is not None:
            raise ValueError(f"spread.{path} = {kinds[path]}: {text}")

    for low, high in order_pairs(cascade, scenario):
        if not reach(low)[1] < reach(high)[0]:
            move = f", or use {low.rpartition('.')[0]}.shift, which moves both" if low.endswith(".start") else ""
            overlap = f"{low} reaches {reach(low)[1]:g} and {high} comes down to {reach(high)[0]:g}"
            refuse((low, high), f"{overlap}, but the first must stay below the second. Narrow the spread{move}.")
    gap, own = "plant.s_0", known["run.clearance"].value is not None or "run.clearance" in kinds
    stops = reach("run.clearance") if own else tuple(0.9 * x for x in reach(gap))
    if not stops[1] < reach(gap)[0] and own:
        refuse(
            ("run.clearance", gap), f"run.clearance reaches {stops[1]:g} m, but must stay below plant.s_0. Narrow it."
        )
    far = max(map(abs, reach("initial.z")))
    if not far < stops[0]:
        text = f"|initial.z| reaches {far:g} m, but must stay below the clearance, {stops[0]:g} m. Narrow the spread."
        refuse(("initial.z", "run.clearance", gap), text)
