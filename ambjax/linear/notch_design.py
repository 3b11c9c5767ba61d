"""Gains of the notch at the speed of the rotor, from the linear loop without the notch."""

import cmath
import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.synchronous_notch import NULLED, NotchGain, SynchronousNotch
from ambjax.linear.analysis import linearise
from ambjax.linear.linear_machine import linearise_machine
from ambjax.simulation.clock import Clock
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotation import PER_MINUTE, Rotation, known
from ambjax.world.scenario import Scenario

# Number of speeds at which the gain of a notch is computed for a run-up.
SPEEDS = 33


def notch_speeds(rotor: Rotation, notch: SynchronousNotch, duration: float) -> tuple[float, ...]:
    """Return the speeds (rpm) at which a notch needs its gain: those of a run while it is on, at most SPEEDS."""
    signed = [float(rotor.rpm(t)) for t in rotor.corners(duration)]
    first, *_, last = sorted(abs(rpm) for rpm in signed)
    if not notch.varying:
        return (first,)
    if min(signed) < 0 < max(signed):
        first = 0.0
    last = min(last, max(first, float(notch.max_speed)))
    low = max(first, float(notch.min_speed), last / (4 * SPEEDS))
    return tuple(np.linspace(low, last, SPEEDS).tolist()) if low < last else (last,)


def with_notch_gains(cascade: Cascade, scenario: Scenario, clock: Clock, phase: float | None = None) -> Cascade:
    """Return the cascade whose notch has the gains for its loop.

    `phase`: phase (degrees) of the response at all speeds; None: that of the linear loop. Raises ValueError as
    `linearise` does.
    """
    assert cascade.notch is not None
    assert scenario.rotor is not None
    system = linearise(dataclasses.replace(cascade, notch=None), scenario, clock)
    speeds = notch_speeds(scenario.rotor, cascade.notch, float(clock.duration))
    response = np.asarray(system.response(PER_MINUTE * np.array(speeds)))
    nulled = response[:, 5, 0] if NULLED[cascade.notch.removes] == "i" else response[:, 0, 0] - 1
    gains = notch_gains(speeds, nulled, phase)
    notch = dataclasses.replace(cascade.notch, gains=gains, rotor=scenario.rotor)
    return dataclasses.replace(cascade, notch=notch)


def notch_gains(speeds: Sequence[float], response: np.ndarray, phase: float | None) -> tuple[NotchGain, ...]:
    """Return the gains for the responses [speeds] of the nulled reading. `phase`: replaces theirs, degrees."""
    found = []
    for speed, G in zip(speeds, response.tolist(), strict=True):
        g = 1 / (G if phase is None else cmath.rect(abs(G), math.radians(phase)))
        found.append(NotchGain(speed, g.real, g.imag))
    return tuple(found)


def with_machine_gains(
    machine: Machine, notches: Sequence[tuple[SynchronousNotch, float | None] | None], clock: Clock
) -> list[SynchronousNotch | None]:
    """Return the notches of the axes with the gains for a machine without notches, all loops closed.

    `notches`: notch and phase (`notch_gains`) of each axis; None: no notch.
    """
    c, found, responses = machine.count, list[SynchronousNotch | None](), dict[float, np.ndarray]()
    for k, given in enumerate(notches):
        if given is None:
            found.append(None)
            continue
        notch, phase = given
        speeds = notch_speeds(known(notch.rotor), notch, float(clock.duration))
        for speed in (x for x in speeds if x not in responses):
            system = linearise_machine(machine, clock.sample_period, speed)
            responses[speed] = np.asarray(system.response(np.array([PER_MINUTE * speed])))[0]
        own = np.array([responses[speed] for speed in speeds])
        nulled = own[:, 2 * c + k, k] if NULLED[notch.removes] == "i" else own[:, k, k] - 1
        found.append(dataclasses.replace(notch, gains=notch_gains(speeds, nulled, phase)))
    return found
