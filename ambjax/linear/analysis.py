"""Linearisation of a case, and its analysis: sensitivity with its zone, margins, stiffness, noise, poles."""

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.cascade import Cascade
from ambjax.ensemble.batching import size
from ambjax.linear.margins import (
    BAND,
    NO_PEAK,
    STATIC,
    LoopMargins,
    Margins,
    ResponsePeak,
    margins_of,
    noise_gain,
    peak,
    poles_in_s,
    whole_end,
)
from ambjax.linear.matrices import loop_matrices, rest
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.declared import require_number
from ambjax.numerics.records import Scalar, bounded, canonical, positive, record, require_concrete
from ambjax.numerics.shapes import require_one_member, varying
from ambjax.simulation.clock import Clock, takes_case
from ambjax.simulation.rollout import prepare
from ambjax.world.scenario import Scenario

_matrices = compiled_quickest(loop_matrices)
_rest = compiled_quickest(rest)


@record
class Zones:
    """Frequency range of the sensitivity, amplitude of its measurement, and limits of the zones A to D.

    The default limits are those of ISO 14839-3 (peak of |S|) and ISO 14839-2 (largest |z| as a share of the clearance),
    as secondary sources cite them.
    """

    f_low: Scalar = positive(1.0, "Hz", 1e6, "lowest frequency; 0 is always included")
    f_high: Scalar | None = positive(
        None,
        "Hz",
        1e6,
        "highest frequency; none: 0.45 of the sampling rate, in continuous time where |S - 1| has decayed",
    )
    amplitude: Scalar | None = positive(None, "m", 1, "amplitude of an injected multi-sine; none: 1 % of the gap s_0")
    zone_a: Scalar = bounded(3.0, "1", 1, 1e3, "upper limit of zone A for the peak of |S|")
    zone_b: Scalar = bounded(4.0, "1", 1, 1e3, "upper limit of zone B")
    zone_c: Scalar = bounded(5.0, "1", 1, 1e3, "upper limit of zone C; above it is zone D")
    clearance_a: Scalar = positive(0.3, "1", 1, "upper limit of zone A for max |z| as a share of the clearance")
    clearance_b: Scalar = positive(0.4, "1", 1, "upper limit of zone B")
    clearance_c: Scalar = positive(0.5, "1", 1, "upper limit of zone C; above it is zone D")

    def check(self, period: Scalar | None) -> None:
        """Raise ValueError if the limits are not in ascending order, or as `range` does."""
        self.range(period)
        for names in (("zone_a", "zone_b", "zone_c"), ("clearance_a", "clearance_b", "clearance_c")):
            limits = [float(getattr(self, name)) for name in names]
            if sorted(limits) != limits:
                raise ValueError(f"sensitivity.{names[0]} to {names[2]} = {limits}: they must be in ascending order.")

    def zone(self, peak: float) -> str:
        """Return the zone of a peak of |S|: A, B, C or D."""
        return _zone(peak, self.zone_a, self.zone_b, self.zone_c)

    def clearance_zone(self, share: float) -> str:
        """Return the zone of a share of the clearance that |z| reaches: A, B, C or D."""
        return _zone(share, self.clearance_a, self.clearance_b, self.clearance_c)

    @property
    def limits(self) -> list[float]:
        """The upper limits of the zones A, B and C."""
        return [float(x) for x in (self.zone_a, self.zone_b, self.zone_c)]

    def whole(self, period: Scalar | None) -> "Zones":
        """Return these zones with the whole range of frequencies, up to half the sampling rate.

        `period`: sample period, s; None in continuous time.
        """
        return dataclasses.replace(self, f_high=None if period is None else 0.5 / float(period))

    def range(self, period: Scalar | None, end: float = math.inf) -> tuple[float, float]:
        """Return the lowest and the highest frequency, Hz.

        `period`: sample period, s; None in continuous time. `end`: the highest frequency in continuous time if f_high
        is not given, Hz. Raises ValueError if the range is empty or exceeds half the sampling rate.
        """
        low, high = float(self.f_low), end if period is None else BAND / float(period)
        if self.f_high is not None:
            high = float(self.f_high)
        if period is not None and high > 0.5 / float(period):
            raise ValueError(
                f"sensitivity.f_high = {high:g}: it must be at most half the sampling rate, {0.5 / float(period):g} Hz."
            )
        if not low < high:
            raise ValueError(f"sensitivity.f_low = {low:g}: it must be below f_high, {high:g} Hz. Lower it.")
        return low, high


