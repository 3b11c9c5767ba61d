"""Stability of whole machines at constant speeds, judged as that of one axis is (`stability`)."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import numpy as np

from ambjax.compiler.short_compilation import compiled_quickly
from ambjax.control.cascade import Cascade
from ambjax.ensemble.blocks import quarters
from ambjax.ensemble.machines import run_machines
from ambjax.linear.linear_machine import turning_machines
from ambjax.linear.margins import poles_in_s
from ambjax.linear.quiet_run import KICK, QuietRun, quiet, quiet_run_of
from ambjax.linear.rotor_modes import RIGID
from ambjax.linear.stability import GROWN, Stability, has_set_valued, judged, may_chatter
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.shapes import map_varying, stack_axes
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import PerAxis
from ambjax.simulation.machine_axes import with_loop
from ambjax.simulation.whole_machine import Machine
from ambjax.world.waveforms import Constant


def growth_of(system: StateSpace) -> float:
    """Return the largest growth rate of a linear machine, 1/s; at most 0 if it is stable (`StateSpace.stable`)."""
    system = system.without_idle()
    rate = float(np.max(np.real(poles_in_s(system))))
    return min(rate, 0.0) if system.stable else rate


def machine_stability(
    machine: Machine, clock: Clock, at: Sequence[tuple[int, float]], growth: np.ndarray
) -> Stability | None:
    """Return the stability of members of an ensemble of machines, each at a constant speed.

    - `at` [N]: number of the member and speed, rpm.
    - `growth` [N]: `growth_of` there; inf without an equilibrium, which counts as not stable under smoothed signs.

    None: the linear machines decide, because no sign is set-valued, and none that is evaluated at the start of a sample
    may chatter where a mode grows. Then no run is needed.
    """
    cascades, duration = _cascades(machine), float(clock.duration)
    smooth = not has_set_valued(cascades)
    grown = np.isfinite(growth) & (growth * duration > GROWN)
    if not len(at) or (smooth and not (grown.any() and may_chatter(cascades))):
        return None
    members, speeds = (np.array(x) for x in zip(*at, strict=True))
    one = map_varying(lambda x: np.asarray(x)[members], machine)
    rotor = dataclasses.replace(one.rotor.without_forces(), speed=speeds, acceleration=0.0, changes=())
    machine = dataclasses.replace(one, rotor=rotor, cuts=None)
    bias = max(float(np.max(np.asarray(loop.scenario.plant.i_0))) for loop in machine.loops())
    run = _quiet_run(machine, bias, clock)
    growths = functools.partial(_growth, machine, clock)
    found = judged(_cascades(machine), growths, run, _clearance(machine), bias, clock)
    return found._replace(stable=found.stable & ~(smooth & np.isinf(growth)))


def _cascades(machine: Machine) -> list[Cascade]:
    """Return the cascades of the groups of axes, and of the rigid coordinates if a law controls these."""
    whole = getattr(machine.law, "laws", None)
    return [loop.cascade for loop in machine.loops()] + ([whole] if isinstance(whole, Cascade) else [])


def _growth(machine: Machine, clock: Clock, cascades: Sequence[Cascade], chosen: np.ndarray) -> np.ndarray:
    """Return the growth rate of each chosen machine with these cascades, 1/s; NaN without a linearisation."""
    groups, rates = len(machine.axes), []
    loops = [dataclasses.replace(loop, cascade=own) for loop, own in zip(machine.loops(), cascades, strict=False)]
    law = dataclasses.replace(machine.law, laws=cascades[groups]) if cascades[groups:] else machine.law
    machine = dataclasses.replace(machine, axes=tuple(map(with_loop, machine.axes, loops)), law=law)
    for k in np.flatnonzero(chosen):
        one = map_varying(lambda x, k=k: np.asarray(x)[k], machine)
        try:
            rates.append(growth_of(next(turning_machines(one, clock.sample_period, [float(one.rotor.speed)])).system))
        except ValueError:
            rates.append(np.nan)
    return np.array(rates)


def _quiet_run(machine: Machine, bias: float, clock: Clock) -> QuietRun:
    """Simulate the quiet runs. The start is displaced by KICK of the clearance at each axis, towards z = 0."""
    rotor, q = machine.rotor, np.asarray(machine.start_q)
    rows = np.asarray(rotor.at_magnets if rotor.at_stops is None else rotor.at_stops)
    moved = np.where(np.sum(rows * q[..., None, :], -1) > 0, -1.0, 1.0) * KICK * _clearance(machine)
    rigid = np.sum(np.linalg.pinv(rows[..., :RIGID]) * moved[..., None, :], -1)
    q = q + np.concatenate([rigid, np.zeros((*rigid.shape[:-1], q.shape[-1] - RIGID))], -1)
    loops = []
    for loop, group in zip(machine.loops(), machine.groups, strict=True):
        calm = quiet(dataclasses.replace(loop.scenario, reference=Constant(0.0)))
        stacked = jax.tree.map(lambda x, c=len(group): np.full(c, x) if np.ndim(x) == 0 else x, calm)
        loops.append(dataclasses.replace(loop, scenario=stacked))
    machine = dataclasses.replace(machine, axes=tuple(map(with_loop, machine.axes, loops)), start_q=q)
    fold = dataclasses.replace(quarters(clock), of=(near := machine.near, "i"))
    # the fold of the axes has a scatter, which the one-kernel path does not support
    run = run_machines(machine, clock, PerAxis(stack_axes([fold] * machine.count)), compiled=compiled_quickly)
    low, high = ({"z": part[near], "i": part["i"]} for part in (run.metrics.low, run.metrics.high))
    return quiet_run_of(low, high, np.asarray(run.trajectory.lost_at), np.array(bias))


def _clearance(machine: Machine) -> np.ndarray:
    """Return the clearance of every axis, m, [c] or [N, c]."""
    parts = [np.asarray(loop.scenario.touchdown, float) for loop in machine.loops()]
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in parts))
    order = np.argsort(np.concatenate(machine.groups))
    return np.concatenate([np.broadcast_to(x, (*lead, x.shape[-1])) for x in parts], -1)[..., order]
