"""Gains of the notch at the speed of the rotor, from the linear loop without the notch."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.cascade import Cascade
from ambjax.control.synchronous_notch import NULLED, NotchGain, SynchronousNotch
from ambjax.ensemble.batching import map_members
from ambjax.linear.analysis import linearisation_inputs, linearise
from ambjax.linear.linear_machine import linearise_machine, machine_loop, machine_rest
from ambjax.linear.matrices import loop_matrices
from ambjax.numerics.records import Scalar, canonical
from ambjax.numerics.smooth import TWO_PI
from ambjax.simulation.clock import Clock
from ambjax.simulation.machine_axes import with_loop
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotation import PER_MINUTE, Rotation
from ambjax.world.scenario import Scenario

# Largest number of speeds at which the gain of a notch is computed.
SPEEDS = 33


def speeds_of(rotor: Rotation, duration: float) -> list[float]:
    """Return the speeds (rpm) at the corners of a run. Numbers of `rotor` may be arrays, as of a spread."""
    return np.concatenate([np.ravel(rotor.rpm(t)) for t in rotor.corners(duration)]).tolist()


def notch_speeds(notch: SynchronousNotch, speeds: Sequence[float]) -> tuple[float, ...]:
    """Return the speeds (rpm) of the gains of a notch: from the least to the largest of `speeds`, while it is on."""
    first, *_, last = sorted(abs(rpm) for rpm in speeds)
    if min(speeds) < 0 < max(speeds):
        first = 0.0
    last = min(last, max(first, float(notch.max_speed)))
    low = max(first, float(notch.min_speed), last / (4 * SPEEDS))
    return tuple(np.linspace(low, last, SPEEDS).tolist()) if low < last else (last,)


def with_notch_gains(cascade: Cascade, scenario: Scenario, clock: Clock, rotor: Rotation) -> Cascade:
    """Return the cascade with its notch gains at all speeds of `rotor`. Raises ValueError as `linearise` does."""
    assert cascade.notch is not None
    system = linearise(dataclasses.replace(cascade, notch=None), scenario, clock)
    speeds = notch_speeds(cascade.notch, speeds_of(rotor, float(clock.duration)))
    response = np.asarray(system.response(PER_MINUTE * np.array(speeds)))
    gains = notch_gains(cascade.notch, speeds, response[:, 0, 0], response[:, 5, 0])
    notch = dataclasses.replace(following(cascade.notch, rotor), gains=gains, rotor=scenario.rotor)
    return dataclasses.replace(cascade, notch=notch)


def following(notch: SynchronousNotch, rotor: Rotation) -> SynchronousNotch:
    """Return the notch for a rotor whose numbers may be arrays: it follows a speed that changes in one of them."""
    return dataclasses.replace(notch, varying=notch.varying or bool(np.any(np.asarray(rotor.acceleration) != 0)))


def redesigned(cascade: Cascade, scenario: Scenario, period: Scalar) -> tuple[NotchGain, ...]:
    """Return the gains of a cascade's notch for its loop, at the speeds of the gains that it has.

    The arguments are the results of `linearisation_inputs`. The function is pure, works under jit and vmap, and is
    differentiable. The gains are NaN if no equilibrium is found.
    """
    assert cascade.notch is not None
    system, found = loop_matrices(dataclasses.replace(cascade, notch=None), scenario, period, 0.0)
    speeds = [gain.speed for gain in cascade.notch.gains]
    response = jnp.where(found, system.response(PER_MINUTE * jnp.stack([jnp.asarray(x) for x in speeds])), jnp.nan)
    return notch_gains(cascade.notch, speeds, response[:, 0, 0], response[:, 5, 0])


# For one cascade with concrete numbers.
redesigned_at_once = compiled_quickest(redesigned)


def redesigned_members(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[NotchGain, ...]:
    """Return the gains of `redesigned` of every member of an ensemble, whose varying leaves are arrays [N]."""
    inputs = canonical(linearisation_inputs(cascade, scenario, clock))
    return map_members(_redesigned, inputs, compiled=compiled_quickest)


def _redesigned(tree: tuple[Cascade, Scenario, Scalar]) -> tuple[NotchGain, ...]:
    return redesigned(*tree)


def notch_gains(
    notch: SynchronousNotch, speeds: Sequence[Scalar], S: Array | np.ndarray, current: Array | np.ndarray
) -> tuple[NotchGain, ...]:
    """Return the gains for the responses [speeds] of the reading of z, S, and of the current to a test signal on z."""
    inverse = _inverse(notch, S, current)
    parts = [x.tolist() if isinstance(x, np.ndarray) else x for x in (inverse.real, inverse.imag)]
    return tuple(NotchGain(speed, parts[0][k], parts[1][k]) for k, speed in enumerate(speeds))


def _inverse(notch: SynchronousNotch, S: Any, current: Any) -> Any:
    """Return the inverse of the response that a notch nulls."""
    G = current if NULLED[notch.removes] == "i" else S - 1
    return 1 / (G if notch.phase is None else abs(G) * np.exp(1j * np.radians(notch.phase)))


def machine_at_speed(machine: Machine, W: Scalar, period: Scalar) -> Machine:
    """Return a machine whose notches are designed for its own loops at the speed W (rad/s), for this speed alone.

    It works under jit, vmap and differentiation. Below the least speed of its gains, they are those for that speed.
    """
    notches = [loop.cascade.notch for loop in machine.loops()]
    lowest = [jnp.min(jnp.asarray(notch.gains[0].speed)) for notch in notches if notch is not None]
    if not lowest:
        return machine
    bare, W = _with_notches(machine, [None] * len(notches)), jnp.abs(W)
    W = jnp.maximum(W, TWO_PI * PER_MINUTE * functools.reduce(jnp.minimum, lowest))
    H = machine_loop(bare, W, period, machine_rest(bare, period)).response(W[None] / TWO_PI)[0]
    c, designed = machine.count, list[SynchronousNotch | None]()
    responses = machine.split((jnp.diagonal(H[:c]), jnp.diagonal(H[2 * c : 3 * c])))
    for notch, own in zip(notches, responses, strict=True):
        if notch is not None:
            g = _inverse(notch, *own)
            notch = dataclasses.replace(notch, gains=(NotchGain(notch.gains[0].speed, g.real, g.imag),))
        designed.append(notch)
    return _with_notches(machine, designed)


def _with_notches(machine: Machine, notches: Sequence[SynchronousNotch | None]) -> Machine:
    axes = []
    for axis, loop, notch in zip(machine.axes, machine.loops(), notches, strict=True):
        cascade = dataclasses.replace(loop.cascade, notch=notch)
        axes.append(with_loop(axis, dataclasses.replace(loop, cascade=cascade)))
    return dataclasses.replace(machine, axes=tuple(axes))


def with_machine_gains(
    machine: Machine, notches: Sequence[SynchronousNotch | None], clock: Clock, speeds: Sequence[float]
) -> list[SynchronousNotch | None]:
    """Return the notches of the axes (None: none) with the gains for a machine without notches, at `notch_speeds`."""
    c, found, responses = machine.count, list[SynchronousNotch | None](), dict[float, np.ndarray]()
    for k, notch in enumerate(notches):
        if notch is None:
            found.append(None)
            continue
        own_speeds = notch_speeds(notch, speeds)
        for speed in (x for x in own_speeds if x not in responses):
            system = linearise_machine(machine, clock.sample_period, speed)
            responses[speed] = np.asarray(system.response(np.array([PER_MINUTE * speed])))[0]
        own = np.array([responses[speed] for speed in own_speeds])
        gains = notch_gains(notch, own_speeds, own[:, k, k], own[:, 2 * c + k, k])
        found.append(dataclasses.replace(notch, gains=gains))
    return found
