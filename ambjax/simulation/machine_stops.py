"""Stops of a machine at places of their own: where the rotor is lost, and the forces of elastic stops.

The functions take the machine: `simulation.whole_machine.Machine`.
"""

import dataclasses
from typing import Protocol

import jax
import jax.numpy as jnp
from jax import Array

from ambjax.numerics.small_matrices import times
from ambjax.simulation.joint_laws import Grouped
from ambjax.simulation.loop import ClosedLoop
from ambjax.world.rotor import Rotor
from ambjax.world.scenario import POLE, Scenario
from ambjax.world.sensor import Measurement


class Stopped(Grouped, Protocol):
    """A machine with a rotor."""

    @property
    def rotor(self) -> Rotor: ...
    def plants(self, name: str) -> Array: ...


def limited(machine: Stopped) -> tuple[Array, Array]:
    """Return the rows [k, n] of the places at which |displacement| is limited, and the limits [k], m.

    The first c are those of `Scenario.limit`: at the stops, or at the magnets if the stops are elastic. Beside rigid
    stops at places of their own, the magnets limit the displacement too.
    """
    rotor, scenarios = machine.rotor, [loop.scenario for loop in machine.loops()]
    limits = machine.join([jnp.asarray(one.limit) for one in scenarios])
    if rotor.at_stops is None or scenarios[0].stop is not None:
        return rotor.at_magnets, limits
    return jnp.concatenate([rotor.at_stops, rotor.at_magnets]), jnp.concatenate([limits, POLE * machine.plants("s_0")])


def between_stops(machine: Stopped, loop: ClosedLoop) -> ClosedLoop:
    """Return the loop of an axis without an elastic stop at a place of its own: `stop_forces` has its force."""
    if machine.rotor.at_stops is None:
        return loop
    return dataclasses.replace(loop, scenario=dataclasses.replace(loop.scenario, stop=None))


def stop_forces(machine: Stopped, q: Array, q_dot: Array) -> Array | None:
    """Return the forces [n] of elastic stops at places of their own on the coordinates; None without such stops."""
    rows, scenarios = machine.rotor.at_stops, tuple(loop.scenario for loop in machine.loops())
    if rows is None or scenarios[0].stop is None:
        return None

    def one(scenario: Scenario, z: Array, z_dot: Array) -> Array:
        assert scenario.stop is not None
        return scenario.stop.force(Measurement(z, z_dot, jnp.zeros_like(z)), scenario.touchdown)

    motion = machine.split(times(rows, q)), machine.split(times(rows, q_dot))
    forces = machine.join([jax.vmap(one)(*own) for own in zip(scenarios, *motion, strict=True)])
    return jnp.sum(rows * forces[:, None], 0)
