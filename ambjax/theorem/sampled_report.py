"""Checks of a cascade on a processor: poles of the laws, the distance to the singular curve C, the rotor's status.

Theorem 1 applies in continuous time, where sigma, v_tilde and e reach 0. With steps of length T they only reach a band
around 0. A law computes its signal from an estimate, so the computed signal differs from that of the plant. Along a
run, two numbers are measured for each signal: W, the largest disturbance of the rate of the computed signal, and the
largest difference between the computed signal and that of the plant. The band of the computed signal follows from W
(`control.sampling.band`). The band plus the difference bounds the signal of the plant.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.sampling import band, disturbance
from ambjax.control.schedule import schedules
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock, takes_case
from ambjax.simulation.rollout import Result, System, prepare, roll
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import system_of
from ambjax.simulation.trajectory import STALLED, Trajectory
from ambjax.theorem.causes import Cause, find_cause
from ambjax.theorem.law_poles import LawPoles, law_poles, sampling_of
from ambjax.theorem.proof import LawSignalsRecorder
from ambjax.world.bearing import Bearing
from ambjax.world.scenario import Scenario

# Samples whose distances to the singular curve are computed together.
BATCH = 4096
# Signal that the law of each stage drives to zero, and its unit.
SIGNALS = {"position": ("sigma", "m/s"), "inversion": ("v_tilde", "A^2/m^2"), "current": ("e", "A")}
# The voltage alternates if the rms of (u_{n+1} - 2 u_n + u_{n-1})/4 is more than this share of the rms of u. The share
# is 0.25 for an oscillation at a sixth of the sampling rate, and 0.61 for white noise.
ALTERNATING = 0.25


@dataclasses.dataclass(frozen=True)
class Band:
    """Measurements of a signal at the samples of a run after `settle`, and the bounds derived from them.

    `noise`: whether the run has the case's noise. `computed`: largest magnitude of the signal that the law computes,
    from the estimate (with prediction: at the end of the delay). `largest`: largest magnitude of the plant's signal.
    `difference`: largest difference of the two signals; 0 for v_tilde, because `LawSignalsRow.true` contains the
    computed one. `gain`: that of the law's sign. `disturbance`: W, the largest disturbance of the rate of the computed
    signal, per s. `band`: bound of `computed` for disturbances up to W; inf if the gain does not exceed W; the
    magnitude at `settle` if the signal is outside its band there. `gain`, `disturbance` and `band` are None for a law
    that is not a single sign or has a schedule.
    """

    signal: str
    unit: str
    noise: bool
    gain: float | None
    disturbance: float | None
    band: float | None
    computed: float
    difference: float
    largest: float
    note: str

    @property
    def bound(self) -> float | None:
        """Bound of `largest`."""
        return None if self.band is None else self.band + self.difference


@dataclasses.dataclass(frozen=True)
class SampledReport:
    """Poles of the laws and bands of a cascade on its processor, and the rotor's status under the case's noise.

    `bands`: of the runs that do not end early. `lost_at`: time at which the run with noise ends early, s; inf if it
    does not. `lost_why`: the reason. `stalled`: whether the integrator stalled at `lost_at`; the rotor's status is then
    unknown. `distance`: smallest distance of (z/s_0, i_ref/i_0) to the singular curve C at the samples (negative beyond
    C), and its time (s); inf for an inversion law that is not singular on C. `alternating`: result of `alternation` for
    the voltage after `settle`, in the run without sensor noise; None if that run ends early. `largest_z`: largest |z|
    (m) at the samples after `settle`, in the run with noise; None if that run ends early. `cause`, `alternation_cause`:
    results of `with_causes`; None if the rotor is not lost, or if the voltage does not alternate.
    """

    laws: list[LawPoles]
    bands: list[Band]
    lost_at: float
    lost_why: str
    stalled: bool = False
    distance: tuple[float, float] = (math.inf, 0.0)
    alternating: float | None = None
    largest_z: float | None = None
    cause: Cause | None = None
    alternation_cause: Cause | None = None

    @property
    def lost(self) -> bool:
        """Whether the rotor is lost in the run with noise. False if that run stalls."""
        return math.isfinite(self.lost_at) and not self.stalled

    @property
    def alternates(self) -> bool:
        """Whether the voltage alternates from sample to sample without noise."""
        return self.alternating is not None and self.alternating > ALTERNATING

    @property
    def holds(self) -> bool:
        """Whether every law is stable, C is not reached, and the rotor is held to the end."""
        return math.isinf(self.lost_at) and self.distance[0] > 0 and all(law.holds for law in self.laws)


class Delays(NamedTuple):
    """Result of runs whose delays increase in steps of at most `step` (samples), from the delay of the case on.

    `held`: the largest delay up to which the rotor is held at every delay of the runs. `lost`: the smallest delay at
    which it is lost; None if there is none. `undecided`: the delay that follows `held`, if the integrator stalled
    there; else None. A second pass divides the step that follows `held`. If the rotor is not held at the delay of the
    case, the delays go from 0 to that delay; if it is not held at 0 either, `held` is None.

    `stable`: the largest delay of these up to which the loop is stable (`linear.stability`); None if it is not stable
    at the first of them. `swing_m`, `current_A`: at the delays up to `held` at which it is not stable, the largest
    amplitude of z and the largest |i| in a run without noise and loads; None if there are none. `tested`: number of
    delays from the first to `held` whose stability was computed.
    """

    held: float | None
    lost: float | None
    undecided: float | None
    step: float
    stable: float | None = None
    swing_m: float | None = None
    current_A: float | None = None
    tested: int = 0

    @property
    def resolution(self) -> float | None:
        """`lost` minus `held`, samples."""
        return None if self.held is None or self.lost is None else self.lost - self.held


# A function that simulates a system.
Run = Callable[[System, Clock], Result]


def rolled(system: System, clock: Clock) -> Result:
    """Roll out a system and record every sample."""
    return roll(*canonical((system, clock)), None, record_every=1)


@takes_case
def check_sampled(
    cascade: Cascade, scenario: Scenario, clock: Clock, settle: float, run: Run = rolled
) -> SampledReport:
    """Return the report on a cascade with a processor. It is computed from a run without sensor noise and, if the case
    has noise, from a run with it.

    `run`: function that simulates a system. With `ensemble.replay.record_system`, the rounding is that of
    `ambjax simulate`. `settle`: start of the evaluation, s. Raises ValueError as `rollout` does.
    """
    loop, clock = prepare(cascade, scenario, clock)
    cascade, quiet = cascade.on_processor(), _without_noise(scenario)
    outcome = _simulated(loop, clock, run)
    calm = outcome if quiet is scenario else _simulated(system_of(cascade, quiet, clock), clock, run)
    runs = [(calm, False)] if calm is outcome else [(calm, False), (outcome, True)]
    settled = min(round(settle / float(clock.sample_period)), max(clock.samples - 2, 0))
    lasting = [(one.rows, noise) for one, noise in runs if np.isinf(one.lost_at)]
    bands = [line for rows, noise in lasting for line in _bands(cascade, scenario, clock, settled, rows, noise)]
    alternating = alternation(np.asarray(calm.rows.u)[settled:]) if np.isinf(calm.lost_at) else None
    largest = _peak(np.asarray(outcome.rows.z)[settled:]) if np.isinf(outcome.lost_at) else None
    stalled = int(outcome.lost_code) == STALLED
    ending = float(outcome.lost_at), outcome.lost_why, stalled
    distance = _smallest_distance(outcome, scenario.plant) if cascade.inversion.singular else (math.inf, 0.0)
    return SampledReport(law_poles(cascade, clock), bands, *ending, distance, alternating, largest)


def with_causes(
    report: SampledReport,
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    settle: float,
    run: Run = rolled,
    tell: Callable[[str], object] = lambda _: None,
) -> SampledReport:
    """Return the report with the causes of a lost rotor and of an alternating voltage (`causes.find_cause`).

    The arguments are those of `check_sampled`. `tell`: is called with a line of text before each run.
    """

    def simulated(cascade: Cascade, scenario: Scenario, clock: Clock) -> Trajectory:
        return _simulated(*prepare(cascade, scenario, clock), run)

    def lost(*case: Any) -> bool:
        return bool(np.isfinite(simulated(*case).lost_at))

    def alternating(cascade: Cascade, scenario: Scenario, finer: Clock) -> bool:
        one, every = simulated(cascade, scenario, finer), finer.samples // clock.samples
        first = min(round(settle / float(clock.sample_period)), max(clock.samples - 2, 0))
        # at the instants of the case, so that a shorter sample period does not change the measure itself
        return bool(np.isfinite(one.lost_at)) or alternation(np.asarray(one.rows.u)[::every][first:]) > ALTERNATING

    case = (cascade, scenario, clock)
    if report.lost:
        report = dataclasses.replace(report, cause=find_cause(lost, *case, tell))
    if report.alternates:
        quiet = (cascade, _without_noise(scenario), clock)
        report = dataclasses.replace(report, alternation_cause=find_cause(alternating, *quiet, tell))
    return report


def _simulated(loop: System, clock: Clock, run: Run) -> Trajectory:
    assert isinstance(loop, Sampled)
    return run(LawSignalsRecorder(loop), clock).trajectory


def _smallest_distance(run: Trajectory, plant: Bearing) -> tuple[float, float]:
    """Return the smallest signed distance to the singular curve C until the rotor is lost, and its time (s)."""
    rows = run.rows
    t, distance = np.asarray(rows.t), np.asarray(_distances(*canonical((plant, rows.z, rows.i_ref))))
    worst = int(np.argmin(np.where(t <= float(run.lost_at), distance, np.inf)))
    return float(distance[worst]), float(t[worst])


@jax.jit
def _distances(plant: Bearing, z: jax.Array, i_ref: jax.Array) -> jax.Array:
    """Return the signed distances to the singular curve C at displacements z [N], m, and currents i_ref [N], A."""
    return jax.lax.map(lambda at: plant.signed_distance_to_C(*at), (z, i_ref), batch_size=BATCH)


def alternation(u: np.ndarray) -> float:
    """Return rms((u_{n+1} - 2 u_n + u_{n-1})/4) / rms(u) for u [N]: sin(pi f T)^2 for a sine of frequency f."""
    size = float(np.sqrt(np.mean(u * u)))
    return float(np.sqrt(np.mean(np.diff(u, 2) ** 2))) / (4 * size) if len(u) > 2 and size else 0.0


def _without_noise(scenario: Scenario) -> Scenario:
    """Return the scenario without sensor noise; the same object if it has none. Faults and random signals remain."""
    quiet = scenario.louder(0.0)
    return scenario if quiet.sensor == scenario.sensor else quiet


def _bands(cascade: Cascade, scenario: Scenario, clock: Clock, settled: int, rows: Any, noise: bool) -> list[Band]:
    sampling, lines = sampling_of(cascade, clock), []
    limited = _peak(rows.u[settled:]) >= float(scenario.voltage_limit)
    for stage, (signal, unit) in SIGNALS.items():
        law = getattr(cascade, stage)
        x, true = (np.asarray(getattr(part, signal))[settled:] for part in (rows.computed, rows.true))
        scheduled, notes = schedules(law), ["the supply limits u"] * limited
        relay = None if scheduled else law.relay()
        if scheduled:
            notes.append(f"no band: schedule of {', '.join(scheduled)}")
        gain = W = limit = None
        if relay is not None:
            implicit = law.has_own_step(sampling.implicit)
            gain, W = float(relay.gain), disturbance(relay, x, sampling.period, implicit)
            limit = band(relay, W, sampling.period, implicit)
            if math.isinf(limit):
                notes.append("the disturbance exceeds the gain")
            elif abs(x[0]) > limit:
                notes.append("at run.settle the signal is outside its band; the band shown is its value then")
                limit = float(abs(x[0]))
        lines.append(
            Band(signal, unit, noise, gain, W, limit, _peak(x), _peak(true - x), _peak(true), "; ".join(notes))
        )
    return lines


def _peak(x: np.ndarray) -> float:
    return float(np.max(np.abs(x), initial=0.0))
