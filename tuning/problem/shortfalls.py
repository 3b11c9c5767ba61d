"""The conditions of Theorem 1: lower bounds of the gains, and a penalty for gains below them."""

import dataclasses
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Cascade
from ambjax.extend import Scalar
from ambjax.simulation.clock import Clock
from ambjax.theorem.conditions import delta_1_on_reference, required
from ambjax.world.scenario import Scenario


@dataclasses.dataclass(frozen=True)
class Bound:
    """Condition: the gain at `path` exceeds `value`. `symbol`: name of the value in the paper. `unit`: unit of both."""

    path: str
    value: float
    symbol: str
    unit: str


def bounds(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[Bound, ...]:
    """Return the lower bounds k > Q_z, k_i > Q_i and gamma > Delta_1 (Eq. 7) of the laws' gains.

    Delta_1 is evaluated on the ideal motion z = r. Q_z and Q_i are maxima over the samples of the clock.
    """
    t = jnp.arange(clock.samples) * clock.sample_period

    def largest(signal: Callable[[Array], Array]) -> float:
        return float(np.max(np.abs(np.asarray(jax.vmap(signal)(t)))))

    sides = {
        "Q_z": lambda: largest(scenario.acceleration),
        "Q_i": lambda: largest(scenario.q_i),
        "Delta_1": lambda: delta_1_on_reference(cascade, scenario, clock)[0],
    }
    valued = [one for one in required(cascade) if one.value is not None]
    return tuple(Bound(one.path, sides[one.over](), one.over, one.unit) for one in valued)


def shortfall(gains: Mapping[str, Array], bounds: tuple[Bound, ...], margin: Scalar) -> Array:
    """Return the sum of max(0, log((1 + margin) bound / gain))^2 over the gains that have a bound. `gains`: by path.

    The bound of a scheduled gain applies to each of its knots. The sum is 0 if every condition holds with the
    relative margin `margin`.
    """
    total = jnp.zeros(())
    for bound in bounds:
        own = [gain for path, gain in gains.items() if path == bound.path or path.startswith(f"{bound.path}.")]
        for gain in own if bound.value > 0 else []:
            total = total + jnp.maximum(jnp.log((1 + margin) * bound.value) - jnp.log(gain), 0.0) ** 2
    return total
