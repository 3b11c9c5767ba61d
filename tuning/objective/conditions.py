"""The conditions of Theorem 1 on the gains, as lower bounds and as margins."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control import current, inversion, position
from ambjax.control.cascade import Cascade
from ambjax.simulation.clock import Clock
from ambjax.theorem.conditions import delta_1_on_reference
from ambjax.world.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Bound:
    """A gain must exceed `value`: `symbol` is what the paper calls it."""

    path: str
    value: float
    symbol: str
    unit: str


def bounds(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[Bound, ...]:
    """k > Q_z, k_i > Q_i, gamma > Delta_1 (Eq. 7, on the ideal motion z = r), where the laws have these gains."""
    t = jnp.arange(clock.samples) * clock.sample_period
    q_z = float(np.max(np.abs(np.asarray(jax.vmap(scenario.acceleration)(t)))))
    q_i = float(np.max(np.abs(np.asarray(jax.vmap(scenario.q_i)(t)))))
    found = []
    if isinstance(cascade.position, position.SlidingMode):
        found.append(Bound("controller.position.k", q_z, "Q_z", "m/s^2"))
    if isinstance(cascade.current, current.SlidingMode):
        found.append(Bound("controller.current.k_i", q_i, "Q_i", "A/s"))
    if isinstance(cascade.inversion, inversion.Adaptive):
        delta = delta_1_on_reference(cascade, scenario, clock)[0]
        found.append(Bound("controller.inversion.gamma", delta, "Delta_1", "A^2/m^2/s"))
    return tuple(found)


def shortfall(gains: Mapping[str, Array], bounds: tuple[Bound, ...], margin: float) -> Array:
    """Sum of max(0, log((1 + margin) bound / gain))^2 over the gains that are bounded: 0 where all hold with margin."""
    total = jnp.zeros(())
    for bound in bounds:
        if bound.path in gains and bound.value > 0:
            total = total + jnp.maximum(jnp.log((1 + margin) * bound.value) - jnp.log(gains[bound.path]), 0.0) ** 2
    return total
