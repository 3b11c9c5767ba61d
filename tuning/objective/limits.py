"""Limits on quantities of an ensemble: their measurement, and their terms of the goal.

A search minimises the error subject to the limits by an augmented Lagrangian (Nocedal and Wright, Numerical
Optimization, 2006, 17.3). With g = log(reached / allowed), a limit adds (max(0, multiplier + penalty g)^2 -
multiplier^2) / (2 penalty) to the goal, which is a logarithm. At the optimum the multiplier is minus the elasticity of
the minimised quantity: a limit 1 % higher lowers it by `multiplier` %.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.extend import Scalar, leaf, record, static
from ambjax.simulation.clock import Clock
from ambjax.simulation.metrics import Driven, Ending, Fold, Peak, Variation
from ambjax.simulation.response import Overshoot, Settling
from ambjax.world.scenario import Scenario

# Initial penalty: at a multiplier of 0, an excess of 10 % adds 0.14 to the goal. Factor by which the penalty grows when
# an update leaves more than the share SUFFICIENT_DECREASE of the excess (Nocedal and Wright, ch. 17); largest penalty.
PENALTY, PENALTY_GROWTH, SUFFICIENT_DECREASE, MOST_PENALTY = 30.0, 4.0, 0.3, 2000.0
# Exponent of the norms that approximate maxima.
NORM = 16
# Prefix of the names of limited quantities among the terms of a loss.
PREFIX = "limit."
# Lower bound of the argument of a logarithm.
TINY = 1e-30
# A limit with a multiplier above 0 is met from this share below the allowed value to half of the margin above it.
TOLERANCE_BELOW = 0.01
# Smallest margin. A search meets a limit to half of its margin only, so a smaller margin would not keep it held.
LEAST_MARGIN = 0.002
# Default limit of the rms voltage, as a share of actuator.u_max.
DEFAULT_SHARE = 0.6
# Intervals of the integral in `Limit.error_reduction`.
PRICE_INTERVALS = 200


@record
class Typical:
    """Fold: the 16-norm over samples of |row.`of`| in units of `size`, a smooth maximum.

    A saturated voltage has the derivative 0. The norm includes the unsaturated samples, which have another one.
    """

    of: str = static()
    size: Scalar = leaf(above=0, at_most=1e30)

    def init(self) -> tuple[Array, Array]:
        zero = jnp.zeros((), jnp.result_type(float))
        return zero, zero

    def update(self, carry: tuple[Array, Array], row: Any, span: Any) -> tuple[Array, Array]:
        total, count = carry
        return total + (jnp.abs(getattr(row, self.of)) / self.size) ** NORM, count + row.alive

    def result(self, carry: tuple[Array, Array], ending: Ending) -> Array:
        total, count = carry
        mean = total / jnp.maximum(count, 1.0)
        some = mean > TINY
        return self.size * jnp.where(some, jnp.where(some, mean, 1.0) ** (1 / NORM), 0.0)


@record
class Scaled:
    """Fold: the result of another fold, divided by `by`."""

    fold: Fold
    by: Scalar = leaf(above=0, at_most=1e30)

    def init(self) -> Any:
        return self.fold.init()

    def update(self, carry: Any, row: Any, span: Any) -> Any:
        return self.fold.update(carry, row, span)

    def result(self, carry: Any, ending: Ending) -> Array:
        return self.fold.result(carry, ending) / self.by


@dataclasses.dataclass(frozen=True)
class LimitContext:
    """Quantities of a case that the folds of limits depend on.

    `settle` (s): start of the settled part. `duration` (s): of the run. `touchdown` (m): clearance. `band` (m): of the
    settling time.
    """

    settle: float
    duration: float
    touchdown: float
    band: float


def pooled(values: Any) -> Any:
    """Return the root mean square over members."""
    return jnp.sqrt(jnp.mean(values**2) + TINY)


def largest(values: Any) -> Any:
    """Return the 16-norm over members: smooth, and not below the maximum."""
    top = jax.lax.stop_gradient(jnp.maximum(jnp.max(values), TINY))
    total = jnp.sum((values / top) ** NORM)
    # 0 if all are 0: the derivative of the root is infinite there
    return top * jnp.where(total > 0, total, 1.0) ** (1 / NORM)


@dataclasses.dataclass(frozen=True)
class Kind:
    """A quantity that may be limited.

    `words` describes the quantity of one member, `over` its reduction over members, both for the report. `fold` returns
    the fold that measures it in the search, of a LimitContext and the limit. `exact` is the column of its exact value
    in the judge's metrics; None: the fold's result. `tuned` reduces the members for the search, `judged` for the judge.
    """

    unit: str
    words: str
    over: str
    fold: Callable[[LimitContext, float], Fold]
    exact: str | None
    tuned: Callable[[Any], Any]
    judged: Callable[[np.ndarray], Any]
    margin: float
    """default margin: relative difference between two ensembles, smaller for means than for worst members"""
    worst: bool = False
    """whether the quantity is that of the worst member"""


_POOLED = {"over": "root mean square over members", "tuned": pooled, "judged": pooled, "margin": 0.005}
_MEAN = {"over": "mean over members", "tuned": jnp.mean, "judged": np.mean, "margin": 0.005}
_WORST = {"over": "of the worst member", "tuned": largest, "judged": np.max, "margin": 0.03, "worst": True}

KINDS: dict[str, Kind] = {
    "rms_u_V": Kind(
        "V",
        "root mean square voltage from run.settle on",
        fold=lambda context, asked: Driven("u_squared", context.settle, root=True),
        exact="settled_rms_u_V",
        **_POOLED,
    ),
    "max_u_V": Kind(
        "V",
        "largest voltage of the run",
        fold=lambda context, asked: Typical("u_peak", asked),
        exact="max_abs_u_V",
        **_WORST,
    ),
    "max_abs_i_A": Kind(
        "A", "largest current of the run", fold=lambda context, asked: Peak("i"), exact="max_abs_i_A", **_WORST
    ),
    "chatter_V_per_s": Kind(
        "V/s",
        "variation of the voltage, averaged over each sample, per second from run.settle on",
        fold=lambda context, asked: Scaled(Variation(context.settle), context.duration - context.settle),
        exact=None,
        **_MEAN,
    ),
    "largest_error_m": Kind(
        "m",
        "largest |z - r| from run.settle on",
        fold=lambda context, asked: Peak("e_z", context.settle),
        exact="settled_max_abs_error_m",
        **_WORST,
    ),
    "settling_s": Kind(
        "s",
        "time of the run from which |z - r|, at the samples, stays within settling_band_m",
        fold=lambda context, asked: Settling(context.band),
        exact=None,
        **_WORST,
    ),
    "overshoot_m": Kind(
        "m",
        "how far z goes, at the samples, beyond where it began and where r has been",
        fold=lambda context, asked: Overshoot(),
        exact=None,
        **_WORST,
    ),
    "clearance_used": Kind(
        "",
        "largest |z| as a share of the clearance",
        fold=lambda context, asked: Scaled(Peak("z"), context.touchdown),
        exact="clearance_used",
        **_WORST,
    ),
}


@dataclasses.dataclass(frozen=True)
class Limit:
    """Upper limit `asked` of the quantity KINDS[`name`], and the state of its augmented Lagrangian.

    `source`: origin of the limit, for the report. `multiplier`, `penalty`: of the augmented Lagrangian. `ratio`: the
    judge's value over the search's. `missed`: g at the last update. `forces`: (reached, multiplier) of every update.
    """

    name: str
    asked: float
    source: str = "tune.limits"
    margin: float = 0.0
    """share by which the search keeps the quantity below the limit"""
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
        """Upper bound that the search uses: the limit less its margin."""
        return (1 - self.margin) * self.asked

    def excess(self, values: Array) -> Array:
        """Return g = log(reached / allowed) for the search's values [N], corrected by `ratio`."""
        reached = self.ratio * self.kind.tuned(values)
        return jnp.log(jnp.maximum(reached, TINY)) - math.log(self.allowed)

    def pull(self, values: Array) -> Array:
        """Return the limit's term of the goal for the search's values [N]."""
        force = jnp.maximum(self.multiplier + self.penalty * self.excess(values), 0.0)
        return (force**2 - self.multiplier**2) / (2 * self.penalty)

    def log_excess(self, reached: float) -> float:
        """Return g = log(reached / allowed)."""
        return math.log(max(reached, TINY) / self.allowed)

    def active(self, reached: float | None) -> bool:
        """Return whether the limit is active: its multiplier is above 0, and the judge's value reaches it.

        If no member is judged, `reached` is None and the multiplier alone decides.
        """
        near = reached is None or self.log_excess(reached) >= -(TOLERANCE_BELOW + self.margin)
        return self.multiplier > 0 and near

    def updated(self, tuned: float, judged: float) -> "Limit":
        """Return the limit after an update of its multiplier at an optimum of the goal.

        `tuned` and `judged` are the values of the search and of the judge there.
        """
        excess = self.log_excess(judged)
        force = max(self.multiplier + self.penalty * self.log_excess(self.ratio * tuned), 0.0)
        slow = force > 0 and abs(excess) > SUFFICIENT_DECREASE * abs(self.missed)
        penalty = min(PENALTY_GROWTH * self.penalty, MOST_PENALTY) if slow else self.penalty
        ratio = max(judged, TINY) / max(tuned, TINY)
        forces = (*self.forces, (max(judged, TINY), force))
        return dataclasses.replace(self, multiplier=force, ratio=ratio, penalty=penalty, missed=excess, forces=forces)

    def error_reduction(self, more: float) -> float:
        """Return the relative decrease of the rms error when the limit grows by the share `more`.

        It is the integral of the multiplier over the logarithm of the limit. The multiplier is interpolated linearly
        between the optima of the updates, which belong to looser limits, and is constant outside of them.
        """
        if not self.multiplier:
            return 0.0
        logs, forces = np.array(sorted((math.log(reached), force) for reached, force in self.forces)).T
        begin = math.log(self.forces[-1][0])
        at = np.linspace(begin, begin + math.log1p(more), PRICE_INTERVALS + 1)
        return -math.expm1(-float(np.trapezoid(np.interp(at, logs, forces), at)) / 2)

    def reached(self, columns: Mapping[str, np.ndarray]) -> float:
        """Return the judge's value. `columns`: every metric and term of an ensemble by name, each [N]."""
        return float(self.kind.judged(self.of_members(columns)))

    def of_members(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the quantity of each member that is held, or of all members if none is held.

        `columns`: every metric and term of an ensemble by name, each [N]. Lost rotors are left out: their voltage is 0
        after the loss, which would lower a mean. The limit `survival` counts them.
        """
        alive = ~np.isfinite(columns["lost_at_s"])
        values = np.asarray(columns[self.kind.exact or f"loss.{PREFIX}{self.name}"])
        return values[alive] if alive.any() else values


def measures(limits: tuple[Limit, ...], scenario: Scenario, clock: Clock, settle: float, band: float) -> dict[str, Any]:
    """Return the fold of each limit by name. `settle` (s): start of the settled part; `band` (m): of settling_s."""
    context = LimitContext(settle, float(clock.duration), float(scenario.touchdown), band)
    return {limit.name: limit.kind.fold(context, limit.asked) for limit in limits}
