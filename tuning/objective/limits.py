"""Limits on quantities of an ensemble, and their terms of the goal.

A search minimises the error subject to the limits by an augmented Lagrangian (Nocedal and Wright, Numerical
Optimization, 2006, 17.3). With g = log(reached / allowed), a limit adds (max(0, multiplier + penalty g)^2 -
multiplier^2) / (2 penalty) to the goal, which is a logarithm. At the optimum the multiplier is minus the elasticity of
the minimised quantity: a limit 1 % higher lowers it by `multiplier` %.
"""

import dataclasses
import math
from collections.abc import Collection, Mapping

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.extend import Scalar, record, static
from ambjax.simulation.folds import Fold
from tuning.objective.quantities import KINDS, TINY, Kind, LimitContext

# Initial penalty: at a multiplier of 0, an excess of 10 % adds 0.14 to the goal. Factor by which the penalty grows when
# an update leaves more than the share SUFFICIENT_DECREASE of the excess (Nocedal and Wright, ch. 17); largest penalty.
PENALTY, PENALTY_GROWTH, SUFFICIENT_DECREASE, MOST_PENALTY = 30.0, 4.0, 0.3, 2000.0
# Prefix of the names of limited quantities among the terms of a loss.
PREFIX = "limit."
# A limit with a multiplier above 0 is met from this share below the allowed value to half of the margin above it.
TOLERANCE_BELOW = 0.01
# Smallest margin. A search meets a limit to half of its margin only, so a smaller margin would not keep it held.
LEAST_MARGIN = 0.002
# Source of the limit on the rms error with which the front of error against voltage is traced.
FRONT = "the front"
# Factor by which a quantity that is judged infinite exceeds its limit, or the search's value, in the search.
LOST_FACTOR = 10.0
# Intervals of the integral in `Limit.error_reduction`.
PRICE_INTERVALS = 200


@record
class LimitTerm:
    """Term of a limit in the goal. Its numbers are leaves: other numbers do not recompile a search.

    `name`: of the quantity in KINDS. `log_allowed`: logarithm of the bound. `multiplier`, `penalty`, `ratio`: as
    in `Limit`.
    """

    name: str = static()
    log_allowed: Scalar
    multiplier: Scalar
    penalty: Scalar
    ratio: Scalar

    def excess(self, values: Array) -> Array:
        """Return g = log(reached / allowed) for the search's values [N], corrected by `ratio`; -g of a lower limit."""
        kind = KINDS[self.name]
        excess = jnp.log(jnp.maximum(self.ratio * kind.tuned(values), TINY)) - self.log_allowed
        return -excess if kind.at_least else excess

    def __call__(self, values: Array) -> Array:
        """Return the term for the search's values [N]."""
        force = jnp.maximum(self.multiplier + self.penalty * self.excess(values), 0.0)
        return (force**2 - self.multiplier**2) / (2 * self.penalty)


