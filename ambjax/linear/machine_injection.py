"""Measurement of the sensitivity of a whole machine by injection into the nonlinear simulation, one axis at a time.

The multi-sine is added to the reading of the position sensor of one axis, with the loops of all axes closed
(ISO 14839-3). All axes and speeds are simulated at once, as members of one ensemble.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.ensemble.machines import compiled_for_machines
from ambjax.linear.analysis import Zones
from ambjax.linear.injection import Injection, frequency_lines, injection_of
from ambjax.linear.linear_machine import machine_rest
from ambjax.linear.machine_at_speed import MachineRest
from ambjax.linear.member_responses import AMPLITUDE, FourierSums, MultiSine, Response, multisine, padded, responses_of
from ambjax.numerics.records import Scalar, canonical, replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.machine_axes import loop_of, with_loop
from ambjax.simulation.rollout import run
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.whole_machine import Machine, PlantOnly
from ambjax.world.waveforms import Constant


class _Test(NamedTuple):
    """A member: the speed (rpm), and the multi-sine on one axis."""

    speed: Scalar
    wave: MultiSine
    axis: Scalar


def machine_injected(
    machine: Machine, clock: Clock, zones: Zones, speeds: Sequence[float], peaks: Sequence[Sequence[float | None]]
) -> list[tuple[Injection, ...]]:
    """Measure the sensitivity at the position sensor of each axis, at constant speeds (rpm).

    - `clock`: its samples are one period of the multi-sine. The first period is not evaluated, the second one is.
    - `zones`: frequency range, and `amplitude`; None: 1 % of the gap of the axis.
    - `peaks`: frequencies (Hz) by speed and axis, at which there is a line, and near which there are more; None: not
      known.

    The rotor is at rest in its bearings under its weight, without unbalance, loads and runout. Returns an `Injection`
    for each axis at each speed.
    """
    gaps = np.asarray(machine.plants("s_0"))
    amplitudes = AMPLITUDE * gaps if zones.amplitude is None else np.full(len(gaps), float(zones.amplitude))
    axes = [(speed, k, peak) for speed, own in zip(speeds, peaks, strict=True) for k, peak in enumerate(own)]
    waves = []
    for _, k, peak in axes:
        f = frequency_lines(zones, clock, peak)
        if peak is not None:
            f = np.append(f, np.clip(peak, f[0], f[-1]))  # the peak of a bending mode is narrow
        harmonics = np.unique(np.round(f * float(clock.duration)).astype(int))
        waves.append(multisine(harmonics, clock.samples, float(clock.sample_period), float(amplitudes[k])))
    most = max(len(wave.harmonics) for wave in waves)
    tests = [_Test(float(speed), padded(wave, most), k) for (speed, k, _), wave in zip(axes, waves, strict=True)]
    tests = canonical(jax.tree.map(lambda *x: np.stack(x), *tests))
    machine, clock = canonical((machine, clock))
    point = machine_rest(machine, clock.sample_period)
    sums, code = _responses(machine, clock, point, tests)
    random = any(np.any(np.asarray(x)) for loop in machine.loops() for x in loop.scenario.sensors.noises)
    found = []
    for n, ((_, k, _), wave) in enumerate(zip(axes, waves, strict=True)):
        own, status = jax.tree.map(lambda x, n=n: np.asarray(x)[n : n + 1], (sums, code))
        found.append(injection_of(responses_of(own, status, wave, clock, float(amplitudes[k])), random))
    return [tuple(found[n : n + len(gaps)]) for n in range(0, len(found), len(gaps))]


@compiled_for_machines
def _responses(machine: Machine, clock: Clock, point: MachineRest, tests: _Test) -> tuple[FourierSums, Array]:
    zero = jnp.zeros_like(point.q)
    rest = machine.moving(machine.rotor.at_magnets, point.q, zero, tuple(map(PlantOnly, point.plant)))
    limits = machine.join([jnp.asarray(loop.scenario.voltage_limit) for loop in machine.loops()])
    skip = clock.samples
    longer = replaced(clock, samples=2 * skip)

    def one(test: _Test) -> tuple[FourierSums, Array]:
        def calm(axis: Sampled | ClosedLoop, own: PlantOnly, size: Array) -> Sampled | ClosedLoop:
            wave, loop = dataclasses.replace(test.wave, size=size), loop_of(axis)
            i = loop.scenario.plant.measurement(own.plant).i
            begin = dataclasses.replace(loop.scenario.initial, i=i)
            scenario = dataclasses.replace(loop.scenario.undisturbed(), reference=Constant(0.0), initial=begin)
            cascade = dataclasses.replace(loop.cascade, inversion=loop.cascade.inversion.started(i))
            loop = with_loop(axis, dataclasses.replace(loop, cascade=cascade, scenario=scenario))
            return dataclasses.replace(loop, wave=wave)

        rotor = dataclasses.replace(machine.rotor.without_forces(), speed=test.speed, acceleration=jnp.zeros(()))
        axis = jnp.asarray(test.axis).astype(int)
        sizes = jnp.where(jnp.arange(len(limits)) == axis, test.wave.size, 0.0)
        axes = tuple(machine.each(calm, rest, machine.split(sizes)))
        turning = dataclasses.replace(machine, rotor=rotor, axes=axes, start_q=point.q)
        outcome = run(turning, longer, Response(test.wave, limits[axis], skip, axis), 0)  # pyright: ignore[reportArgumentType]
        return outcome.metrics, jnp.asarray(outcome.trajectory.lost_code)

    return jax.vmap(one)(tests)
