"""Equilibrium of the closed loop under a constant reference.

In equilibrium no state changes: the plant rests under a constant command, and the laws return this command. Noise,
runout, disturbances, converters, faults, the guard, the stop, the limits of supply and amplifier, and the dead band are
left out.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.numerics.linear import choose
from ambjax.numerics.records import Scalar
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors, Measurement
from ambjax.world.waveforms import Constant, Reference, reference_at

# Largest number of Newton trials. Near the equilibrium, five suffice; far outside the boundary layer of a sign, more.
STEPS = 200
# A Newton step is halved until the residual decreases. If the remaining fraction of the full step is below LEAVING, the
# method turns to the path of `newton_of`, unless its step along this path is at most SHORTEST. It ends below SMALLEST.
LEAVING, SMALLEST = 0.1, 1e-4
SHORTEST = 0.01
# Largest residual that counts as 0, relative to the sizes of the states, in units of the rounding error.
TOLERANCE = 1e7


class Point(NamedTuple):
    """State of the loop at an instant: state of the plant, states of the laws, and the command u (V or A) that acts."""

    plant: Any
    control: CascadeState
    u: Array


class Equilibrium(NamedTuple):
    """An equilibrium. `found`: whether Newton's method converged; if not, `point` is not an equilibrium.

    `residual`: residual before the last step, in the form of a `Point`, relative to the sizes of the states; without an
    equilibrium, that at `point`.
    """

    point: Point
    found: Array
    residual: Point

    def moving(self) -> str:
        """Return the path of the component with the largest residual, such as "control.position.integral"."""
        leaves = jax.tree_util.tree_leaves_with_path(self.residual)
        path, _ = max(leaves, key=lambda leaf: np.nan_to_num(abs(float(leaf[1])), nan=np.inf))
        return jax.tree_util.keystr(path, simple=True, separator=".")


def ideal(scenario: Scenario) -> Scenario:
    """Return the scenario without noise, runout, disturbances, converter, faults, limits and dead band.

    The sensor keeps its gain, offset and bandwidth, the amplifier its bandwidth.
    """
    scenario = scenario.undisturbed()
    sensor, amplifier = scenario.sensor, scenario.amplifier
    sensor, amplifier = sensor and sensor.linear(), amplifier and amplifier.linear()
    return dataclasses.replace(scenario, sensor=sensor, amplifier=amplifier, u_max=jnp.inf)


def reading(scenario: Scenario, motion: Measurement, injected: tuple[Scalar, Scalar]) -> Measurement:
    """Return the noise-free readings of a motion plus the test signals `injected` on z (m) and z_dot (m/s).

    The signal on z_dot has no effect if the velocity is not measured.
    """
    zero = jnp.zeros(())
    motion = scenario.sensors.reading(motion, Errors(zero, zero, zero))
    z_dot = motion.z_dot + injected[1] if scenario.sensors.velocity else motion.z_dot
    return motion._replace(z=motion.z + injected[0], z_dot=z_dot)


def at_rest(r: Scalar) -> Reference:
    """Return the constant reference r (m)."""
    return reference_at(Constant(r), 0.0)


def equilibrium(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> Equilibrium:
    """Compute the equilibrium at the constant reference r (m) by Newton's method (`newton_of`).

    - `cascade`: without a guard; if it has a processor, a result of `Cascade.on_processor`.
    - `scenario`: a result of `ideal`.
    - `period`: sample period, s; not used in continuous time.

    If the equilibrium is found, its derivatives with respect to gains and parameters are those of the implicit
    function; otherwise they have no meaning. A state that never changes, such as an integral whose gain is 0, keeps
    its initial value. The function is pure and works under jit and vmap.
    """
    start = start_of(cascade, scenario, period, r)
    flat, restore = ravel_pytree(start)
    sizes = ravel_pytree(sizes_of(cascade, scenario, start))[0]

    def residual(y: Array, cascade: Cascade, scenario: Scenario) -> Array:
        return _residual(cascade, scenario, period, r, restore(y * sizes))

    held = lax.stop_gradient((cascade, scenario))
    newton = newton_of(lambda y: residual(y, *held), lax.stop_gradient(flat / sizes))
    found = newton.error <= TOLERANCE * jnp.finfo(flat.dtype).eps
    # one more Newton step with a constant Jacobian: its derivative is that of the implicit function
    last = residual(newton.y, cascade, scenario)
    y = newton.y - jnp.where(found, inverse(newton.J) @ last, 0.0)
    return Equilibrium(restore(y * sizes), found, restore(lax.stop_gradient(last)))


class Newton(NamedTuple):
    """State of Newton's method for G(y) = `target` G(y_0), relative to the sizes of the states.

    - `y`, `error`, `J`: best point so far for this target, the size of G(y) - target G(y_0), and the Jacobian of G.
    - `direction`, `fraction`: the full step from `y`, and the fraction of it to try.
    - `trial`: the next point to evaluate.
    - `target`: 1 at the first point y_0, 0 at the equilibrium.
    - `reached`, `base`: the last target that was reached, and its solution.
    - `first`: G(y_0), from the first trial on.
    - `number`: trials so far.
    """

    y: Array
    error: Array
    J: Array
    direction: Array
    fraction: Array
    trial: Array
    target: Array
    reached: Array
    base: Array
    first: Array
    number: Array

    def begun(self, base: Array, reached: Array, target: Array) -> "Newton":
        """Return the method that begins at the solution `base` for `reached`, with another target."""
        inf = jnp.full_like(target, jnp.inf)
        return self._replace(trial=base, base=base, error=inf, reached=reached, target=target)


def newton_of(residual: Callable[[Array], Array], y: Array) -> Newton:
    """Return the last state of a damped Newton's method from y [N] on, for residual(y) = 0. It has no derivatives.

    Outside the boundary layer of a sign, the residual hardly depends on the argument of the sign, and the steps fail.
    Then the method follows the solutions of residual(y) = t residual(y_0) from the first point y_0, where t = 1, to
    t = 0. It halves the step of t if Newton's method fails, and doubles it otherwise (Newton homotopy).
    """
    tolerance = TOLERANCE * jnp.finfo(y.dtype).eps

    def both(y: Array) -> tuple[Array, Array]:
        G = residual(y)
        return G, G

    def evaluate(newton: Newton) -> Newton:
        J, G = jax.jacfwd(both, has_aux=True)(newton.trial)
        first = jnp.where(newton.number == 0, G, newton.first)
        G = G - newton.target * first
        better = _size(G) < newton.error
        y, J, error = choose(better, (newton.trial, J, _size(G)), (newton.y, newton.J, newton.error))
        direction = jnp.where(better, inverse(J) @ G, newton.direction)
        fraction = jnp.where(better, 1.0, 0.5 * newton.fraction)
        trial, number = y - fraction * direction, newton.number + 1
        after = Newton(y, error, J, direction, fraction, trial, *newton[6:9], first, number)
        step, solved = after.reached - after.target, error <= tolerance
        onward = after.begun(y, after.target, jnp.maximum(after.target - 2 * step, 0.0))
        back = after.begun(after.base, after.reached, after.target + step / 2)
        failed = ~solved & (fraction < LEAVING) & (step > SHORTEST)
        return choose(solved & (after.target > 0), onward, choose(failed, back._replace(fraction=one), after))

    def unfinished(newton: Newton) -> Array:
        return (newton.number < STEPS) & (newton.fraction > SMALLEST) & (newton.error > 0)

    one = jnp.ones_like(y[0])
    J = jnp.eye(y.size, dtype=y.dtype)
    begin = Newton(y, jnp.inf * one, J, 0 * y, one, y, 0 * one, one, y, 0 * y, jnp.asarray(0))
    return lax.stop_gradient(lax.while_loop(unfinished, evaluate, begin))


def _size(G: Array) -> Array:
    return jnp.where(jnp.all(jnp.isfinite(G)), jnp.max(jnp.abs(G)), jnp.inf)


def inverse(J: Array) -> Array:
    """Return the pseudo-inverse of a Jacobian, in which a state that never changes is held.

    The row of a state that never changes is 0: the equation dx = 0 replaces it. The other rows are divided by their
    largest entries. Singular values that are rounding errors count as 0, so that a law with an integral gain of 1e-20
    rests where the law without this integral does.
    """
    size = jnp.max(jnp.abs(J), 1)
    rows = jnp.where(size[:, None] > 0, J, jnp.eye(len(J), dtype=J.dtype))
    size = jnp.where(size > 0, size, 1.0)
    usable = jnp.all(jnp.isfinite(J))
    # a matrix with NaN stops the LAPACK routine
    scaled = jnp.where(usable, rows / size[:, None], jnp.eye(len(J), dtype=J.dtype))
    return jnp.where(usable, jnp.linalg.pinv(scaled) / size, jnp.nan)


def start_of(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> Point:
    """Return the first point of the iteration: the plant rests where the sensor reads r (m), the laws begin there.

    At another reading, or at the current that the model needs, a sign may begin outside its boundary layer.
    """
    plant, zero = scenario.plant, jnp.zeros(())

    def read(z: Array) -> Array:
        return reading(scenario, Measurement(z, zero, zero), (0.0, 0.0)).z

    shown, gain = jax.jvp(read, (zero + r,), (zero + 1.0,))
    z = r - (shown - r) / gain
    i, u = plant.equilibrium(z)
    zero = jnp.zeros_like(i)
    inversion = cascade.inversion.started(i)
    state = plant.start(Measurement(zero + z, zero, i))
    measured = reading(scenario, plant.measurement(state), (0.0, 0.0))
    cascade = dataclasses.replace(cascade, inversion=inversion, observer=cascade.observer.started(measured.z))
    control = jax.tree.map(lambda x: jnp.asarray(x, zero.dtype), cascade.init(measured))
    return Point(state, control, zero + (i if scenario.drive == "current" else u))


def sizes_of(cascade: Cascade, scenario: Scenario, point: Point) -> Point:
    """Return the characteristic size of each component of a point."""
    plant = scenario.plant
    u = jnp.asarray(plant.i_0 / 25)
    if scenario.drive == "voltage":
        u = (plant.R + plant.L * plant.pole) * u
    sizes = Point(plant.scale(), cascade.scale(), u)
    return jax.tree.map(lambda x, size: jnp.zeros_like(x) + size, point, sizes)


def _residual(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar, point: Point) -> Array:
    """Return the residual, which is 0 in equilibrium, relative to the sizes of the states.

    It consists of the rates of the plant, the rates of the laws (on a processor: their changes in a sample), and the
    difference between the command and u. Rates are multiplied by the time constant of the plant's pole.
    """
    plant, u_max = scenario.plant, jnp.asarray(jnp.inf)
    sizes = sizes_of(cascade, scenario, point)
    u = scenario.coil_voltage(point.u, point.plant) if scenario.drive == "current" else point.u
    moved = jax.tree.map(lambda x: x / plant.pole, plant.rates(point.plant, u))
    measured, reference = reading(scenario, plant.measurement(point.plant), (0.0, 0.0)), at_rest(r)
    sample = Sample(reference, None, u_max)
    if cascade.sampled:
        sample = Sample(reference, period, u_max, cascade.timing.constant_past(point.u))
    command, after, _ = cascade.step(measured, point.control, sample)
    control = jax.tree.map(lambda a, b: b - a if cascade.sampled else b / plant.pole, point.control, after)
    change = Point(moved, control, command.u - point.u)
    return ravel_pytree(jax.tree.map(lambda x, size: x / size, change, sizes))[0]
