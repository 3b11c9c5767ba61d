"""Linearisation of the closed loop at an equilibrium: of the map of one sample period, or of the vector field."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import Sample
from ambjax.linear.equilibrium import Equilibrium, Point, at_rest, equilibrium, ideal, reading, sizes_of
from ambjax.linear.state_space import CommandPath, StateSpace
from ambjax.numerics.records import Scalar
from ambjax.numerics.small_matrices import held
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


class LagState(NamedTuple):
    """State of the plant, of the sensor's low-pass (m) and of the amplifier (V); () for a missing lag."""

    plant: Any
    z_filtered: Array | tuple[()]
    u_a: Array | tuple[()]

    def read(self, scenario: Scenario, injected: tuple[Scalar, Scalar]) -> Measurement:
        """Return the readings plus `injected`: test signals on z (m) and z_dot (m/s)."""
        motion = scenario.plant.measurement(self.plant)
        if not isinstance(self.z_filtered, tuple):
            motion = motion._replace(z=self.z_filtered)
        return reading(scenario, motion, injected)

    def lag_rates(self, scenario: Scenario, u: Array) -> tuple["LagState", Array]:
        """Return the rates of the lags under a command u (V or A), without the plant's, and the amplifier's output."""
        rates, bandwidth = LagState((), (), ()), scenario.sensors.bandwidth
        if bandwidth is not None:
            z = scenario.plant.measurement(self.plant).z
            rates = rates._replace(z_filtered=2 * jnp.pi * bandwidth * (z - jnp.asarray(self.z_filtered)))
        if isinstance(self.u_a, tuple):
            return rates, u
        return rates._replace(u_a=scenario.actuator.slope() * (u - self.u_a)), self.u_a


def with_lags(scenario: Scenario, point: Point) -> LagState:
    """Return the state of plant and lags at rest. `point`: an equilibrium, or the sizes of its components."""
    low_passed, z = scenario.sensors.bandwidth is not None, scenario.plant.measurement(point.plant).z
    return LagState(point.plant, z if low_passed else (), point.u if scenario.actuator.slow else ())


class Lagged:
    """The plant of a scenario with the lags of sensor and amplifier; its state, a `LagState`, is one vector [N]."""

    def __init__(self, scenario: Scenario, point: Point):
        self.scenario = scenario
        self.start, self.restore = ravel_pytree(with_lags(scenario, point))

    def rates(self, x: Array, u: Scalar, q_z: Scalar) -> Array:
        """Return the time derivative of the state under a command u (V or A) and a disturbance q_z (m/s^2)."""
        state = self.restore(x)
        rates, u = state.lag_rates(self.scenario, u)
        u = self.scenario.coil_voltage(jnp.asarray(u), state.plant)
        return ravel_pytree(rates._replace(plant=self.scenario.plant.rates(state.plant, u, q_z)))[0]

    def voltage(self, x: Array, commands: tuple[Array, ...], delay: Scalar) -> Array:
        """Return the voltage (V) of a sample: the command u_n, or for current commands the coil voltage at the sample.

        `commands`: u_n, u_{n-1} and so on (V or A). `delay`: in samples.
        """
        if self.scenario.drive != "current":
            return commands[0]
        return self.scenario.coil_voltage(at_sample(commands, jnp.asarray(delay)), self.restore(x).plant)

    def held(self, point: Point, period: Scalar, delay: Scalar, kept: int) -> HeldPlant:
        """Return the linear map of one sample at the equilibrium `point`.

        `delay`: samples after which the voltage of a sample begins to act.
        """
        A, B = jax.jacfwd(lambda x, w: self.rates(x, w[0], w[1]), (0, 1))(
            self.start, jnp.stack([point.u, 0.0 * point.u])
        )
        path = CommandPath(A, B[:, 0], jnp.asarray(delay))
        driven = jnp.stack(path.effects(jnp.asarray(period), kept))
        transition, disturbed = held(A, B[:, 1:], period)
        return HeldPlant(transition, driven, disturbed[:, 0], path)


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
        state = plant.restore(at)
        measured = state.read(scenario, (w[0], w[1]))
        sample = Sample(reference, period, jnp.asarray(jnp.inf), past)
        command, after, _ = cascade.step(measured, restore(laws), sample)
        commands = jnp.stack([command.u, *past])
        moved = held.transition @ at + commands @ held.driven + held.disturbed * w[2]
        after = jnp.concatenate([moved, ravel_pytree(after)[0], commands[: len(past)]])
        u = plant.voltage(at, (command.u, *past), processor.delay)
        z = scenario.plant.measurement(state.plant).z
        return after, jnp.stack([measured.z, measured.z_dot, u, z, command.u, measured.i])

    x = ravel_pytree((plant.start, laws, past))[0]
    (A, B), (C, D) = jax.jacfwd(step, (0, 1))(x, jnp.zeros(3, x.dtype))
    sizes = sizes_of(cascade, scenario, point)
    scale = ravel_pytree((with_lags(scenario, sizes), sizes.control, processor.constant_past(sizes.u)))[0]
    return StateSpace(A, B, C, D, scale, jnp.asarray(period), held.path)
