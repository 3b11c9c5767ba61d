"""The conditions of Theorem 1 on the gains, as lower bounds and as margins."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.simulation.clock import Clock
from ambjax.theorem.conditions import delta_1_on_reference, required
from ambjax.world.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Bound:
    """A gain must exceed `value`: `symbol` is what the paper calls it."""

    path: str
    value: float
    symbol: str
    unit: str


def bounds(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[Bound, ...]:
    """What the laws require of their gains: k > Q_z, k_i > Q_i, gamma > Delta_1 (Eq. 7, on the ideal motion z = r)."""
    t = jnp.arange(clock.samples) * clock.sample_period

    def largest(signal: Callable[[Array], Array]) -> float:
        return float(np.max(np.abs(np.asarray(jax.vmap(signal)(t)))))

    sides = {
        "Q_z": lambda: largest(scenario.acceleration),
        "Q_i": lambda: largest(scenario.q_i),
        "Delta_1": lambda: delta_1_on_reference(cascade, scenario, clock)[0],
    }
    asked = [one for one in required(cascade) if one.value is not None]
    return tuple(Bound(one.path, sides[one.over](), one.over, one.unit) for one in asked)


def shortfall(gains: Mapping[str, Array], bounds: tuple[Bound, ...], margin: float) -> Array:
    """Sum of max(0, log((1 + margin) bound / gain))^2 over the gains that are bounded: 0 where all hold with margin."""
    total = jnp.zeros(())
    for bound in bounds:
        if bound.path in gains and bound.value > 0:
            total = total + jnp.maximum(jnp.log((1 + margin) * bound.value) - jnp.log(gains[bound.path]), 0.0) ** 2
    return total
