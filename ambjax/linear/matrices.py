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
    return _state_space(cascade, scenario, period, r, point), found & cascade.timing.supported()


def rest(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> Equilibrium:
    """Return the equilibrium at which `loop_matrices` linearises the loop. The arguments are those of that function."""
    return equilibrium(*_linear_parts(cascade, scenario), period, r)


def _linear_parts(cascade: Cascade, scenario: Scenario) -> tuple[Cascade, Scenario]:
    """Return the cascade without its guard, at the speed of t = 0, and the scenario as a linear system contains it."""
    cascade = cascade.turning(scenario.rotor).at_speed()
    return cascade.with_processor(guard=None), ideal(scenario)


def _state_space(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar, point: Point) -> StateSpace:
    """Return the state space, with the state (plant and lags, laws, u_{n-1}, u_{n-2}, ...)."""
    processor, plant, reference = cascade.timing, scenario.plant, at_rest(r)
    start, lags = ravel_pytree(with_lags(scenario, point))
    tick, delay = jnp.asarray(period) if cascade.sampled else None, jnp.asarray(processor.delay)
    past = () if tick is None else processor.constant_past(point.u)
    x, restore = ravel_pytree((start, point.control, past))

    def rates(x: Array, w: Array) -> Array:
        """Return the rates of plant and lags under a command and a disturbance q_z, w [2]."""
        state = lags(x)
        moving, u = state.lag_rates(scenario, w[0])
        u = scenario.coil_voltage(u, state.plant)
        return ravel_pytree(moving._replace(plant=plant.rates(state.plant, u, w[1])))[0]

    inputs = jnp.stack([point.u, 0.0 * point.u])
    if tick is None:  # then the path does not use its A
        A, B = jnp.zeros((start.size, start.size), start.dtype), jax.jacfwd(rates, 1)(start, inputs)
    else:
        A, B = jax.jacfwd(rates, (0, 1))(start, inputs)
    path, transition, driven, disturbed = CommandPath(A, B[:, 0], delay), A, B, B
    if tick is not None:
        driven = jnp.stack(path.effects(tick, len(past)))
        transition, disturbed = held(A, B[:, 1:], tick)

    def step(x: Array, w: Array) -> tuple[Array, Array]:
        at, laws, past = restore(x)
        state = lags(at)
        measured = state.read(scenario, (w[0], w[1]))
        command, after, _ = cascade.step(measured, laws, Sample(reference, tick, jnp.asarray(jnp.inf), past))
        commands = command.u, *past
        if tick is None:
            moved = rates(at, jnp.stack([command.u, w[2]]))
        else:
            moved = transition @ at + jnp.stack(commands) @ driven + disturbed[:, 0] * w[2]
        u = command.u
        if scenario.drive == "current":
            u = scenario.coil_voltage(at_sample(commands, delay), state.plant)
        outputs = jnp.stack([measured.z, measured.z_dot, u, plant.measurement(state.plant).z, command.u, measured.i])
        return ravel_pytree((moved, after, commands[: len(past)]))[0], outputs

    (A, B), (C, D) = jax.jacfwd(step, (0, 1))(x, jnp.zeros(3, x.dtype))
    sizes = sizes_of(cascade, scenario, point)
    scale = ravel_pytree((with_lags(scenario, sizes), sizes.control, (sizes.u,) * len(past)))[0]
    return StateSpace(A, B, C, D, scale, tick, path)
