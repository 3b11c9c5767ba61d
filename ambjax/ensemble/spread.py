"""Spreads: which numbers of a case vary between the members of an ensemble, and their distributions.

Every distribution has bounds. If they exceed the allowed range of the number, a ValueError is raised. The distribution
is not truncated to the allowed range. Examples of refused spreads: those that allow a negative mass, a pulse that ends
before it starts, or a rotor that starts outside its clearance.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.design import DESIGNS, design_points
from ambjax.ensemble.distributions import Choice, Distribution, Percent
from ambjax.ensemble.paths import Place, order_pairs, places, with_values
from ambjax.host.sealed import Arrays
from ambjax.numerics.declared import numbers, within
from ambjax.text.words import hint_of_path
from ambjax.world.scenario import POLE, Scenario

# Prefixes of the paths whose values affect the choice of the integration step. Disturbances are among them because
# steps end at their jumps. Sensors and the other numbers of amplifiers are solved exactly, without integration steps.
STEP_PATHS = ("plant.", "controller.", "actuator.bandwidth", "run.clearance", "run.stop", "disturbance.", "rotor.")


@dataclasses.dataclass(frozen=True)
class Spread:
    """The numbers that vary between members, and the design of experiments.

    - `entries`: pairs of dotted path and distribution, one for each number that varies.
    - `design`: "random" (independent members), "latin-hypercube" (each number stratified over all members), or "sobol"
      (low discrepancy in all numbers together; best if the number of members is a power of 2).
    """

    entries: tuple[tuple[str, Distribution], ...] = ()
    design: str = "random"

    @property
    def paths(self) -> tuple[str, ...]:
        return tuple(path for path, _ in self.entries)


def draw(spread: Spread, cascade: Cascade, scenario: Scenario, seed: int, members: np.ndarray, total: int) -> Arrays:
    """Draw the values of `members` (integers [n]) of an ensemble of `total` members.

    Returns the values by dotted path, float64 [n]. The values of member k depend only on (seed, k), and for a Latin
    hypercube on the total. Raises ValueError as `check_spread` does.
    """
    return drawn(spread, check_spread(spread, cascade, scenario), seed, members, total)


def drawn(spread: Spread, known: Mapping[str, Place], seed: int, members: np.ndarray, total: int) -> Arrays:
    """Draw the values as `draw` does. `known`: the numbers of a checked spread by dotted path."""
    u = design_points(spread.design, seed, len(spread.entries), members, total)
    return {path: kind.quantile(u[:, n], _nominal(known[path])) for n, (path, kind) in enumerate(spread.entries)}


def apply(cascade: Cascade, scenario: Scenario, values: Mapping[str, object]) -> tuple[Cascade, Scenario]:
    """Return the cascade and scenario with the numbers at these dotted paths replaced.

    Values that are arrays [n] make an ensemble. The paths plant.* change the true plant only; the controller's model
    changes with controller.model.*. Raises ValueError for a path that does not exist.
    """
    known = places(cascade, scenario)
    for path in values:
        require_path(path, known)
    return with_values(cascade, scenario, values)


def corners(spread: Spread, cascade: Cascade, scenario: Scenario) -> tuple[Cascade, Scenario]:
    """Return the cascade and scenario at every combination of the ends of the spreads that affect the step.

    Each such number gets an array axis of length 2. Raises ValueError as `check_spread` does.
    """
    check_spread(spread, cascade, scenario)
    return ends(spread, cascade, scenario, STEP_PATHS)


def ends(spread: Spread, cascade: Cascade, scenario: Scenario, under: tuple[str, ...]) -> tuple[Cascade, Scenario]:
    """Return the cascade and scenario with the two ends of each spread number whose path begins with one of `under`."""
    known = places(cascade, scenario)
    supports = [(p, d.support(_nominal(known[p]))) for p, d in spread.entries if p.startswith(under)]
    shape = [1] * len(supports)
    values = {p: np.reshape(x, [*shape[:n], 2, *shape[n + 1 :]]) for n, (p, x) in enumerate(supports)}
    return with_values(cascade, scenario, values)


def _nominal(place: Place) -> float:
    return math.nan if place.value is None else float(np.asarray(place.value))


class SpreadError(ValueError):
    """A distribution that is not valid for the number at `path`; `reason` says why, and how to fix it."""

    def __init__(self, path: str, kind: Distribution, reason: str) -> None:
        super().__init__(f"spread.{path} = {kind}: {reason}")
        self.path, self.reason = path, reason


def check_spread(spread: Spread, cascade: Cascade, scenario: Scenario) -> dict[str, Place]:
    """Check a spread; return all numbers of this cascade and scenario by path. Raises ValueError if it is not valid."""
    known = places(cascade, scenario)
    check_entries(spread, known)
    _check_together(dict(spread.entries), known, cascade, scenario)
    return known


def check_entries(spread: Spread, known: Mapping[str, Place]) -> None:
    """Raise ValueError if the design is unknown, or if an entry is not valid for its number in `known`."""
    if spread.design not in DESIGNS:
        raise ValueError(f"spread.design = {spread.design!r}: it must be one of {', '.join(map(repr, DESIGNS))}.")
    for path, kind in spread.entries:
        require_path(path, known)
        if spread.paths.count(path) > 1:
            raise ValueError(f"spread.{path} is given {spread.paths.count(path)} times. Keep one of them.")
        _check_one(path, kind, known[path])


def require_path(path: str, known: Iterable[str], value: str = "") -> None:
    """Raise ValueError for a path that is not in `known`; the message lists similar paths."""
    known = list(known)
    if path not in known:
        what = f"spread.{path} = {value}" if value else f"spread.{path}"
        raise ValueError(f"{what}: {no_such_number(path, known)}")


def no_such_number(path: str, known: Iterable[str], where: str = "in this case") -> str:
    """Return the message for a path that is not in `known`; it lists similar paths. `where`: scope of `known`."""
    known = list(known)
    hint = hint_of_path(path, known)
    if path.split(".")[0] == "sensor" and not any(one.startswith("sensor.") for one in known):
        hint = " This case has no sensor noise; add the table [sensor], with std = 0.0 for example."
    if path == "rotor.acceleration" and "rotor.speed" in known:
        hint = " The table rotor.speed gives it; a spread of rotor.speed shifts the whole table."
    stems = [path.rsplit(".", n)[0] for n in range(path.count(".") + 1)]
    near = next((some for stem in stems if (some := [p for p in known if p.startswith(stem + ".")])), known)
    if len(near) > 12:
        near = dict.fromkeys(p.rpartition(".")[0] + ".*" for p in near)
    return f"there is no such number {where}.{hint} There are: {', '.join(near)}."


def _check_one(path: str, kind: Distribution, place: Place) -> None:
    """Raise ValueError for a distribution that is not valid for its number."""

    def refuse(text: str) -> ValueError:
        return SpreadError(path, kind, text)

    try:
        fault = kind.fault()
    except TypeError:  # a text or None
        raise ValueError(f"spread.{path} = {kind!r}: its values must be numbers.") from None
    if fault:
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
        raise refuse(f"it reaches from {low:g} to {high:g}, but {path} must be {limit}. Narrow the range.")
    if place.field.metadata["whole"] and not (
        isinstance(kind, Choice) and within(place.field.metadata, np.array(kind.values))
    ):
        raise refuse(f"{path} must be {numbers(place.field)}. Use choices of such numbers.")


def _check_together(
    kinds: dict[str, Distribution], known: dict[str, Place], cascade: Cascade, scenario: Scenario
) -> None:
    """Check the conditions that involve more than one number.

    They are: start before stop, the clearance below the gap, the rotor inside its clearance, and `_check_coils`.
    """

    def reach(path: str) -> tuple[float, float]:
        nominal = _nominal(known[path])
        return kinds[path].support(nominal) if path in kinds else (nominal, nominal)

    def refuse(paths: tuple[str, ...], text: str) -> None:
        path = next((p for p in paths if p in kinds), None)
        if path is not None:
            raise SpreadError(path, kinds[path], text)

    for low, high in order_pairs(cascade, scenario):
        if not reach(low)[1] < reach(high)[0]:
            move = f", or use {low.rpartition('.')[0]}.shift, which moves both" if low.endswith(".start") else ""
            overlap = f"{low} reaches {reach(low)[1]:g} and {high} can be as small as {reach(high)[0]:g}"
            refuse((low, high), f"{overlap}, but the first must stay below the second. Narrow the range{move}.")
    gap, explicit = "plant.s_0", known["run.clearance"].value is not None or "run.clearance" in kinds
    stops = reach("run.clearance") if explicit else tuple(0.9 * x for x in reach(gap))
    if not stops[1] < reach(gap)[0] and explicit:
        refuse(
            ("run.clearance", gap),
            f"run.clearance reaches {stops[1]:g} m, but must stay below {gap}, {reach(gap)[0]:g} m. Narrow the range.",
        )
    far = max(map(abs, reach("initial.z")))
    what, limit = ("the clearance", stops[0]) if scenario.stop is None else (f"{POLE} of s_0", POLE * reach(gap)[0])
    if not far < limit:
        text = f"|initial.z| reaches {far:g} m, but must stay below {what}, {limit:g} m. Narrow the range."
        refuse(("initial.z", "run.clearance", gap), text)
    if "actuator.coil.i_max" in known:
        _check_coils(reach, refuse)


def _check_coils(reach: Callable[[str], tuple[float, float]], refuse: Callable[[tuple[str, ...], str], None]) -> None:
    """Check that the limits of each coil exceed its bias: i_max > i_0 and u_max > R i_0."""
    i_max, u_max, i_0, R = "actuator.coil.i_max", "actuator.coil.u_max", "plant.i_0", "plant.R"
    least, most = reach(i_max)[0], reach(i_0)[1]
    if least <= most:
        text = f"{i_max} can be as small as {least:g} A, but must stay above {i_0}, which reaches {most:g} A."
        refuse((i_max, i_0), f"{text} Narrow the range.")
    least, most = reach(u_max)[0], reach(R)[1] * reach(i_0)[1]
    if least <= most:
        text = f"{u_max} can be as small as {least:g} V, but must stay above R i_0, which reaches {most:g} V."
        refuse((u_max, R, i_0), f"{text} Narrow the range.")
