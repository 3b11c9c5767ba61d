"""The loss of one rollout: a fold that returns dimensionless terms, and their weighted sum."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.extend import Scalar, leaf, record
from ambjax.simulation.folds import Ending, Fold, Named
from ambjax.simulation.span import Span
from ambjax.simulation.trajectory import ALIVE, Row
from ambjax.world.scenario import Scenario
from tuning.objective.limits import PREFIX

# Exponent of the norm that approximates the maximum: over 1e4 samples of noise it is 1.2 to 1.6 times smaller.
NORM = 16
TERMS = ("tracking", "peak", "effort", "chatter", "clearance", "survival")
# Terms that measure how close the rotor is to touchdown, and its loss.
HELD = ("clearance", "survival")
# Terms that multiply the error.
COSTS = ("effort", "chatter")


class Sums(NamedTuple):
    """Carry of the fold: sums over samples, and the carries of the limits' folds."""

    square: Array
    power: Array
    weight: Array
    effort: Array
    chatter: Array
    u: Array
    clearance: Array
    driven: Array
    time: Array
    contact_time: Array
    measured: Any


@record
class Loss:
    """Fold: the terms of the loss of one member by name (TERMS), dimensionless and not negative.

    tracking: mean of (e_z / s_0)^2 from `settle` on; earlier samples have the weight `early`.
    peak: square of the 16-norm of e_z / s_0 over the same samples, a smooth maximum.
    effort: mean over time of (u / u_scale)^2 while the drive is on.
    chatter: mean over samples of ((u_k - u_{k-1}) / u_scale)^2, where u_k is the average of u over sample k.
    clearance: mean of max(0, (|z| - h) / (stop - h))^2, where h = (|r| + stop) / 2.
    survival: share of the horizon after the loss of the rotor. Its derivative is that of the time at which |z| reaches
    the stop at its last speed, so a descent step keeps the rotor for longer.
    The result also holds the result of each fold of `measures`, under its name with PREFIX.
    """

    settle: Scalar = leaf(default=0.2, unit="s", at_least=0, at_most=1e6)
    early: Scalar = leaf(default=0.0, at_least=0, at_most=1e6)
    s_0: Scalar = leaf(default=5e-3, unit="m", above=0, at_most=1.0)
    u_scale: Scalar = leaf(default=200.0, unit="V", above=0, at_most=1e30)
    stop: Scalar = leaf(default=4.5e-3, unit="m", above=0, at_most=1.0)
    measures: Mapping[str, Fold] = dataclasses.field(default_factory=dict)

    def init(self) -> Sums:
        zeros = [jnp.zeros((), jnp.result_type(float))] * (len(Sums._fields) - 1)
        return Sums._make([*zeros, Named(self.measures).init()])

    def update(self, carry: Sums, row: Row, span: Span) -> Sums:
        on = row.alive
        weight = jnp.where(row.t >= self.settle, 1.0, self.early)
        square = ((row.z - row.r) / self.s_0) ** 2
        halfway = (jnp.abs(row.r) + self.stop) / 2
        beyond = jnp.maximum((jnp.abs(row.z) - halfway) / (self.stop - halfway), 0.0)
        outward = jnp.where(row.z < 0, -row.z_dot, row.z_dot)
        moving = outward > 1e-6
        contact_time = row.t + (self.stop - jnp.abs(row.z)) / jnp.where(moving, outward, 1.0)
        return Sums(
            carry.square + weight * square,
            carry.power + weight * square ** (NORM // 2),
            carry.weight + weight,
            carry.effort + span.densities.u_squared,
            carry.chatter + jnp.where(on & (row.t > 0), (row.u_mean - carry.u) ** 2, 0.0),
            row.u_mean,
            carry.clearance + beyond**2,
            carry.driven + on,
            carry.time + span.time,
            jnp.where(on & moving, contact_time, carry.contact_time),
            Named(self.measures).update(carry.measured, row, span),
        )

    def result(self, carry: Sums, ending: Ending) -> dict[str, Array]:
        weight, driven = jnp.maximum(carry.weight, 1e-9), jnp.maximum(carry.driven, 1.0)
        mean = carry.power / weight
        some = mean > 1e-280
        lost = ending.lost_code != ALIVE
        at = jnp.where(lost, ending.lost_at, 0.0)
        at = jax.lax.stop_gradient(at) + (carry.contact_time - jax.lax.stop_gradient(carry.contact_time))
        measured = Named(self.measures).result(carry.measured, ending)
        return {PREFIX + name: value for name, value in measured.items()} | {
            "tracking": carry.square / weight,
            "peak": jnp.where(some, jnp.where(some, mean, 1.0) ** (2 / NORM), 0.0),
            "effort": carry.effort / jnp.where(carry.time > 0, carry.time, 1.0) / self.u_scale**2,
            "chatter": carry.chatter / driven / self.u_scale**2,
            "clearance": carry.clearance / driven,
            "survival": jnp.where(lost, 1 - at / ending.duration, 0.0),
        }


def loss_for(scenario: Scenario, settle: float, early: float = 0.0, measures: Mapping[str, Fold] | None = None) -> Loss:
    """Return the loss of a scenario. u is scaled by the supply's limit, or by R i_0 without a limit.

    `settle` (s): start of the settled part. `early`: weight of the samples before it. `measures`: folds of limits.
    """
    plant = scenario.plant
    u_scale = jnp.where(jnp.isfinite(scenario.u_max), scenario.u_max, plant.R * plant.i_0)
    return Loss(settle, early, plant.s_0, float(u_scale), scenario.touchdown, dict(measures or {}))


def weigh(weights: Any, terms: Mapping[str, Any], stressed: Any) -> Any:
    """Return the loss: clearance + survival + (tracking + peak) (1 + effort + chatter), each term times its weight.

    For a stressed member it is clearance + survival. Costs are relative to the error, whose size is unknown in advance:
    at a weight of 0.1, a voltage at its limit throughout adds a tenth of the error.
    """
    ordinary = 1.0 - 1.0 * stressed
    each = dict(zip(TERMS, (weights[k] * terms[name] for k, name in enumerate(TERMS)), strict=True))
    costs = sum(each.pop(name) for name in COSTS)
    held = sum(each.pop(name) for name in HELD)
    return held + ordinary * sum(each.values()) * (1 + costs)


def outcomes(weights: object, terms: dict[str, Any], stressed: object) -> list[Any]:
    """Return the weighted loss and the limited quantities, in the order of their names."""
    return [weigh(weights, terms, stressed), *(terms[name] for name in sorted(terms) if name.startswith(PREFIX))]
