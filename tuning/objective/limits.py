"""Limits of what an engineer limits: how each is measured on a member and over an ensemble, and how it pulls.

A search minimises the error subject to them by an augmented Lagrangian (Nocedal and Wright, Numerical Optimization,
2006, 17.3) in logarithms: with g = log(reached / allowed), each adds (max(0, multiplier + penalty g)^2 - multiplier^2)
/ (2 penalty) to the goal, a logarithm too. At the optimum the multiplier is minus the elasticity of what is minimised:
1 % more of the limit buys `multiplier` % less of it.
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

# How steeply a limit that is exceeded pulls at first: 10 % beyond it count as 14 % of the mean square error where the
# multiplier is 0. By how much steeper where an update leaves more than this share of the excess, and at most.
PENALTY, STEEPER, LEFT, STEEPEST = 30.0, 4.0, 0.3, 2000.0
# Exponent of the norms that stand for maxima.
NORM = 16
# Before the names of what limits hold among the terms of a loss.
PREFIX = "limit."
# Of what is 0 there is no logarithm.
TINY = 1e-30
# Where it pulls, a limit is met from this share below what is allowed, to half of the margin above.
BELOW = 0.01
# Half of a margin is what a search meets a limit to: of less, a limit that was met would not be held.
LEAST_MARGIN = 0.002
# What a supply is worth without being asked: rms voltage as a share of its limit.
SHARE = 0.6
# Stretches of the integral that prices a limit.
STRETCHES = 200


@record
class Typical:
    """The 16-norm over samples of |row.`of`|: a smooth maximum.

    At its stop a voltage has no slope; the samples that are below it do.
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
    """A fold's number, divided."""

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
    """What the measures of a case depend on: from when errors count (s), run's duration (s), clearance and band (m)."""

    settle: float
    duration: float
    touchdown: float
    band: float


def pooled(values: Any) -> Any:
    """Root mean square over members."""
    return jnp.sqrt(jnp.mean(values**2) + TINY)


def largest(values: Any) -> Any:
    """16-norm over members: at least the largest, and smooth."""
    top = jax.lax.stop_gradient(jnp.maximum(jnp.max(values), TINY))
    total = jnp.sum((values / top) ** NORM)
    # 0 where all are 0: a root has no slope there
    return top * jnp.where(total > 0, total, 1.0) ** (1 / NORM)


@dataclasses.dataclass(frozen=True)
class Kind:
    """A quantity that may be limited: its unit; what it is of a member, and over members, in words.

    `fold` measures it on a member for the search; `exact` names the column in which a judge finds it, None: the fold's
    own number. `tuned` makes one number of all members for the search, `judged` for the judge.
    """

    unit: str
    words: str
    over: str
    fold: Callable[[LimitContext, float], Fold]
    exact: str | None
    tuned: Callable[[Any], Any]
    judged: Callable[[np.ndarray], Any]
    margin: float
    """share by which two ensembles differ at most: of their averages less than of their worst members"""
    worst: bool = False
    """whether one member decides"""


_POOLED = {"over": "root mean square over members", "tuned": pooled, "judged": pooled, "margin": 0.005}
_MEAN = {"over": "mean over members", "tuned": jnp.mean, "judged": np.mean, "margin": 0.005}
_WORST = {"over": "of the worst member", "tuned": largest, "judged": np.max, "margin": 0.03, "worst": True}

KINDS: dict[str, Kind] = {
    "rms_u_V": Kind(
        "V",
        "root mean square voltage from run.settle on",
        fold=lambda site, asked: Driven("u_squared", site.settle, root=True),
        exact="settled_rms_u_V",
        **_POOLED,
    ),
    "max_u_V": Kind(
        "V",
        "largest voltage of the run",
        fold=lambda site, asked: Typical("u_peak", asked),
        exact="max_abs_u_V",
        **_WORST,
    ),
    "max_abs_i_A": Kind(
        "A", "largest current of the run", fold=lambda site, asked: Peak("i"), exact="max_abs_i_A", **_WORST
    ),
    "chatter_V_per_s": Kind(
        "V/s",
        "variation of the voltage, averaged over each sample, per second from run.settle on",
        fold=lambda site, asked: Scaled(Variation(site.settle), site.duration - site.settle),
        exact=None,
        **_MEAN,
    ),
    "largest_error_m": Kind(
        "m",
        "largest |z - r| from run.settle on",
        fold=lambda site, asked: Peak("e_z", site.settle),
        exact="settled_max_abs_error_m",
        **_WORST,
    ),
    "settling_s": Kind(
        "s",
        "time of the run from which |z - r|, at the samples, stays within settling_band_m",
        fold=lambda site, asked: Settling(site.band),
        exact=None,
        **_WORST,
    ),
    "overshoot_m": Kind(
        "m",
        "how far z goes, at the samples, beyond where it began and where r has been",
        fold=lambda site, asked: Overshoot(),
        exact=None,
        **_WORST,
    ),
    "clearance_used": Kind(
        "",
        "largest |z| as a share of the clearance",
        fold=lambda site, asked: Scaled(Peak("z"), site.touchdown),
        exact="clearance_used",
        **_WORST,
    ),
}


