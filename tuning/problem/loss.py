"""The loss of one rollout: a fold that returns dimensionless terms, and their weighted sum."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.extend import Scalar, leaf, record
from ambjax.simulation.folds import Ending, Fold, Named
from ambjax.simulation.trajectory import ALIVE, Row, Span
from ambjax.world.scenario import Scenario
from tuning.problem.limits import PREFIX
from tuning.problem.quantities import NORM

# Weights of the terms, in the order of TERMS; values of a term, for one member or for many [N].
Weights = Sequence[float] | np.ndarray | Array
Values = TypeVar("Values", Array, np.ndarray)
# Names of the terms, in the order of the weights.
TERMS = ("tracking", "peak", "effort", "chatter", "clearance", "survival")
# Terms that measure the distance from touchdown and the loss of the rotor.
HELD = ("clearance", "survival")
# Terms that are factors of the error (`weigh`).
COSTS = ("effort", "chatter")


class Sums(NamedTuple):
    """State of the fold: sums over samples, values of the last sample, and the states of the limits' folds.

    `square`, `power`: weighted sums of the squared error in units of s_0^2, and of the error to the power NORM in units
    of s_0^NORM. `weight`: sum of the weights. `effort`: integral of u^2, V^2 s. `chatter`: sum of the squared steps of
    the averaged voltage, V^2. `u`: average of u over the last sample, V. `clearance`: sum of the clearance term.
    `driven`: number of samples with the rotor held. `time`: time with the drive on, s. `contact_time`: extrapolated
    time at which |z| reaches the stop, s. `measured`: states of the limits' folds.
    """

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
    """Fold that returns the terms of the loss of one member by name (TERMS), dimensionless and not negative.

    With e_z = z - r:

    tracking: mean of (e_z / s_0)^2 from `settle` on; earlier samples have the weight `early`.
    peak: square of the power mean of |e_z| / s_0 with exponent 16, with the same weights: a smooth maximum.
    effort: mean over time of (u / u_scale)^2 while the drive is on.
    chatter: mean over samples of ((u_k - u_{k-1}) / u_scale)^2, where u_k is the average of u over sample k.
    clearance: sum over all samples of max(0, (|z| - h) / (stop - h))^2, where h = (|r| + stop) / 2, divided by the
    number of samples with the rotor held.
    survival: share of the run after the loss of the rotor. In its derivative, the time of the loss is replaced by the
    time at which |z| would reach the stop with the speed at the last sample. A descent step then delays the loss.

    The result also contains the result of each fold in `measures`, with PREFIX before its name.
    """

    settle: Scalar = leaf(default=0.2, unit="s", at_least=0, at_most=1e6, doc="time from which errors count")
    early: Scalar = leaf(default=0.0, at_least=0, at_most=1e6, doc="weight of the errors before `settle`")
    s_0: Scalar = leaf(default=5e-3, unit="m", above=0, at_most=1.0, doc="gap, the unit of errors")
    u_scale: Scalar = leaf(default=200.0, unit="V", above=0, at_most=1e30, doc="unit of voltages")
    stop: Scalar = leaf(default=4.5e-3, unit="m", above=0, at_most=1.0, doc="clearance")
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
    """Return the loss of a scenario. The unit of u is the supply's limit, or R i_0 without a limit.

    `settle` (s): time from which errors count fully. `early`: weight of earlier errors. `measures`: folds of the
    limited quantities by name.
    """
    plant = scenario.plant
    u_scale = jnp.where(jnp.isfinite(scenario.u_max), scenario.u_max, plant.R * plant.i_0)
    return Loss(settle, early, plant.s_0, float(u_scale), scenario.touchdown, dict(measures or {}))


def weigh(weights: Weights, terms: Mapping[str, Values], stressed: Values) -> Values:
    """Return the loss: clearance + survival + (tracking + peak) (1 + effort + chatter), each term times its weight.

    `weights`: in the order of TERMS. `terms`: the terms by name, numbers or arrays [N]. `stressed`: whether a member is
    stressed; its loss is clearance + survival only. Effort and chatter count relative to the error, because the size of
    the error is unknown in advance. With a weight of 0.1, a voltage that is always at its limit adds a tenth of the
    error.
    """
    ordinary: Any = 1.0 - 1.0 * stressed
    each: dict[str, Any] = dict(zip(TERMS, (weights[k] * terms[name] for k, name in enumerate(TERMS)), strict=True))
    costs = sum(each.pop(name) for name in COSTS)
    held = sum(each.pop(name) for name in HELD)
    return held + ordinary * sum(each.values()) * (1 + costs)


def outcomes(weights: Weights, terms: dict[str, Values], stressed: Values, names: Sequence[str]) -> list[Values]:
    """Return the loss (`weigh`), then the limited quantities `names` among `terms`."""
    return [weigh(weights, terms, stressed), *(terms[PREFIX + name] for name in names)]
