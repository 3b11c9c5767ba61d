"""The linear system of a whole machine at rest and constant speed."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.linear.equilibrium import TOLERANCE
from ambjax.linear.machine_at_speed import Groups, MachineAtSpeed, MachineRest, plants_of
from ambjax.linear.state_space import CommandPath, StateSpace
from ambjax.numerics.small_matrices import exponential, times
from ambjax.world.sensor import Measurement

# The machine at rest and the sizes of its states, and both for the vector of the states other than those of the laws.
AtRest = tuple[MachineRest, MachineRest, Array, Array]


def rests(own: MachineAtSpeed, point: MachineRest) -> Array:
    """Return whether the machine rests at a point."""
    deviation = own.deviation(point, ravel_pytree(own.start()[1])[0])
    return jnp.max(jnp.abs(deviation)) <= TOLERANCE * jnp.finfo(deviation.dtype).eps


def machine_matrices(own: MachineAtSpeed, point: MachineRest) -> tuple[StateSpace, Array]:
    """Return the state space at a point, and its A under constant commands."""
    sizes = own.start()[1]
    amplified = tuple(u if on else () for u, on in zip(point.u, own.lagged, strict=True))
    body, restore = ravel_pytree((point.q, jnp.zeros_like(point.q), point.plant, own.sensed(point.q), amplified))
    fastest = jnp.max(own.machine.join([scenario.plant.pole for scenario in own.scenario]))
    low = own.machine.split(times(jnp.abs(own.rotor.at_sensors), sizes.q))
    lag_sizes = tuple(x if on else () for x, on in zip(low, own.low_passed, strict=True))
    u_sizes = tuple(x if on else () for x, on in zip(sizes.u, own.lagged, strict=True))
    body_sizes = ravel_pytree((sizes.q, sizes.q * fastest, sizes.plant, lag_sizes, u_sizes))[0]

    def moved(x: Array, u: Groups) -> Array:
        q, q_dot, plant, filtered, voltage = restore(x)
        z_rates, u_rates, applied = [], [], []
        for k, (scenario, z) in enumerate(zip(own.scenario, own.sensed(q), strict=True)):
            bandwidth, amplifier = scenario.sensors.bandwidth, scenario.actuator
            low = () if bandwidth is None else 2 * jnp.pi * jnp.asarray(bandwidth)
            z_rates.append(() if isinstance(low, tuple) else low * (z - filtered[k]))
            slow = own.lagged[k]
            u_rates.append(jnp.asarray(amplifier.slope()) * (u[k] - voltage[k]) if slow else ())
            applied.append(voltage[k] if slow else u[k])
        after = own.rates(q, q_dot, plant, tuple(applied))
        return ravel_pytree((after.q, after.q_dot, plants_of(after.axes), tuple(z_rates), tuple(u_rates)))[0]

    def read(x: Array, e: Array) -> list[Measurement]:
        q, q_dot, plant, filtered, _ = restore(x)
        return own.read(q, q_dot, plant, filtered, own.machine.split(e))

    u = own.machine.join(point.u)
    free = jax.jacfwd(lambda x, u: moved(x, own.machine.split(u)), (0, 1))(body, u)
    if own.sampled:
        ((A, B), (C, D)), scale = _sampled(own, (point, sizes, body, body_sizes), free, read)
    else:
        ((A, B), (C, D)), scale = _continuous(own, (point, sizes, body, body_sizes), moved, read)
    return StateSpace(A, B, C, D, scale, jnp.asarray(own.period) if own.sampled else None), free[0]


def _outputs(own: MachineAtSpeed, measured: Sequence[Measurement], u: Groups, x: Array) -> Array:
    """Return the outputs of the linear system: readings, commands, and currents of the axes, and coordinates."""
    z, i = (own.machine.join([getattr(one, name) for one in measured]) for name in ("z", "i"))
    return jnp.concatenate([z, own.machine.join(u), i, x[: len(jnp.asarray(own.rotor.gravity))]])


def _continuous(own: MachineAtSpeed, at_rest: AtRest, moved: Callable, read: Callable) -> tuple:
    point, sizes, body, body_sizes = at_rest
    x, restore = ravel_pytree((body, point.control, point.law))

    def field(x: Array, e: Array) -> tuple[Array, Array]:
        at, control, law = restore(x)
        measured = read(at, e)
        u, *rates = own.laws(measured, control, law, own.past(point.u))
        return ravel_pytree((moved(at, u), tuple(rates)))[0], _outputs(own, measured, u, at)

    scale = ravel_pytree((body_sizes, sizes.control, sizes.law))[0]
    return jax.jacfwd(field, (0, 1))(x, jnp.zeros(own.machine.count, x.dtype)), scale


def _sampled(own: MachineAtSpeed, at_rest: AtRest, free: tuple[Array, Array], read: Callable) -> tuple:
    point, sizes, body, body_sizes = at_rest
    past, delay = own.past(point.u), jnp.asarray(own.cascade[0].timing.delay)[0]
    (A, B), kept = free, len(past[0])
    transition, driven = exponential(A * own.period), CommandPath(A, B, delay).effects(own.period, kept)
    x, restore = ravel_pytree((body, point.control, point.law, past))

    def step(x: Array, e: Array) -> tuple[Array, Array]:
        at, control, law, past = restore(x)
        measured = read(at, e)
        u, after, law = own.laws(measured, control, law, past)
        commands = [own.machine.join([(new, *old)[lag] for new, old in zip(u, past, strict=True)])
                    for lag in range(kept + 1)]  # fmt: skip
        end = transition @ at + sum(effect @ one for effect, one in zip(driven, commands, strict=True))
        kept_now = tuple((new, *old)[:kept] for new, old in zip(u, past, strict=True))
        return ravel_pytree((end, after, law, kept_now))[0], _outputs(own, measured, u, at)

    scale = ravel_pytree((body_sizes, sizes.control, sizes.law, own.past(sizes.u)))[0]
    return jax.jacfwd(step, (0, 1))(x, jnp.zeros(own.machine.count, x.dtype)), scale
