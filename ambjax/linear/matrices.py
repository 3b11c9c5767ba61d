"""Linearisation of the closed loop at an equilibrium: of the map of one sample period, or of the vector field."""

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import Sample
from ambjax.linear.equilibrium import Equilibrium, Point, at_rest, equilibrium, ideal, reading, sizes_of
from ambjax.linear.held_plant import Lagged
from ambjax.linear.state_space import CommandPath, StateSpace
from ambjax.numerics.records import Scalar
from ambjax.world.scenario import Scenario


def loop_matrices(cascade: Cascade, scenario: Scenario, period: Scalar, r: Scalar) -> tuple[StateSpace, Array]:
    """Linearise the loop at the equilibrium of the constant reference r (m).

    - `cascade`: a result of `Cascade.on_processor` if it has a processor. The guard is left out.
    - `scenario`: the function removes what a linear system cannot contain (`ideal`).
    - `period`: sample period, s; not used in continuous time.

    The function is pure, works under jit and vmap, and is differentiable in all gains and parameters. Returns the state
    space, and whether an equilibrium was found; if not, the matrices have no meaning. They are not finite if a law has
    no derivative at the equilibrium.
    """
    cascade, scenario = _linear_parts(cascade, scenario)
    point, found, _ = equilibrium(cascade, scenario, period, r)
    build = _sampled if cascade.sampled else _continuous
    return build(cascade, scenario, period, r, point), found


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
        u = plant.voltage(at, command.u)
        return after, jnp.stack([measured.z, measured.z_dot, u, plant.motion(at).z, command.u, measured.i])

    x = ravel_pytree((plant.start, laws, past))[0]
    (A, B), (C, D) = jax.jacfwd(step, (0, 1))(x, jnp.zeros(3, x.dtype))
    sizes = sizes_of(cascade, scenario, point)
    scale = ravel_pytree((plant.sizes(sizes), sizes.control, processor.constant_past(sizes.u)))[0]
    return StateSpace(A, B, C, D, scale, jnp.asarray(period), held.path)