@dataclasses.dataclass(frozen=True)
class Limit:
    """Limit `threshold` of the quantity KINDS[`name`], and the state of its augmented Lagrangian.

    `source`: origin of the limit, for the report. `multiplier`, `penalty`: of the augmented Lagrangian. `ratio`: the
    judge's value over the search's. `missed`: g at the last update. `forces`: (reached, multiplier) of every update.
    """

    name: str
    threshold: float
    source: str = "tune.limits"
    margin: float = 0.0
    """share by which the search keeps the quantity below the limit, or above a lower one"""
    multiplier: float = 0.0
    ratio: float = 1.0
    penalty: float = PENALTY
    missed: float = math.inf
    forces: tuple[tuple[float, float], ...] = ()

    @property
    def kind(self) -> Kind:
        """The limited quantity."""
        return KINDS[self.name]

    @property
    def allowed(self) -> float:
        """Bound that the search uses: the limit less its margin, or a lower limit and its margin."""
        return (1 + self.margin if self.kind.at_least else 1 - self.margin) * self.threshold

    def holds(self, reached: float) -> bool:
        """Return whether a value keeps the limit."""
        return reached >= self.threshold if self.kind.at_least else reached <= self.threshold

    @property
    def term(self) -> LimitTerm:
        """The limit's term of the goal."""
        return LimitTerm(self.name, math.log(self.allowed), self.multiplier, self.penalty, self.ratio)

    def log_excess(self, reached: float) -> float:
        """Return g = log(reached / allowed); -g for a lower limit."""
        excess = math.log(max(reached, TINY) / self.allowed)
        return -excess if self.kind.at_least else excess

    def active(self, reached: float | None) -> bool:
        """Return whether the limit is active: its multiplier is above 0, and the judge's value reaches it.

        If no member is judged, `reached` is None and the multiplier alone decides.
        """
        near = reached is None or self.log_excess(reached) >= -(TOLERANCE_BELOW + self.margin)
        return self.multiplier > 0 and near

    def updated(self, tuned: float, judged: float) -> "Limit":
        """Return the limit after an update of its multiplier at an optimum of the goal.

        `tuned` and `judged` are the values of the search and of the judge there. `judged` is infinite where an
        injection loses the rotor: LOST_FACTOR times the larger of `tuned` and the limit stands for it.
        """
        judged = judged if math.isfinite(judged) else LOST_FACTOR * max(tuned, self.threshold)
        excess = self.log_excess(judged)
        force = max(self.multiplier + self.penalty * self.log_excess(self.ratio * tuned), 0.0)
        slow = force > 0 and abs(excess) > SUFFICIENT_DECREASE * abs(self.missed)
        penalty = min(PENALTY_GROWTH * self.penalty, MOST_PENALTY) if slow else self.penalty
        ratio = max(judged, TINY) / max(tuned, TINY)
        forces = (*self.forces, (max(judged, TINY), force))
        return dataclasses.replace(self, multiplier=force, ratio=ratio, penalty=penalty, missed=excess, forces=forces)

    def restarted(self) -> "Limit":
        """Return the limit for the minimum of another quantity: only `ratio` stays."""
        return dataclasses.replace(self, multiplier=0.0, penalty=PENALTY, missed=math.inf, forces=())

    def error_reduction(self, more: float) -> float:
        """Return the relative decrease of the minimised rms value when the limit is looser by the share `more`.

        It is the integral of the multiplier over the logarithm of the limit. The multiplier is interpolated linearly
        between the optima of the updates, which belong to looser limits, and is constant outside of them.
        """
        if not self.multiplier:
            return 0.0
        side = -1.0 if self.kind.at_least else 1.0
        logs, forces = np.array(sorted((side * math.log(reached), force) for reached, force in self.forces)).T
        begin = side * math.log(self.forces[-1][0])
        at = np.linspace(begin, begin + math.log1p(more), PRICE_INTERVALS + 1)
        return -math.expm1(-float(np.trapezoid(np.interp(at, logs, forces), at)) / 2)

    def reached(self, columns: Mapping[str, np.ndarray]) -> float:
        """Return the judge's value. `columns`: every metric and term of an ensemble by name, each [N]."""
        return float(self.kind.judged(self.of_members(columns)))

    def worst(self, columns: Mapping[str, np.ndarray]) -> float:
        """Return the value of the worst member. `columns`: as for `reached`."""
        return float((np.min if self.kind.at_least else np.max)(self.of_members(columns)))

    def of_members(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the quantity of each member that is held, or of all members if none is held.

        `columns`: every metric and term of an ensemble by name, each [N]. Lost rotors are left out: their voltage is 0
        after the loss, which would lower a mean. The limit `survival` counts them.
        """
        alive = ~np.isfinite(columns["lost_at_s"])
        values = np.asarray(columns[self.kind.exact or f"loss.{PREFIX}{self.name}"])
        return values[alive] if alive.any() else values


def measures(names: Collection[str], limits: tuple[Limit, ...], context: LimitContext) -> dict[str, Fold]:
    """Return the fold of each of the quantities that has one, by name. `limits`: those among them."""
    thresholds = {limit.name: limit.threshold for limit in limits}
    folds = {name: KINDS[name].fold for name in names}
    return {name: fold(context, thresholds.get(name, 1.0)) for name, fold in folds.items() if fold is not None}
