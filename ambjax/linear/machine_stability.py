"""Stability of whole machines at constant speeds, judged as that of one axis is (`stability`)."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.blocks import quarters
from ambjax.ensemble.machines import run_machines
from ambjax.linear.linear_machine import turning_machines
from ambjax.linear.margins import poles_in_s
from ambjax.linear.quiet_run import KICK, QuietRun, quiet, quiet_run_of
from ambjax.linear.stability import GROWN, Stability, has_set_valued, judged, may_chatter
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.records import Scalar
from ambjax.numerics.shapes import map_varying
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.whole_machine import Machine, PerAxis, loop_of, stack_axes, with_loop
from ambjax.world.scenario import Scenario
from ambjax.world.waveforms import Constant

# Number of the coordinates of a rigid rotor, which the displaced start of a quiet run moves.
RIGID = 5


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
    found = judged(_Machines(dataclasses.replace(one, rotor=rotor, cuts=None), clock))
    return found._replace(stable=found.stable & ~(smooth & np.isinf(growth)))


def _cascades(machine: Machine) -> list[Cascade]:
    """Return the cascades of the groups of axes, and of the rigid coordinates if a law controls these."""
    whole = getattr(machine.law, "laws", None)
    return [loop.cascade for loop in machine.loops()] + ([whole] if isinstance(whole, Cascade) else [])


def _of_axes(machine: Machine, name: str) -> np.ndarray:
    """Return a number of the scenario of every axis, [c] or [N, c]."""
    parts = [np.asarray(getattr(loop.scenario, name), float) for loop in machine.loops()]
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in parts))
    order = np.argsort(np.concatenate(machine.groups))
    return np.concatenate([np.broadcast_to(x, (*lead, x.shape[-1])) for x in parts], -1)[..., order]


class _Machines(NamedTuple):
    """N machines without loads, each at a constant speed."""

    machine: Machine
    clock: Clock

    @property
    def period(self) -> Scalar:
        return self.clock.sample_period

    @property
    def duration(self) -> float:
        return float(self.clock.duration)

    @property
    def clearance(self) -> np.ndarray:
        return _of_axes(self.machine, "touchdown")

    @property
    def bias(self) -> float:
        return max(float(np.max(loop.scenario.plant.i_0)) for loop in self.machine.loops())

    @property
    def cascades(self) -> Sequence[Cascade]:
        return _cascades(self.machine)

    def growth(self, cascades: Sequence[Cascade], chosen: np.ndarray) -> np.ndarray:
        groups = len(self.machine.axes)
        axes = [
            with_loop(axis, dataclasses.replace(loop_of(axis), cascade=own))
            for axis, own in zip(self.machine.axes, cascades[:groups], strict=True)
        ]
        law = dataclasses.replace(self.machine.law, laws=cascades[groups]) if cascades[groups:] else self.machine.law
        machine, rates = dataclasses.replace(self.machine, axes=tuple(axes), law=law), []
        for k in np.flatnonzero(chosen):
            one = map_varying(lambda x, k=k: np.asarray(x)[k], machine)
            try:
                rates.append(growth_of(next(turning_machines(one, self.period, [float(one.rotor.speed)])).system))
            except ValueError:  # no linearisation
                rates.append(np.nan)
        return np.array(rates)

    def quiet(self) -> QuietRun:
        axes = [_calm(axis, len(group)) for axis, group in zip(self.machine.axes, self.machine.groups, strict=True)]
        machine = dataclasses.replace(self.machine, axes=tuple(axes), start_q=self._displaced())
        near = machine.near
        fold = dataclasses.replace(quarters(self.clock), of=(near, "i"))
        # the fold of the axes has a scatter, which the one-kernel path does not support
        run = run_machines(machine, self.clock, PerAxis(stack_axes([fold] * machine.count)), plain=True)
        low, high = ({"z": part[near], "i": part["i"]} for part in (run.metrics.low, run.metrics.high))
        return quiet_run_of(low, high, np.asarray(run.trajectory.lost_at), np.array(self.bias))

    def _displaced(self) -> np.ndarray:
        """Return coordinates that are displaced by KICK of the clearance at each axis, towards z = 0."""
        rotor, q = self.machine.rotor, np.asarray(self.machine.start_q)
        rows = np.asarray(rotor.at_magnets if rotor.at_stops is None else rotor.at_stops)
        z = np.sum(rows * q[..., None, :], -1)
        moved = np.where(z > 0, -1.0, 1.0) * KICK * self.clearance
        rigid = np.sum(np.linalg.pinv(rows[..., :RIGID]) * moved[..., None, :], -1)
        return q + np.concatenate([rigid, np.zeros((*rigid.shape[:-1], q.shape[-1] - RIGID))], -1)


def _calm(axis: Sampled | ClosedLoop, count: int) -> Sampled | ClosedLoop:
    """Return the loops of a group of `count` axes in a quiet run, at the reference 0."""

    def stacked(x: Any) -> Any:
        return np.full(count, x) if np.ndim(x) == 0 else x

    loop = loop_of(axis)
    scenario: Scenario = quiet(dataclasses.replace(loop.scenario, reference=Constant(0.0)))
    return with_loop(axis, dataclasses.replace(loop, scenario=jax.tree.map(stacked, scenario)))
