"""Equilibrium of the closed loop under a constant reference, and the loop's equations around it.

In equilibrium no state moves: the plant rests under a constant voltage, and the laws repeat their command. Noise,
disturbances, converters, faults, the limits of the supply and of the amplifier, and its dead band are left out.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade, CascadeState, Sample
from ambjax.numerics.records import Scalar
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors, Measurement
from ambjax.world.signals import Constant, Reference, reference_at

# Newton steps. From a start near the equilibrium five suffice; a smoothed sign far from its layer needs more.
STEPS = 60
# A step is halved until the residual falls; the iteration ends with a step below this fraction.
SMALLEST = 1e-4
# Largest residual of an equilibrium, relative to the sizes of the states, in units of the rounding error.
TOLERANCE = 1e7


class Point(NamedTuple):
    """State of the loop at an instant: of the plant and of the laws, and the voltage u (V) that acts."""

    plant: Any
    control: CascadeState
    u: Array


class Equilibrium(NamedTuple):
    """An equilibrium. `found`: whether Newton's method converged to it."""

    point: Point
    found: Array


def ideal(scenario: Scenario) -> Scenario:
    """Return the scenario without noise, disturbance, converter, faults and limits; sensor and amplifier keep theirs.

    What remains of the sensor is its gain, its offset and its bandwidth; of the amplifier its bandwidth.
    """
    sensor, amplifier, none = scenario.sensor, scenario.amplifier, Constant()
    if sensor is not None:
        sensor = dataclasses.replace(sensor.louder(0.0), bits=None, outliers=None, dropouts=None)
    if amplifier is not None:
        amplifier = dataclasses.replace(amplifier, slew=None, dead_band=None, i_max=None)
        amplifier = None if amplifier.bandwidth is None else amplifier
    quiet = {"q_z": none, "q_v": none, "q_i": none, "u_max": jnp.inf}
    return dataclasses.replace(scenario, sensor=sensor, amplifier=amplifier, **quiet)


def reading(scenario: Scenario, motion: Measurement, injected: tuple[Scalar, Scalar]) -> Measurement:
    """Return what the controller reads of a motion, with numbers added to z (m) and z_dot (m/s)."""
    zero = jnp.zeros(())
    if scenario.sensor is not None:
        motion = scenario.sensor.reading(motion, Errors(zero, zero, zero))
    z_dot = motion.z_dot + injected[1]
    if scenario.sensor is not None and not scenario.sensor.velocity:
        z_dot = motion.z_dot
    return motion._replace(z=motion.z + injected[0], z_dot=z_dot)


def at_rest(r: Scalar) -> Reference:
    """Return the constant reference r (m)."""
    return reference_at(Constant(r), 0.0)


def equilibrium(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> Equilibrium:
    """Compute the equilibrium at the constant reference r (m) by damped Newton steps.

    `cascade`: resolved for its processor, without a guard. `scenario`: `ideal`. Derivatives with respect to gains and
    parameters are those of the implicit function. Pure; works under jit and vmap.
    """
    start = _start(cascade, scenario, period, r)
    flat, restore = ravel_pytree(start)
    sizes = ravel_pytree(sizes_of(cascade, scenario, start))[0]

    def residual(y: Array, cascade: Cascade, scenario: Scenario) -> Array:
        return _residual(cascade, scenario, period, r, restore(y * sizes))

    held = lax.stop_gradient((cascade, scenario))

    def both(y: Array) -> tuple[Array, Array]:
        G = residual(y, *held)
        return G, G

    def evaluate(newton: _Newton) -> _Newton:
        J, G = jax.jacfwd(both, has_aux=True)(newton.trial)
        better = _size(G) < newton.error
        direction = jnp.where(better, jnp.linalg.solve(J, G), newton.direction)
        fraction = jnp.where(better, 1.0, 0.5 * newton.fraction)
        y, J = jnp.where(better, newton.trial, newton.y), jnp.where(better, J, newton.J)
        error = jnp.where(better, _size(G), newton.error)
        return _Newton(y, error, J, direction, fraction, y - fraction * direction, newton.number + 1)

    def unfinished(newton: _Newton) -> Array:
        return (newton.number < STEPS) & (newton.fraction > SMALLEST) & (newton.error > 0)

    y = lax.stop_gradient(flat / sizes)
    one = jnp.ones_like(y[0])
    first = _Newton(y, jnp.inf * one, jnp.eye(y.size, dtype=y.dtype), 0 * y, one, y, jnp.asarray(0))
    newton = lax.stop_gradient(lax.while_loop(unfinished, evaluate, first))
    found = newton.error <= TOLERANCE * jnp.finfo(y.dtype).eps
    # one more step, differentiated with the Jacobian held: the derivative of the implicit function
    y = newton.y - jnp.where(found, jnp.linalg.solve(newton.J, residual(newton.y, cascade, scenario)), 0.0)
    return Equilibrium(restore(y * sizes), found)


class _Newton(NamedTuple):
    """State of Newton's method: best point, its error and Jacobian, the step from it, and the next trial."""

    y: Array
    error: Array
    J: Array
    direction: Array
    fraction: Array
    trial: Array
    number: Array


def _size(G: Array) -> Array:
    """Return the largest residual; inf if one is not finite."""
    return jnp.where(jnp.all(jnp.isfinite(G)), jnp.max(jnp.abs(G)), jnp.inf)


def _start(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> Point:
    """Return the plant at rest at r (m), and the laws at their start, with the reference current of the model there."""
    plant, inversion = scenario.plant, cascade.inversion.started(cascade.model.equilibrium(r)[0])
    i, u = plant.equilibrium(r)
    zero = jnp.zeros_like(i)
    state = plant.start(Measurement(zero + r, zero, i))
    measured = reading(scenario, plant.measurement(state), (0.0, 0.0))
    cascade = dataclasses.replace(cascade, inversion=inversion, observer=cascade.observer.started(measured.z))
    control = jax.tree.map(lambda x: jnp.asarray(x, zero.dtype), cascade.init(measured))
    return Point(state, control, zero + u)


def sizes_of(cascade: Cascade, scenario: Scenario, point: Point) -> Point:
    """Return the characteristic size of each number of a point."""
    plant = scenario.plant
    u = jnp.asarray((plant.R + plant.L * plant.pole) * plant.i_0 / 25)
    sizes = Point(plant.scale(), cascade.scale(), u)
    return jax.tree.map(lambda x, size: jnp.zeros_like(x) + size, point, sizes)


def _residual(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar, point: Point) -> Array:
    """Return the rates, or on a processor the changes in a sample, relative to the sizes; all are 0 in equilibrium."""
    plant, u_max = scenario.plant, jnp.asarray(jnp.inf)
    sizes = sizes_of(cascade, scenario, point)
    moved = jax.tree.map(lambda x: x / plant.pole, plant.rates(point.plant, point.u))
    measured, reference = reading(scenario, plant.measurement(point.plant), (0.0, 0.0)), at_rest(r)
    if cascade.processor is None:
        command, rates = cascade(measured, point.control, reference, u_max)
        control = jax.tree.map(lambda x: x / plant.pole, rates)
    else:
        command, after, _ = cascade.step(measured, point.control, Sample(reference, period, u_max, (point.u, point.u)))
        control = jax.tree.map(lambda a, b: b - a, point.control, after)
    change = Point(moved, control, command.u - point.u)
    return ravel_pytree(jax.tree.map(lambda x, size: x / size, change, sizes))[0]
