"""The table [clock] of a case file: samples, their period, the integrator between them, and what is settled."""

import dataclasses
import math

from ambjax.cases.table import Table, show
from ambjax.numerics.records import leaf, numbers
from ambjax.simulation.clock import Clock
from ambjax.simulation.explicit import DOP853, RK4, Euler
from ambjax.simulation.integrate import AdaptiveRodas3, Integrator, Rodas3, Slide

METHODS: dict[str, type] = {"rk4": RK4, "dop853": DOP853, "euler": Euler, "rodas3": Rodas3, "sliding": Slide}
# Substeps of the sliding step where dt = "auto".
SLIDING_SUBSTEPS = 3
# Rows that a run may record: 16 numbers each, so this is about 2.5 GB.
MOST_SAMPLES = 20_000_000
# Metrics compare samples; and by how much two times that are the same may differ.
FEWEST_SAMPLES, ROUNDING = 2, 1e-9
# Steps of a run with a given dt: hours.
MOST_STEPS = 10_000_000_000
DURATION = leaf(default=2.0, unit="s", at_least=1e-9, at_most=1e6, doc="simulated time")
DT = leaf(default=1e-6, unit="s", at_least=1e-15, at_most=1e6, doc="integration step")
(SAMPLE_PERIOD,) = (field for field in dataclasses.fields(Clock) if field.name == "sample_period")


def clock_from(table: Table) -> tuple[Clock, float]:
    """The clock, its method None where it is to be chosen, and clock.duration, s. Raises ValueError as `read_case`."""
    table.only(["duration", "sample_period", "dt", "method"])
    duration = table.leaf("duration", DURATION, DURATION.default)
    period = table.leaf("sample_period", SAMPLE_PERIOD, SAMPLE_PERIOD.default)
    samples = _whole(duration / period)
    if samples is None:
        nearest = max(round(duration / period), 1) * period
        raise ValueError(
            f"{table.at('sample_period')} = {period:g} s does not divide clock.duration = {duration:g} s. "
            f"The nearest duration that it divides is {nearest:.12g} s."
        )
    if samples > MOST_SAMPLES:
        raise ValueError(
            f"{table.at('duration')} = {duration:g} s makes {samples:,} samples of {period:g} s; at most "
            f"{MOST_SAMPLES:,} can be recorded. Shorten the run or lengthen clock.sample_period."
        )
    if samples < FEWEST_SAMPLES:
        raise ValueError(
            f"{table.at('duration')} = {duration:g} s is one sample of {period:g} s; at least {FEWEST_SAMPLES} are "
            "needed. Lengthen the run or shorten clock.sample_period."
        )
    return Clock(samples, period, _method(table, period, samples)), duration


def settled(settle: float, clock: Clock) -> float:
    """run.settle, s, of a run that has a sample from then on. Raises ValueError for one that has none."""
    last = (clock.samples - 1) * clock.sample_period
    if settle > (1 + ROUNDING) * last:
        raise ValueError(
            f"run.settle = {settle:g} s: it must be at most {last:.12g} s, the last sample of clock.duration = "
            f"{clock.duration:g} s, or nothing is settled. Begin it earlier, or lengthen clock.duration."
        )
    return min(settle, last)


def _whole(ratio: float) -> int | None:
    """The whole number of at least 1 that `ratio` is to rounding, or None."""
    nearest = round(ratio) if math.isfinite(ratio) else 0
    return nearest if nearest >= 1 and abs(ratio - nearest) <= ROUNDING * nearest else None


def _method(table: Table, period: float, samples: int) -> Integrator | None:
    dt = table.raw.get("dt", "auto")
    if dt == "auto":
        name = table.choice("method", ["auto", "adaptive", "sliding"], "auto") if "method" in table.raw else "auto"
        return {"auto": None, "adaptive": AdaptiveRodas3(), "sliding": Slide(SLIDING_SUBSTEPS)}[name]
    if isinstance(dt, str):
        raise ValueError(f'{table.at("dt")} = {show(dt)}: it must be "auto" or {numbers(DT)}.')
    dt = table.leaf("dt", DT)
    method = METHODS[table.choice("method", list(METHODS), "rk4")]
    substeps = _whole(period / dt)
    if substeps is None:
        nearest = period / max(round(period / dt), 1)
        raise ValueError(
            f"{table.at('dt')} = {dt:g} s does not divide clock.sample_period = {period:g} s. "
            f'The nearest step that does is {nearest:.12g} s; or use dt = "auto".'
        )
    if samples * substeps > MOST_STEPS:
        raise ValueError(
            f"{table.at('dt')} = {dt:g} s makes {samples * substeps:.3g} steps; at most {MOST_STEPS:.0e} are taken. "
            'Use dt = "auto", or shorten clock.duration.'
        )
    return method(substeps)
