"""Operating points: linearised loops of a case at its equilibria, and of the members of its spread."""

import contextlib
import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, overload

import jax
import numpy as np

from ambjax import linear
from ambjax.cases.given import of_case
from ambjax.cases.machine_case import MachineCase
from ambjax.cases.reader import Case
from ambjax.control.cascade import Cascade
from ambjax.ensemble.replay import as_member
from ambjax.ensemble.study import Study
from ambjax.host.one_thread import one_thread
from ambjax.linear import analysis, linear_machine
from ambjax.linear.linear_machine import MachineSensitivity, TurningMachine, sensitivity_of, turning_machines
from ambjax.linear.machine_stability import growth_of, machine_stability
from ambjax.linear.stability import has_set_valued
from ambjax.numerics.records import replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.system import reads_velocity
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.waveforms import Constant

# Number of members of [spread] that `ambjax compare` analyses, and `ambjax sensitivity` without --members.
MEMBERS = 100


class OperatingPoint(NamedTuple):
    """An analysed loop: its name, the reference r (m) of its equilibrium, mass m (kg), matrices and analysis.

    `held`: whether the loop is stable in a run without noise and loads; None: no sign is set-valued, so no run decides.
    """

    name: str
    r: float
    m: float
    system: linear.StateSpace
    analysis: linear.Analysis
    held: bool | None = None

    @property
    def stable(self) -> bool:
        """Whether the loop is stable. If it is, but the linear loop is not, there are no peaks."""
        return self.analysis.stable if self.held is None else self.held

    @property
    def zone(self) -> str | None:
        """Zone of the peak of |S|; None for a stable loop without peaks."""
        return self.analysis.zone if self.analysis.stable or not self.stable else None


class SpreadPeaks(NamedTuple):
    """Result of `spread_peaks`.

    `members`: number of members analysed. `stable`, `zone_a`: how many of them are stable, and stable in zone A.
    `failed`: how many have no linearisation; they count as not stable.
    `worst`: index of the member with the largest peak, or of the first one that is not stable. `point`: the loop of
    this member; None if it has no equilibrium. `measured`: the peaks of all members by injection; None from
    `spread_peaks` itself.
    """

    members: int
    stable: int
    zone_a: int
    worst: int
    point: OperatingPoint | None
    measured: linear.MemberPeaks | None = None
    failed: int = 0


def operating_point(case: Case, name: str, r: float) -> OperatingPoint:
    """Linearise and analyse the loop of a case at a constant reference r (m). Raises ValueError as `linearise` does."""
    system = linear.linearise(case.cascade, case.scenario, case.clock, r)
    m, held = float(case.scenario.plant.m), None
    if has_set_valued([case.cascade]):
        scenario = as_member(case.scenario)
        if r:
            start = Initial(r, 0.0, float(scenario.plant.equilibrium(r)[0]))
            scenario = dataclasses.replace(scenario, reference=Constant(r), initial=start)
        held = bool(linear.stability_of(case.cascade, scenario, case.clock).stable[0])
    return OperatingPoint(name, r, m, system, _analysis(case, system, m, held), held)


# Modules in these types: the documentation would find two classes of each name, one of them in `ambjax.linear`.
@overload
def sensitivity(case: MachineCase) -> list[linear_machine.MachineSensitivity]: ...
@overload
def sensitivity(case: Case, r: float = 0.0) -> analysis.Analysis: ...
@overload
def sensitivity(case: Cascade, scenario: Scenario, clock: Clock, /, r: float = 0.0) -> analysis.Analysis: ...
@of_case(machines=True)
@one_thread()
def sensitivity(case: Case | MachineCase, r: float = 0.0) -> linear.Analysis | list[MachineSensitivity]:
    """Linearise the loop of a case, and return its peaks of |S|, |T| and |KS|, zone, margins and stiffness.

    - `case`: from `read_case` or `read_machine`; or a cascade, a scenario and a clock.
    - `r`: constant reference, m; a machine has none.

    Returns an `Analysis`; for a machine, a list with one `MachineSensitivity` for each speed. `ambjax.linear` contains
    functions for the single steps, and for the measurement of S by injection of a test signal. Raises ValueError if the
    loop has no equilibrium at r or no derivative there, and as `rollout` does.

        loop = ambjax.sensitivity(case)
        loop.S.height, loop.zone, loop.margins.pm  # 1, "A" to "D", degrees
    """
    if isinstance(case, MachineCase):
        return points_of(case, list(turning_machines(case.machine, case.clock.sample_period, case.speeds)))
    system = linear.linearise(case.cascade, case.scenario, case.clock, r)
    return _analysis(case, system, float(case.scenario.plant.m))


def points_of(case: MachineCase, turning: Sequence[TurningMachine]) -> list[MachineSensitivity]:
    """Return the sensitivity of a machine at its speeds, with its stability there. `turning`: its linear machines."""
    growth = np.array([growth_of(point.system) for point in turning])
    found = machine_stability(case.machine, case.clock, [(0, speed) for speed in case.speeds], growth)
    runs = [(None, None)] * len(growth)
    if found is not None:
        pairs = zip(found.stable, found.swing, strict=True)
        runs = [(bool(stable), None if stable else float(swing)) for stable, swing in pairs]
    each = zip(turning, case.speeds, runs, strict=True)
    return [sensitivity_of(point, case.axes, speed, case.zones, *found) for point, speed, found in each]


