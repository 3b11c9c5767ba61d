"""Slope of each law times the sample period, and the limits below which the discrete step of the law is stable."""

import dataclasses
import math
from typing import Any, SupportsFloat

from ambjax.control.base import with_infinite_steepness
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState
from ambjax.control.sampling import Sampling, slope_limits
from ambjax.control.schedule import extremes
from ambjax.simulation.clock import Clock

# Stages whose output acts after the delay. Observers and inversion laws act on states of their own, without delay.
DELAYED = ("position", "current")


@dataclasses.dataclass(frozen=True)
class SlopeCheck:
    """Slope of a law times T, and the limits for stability and for no oscillation.

    `slope`: the slope (`Law.slope`) times T. `effective_slope`: for an explicit step, equal to `slope`. With
    a = `slope`, an implicit step acts as an explicit step whose slope times T is a/(1 + a). Its `effective_slope` is
    the larger of a/(1 + a) and T times `Law.explicit_rate`. Without a delay, a/(1 + a) is below both limits. `limit`:
    the law is stable if `effective_slope` is below it. `oscillation_limit`: the law does not oscillate if
    `effective_slope` is below it.
    """

    stage: str
    slope: float
    effective_slope: float
    limit: float
    oscillation_limit: float
    implicit: bool

    @property
    def holds(self) -> bool:
        """Whether the law, without the other laws, is stable."""
        return self.effective_slope < self.limit


def slope_checks(cascade: Cascade, clock: Clock) -> list[SlopeCheck]:
    """Return slope times T and its limits for every law with a slope. `cascade`: of one member."""
    sampling, lines = sampling_of(cascade, clock), []
    for stage, law in zip(CascadeState._fields, map(with_infinite_steepness, cascade.laws), strict=True):
        implicit = law.has_own_step(sampling.implicit)
        ends = extremes(law)
        slope = effective_slope = max(_steepest(one.slope(cascade.model)) for one in ends) * sampling.period
        if implicit:
            relaxed = 1 / (1 + 1 / slope) if slope else 0.0
            rate = max(float(one.explicit_rate(cascade.model)) for one in ends)
            effective_slope = max(relaxed, rate * sampling.period)
        if slope:
            limits = slope_limits(sampling.late if stage in DELAYED else 0.0)
            lines.append(SlopeCheck(stage, slope, effective_slope, *limits, implicit))
    return lines


def _steepest(slope: SupportsFloat) -> float:
    """Convert a slope to float. NaN, which results if infinite slopes of set-valued signs cancel, becomes inf."""
    return math.inf if math.isnan(float(slope)) else float(slope)


def sampling_of(cascade: Cascade, clock: Clock) -> Sampling:
    """Return the sampling of the laws of a cascade with a processor."""
    processor: Any = cascade.on_processor().processor
    return processor.sampling(clock.sample_period)
