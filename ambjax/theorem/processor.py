"""What decides on a processor: slopes of laws times the period, and the bands about zero that sampling leaves.

Theorem 1 is about continuous time, where sigma, v_tilde and e reach 0. Stepped once in T they reach a band: T W under
an implicit sign, where W bounds what disturbs the signal's rate, as Q_z, Delta_1 and Q_i do in continuous time. W is
taken from a run of the loop without sensor noise, from `settle` on: the signal's change over a sample, less what its
law asked for. So it holds what the other laws, the held voltage and a wrong model leave, too.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control import answers
from ambjax.control.cascade import Cascade, CascadeState
from ambjax.control.sampling import Sampling, limits
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import rollout
from ambjax.simulation.trajectory import STALLED, Row
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference, reference_at

# The stages whose output acts a delay later; an observer and an inversion law act on states of their own.
DELAYED = ("position", "current")
# The signal that the law of a stage drives to zero, and its unit.
SIGNALS = {"position": ("sigma", "m/s"), "inversion": ("v_tilde", "A^2/m^2"), "current": ("e", "A")}


@dataclasses.dataclass(frozen=True)
class Slope:
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
    """What a signal can reach on this processor, and its largest value in the run from `settle` on, without noise and
    with the case's own.

    `disturbance`: bound W of that of its rate, per s. `band`: inf where the law's gain does not exceed W, None where
    nothing is known of such a law. `noisy` is None where the rotor is lost under the noise.
    """

    signal: str
    unit: str
    disturbance: float
    band: float | None
    seen: float
    noisy: float | None
    note: str


@dataclasses.dataclass(frozen=True)
class Sampled:
    """Slopes and bands of a cascade on its processor, and the fate of the rotor there, under the case's noise.

    No bands where the run without noise does not last. `stalled`: the integrator gave up at `lost_at`, and nothing is
    decided.
    """

    slopes: list[Slope]
    bands: list[Band]
    lost_at: float
    lost_why: str
    stalled: bool = False

    @property
    def holds(self) -> bool:
        """Whether no slope is beyond its limit, and the rotor is levitated to the end."""
        return math.isinf(self.lost_at) and all(slope.holds for slope in self.slopes)


class Delays(NamedTuple):
    """Of delays (samples) tried from the case's own up: every one up to `held` holds the rotor, at `lost` it is lost.

    `undecided` is the least beyond `held` where that is not known, for the integrator stalled (None: all is known up to
    `lost`). Where the case's own does not hold: from 0 up, and `held` is None where that does not either. `lost` is
    None where no delay allowed loses it.
    """

    held: float | None
    lost: float | None
    undecided: float | None = None

    @property
    def resolution(self) -> float | None:
        """How far `held` and `lost` are apart, samples."""
        return None if self.held is None or self.lost is None else self.lost - self.held


class Errors(NamedTuple):
    """What the laws drive to zero, or what disturbs its rate, sample by sample: m/s, A^2/m^2, A, or those per s."""

    position: np.ndarray
    inversion: np.ndarray
    current: np.ndarray


def check(cascade: Cascade, scenario: Scenario, clock: Clock, settle: float) -> Sampled:
    """Slopes and bands of a cascade with a processor. Two runs of the loop: without noise and with it.

    Raises ValueError as `rollout` does.
    """
    outcome = rollout(cascade, scenario, clock).trajectory
    quiet = _without_noise(scenario)
    calm = outcome if quiet is scenario else rollout(cascade, quiet, clock).trajectory
    held = [bool(np.isinf(trajectory.lost_at)) for trajectory in (calm, outcome)]
    rough = outcome.rows if held[1] else None
    bands = _bands(cascade, quiet, clock, settle, calm.rows, rough) if held[0] else []
    stalled = int(outcome.lost_code) == STALLED
    return Sampled(slopes(cascade, clock), bands, float(outcome.lost_at), outcome.lost_why, stalled)


def _without_noise(scenario: Scenario) -> Scenario:
    sensor = scenario.sensor
    if sensor is None:
        return scenario
    none = {field.name: 0.0 for field in dataclasses.fields(sensor) if field.name.startswith("std")}
    return dataclasses.replace(scenario, sensor=dataclasses.replace(sensor, **none))


def slopes(cascade: Cascade, clock: Clock) -> list[Slope]:
    """Slope times T of every law that has one, against its limits. Laws and processor of one member."""
    sampling, lines = sampling_of(cascade, clock), []
    for stage, law in zip(CascadeState._fields, map(answers.unhardened, cascade.laws), strict=True):
        implicit = answers.steps_implicitly(law, sampling.implicit)
        slope = stepped = _steepest(law.slope(cascade.model)) * sampling.period
        if implicit:
            relaxed = 1 / (1 + 1 / slope) if slope else 0.0
            stepped = max(relaxed, float(answers.held(law, cascade.model)) * sampling.period)
        if slope:
            lines.append(Slope(stage, slope, stepped, *limits(sampling.late if stage in DELAYED else 0.0), implicit))
    return lines


def _steepest(slope: Any) -> float:
    """A number; where infinities of a sign without a layer cancel, infinity."""
    return math.inf if math.isnan(float(slope)) else float(slope)


def sampling_of(cascade: Cascade, clock: Clock) -> Sampling:
    """How the laws of a cascade with a processor are sampled."""
    processor: Any = cascade.on_processor().processor
    return Sampling(float(clock.sample_period), float(processor.delay), processor.implicit, processor.predicts)


def _bands(
    cascade: Cascade, scenario: Scenario, clock: Clock, settle: float, calm: Row, noisy: Row | None
) -> list[Band]:
    sampling = sampling_of(cascade, clock)
    seen, disturbed = _errors(cascade, scenario, sampling, calm)
    rough = None if noisy is None else _errors(cascade, scenario, sampling, noisy)[0]
    # the last samples' voltages have not acted yet; what is seen at the first was disturbed just before
    late = 2 + math.ceil(sampling.delay)
    first = min(math.ceil(settle / sampling.period), max(clock.samples - 2 * late, 0))
    settled, before = slice(first, clock.samples - late), slice(max(first - late, 0), clock.samples - late)
    limited = float(np.max(np.abs(calm.u[settled]), initial=0.0)) >= float(scenario.u_max)
    note = "the supply limits u: the laws have less than their gains" if limited else ""
    lines = []
    for stage, (signal, unit) in SIGNALS.items():
        w, law = getattr(disturbed, stage)[before], answers.unhardened(getattr(cascade, stage))
        W, L = _peak(w), _peak(np.diff(w)) / sampling.period
        band = answers.band(law, W, L, sampling if stage in DELAYED else sampling._replace(delay=0.0))
        values = [None if errors is None else _peak(getattr(errors, stage)[settled]) for errors in (seen, rough)]
        lines.append(Band(signal, unit, W, band, values[0] or 0.0, values[1], note))
    return lines


def _peak(x: np.ndarray) -> float:
    return float(np.max(np.abs(x), initial=0.0))


def _errors(cascade: Cascade, scenario: Scenario, sampling: Sampling, rows: Row) -> tuple[Errors, Errors]:
    """The errors at every sample, and what disturbs their rates from there to the next one.

    With prediction the laws act on what will be when their voltage begins: their output of sample n is measured against
    the state then, and i against the i_ref of that sample, on a straight line from one to the next.
    """
    T, ahead = sampling.period, sampling.delay if sampling.predict else 0.0
    n = np.arange(len(rows.t))
    z, z_dot, i = (np.interp(n + ahead, n, np.asarray(x)) for x in (rows.z, rows.z_dot, rows.i))
    i_ref, v_star = np.asarray(rows.i_ref), np.asarray(rows.v_star)
    rate = np.diff(i_ref, append=i_ref[-1:]) / T
    wanted = _wanted(cascade, scenario.realised(), jnp.asarray(rows.t) + ahead * T, z, z_dot, i, v_star, rows.u)
    errors = Errors(
        np.asarray(rows.sigma), np.asarray(rows.v_tilde), np.asarray(rows.i) - np.interp(n - ahead, n, i_ref)
    )
    # the part of v_star that no step of i_ref can follow, Eq. (8)
    drift = np.diff(v_star) - (cascade.model.v(z[1:], i_ref[1:]) - cascade.model.v(z[:-1], i_ref[1:]))
    sigma = np.diff(errors.position) / T - _acting(np.asarray(wanted[0]), sampling.delay)[:-1]
    e = np.diff(errors.current) / T - _acting(np.asarray(wanted[1]) - rate, sampling.delay)[:-1]
    return errors, Errors(sigma, np.asarray(drift) / T, e)


def _acting(x: np.ndarray, delay: float) -> np.ndarray:
    """The mean, over each sample, of what is decided at samples and acts `delay` samples later; 0 before the first."""
    late = [np.concatenate([np.zeros(lag), x])[: len(x)] for lag in (math.floor(delay), math.ceil(delay))]
    share = delay - math.floor(delay)
    return (1 - share) * late[0] + share * late[1]


@jax.jit
def _wanted(
    cascade: Cascade, scenario: Scenario, t: Array, z: Array, z_dot: Array, i: Array, v_star: Array, u: Array
) -> tuple[Array, Array]:
    """Rates of sigma (m/s^2) under the force v_star and of i (A/s) under u, on the nominal plant, undisturbed."""
    model = cascade.model

    def one(t: Array, z: Array, z_dot: Array, i: Array, v_star: Array, u: Array) -> tuple[Array, Array]:
        reference: Reference = reference_at(scenario.reference, t)
        z_ddot = 2 * model.k_z / model.m * z + model.a * v_star - model.g
        along = (Measurement(z_dot, z_ddot, jnp.zeros_like(i)), reference.rate())
        at = (Measurement(z, z_dot, i), reference)
        return jax.jvp(cascade.position.sigma, at, along)[1], model.i_dot(z, z_dot, i, u)

    return jax.vmap(one)(t, z, z_dot, i, v_star, u)
