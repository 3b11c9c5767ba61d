"""Forces and flux of the machine of a case, without [spread]."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.cases.reader import Case
from ambjax.world.bearing import Bearing
from ambjax.world.sensor import Measurement


class Forces(NamedTuple):
    """Largest magnetic force, weight, and a bound on the disturbing force, all in N."""

    largest: float
    weight: float
    load: float

    @property
    def too_small(self) -> str:
        """Why the magnets cannot carry the rotor; empty if they can."""
        words = f"their largest force is {self.largest:.4g} N, below its weight of {self.weight:.4g} N"
        return f"the magnets cannot carry the rotor: {words}" if self.largest < self.weight else ""


def forces(case: Case) -> Forces:
    """Return the forces of a case, for the plant without [spread].

    The largest force is `Scenario.largest_force`. The load is the sum of the bounds of all signals that disturb z.
    """
    scenario, plant = case.scenario.turning(), case.scenario.plant
    m, largest = float(plant.m), float(scenario.largest_force)
    factors = {"q_z": m, "q_v": m * float(plant.a), "q_f": 1.0, "base": m}
    signals = {slot: signal for slot in factors if (signal := getattr(scenario, slot)) is not None}
    ends = {slot: signal.span(float(case.clock.duration)) for slot, signal in signals.items()}
    load = sum(factors[slot] * max(abs(low), abs(high)) for slot, (low, high) in ends.items())
    return Forces(largest, m * abs(float(plant.g)), load)


@jax.jit
def linear_magnet(plant: Bearing) -> tuple[Array, Array, Array, Array]:
    """Return numbers of the true magnets at z = i = 0, with the saturation and the leakage of their iron.

    They are k_s, the negative stiffness, N/m; k_i, the force per current, N/A; L, the voltage per rate of the current,
    H; and the flux density of the cores, T.
    """
    zero = jnp.zeros(())
    rest = plant.start(Measurement(zero, zero, zero))

    def force(z: Array, i: Array) -> Array:
        return plant.m * plant.a * plant.pull((plant.i_0 + i, plant.i_0 - i), z)

    def rate(u: Array) -> Array:
        return plant.measurement(plant.rates(rest, u)).i

    k_s, k_i = jax.grad(force, (0, 1))(zero, zero)
    return k_s, k_i, 1 / jax.grad(rate)(zero), plant.flux_density(rest)
