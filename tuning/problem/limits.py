"""Limits on quantities of an ensemble, and their terms in the goal.

A search minimises the error subject to the limits by an augmented Lagrangian (Nocedal and Wright, Numerical
Optimization, 2006, 17.3). With g = log(reached / allowed), or log(allowed / reached) for a lower limit, a limit adds

    (max(0, multiplier + penalty g)^2 - multiplier^2) / (2 penalty)

to the goal, which is a logarithm. At the optimum, a limit that is 1 % looser lowers the objective, exp(goal), by
`multiplier` %.

Some limits cannot be broken (`bounds_of`): no held member can exceed them, whatever its gains.
"""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.cases.reach import reach
from ambjax.cases.reader import Case
from ambjax.ensemble.spread import ends
from ambjax.extend import Scalar, record, static
from ambjax.simulation.folds import Fold
from ambjax.world.scenario import Scenario
from tuning.problem.quantities import KINDS, LOOPS, NEGLIGIBLE, NORM, TINY, Kind, LimitContext

# Penalty; at a multiplier of 0, an excess of 10 % adds 0.14 to the goal.
PENALTY = 30.0
# Largest extrapolation of a multiplier, in updates. Beyond it g fell by less than a sixth, so the search has probably
# ended before its minimum: three updates without the line led to 2.1e-07 m on bearing 25 of benchmarks/fleet.py, and
# extrapolations of five updates to 1.1e-06 m.
MOST_STEPS = 5.0
# Prefix that marks a limited quantity among the terms of a loss.
PREFIX = "limit."
# Value of `Limit.source` for the limit on the rms error that traces the front of error against voltage.
FRONT = "the front"
# The same for a limit on the rms voltage that the search sets itself.
SATURATION = "saturated injections"
# Prefixes of the paths on which the bounds of quantities depend.
PATHS = ("actuator.u_max", "actuator.coil.u_max", "reference.", "plant.s_0", "run.clearance")


@record
class LimitTerm:
    """Term of a limit in the goal. Its numbers are leaves: a change of them does not recompile the search.

    `name`: key of the quantity in KINDS. `log_allowed`: logarithm of `Limit.allowed`. `multiplier`, `ratio`: as in
    `Limit`.
    """

    name: str = static()
    log_allowed: Scalar
    multiplier: Scalar
    ratio: Scalar

    def excess(self, values: Array) -> Array:
        """Return g = log(reached / allowed), or log(allowed / reached) for a lower limit.

        `values` [N]: the quantity of each member in the search. Their reduction over members is multiplied by `ratio`.
        """
        kind = KINDS[self.name]
        excess = jnp.log(jnp.maximum(self.ratio * kind.tuned(values), TINY)) - self.log_allowed
        return -excess if kind.at_least else excess

    def __call__(self, values: Array) -> Array:
        """Return the term in the goal for the members' values [N] in the search."""
        multiplier = jnp.maximum(self.multiplier + PENALTY * self.excess(values), 0.0)
        return (multiplier**2 - self.multiplier**2) / (2 * PENALTY)


