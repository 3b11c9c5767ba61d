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
from ambjax.numerics.records import Scalar
from ambjax.simulation.clock import Clock
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotation import PER_MINUTE, Rotation
from ambjax.world.scenario import Scenario

# Number of speeds at which the gain of a notch is computed for a run-up.
SPEEDS = 33


def notch_speeds(rotor: Rotation, notch: SynchronousNotch, duration: float) -> tuple[float, ...]:
    """Return the speeds (rpm) at which a notch needs its gain: those of a run from `min_speed` on, at most SPEEDS."""
    signed = [float(rotor.rpm(t)) for t in rotor.corners(duration)]
    first, *_, last = sorted(abs(rpm) for rpm in signed)
    if not notch.varying:
        return (first,)
    if min(signed) < 0 < max(signed):
        first = 0.0
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


def machine_notch_gains(
    machine: Machine, notch: SynchronousNotch, speeds: Sequence[float], period: Scalar, phase: float | None
) -> list[tuple[NotchGain, ...]]:
    """Return the gains of the notch of each axis of a machine without notches, all loops closed. See `notch_gains`."""
    c, responses = machine.count, []
    for speed in speeds:
        H = linearise_machine(machine, period, speed).response(np.array([PER_MINUTE * speed]))[0]
        responses.append(np.diag(H[2 * c : 3 * c]) if NULLED[notch.removes] == "i" else np.diag(H[:c]) - 1)
    return [notch_gains(speeds, np.array([one[k] for one in responses]), phase) for k in range(c)]
