"""Linearisation of the closed loop at an equilibrium: of the map of one sample period, or of the vector field."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import Sample
from ambjax.linear.equilibrium import Equilibrium, Point, at_rest, equilibrium, ideal, reading, sizes_of
from ambjax.linear.state_space import CommandPath, StateSpace
from ambjax.numerics.records import Scalar
from ambjax.numerics.small_matrices import exponential
from ambjax.simulation.between import at_sample
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement


class HeldPlant(NamedTuple):
    """Linear map of one sample, x_{n+1} = transition x_n + sum over k of driven[k] u_{n-k} + disturbed q_z.

    x [N] is the state of the plant, of the sensor's low-pass (m) and of the amplifier (V). `transition` is [N, N],
    `driven` [K + 1, N] for K past commands, and `disturbed` [N]. x and u are deviations from the equilibrium. q_z
    (m/s^2) is constant during the sample. `path`: the rates of x under a command.
    """

    transition: Array
    driven: Array
    disturbed: Array
    path: CommandPath


class Lagged:
    """The plant of a scenario with the lags of sensor and amplifier; its state is one vector [N]."""

    def __init__(self, scenario: Scenario, point: Point):
        self.scenario = scenario
        self.low_passed = scenario.sensors.bandwidth is not None
        self.lagged = scenario.actuator.slow
        z = scenario.plant.measurement(point.plant).z
        lags = [z] * self.low_passed + [point.u] * self.lagged
        self.start, self.restore = ravel_pytree((point.plant, lags))

    def motion(self, x: Array) -> Measurement:
        """Return the true motion and current in a state."""
        return self.scenario.plant.measurement(self.restore(x)[0])

    def read(self, x: Array, injected: tuple[Scalar, Scalar]) -> Measurement:
        """Return the readings in a state plus `injected`: test signals on z (m) and z_dot (m/s)."""
        plant, lags = self.restore(x)
        motion = self.scenario.plant.measurement(plant)
        return reading(self.scenario, motion._replace(z=lags[0]) if self.low_passed else motion, injected)

    def rates(self, x: Array, u: Scalar, q_z: Scalar) -> Array:
        """Return the time derivative of the state under a command u (V or A) and a disturbance q_z (m/s^2)."""
        (plant, lags), sensor, amplifier, lag_rates = self.restore(x), self.scenario.sensors, self.scenario.actuator, []
        if sensor.bandwidth is not None:
            z = self.scenario.plant.measurement(plant).z
            lag_rates.append(2 * jnp.pi * sensor.bandwidth * (z - lags[0]))
        if self.lagged:
            lag_rates.append(amplifier.slope() * (u - lags[-1]))
            u = lags[-1]
        u = self.scenario.coil_voltage(jnp.asarray(u), plant)
        return ravel_pytree((self.scenario.plant.rates(plant, u, q_z), lag_rates))[0]

    def voltage(self, x: Array, commands: tuple[Array, ...], delay: Scalar) -> Array:
        """Return the voltage (V) of a sample: the command u_n, or for current commands the coil voltage at the sample.

        `commands`: u_n, u_{n-1} and so on (V or A). `delay`: in samples.
        """
        if self.scenario.drive != "current":
            return commands[0]
        return self.scenario.coil_voltage(at_sample(commands, jnp.asarray(delay)), self.restore(x)[0])

    def sizes(self, sizes: Point) -> Array:
        """Return the characteristic sizes [N] of the state. `sizes`: those of a `Point`."""
        z = self.scenario.plant.measurement(sizes.plant).z
        lags = [z] * self.low_passed + [sizes.u] * self.lagged
        return ravel_pytree((sizes.plant, lags))[0]

    def held(self, point: Point, period: Scalar, delay: Scalar, kept: int) -> HeldPlant:
        """Return the linear map of one sample at the equilibrium `point`.

        `delay`: samples after which the voltage of a sample begins to act.
        """
        A, B = jax.jacfwd(lambda x, w: self.rates(x, w[0], w[1]), (0, 1))(
            self.start, jnp.stack([point.u, 0.0 * point.u])
        )
        path = CommandPath(A, B[:, 0], jnp.asarray(delay))
        driven = jnp.stack(path.effects(jnp.asarray(period), kept))
        transition, disturbed = _integrated(A, B[:, 1], period)
        return HeldPlant(transition, driven, disturbed, path)


def _integrated(A: Array, b: Array, h: Scalar) -> tuple[Array, Array]:
    """Return exp(A h), and the integral of exp(A t) b over t from 0 to h (s)."""
    n = len(b)
    table = jnp.zeros((n + 1, n + 1), A.dtype).at[:n].set(jnp.concatenate([A, b[:, None]], 1) * h)
    whole = exponential(table)
    return whole[:n, :n], whole[:n, n]


def loop_matrices(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> tuple[StateSpace, Array]:
    """Linearise the loop at the equilibrium of the constant reference r (m).

    - `cascade`: a result of `Cascade.on_processor` if it has a processor. The guard is left out.
    - `scenario`: the function removes what a linear system cannot contain (`ideal`).
    - `period`: sample period, s; not used in continuous time.

    The function is pure, works under jit and vmap, and is differentiable in all gains and parameters. Returns the state
    space, and whether an equilibrium was found and the processor supports its delay (`Cascade.on_processor`); if not,
    the matrices have no meaning. They are not finite if a law has no derivative at the equilibrium.
    """
    cascade, scenario = _linear_parts(cascade, scenario)
    point, found, _ = equilibrium(cascade, scenario, period, r)
    build = _sampled if cascade.sampled else _continuous
    return build(cascade, scenario, period, r, point), found & cascade.timing.supported()


def rest(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> Equilibrium:
    """Return the equilibrium at which `loop_matrices` linearises the loop. The arguments are those of that function."""
    return equilibrium(*_linear_parts(cascade, scenario), period, r)


def _linear_parts(cascade: Cascade, scenario: Scenario) -> tuple[Cascade, Scenario]:
    """Return the cascade without its guard, at the speed of t = 0, and the scenario as a linear system contains it."""
    cascade = cascade.turning(scenario.rotor).at_speed()
    return cascade.with_processor(guard=None), ideal(scenario)


def _continuous(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar, point: Point) -> StateSpace:
    """Return the state space in continuous time, with the state (plant, laws)."""
    plant, reference = scenario.plant, at_rest(r)
    x, restore = ravel_pytree((point.plant, point.control))

    def system(x: Array, w: Array) -> tuple[Array, Array]:
        state, control = restore(x)
        measured = reading(scenario, plant.measurement(state), (w[0], w[1]))
        command, rates = cascade(measured, control, reference, jnp.asarray(jnp.inf))
        u = scenario.coil_voltage(command.u, state)
        outputs = jnp.stack([measured.z, measured.z_dot, u, plant.measurement(state).z, command.u, measured.i])
        moved = plant.rates(state, u, w[2])
        return ravel_pytree((moved, rates))[0], outputs

    def driven(u: Array) -> Array:
        return ravel_pytree(plant.rates(point.plant, scenario.coil_voltage(u, point.plant)))[0]

    (A, B), (C, D) = jax.jacfwd(system, (0, 1))(x, jnp.zeros(3, x.dtype))
    sizes, b = sizes_of(cascade, scenario, point), jax.jacfwd(driven)(point.u)
    # in continuous time, the path does not use its A
    path = CommandPath(jnp.zeros((len(b), len(b)), b.dtype), b, jnp.zeros_like(point.u))
    return StateSpace(A, B, C, D, ravel_pytree((sizes.plant, sizes.control))[0], None, path)


def _sampled(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar, point: Point) -> StateSpace:
    """Return the state space of one sample period, with the state (plant and lags, laws, u_{n-1}, u_{n-2}, ...)."""
    processor, plant, reference = cascade.timing, Lagged(scenario, point), at_rest(r)
    past = processor.constant_past(point.u)
    held = plant.held(point, period, processor.delay, len(past))
    laws, restore = ravel_pytree(point.control)
    nx, nl = plant.start.size, laws.size

    def step(x: Array, w: Array) -> tuple[Array, Array]:
        at, laws, past = x[:nx], x[nx : nx + nl], tuple(x[nx + nl :])
        measured = plant.read(at, (w[0], w[1]))
        sample = Sample(reference, period, jnp.asarray(jnp.inf), past)
        command, after, _ = cascade.step(measured, restore(laws), sample)
        commands = jnp.stack([command.u, *past])
        moved = held.transition @ at + commands @ held.driven + held.disturbed * w[2]
        after = jnp.concatenate([moved, ravel_pytree(after)[0], commands[: len(past)]])
        u = plant.voltage(at, (command.u, *past), processor.delay)
        return after, jnp.stack([measured.z, measured.z_dot, u, plant.motion(at).z, command.u, measured.i])

    x = ravel_pytree((plant.start, laws, past))[0]
    (A, B), (C, D) = jax.jacfwd(step, (0, 1))(x, jnp.zeros(3, x.dtype))
    sizes = sizes_of(cascade, scenario, point)
    scale = ravel_pytree((plant.sizes(sizes), sizes.control, processor.constant_past(sizes.u)))[0]
    return StateSpace(A, B, C, D, scale, jnp.asarray(period), held.path)
