"""Checks of a cascade on a processor: slopes of laws times T, the distance to the singular curve C, the rotor's status.

Theorem 1 is about continuous time, where sigma, v_tilde and e reach 0. Stepped once in T they reach a band, and what it
is made of is measured along a run: W, the largest disturbance of the rate of the signal that a law acts on, and how far
that signal is off the plant's. From W follows the band of the one (`control.sampling.band`), and with the second a
bound of the other.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ambjax.control import answers
from ambjax.control.cascade import Cascade, CascadeState
from ambjax.control.sampling import Sampling, band, disturbance, slope_limits
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import Outcome, prepare, roll
from ambjax.simulation.sampled import system_of
from ambjax.simulation.trajectory import STALLED, Trajectory
from ambjax.theorem.watched import Watched
from ambjax.world.scenario import Scenario

# The stages whose output acts a delay later; an observer and an inversion law act on states of their own.
DELAYED = ("position", "current")
# The signal that the law of a stage drives to zero, and its unit.
SIGNALS = {"position": ("sigma", "m/s"), "inversion": ("v_tilde", "A^2/m^2"), "current": ("e", "A")}
# A voltage alternates where (u_{n+1} - 2 u_n + u_{n-1})/4, its part that changes sign from sample to sample, has more
# than this share of its rms value: that of an oscillation at a sixth of the sampling rate. White noise has 0.61.
ALTERNATING = 0.25


@dataclasses.dataclass(frozen=True)
class SlopeCheck:
    """Slope times T of a law, the same as it is stepped, and its limits: for stability, and without oscillation.

    An explicit step keeps a slope; an implicit one makes a = slope T of a sign a/(1 + a), which is below both limits
    unless the law is late.
    """

    stage: str
    slope: float
    stepped: float
    limit: float
    quiet: float
    implicit: bool

    @property
    def holds(self) -> bool:
        """Whether the law is stable by itself."""
        return self.stepped < self.limit


@dataclasses.dataclass(frozen=True)
class Band:
    """What is measured of a signal along a run from `settle` on, at the samples, and the bounds that follow.

    `noise`: whether the run is with the case's noise. `off`: largest difference between the plant's signal and the one
    that the law acts on, of the estimate, carried over the delay where that is predicted. `computed`, `seen`: largest
    magnitude of the latter and of the plant's. `gain`: of the law's sign; `disturbance`: W, per s, of the rate of the
    signal that the law acts on. `band`: bound of `computed` for disturbances up to W; inf where the gain does not
    exceed W. These three are None for a law that is more, or less, than a sign.
    """

    signal: str
    unit: str
    noise: bool
    gain: float | None
    disturbance: float | None
    band: float | None
    computed: float
    off: float
    seen: float
    note: str

    @property
    def bound(self) -> float | None:
        """Bound of `seen`."""
        return None if self.band is None else self.band + self.off


@dataclasses.dataclass(frozen=True)
class SampledReport:
    """Slopes and bands of a cascade on its processor, and the status of the rotor there, under the case's noise.

    `distance`: the least of (z/s_0, i_ref/i_0) to the singular curve C at the samples of that run, and its time (s);
    negative beyond C. `alternating`: share of the voltage's rms value that changes sign from sample to sample, without
    noise, from `settle` on; None where that run does not last. Bands are of the runs that last. `stalled`: the
    integrator gave up at `lost_at`, and nothing is decided.
    """

    slopes: list[SlopeCheck]
    bands: list[Band]
    lost_at: float
    lost_why: str
    stalled: bool = False
    distance: tuple[float, float] = (math.inf, 0.0)
    alternating: float | None = None

    @property
    def alternates(self) -> bool:
        """Whether the voltage alternates from sample to sample without noise."""
        return self.alternating is not None and self.alternating > ALTERNATING

    @property
    def holds(self) -> bool:
        """Whether no slope is beyond its limit, C is not reached, and the rotor is levitated to the end."""
        return math.isinf(self.lost_at) and self.distance[0] > 0 and all(slope.holds for slope in self.slopes)


class Delays(NamedTuple):
    """Of delays (samples) tried from the case's own up, `step` apart: every one up to `held` holds the rotor, and at
    `lost` it is lost, `resolution` further.

    `undecided` is the least beyond `held` where that is not known, for the integrator stalled (None: all is known up to
    `lost`). Where the case's own does not hold: from 0 up, and `held` is None where that does not either. `lost` is
    None where no delay tried loses it.
    """

    held: float | None
    lost: float | None
    undecided: float | None
    step: float

    @property
    def resolution(self) -> float | None:
        """How far `held` and `lost` are apart, samples."""
        return None if self.held is None or self.lost is None else self.lost - self.held


def rolled(system: Any, clock: Clock) -> Outcome:
    """A rollout, every sample recorded."""
    return roll(*canonical((system, clock)), None, every=1)


def check(
    cascade: Cascade,
    scenario: Scenario,
    clock: Clock,
    settle: float,
    run: Callable[[Any, Clock], Outcome] = rolled,
) -> SampledReport:
    """Slopes and bands of a cascade with a processor. Two runs of the loop: without noise and with it.

    `run` simulates: `ensemble.replay.record_system` has the rounding of `ambjax simulate`. Raises ValueError as
    `rollout` does.
    """
    loop, clock = prepare(cascade, scenario, clock)
    cascade, quiet = cascade.on_processor(), _without_noise(scenario)
    outcome = _watched(loop, clock, run)
    calm = outcome if quiet is scenario else _watched(system_of(cascade, quiet, clock), clock, run)
    runs = [(calm, False)] if calm is outcome else [(calm, False), (outcome, True)]
    settled = min(round(settle / float(clock.sample_period)), max(clock.samples - 2, 0))
    lasting = [(one.rows, noise) for one, noise in runs if np.isinf(one.lost_at)]
    bands = [line for rows, noise in lasting for line in _bands(cascade, scenario, clock, settled, rows, noise)]
    alternating = alternation(np.asarray(calm.rows.u)[settled:]) if np.isinf(calm.lost_at) else None
    stalled = int(outcome.lost_code) == STALLED
    return SampledReport(
        slopes(cascade, clock),
        bands,
        float(outcome.lost_at),
        outcome.lost_why,
        stalled,
        _least(outcome),
        alternating,
    )


def _watched(loop: Any, clock: Clock, run: Callable[[Any, Clock], Outcome]) -> Trajectory:
    """A run whose rows are those of `Watched`."""
    return run(Watched(loop), clock).trajectory


def _least(run: Trajectory) -> tuple[float, float]:
    """The least signed distance to the singular curve C while the rotor was levitated, and its time (s)."""
    rows: Any = run.rows
    t, distance = np.asarray(rows.t), np.asarray(rows.distance)
    worst = int(np.argmin(np.where(t <= float(run.lost_at), distance, np.inf)))
    return float(distance[worst]), float(t[worst])


def alternation(u: np.ndarray) -> float:
    """Share of the rms value of u [N] that changes sign from sample to sample: 1 for +-U, sin(pi f T)^2 at f Hz."""
    size = float(np.sqrt(np.mean(u * u)))
    return float(np.sqrt(np.mean(np.diff(u, 2) ** 2))) / (4 * size) if len(u) > 2 and size else 0.0


def _without_noise(scenario: Scenario) -> Scenario:
    """The same scenario where there is no noise."""
    quiet = None if scenario.sensor is None else scenario.sensor.louder(0.0)
    return scenario if quiet in (None, scenario.sensor) else dataclasses.replace(scenario, sensor=quiet)


def slopes(cascade: Cascade, clock: Clock) -> list[SlopeCheck]:
    """Slope times T of every law that has one, against its limits. Laws and processor of one member."""
    sampling, lines = sampling_of(cascade, clock), []
    for stage, law in zip(CascadeState._fields, map(answers.unhardened, cascade.laws), strict=True):
        implicit = answers.has_own_step(law, sampling.implicit)
        slope = stepped = _steepest(law.slope(cascade.model)) * sampling.period
        if implicit:
            relaxed = 1 / (1 + 1 / slope) if slope else 0.0
            stepped = max(relaxed, float(answers.held(law, cascade.model)) * sampling.period)
        if slope:
            lines.append(
                SlopeCheck(stage, slope, stepped, *slope_limits(sampling.late if stage in DELAYED else 0.0), implicit)
            )
    return lines


def _steepest(slope: Any) -> float:
    """A number; where infinities of a sign without a layer cancel, infinity."""
    return math.inf if math.isnan(float(slope)) else float(slope)


def sampling_of(cascade: Cascade, clock: Clock) -> Sampling:
    """How the laws of a cascade with a processor are sampled."""
    processor: Any = cascade.on_processor().processor
    late = float(processor.delay) - (float(processor.ahead) if processor.predicts else 0.0)
    return Sampling(float(clock.sample_period), max(late, 0.0), processor.implicit)


def _bands(cascade: Cascade, scenario: Scenario, clock: Clock, settled: int, rows: Any, noise: bool) -> list[Band]:
    """The lines of one run, from sample number `settled` on."""
    sampling, lines = sampling_of(cascade, clock), []
    limited = _peak(rows.u[settled:]) >= float(scenario.u_max)
    for stage, (signal, unit) in SIGNALS.items():
        law = getattr(cascade, stage)
        x, true = (np.asarray(getattr(part, signal))[settled:] for part in (rows.computed, rows.true))
        relay, notes = answers.relay(law), ["the supply limits u"] * limited
        gain = W = limit = None
        if relay is not None:
            implicit = answers.has_own_step(law, sampling.implicit)
            gain, W = float(relay.gain), disturbance(relay, x, sampling.period, implicit)
            limit = band(relay, W, sampling.period, implicit)
            if math.isinf(limit):
                notes.append("the disturbance exceeds the gain")
            elif abs(x[0]) > limit:
                notes.append("not reached at run.settle: where it is then")
                limit = float(abs(x[0]))
        lines.append(
            Band(signal, unit, noise, gain, W, limit, _peak(x), _peak(true - x), _peak(true), "; ".join(notes))
        )
    return lines


def _peak(x: np.ndarray) -> float:
    return float(np.max(np.abs(x), initial=0.0))