def _analysis(case: Case, system: linear.StateSpace, m: float, held: bool | None = None) -> linear.Analysis:
    velocity = case.scenario.sensors.velocity and reads_velocity(case.cascade, case.clock.sample_period)
    return linear.analyse(system, m, case.clock.sample_period, case.zones, velocity, held is not False)


def spread_peaks(case: Case, study: Study, most: int | None = None) -> SpreadPeaks:
    """Analyse the members of the study at r = 0, and return the counts and the member with the largest peak."""
    members = study.members if most is None else min(study.members, most)
    cascade, scenario = study.batch(np.arange(members))
    systems, found = linear.linearise_members(cascade, scenario, study.clock)
    held: list[bool | None] = [None] * members
    if has_set_valued([case.cascade]):
        held = linear.stability_of(cascade, scenario, study.clock).stable.tolist()
    peaks, good = np.full(members, math.inf), np.zeros(members, bool)
    masses = np.broadcast_to(np.asarray(scenario.plant.m, float), (members,))
    analyses: list[linear.Analysis | None] = []
    loops: list[linear.StateSpace] = []
    for k in range(members):
        one, loop = None, jax.tree.map(lambda x, k=k: np.asarray(x)[k], systems)
        with contextlib.suppress(ValueError):  # the member has no linearisation
            loop = linear.checked(loop, found[k], 0.0)
            one = _analysis(case, loop, float(masses[k]), held[k])
        loops.append(loop)
        analyses.append(one)
        if one is not None:
            peaks[k], good[k] = one.S.height, one.stable if held[k] is None else held[k]
    worst = int(np.lexsort((-peaks, good))[0])  # the first one that is not stable, if there is one
    zone_a = sum(one is not None and one.stable and one.zone == "A" for one in analyses)
    one = analyses[worst]
    parts = f"member {worst}", 0.0, float(masses[worst]), loops[worst]
    point = None if one is None else OperatingPoint(*parts, one, held[worst])
    failed = sum(one is None for one in analyses)
    return SpreadPeaks(members, int(good.sum()), int(zone_a), worst, point, failed=failed)


def measured_peaks(case: Case, study: Study, peak: float) -> linear.MemberPeaks:
    """Measure the peak of |S| of each member of the study by injection of a multi-sine."""
    cascade, scenario = study.batch(np.arange(study.members))
    clock = one_period(case)
    lines = linear.frequency_lines(case.zones, clock, peak)
    return linear.injected_members(cascade, scenario, clock, lines, amplitude=case.zones.amplitude)


def one_period(case: Case | MachineCase) -> Clock:
    """Return the clock of one period of the multi-sine of an injection: the period of its lowest frequency."""
    period = float(case.clock.sample_period)
    return replaced(case.clock, samples=math.ceil(1 / (float(case.zones.f_low) * period)))


def shown_band(case: Case, systems: list[linear.StateSpace]) -> tuple[float, float]:
    """Return the band (Hz) of a picture of these loops: that of the case, by default until |S - 1| has decayed."""
    if case.cascade.sampled:
        return case.zones.range(case.clock.sample_period)
    low = float(case.zones.f_low)
    return case.zones.range(None, max([linear.decayed_end(system, low) for system in systems], default=1e3 * low))


def analysis_summary(one: linear.Analysis) -> dict[str, object]:
    """Return the numbers of an analysis by their names in the JSON summary."""
    margins = one.margins
    return {
        "stable": one.stable,
        "peak": one.S.height,
        "frequency_hz": one.S.frequency,
        "zone": one.zone,
        "t_peak": one.T.height,
        "t_frequency_hz": one.T.frequency,
        "ks_peak": one.KS.height,
        "ks_frequency_hz": one.KS.frequency,
        "velocity_peak": None if one.S_velocity is None else one.S_velocity.height,
        "velocity_frequency_hz": None if one.S_velocity is None else one.S_velocity.frequency,
        **_margin_numbers(margins),
        "margins": margin_numbers(one),
        "static_stiffness_N_per_m": one.stiffness,
        "noise_gain": one.noise,
        "poles_per_s": [[float(pole.real), float(pole.imag)] for pole in one.poles],
    }


def margin_numbers(one: linear.Analysis) -> dict[str, object]:
    """Return the margins of a loop by place, and the place of the smaller delay margin, for a JSON summary."""
    numbers: dict[str, object] = {place: _margin_numbers(getattr(one.margins_at, place)) for place in linear.PLACES}
    return numbers | {"delay_at": one.margins_at.place("delay")}


def _margin_numbers(margins: linear.Margins) -> dict[str, float]:
    return {
        "gain_margin": margins.gm,
        "gain_margin_low": margins.gm_low,
        "gain_margin_high": margins.gm_high,
        "phase_margin_deg": margins.pm,
        "delay_margin_s": margins.delay,
        "disk_margin": margins.dm,
    }