def largest_in(system: StateSpace, zones: Zones) -> Callable[[Callable[[np.ndarray], np.ndarray]], ResponsePeak]:
    """Return the function that finds the peak of a magnitude in the band of `zones`, and a larger one outside it.

    It takes a function that returns magnitudes [F] of responses [F, outputs, inputs]. All peaks scan the same
    frequencies. Raises ValueError as `Zones.range` does.
    """
    end, responses = whole_end(system), dict[bytes, np.ndarray]()
    low, high = zones.range(system.period, max(end, 2 * float(zones.f_low)))

    def response(f: np.ndarray) -> np.ndarray:
        key = f.tobytes()
        if key not in responses:
            responses[key] = np.asarray(system.response(f))
        return responses[key]

    return lambda magnitude: peak(system, lambda f: magnitude(response(f)), low, high, end)


def _stiffness(system: StateSpace, m: float, f: float) -> float:
    """Return the static stiffness, N/m. `f`: a small frequency (Hz) at which the static response is computed.

    The stiffness is infinite if the response to a force vanishes at frequency 0, as with integral action.
    """
    static, above = np.abs(system.response(np.array([f, 10 * f]))[:, 3, 2])
    return m / float(static) if static > 0.5 * above else np.inf


def _zone(x: float, a: Scalar, b: Scalar, c: Scalar) -> str:
    return next((name for name, limit in zip("ABC", (a, b, c), strict=True) if x < float(limit)), "D")


class Analysis(NamedTuple):
    """Linear analysis of a loop at one equilibrium.

    - `stable`: whether all poles are stable. If not, the peaks are infinite (`margins.NO_PEAK`), and the stiffness NaN.
    - `S`, `T`, `KS`: peaks of |S|, |T| (1) and |KS| (V/m) in the band of the case. Each contains the largest value
      outside this band if it is larger.
    - `zone`: zone of the peak of |S|; D if the loop is unstable.
    - `S_velocity`: peak of |S| for a test signal on the velocity reading; None if the controller does not use one.
    - `margins`: the smaller of the margins at the reading and at the command; all are 0 if the loop is unstable.
    - `margins_at`: the margins at each of the two places.
    - `stiffness`: static stiffness, N/m; inf if the law integrates the measured position. If it integrates a prediction
      over the delay T, the stiffness is finite, about 2 m / T^2, because the prediction does not include the force.
    - `noise`: rms of z per rms of white noise on the reading of z, one value per sample; inf if the loop is unstable.
    - `poles`: poles in 1/s, in the order of decreasing real part.
    """

    stable: bool
    S: ResponsePeak
    T: ResponsePeak
    KS: ResponsePeak
    zone: str
    S_velocity: ResponsePeak | None
    margins: Margins
    stiffness: float
    noise: float
    poles: np.ndarray
    margins_at: LoopMargins


@takes_case
def linearise(cascade: Cascade, scenario: Scenario, clock: Clock, r: Scalar = 0.0) -> StateSpace:
    """Linearise the loop at the equilibrium of the constant reference r (m).

    The linear system contains the gain, offset and bandwidth of the sensor and the bandwidth of the amplifier. It does
    not contain noise, runout, disturbances, converters, faults, the guard, the limits of supply and amplifier, or the
    dead band. On a processor it is the exact map of one sample period.

    Returns the state space with NumPy arrays. States that no input reaches are left out. Raises ValueError as `rollout`
    does, if no equilibrium is found at r, and if a law has no derivative there.
    """
    require_number("r", r)
    require_concrete("linearise", (cascade, scenario, clock, r))
    require_one_member({"controller": cascade, "scenario": scenario, "clock": clock})
    inputs = canonical((*linearisation_inputs(cascade, scenario, clock), r))
    system, found = _matrices(*inputs)
    return checked(system, found, r, "" if found else _rest(*inputs).moving())