@dataclasses.dataclass(frozen=True)
class Limit:
    """At most `asked` of a KIND; `source` says who asks. What a search has learnt: `multiplier`, `penalty`, by how much
    the judge's number exceeds the search's (`ratio`), the last g (`missed`), and what acted at each optimum on the way:
    (reached, multiplier) (`forces`)."""

    name: str
    asked: float
    source: str = "tune.limits"
    margin: float = 0.0
    """share by which a search stays below it"""
    multiplier: float = 0.0
    ratio: float = 1.0
    penalty: float = PENALTY
    missed: float = math.inf
    forces: tuple[tuple[float, float], ...] = ()

    @property
    def kind(self) -> Kind:
        """How it is measured."""
        return KINDS[self.name]

    @property
    def allowed(self) -> float:
        """What a search keeps to."""
        return (1 - self.margin) * self.asked

    def excess(self, values: Array) -> Array:
        """g = log(reached / allowed), of a search's own numbers [N]."""
        reached = self.ratio * self.kind.tuned(values)
        return jnp.log(jnp.maximum(reached, TINY)) - math.log(self.allowed)

    def pull(self, values: Array) -> Array:
        """What it adds to the goal."""
        force = jnp.maximum(self.multiplier + self.penalty * self.excess(values), 0.0)
        return (force**2 - self.multiplier**2) / (2 * self.penalty)

    def beyond(self, reached: float) -> float:
        """g of a number that is reached."""
        return math.log(max(reached, TINY) / self.allowed)

    def active(self, reached: float | None) -> bool:
        """Whether it pulls and is reached, by members that judge; None: by none, and its multiplier alone decides."""
        near = reached is None or self.beyond(reached) >= -(BELOW + self.margin)
        return self.multiplier > 0 and near

    def informed(self, tuned: float, judged: float) -> "Limit":
        """It knows what the search's number and the judge's are at an optimum of the goal with it: the multiplier is
        the force that acted there."""
        excess = self.beyond(judged)
        force = max(self.multiplier + self.penalty * self.beyond(self.ratio * tuned), 0.0)
        slow = force > 0 and abs(excess) > LEFT * abs(self.missed)
        penalty = min(STEEPER * self.penalty, STEEPEST) if slow else self.penalty
        ratio = max(judged, TINY) / max(tuned, TINY)
        forces = (*self.forces, (max(judged, TINY), force))
        return dataclasses.replace(self, multiplier=force, ratio=ratio, penalty=penalty, missed=excess, forces=forces)

    def bought(self, more: float) -> float:
        """Share of the root mean square error that this share more of the limit takes off.

        What is minimised falls by the multiplier, which falls on the way: each optimum that a search came by was that
        of a looser limit. Between them it is linear in the logarithm of the limit; beyond them as at the last.
        """
        if not self.multiplier:
            return 0.0
        logs, forces = np.array(sorted((math.log(reached), force) for reached, force in self.forces)).T
        begin = math.log(self.forces[-1][0])
        at = np.linspace(begin, begin + math.log1p(more), STRETCHES + 1)
        return -math.expm1(-float(np.trapezoid(np.interp(at, logs, forces), at)) / 2)

    def reached(self, columns: Mapping[str, np.ndarray]) -> float:
        """The judge's number, of every metric and term [N] of an ensemble."""
        return float(self.kind.judged(self.of_members(columns)))

    def of_members(self, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """The quantity of each member that is held, or of every one where none is.

        `columns` [N]: every metric and term of an ensemble. A rotor that is lost counts 0 V from then on, which would
        lower an average; whether it may be lost is decided by `survival`.
        """
        alive = ~np.isfinite(columns["lost_at_s"])
        values = np.asarray(columns[self.kind.exact or f"loss.{PREFIX}{self.name}"])
        return values[alive] if alive.any() else values


def measures(limits: tuple[Limit, ...], scenario: Scenario, clock: Clock, settle: float, band: float) -> dict[str, Any]:
    """A fold for each limit, by its name."""
    site = LimitContext(settle, float(clock.duration), float(scenario.touchdown), band)
    return {limit.name: limit.kind.fold(site, limit.asked) for limit in limits}