@dataclasses.dataclass(frozen=True)
class Limit:
    """A limit, and the state of its augmented Lagrangian.

    `name`: key of the quantity in KINDS. `threshold`: the limit, in the unit of the quantity. `source`: origin of the
    limit (case file, default, FRONT or SATURATION), for the report. `margin`: relative distance that the search keeps
    from the limit, on the allowed side. `multiplier`: of the augmented Lagrangian. `ratio`: the judge's value divided
    by the search's value. `history`: (judge's value, multiplier) of every update.
    """

    name: str
    threshold: float
    source: str = "tune.limits"
    margin: float = 0.0
    multiplier: float = 0.0
    ratio: float = 1.0
    history: tuple[tuple[float, float], ...] = ()

    @property
    def asked(self) -> bool:
        """Whether the limit is a requirement of [tune.limits], and not a means of the search."""
        return self.source not in (FRONT, SATURATION)

    @property
    def kind(self) -> Kind:
        """The limited quantity."""
        return KINDS[self.name]

    @property
    def allowed(self) -> float:
        """Bound that the search uses: the limit minus its margin; a lower limit plus its margin."""
        return (1 + self.margin if self.kind.at_least else 1 - self.margin) * self.threshold

    def holds(self, reached: float) -> bool:
        """Return whether the value `reached` is within the limit, without a margin."""
        return reached >= self.threshold if self.kind.at_least else reached <= self.threshold

    def other_bound(self, reached: float, members: int) -> float:
        """Return the other bound of the worst member's value, of which `reached` (of the search) is one.

        The 16-norm of N members is between the largest value and N^(1/16) times it. A `ratio` makes it exact.
        """
        if not self.kind.worst or self.ratio != 1.0:
            return reached
        most = min(members, LOOPS) if self.kind.fold is None else members
        return reached * most ** ((1 if self.kind.at_least else -1) / NORM)

    def has_reserve(self, reached: float) -> bool:
        """Return whether the value `reached` is within the limit by at least half of the margin."""
        return self.log_excess(reached) <= self.margin / 2

    @property
    def term(self) -> LimitTerm:
        """The limit's term in the goal."""
        return LimitTerm(self.name, math.log(self.allowed), self.multiplier, self.ratio)

    def log_excess(self, reached: Any) -> Any:
        """Return g = log(reached / allowed), or log(allowed / reached) for a lower limit, of a number or an array."""
        excess = np.log(np.maximum(reached, TINY) / self.allowed)
        return -excess if self.kind.at_least else excess

    def active(self, reached: float | None) -> bool:
        """Return whether the limit is active: its multiplier is above 0, and `reached` (judged) is near the limit.

        It is near if g is at least -(NEGLIGIBLE + margin). `reached`: None if no judged member is held; then only
        the multiplier decides.
        """
        near = reached is None or self.log_excess(reached) >= -(NEGLIGIBLE + self.margin)
        return self.multiplier > 0 and near

    def updated(self, tuned: float, judged: float) -> "Limit":
        """Return the limit after an update of its multiplier at an optimum of the goal.

        `tuned`, `judged`: values of the search and of the judge at the optimum. `judged` is infinite if an injection
        loses the rotor; it is then replaced by 10 times the larger of `tuned` and the limit.
        """
        judged = judged if math.isfinite(judged) else 10 * max(tuned, self.threshold)
        multiplier = max(self.multiplier + PENALTY * float(self.log_excess(self.ratio * tuned)), 0.0)
        ratio = max(judged, TINY) / max(tuned, TINY)
        history = (*self.history, (max(judged, TINY), multiplier))
        return dataclasses.replace(self, multiplier=_extrapolated(self, history), ratio=ratio, history=history)

    def error_reduction(self, more: float) -> float:
        """Return the relative decrease of the minimised rms value if the limit is looser by the share `more`.

        The decrease is 1 - exp(-I/2), where I is the integral of the multiplier over the logarithm of the limit. The
        optimum of an earlier update that exceeds the limit is the optimum of a looser limit. The multiplier is
        interpolated linearly between the optima of all updates, and is constant beyond them.
        """
        if not self.multiplier:
            return 0.0
        side = -1.0 if self.kind.at_least else 1.0
        logs, multipliers = np.array(sorted((side * math.log(reached), one) for reached, one in self.history)).T
        begin = side * math.log(self.history[-1][0])
        ends = np.array([begin, begin + math.log1p(more)])
        at = np.sort([*ends, *logs[(logs > ends[0]) & (logs < ends[1])]])
        return -math.expm1(-float(np.trapezoid(np.interp(at, logs, multipliers), at)) / 2)

    def reached(self, columns: Mapping[str, np.ndarray]) -> float:
        """Return the judge's value over an ensemble. `columns`: its metrics and terms by name, each [N]."""
        return float(self.kind.judged(self.of_members(columns)))

    def worst(self, columns: Mapping[str, np.ndarray]) -> float:
        """Return the value of the worst member of an ensemble. `columns`: as for `reached`."""
        return float((np.min if self.kind.at_least else np.max)(self.of_members(columns)))

    def of_members(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the quantity of each member that is held, or of all members if none is held.

        Lost rotors are excluded, because their voltage is 0 afterwards, which would lower a mean. The limit `survival`
        counts them.
        """
        alive, values = ~np.isfinite(columns["lost_at_s"]), self.values(columns)
        return values[alive] if alive.any() else values

    def values(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the quantity of every member [N] of an ensemble."""
        return np.asarray(columns[self.kind.exact or f"loss.{PREFIX}{self.name}"])


def _extrapolated(limit: Limit, history: Sequence[tuple[float, float]]) -> float:
    """Return the next multiplier: the last one of `history`, or that at g = 0 on the line through the last two.

    The multiplier that minimises at g is the slope of the objective there. Without the line, g falls by a fixed factor
    in each update, which may be close to 1. A line that leads farther than MOST_STEPS updates is not followed.
    """
    (*_, (before, first)), (reached, last) = ((math.nan, math.nan), *history[:-1]), history[-1]
    g_before, g = float(limit.log_excess(before)), float(limit.log_excess(reached))
    if not (0 < g < g_before and 0 < last - first <= MOST_STEPS * PENALTY * (g_before - g)):
        return last
    return last + g * (last - first) / (g_before - g)


def measures(names: Collection[str], limits: tuple[Limit, ...], context: LimitContext) -> dict[str, Fold]:
    """Return the folds that measure the quantities `names` in a rollout, by name.

    A quantity of the linearised loop has no fold. `limits`: the limits on some of the quantities; their thresholds
    scale the folds. `context`: numbers of the case on which the folds depend.
    """
    thresholds = {limit.name: limit.threshold for limit in limits}
    folds = {name: KINDS[name].fold for name in names}
    return {name: fold(context, thresholds.get(name, 1.0)) for name, fold in folds.items() if fold is not None}


class Ceiling(NamedTuple):
    """Number that a limited quantity of a held member cannot exceed (in the unit of the quantity), and the reason."""

    most: float
    why: str


def bounds_of(case: Case) -> dict[str, Ceiling]:
    """Return the bounds of the quantities that have one, by the name of the limit.

    A current has none: the supply may be too weak to keep it within `actuator.i_max`.
    """
    scenario = ends(case.spread, case.cascade, case.scenario, PATHS)[1]
    volts, key = _voltage(scenario)
    near, far = float(np.max(scenario.limit)), reach(scenario, case.clock)
    voltage = Ceiling(volts, f"|u| is at most {volts:g} V ({key})")
    error = Ceiling(near + far, f"|z| of a held rotor is below {near:g} m, and |r| is at most {far:g} m")
    found = {"max_u_V": voltage, "rms_u_V": voltage}
    found["chatter_V_per_s"] = Ceiling(2 * volts / float(case.clock.sample_period), f"{voltage.why} in each sample")
    found |= dict.fromkeys(("rms_error_m", "largest_error_m", "overshoot_m"), error)
    # with an elastic stop, |z| may exceed the clearance
    used = near / float(np.max(case.scenario.touchdown))
    return found | {"clearance_used": Ceiling(used, "a rotor that reaches the clearance is lost")}


def _voltage(scenario: Scenario) -> tuple[float, str]:
    """Return the largest |u| (V) that the drive can apply, inf if it has no limit, and the key that sets it."""
    supply, coil = float(np.max(scenario.u_max)), scenario.actuator.coil
    if coil is None:
        return supply, "actuator.u_max"
    each = math.inf if coil.u_max is None else float(np.max(coil.u_max))
    # to hold the current of a coil, its amplifier may apply more than the commanded voltage
    if each < supply or coil.i_max is not None or coil.unidirectional:
        return each, "actuator.coil.u_max"
    return supply, "actuator.u_max"