def checked(system: StateSpace, found: Any, r: Scalar, moving: str = "") -> StateSpace:
    """Return a result of `loop_matrices` with NumPy arrays, without the states that no input reaches.

    `moving`: path of the state that changes most where the search for an equilibrium ended, for the message. Raises
    ValueError if the result has no meaning: no equilibrium at r (m), or a matrix that is not finite.
    """
    if not found:
        raise ValueError(
            f"no equilibrium at r = {float(r):g} m was found, so the loop has no linearisation there: Newton's method "
            f"ended where {moving or 'a state'} still changes. `ambjax simulate` shows whether the rotor is held."
        )
    if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(system)):
        raise ValueError(
            f"the loop has no linearisation at the equilibrium of r = {float(r):g} m: the derivative of a law or of "
            "the plant is not finite there."
        )
    return system.without_idle()


@takes_case
def linearise_members(
    cascade: Cascade, scenario: Scenario, clock: Clock, r: Scalar = 0.0
) -> tuple[StateSpace, np.ndarray]:
    """Linearise the loop of every member of an ensemble, whose varying leaves are arrays [N], at the reference r (m).

    Returns the matrices, each with a leading axis [N], and whether an equilibrium was found for each member [N]; if
    not, the matrices of the member have no meaning. `checked` examines one member. Raises ValueError as `rollout` does.
    """
    inputs = canonical((*linearisation_inputs(cascade, scenario, clock), r))
    # in turn, with the program of one loop: a call takes about 1 ms, the compilation of another program seconds
    leaves, structure = jax.tree.flatten(inputs)
    columns = [x if varies else itertools.repeat(x) for x, varies in zip(leaves, varying(inputs), strict=True)]
    members = itertools.islice(zip(*columns, strict=False), size(inputs))
    each = [_matrices(*jax.tree.unflatten(structure, member)) for member in members]
    return jax.tree.map(lambda *xs: np.stack(xs), *each)


def linearisation_inputs(cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[Cascade, Scenario, Scalar]:
    """Check a case, and return the first three arguments of `loop_matrices`: cascade, scenario and sample period (s).

    If the cascade has a processor, the returned cascade is that of `Cascade.on_processor`. The integration method of
    `clock` has no effect: it may be too coarse for this cascade. Raises ValueError as `rollout` does otherwise.
    """
    system, clock = prepare(cascade, scenario, clock.with_method(None))
    if cascade.sampled:
        cascade = system.loop.cascade  # pyright: ignore[reportAttributeAccessIssue]
    return dataclasses.replace(cascade), scenario, clock.sample_period


def analyse(
    system: StateSpace,
    m: Scalar,
    period: Scalar,
    zones: Zones | None = None,
    velocity: bool = False,
    held: bool = True,
) -> Analysis:
    """Analyse a linearised loop.

    - `m`: mass of the rotor, kg.
    - `period`: time for which a value of the noise is held in continuous time, s; not used on a processor.
    - `zones`: frequency range and zones; None: the defaults.
    - `velocity`: whether the velocity has its own sensor.
    - `held`: False for a loop that a run shows not to be stable (`stability_of`), whatever its poles are.

    Raises ValueError as `Zones.range` does.
    """
    zones = Zones() if zones is None else zones
    largest, poles = largest_in(system, zones), poles_in_s(system)
    if not (held and system.stable):
        none, no, at = Margins(*[0.0] * 6), NO_PEAK, NO_PEAK if velocity else None
        return Analysis(False, no, no, no, "D", at, none, np.nan, np.inf, poles, LoopMargins(none, none))
    S, T = largest(lambda H: np.abs(H[:, 0, 0])), largest(lambda H: np.abs(H[:, 0, 0] - 1))
    KS, at = largest(lambda H: np.abs(H[:, 2, 0])), largest(lambda H: np.abs(H[:, 1, 1])) if velocity else None
    stiffness = _stiffness(system, float(m), STATIC * float(zones.f_low))
    noise = noise_gain(system, float(period))
    margins = margins_of(system)
    return Analysis(True, S, T, KS, zones.zone(S.height), at, margins.smaller, stiffness, noise, poles, margins)
