"""The table [clock] of a case file: samples, their period, and the integrator."""

import dataclasses
import math

from ambjax.cases.table import Table, show
from ambjax.numerics.declared import numbers
from ambjax.numerics.records import leaf
from ambjax.simulation.clock import Clock
from ambjax.simulation.explicit import DOP853, RK4, Euler
from ambjax.simulation.integrate import Integrator
from ambjax.simulation.metrics import ROUNDING
from ambjax.simulation.rosenbrock import AdaptiveRodas3, Rodas3
from ambjax.simulation.sliding import Slide

METHODS: dict[str, type] = {"rk4": RK4, "dop853": DOP853, "euler": Euler, "rodas3": Rodas3, "sliding": Slide}
# Substeps per sample of method = "sliding" with dt = "auto".
SLIDING_SUBSTEPS = 3
# Largest number of rows of a run; with 16 numbers a row, about 2.5 GB.
MOST_SAMPLES = 20_000_000
FEWEST_SAMPLES = 2  # smallest number of samples for the metrics
# Largest number of steps of a run with a given dt. A run of so many steps takes hours.
MOST_STEPS = 10_000_000_000
DURATION = leaf(default=2.0, unit="s", at_least=1e-9, at_most=1e6, doc="simulated time")
DT = leaf(default=1e-6, unit="s", at_least=1e-15, at_most=1e6, doc="integration step")
(SAMPLE_PERIOD,) = (field for field in dataclasses.fields(Clock) if field.name == "sample_period")


def clock_from(table: Table) -> tuple[Clock, float]:
    """Return the clock and clock.duration in s. The clock's method is None if the reader must choose it later."""
    table.only(["duration", "sample_period", "dt", "method"])
    duration = table.leaf("duration", DURATION, DURATION.default)
    period = table.leaf("sample_period", SAMPLE_PERIOD, SAMPLE_PERIOD.default)
    samples = _whole(duration / period)
    if period > duration:
        rate = f" If it is a rate in Hz, give its inverse, {1 / period:g} s." if 1 / period < duration else ""
        raise ValueError(
            f"{table.at('sample_period')} = {period:g} s is longer than clock.duration = {duration:g} s.{rate} If it "
            "is in milliseconds or microseconds, give it in seconds."
        )
    if samples is None:
        nearest = max(round(duration / period), 1) * period
        raise ValueError(
            f"{table.at('sample_period')} = {period:g} s does not divide clock.duration = {duration:g} s. "
            f"The nearest duration that it divides is {nearest:.12g} s."
        )
    if samples > MOST_SAMPLES:
        why = f"at most {MOST_SAMPLES:,} can be recorded. Shorten the run or lengthen clock.sample_period."
        raise ValueError(f"{table.at('duration')} = {duration:g} s makes {samples:,} samples of {period:g} s; {why}")
    if samples < FEWEST_SAMPLES:
        why = f"at least {FEWEST_SAMPLES} are needed. Lengthen the run or shorten clock.sample_period."
        raise ValueError(f"{table.at('duration')} = {duration:g} s is one sample of {period:g} s; {why}")
    return Clock(samples, period, _method(table, period, samples)), duration


def _whole(ratio: float) -> int | None:
    """Return the integer that `ratio` equals within ROUNDING; None if there is none or if it is below 1."""
    nearest = round(ratio) if math.isfinite(ratio) else 0
    return nearest if nearest >= 1 and abs(ratio - nearest) <= ROUNDING * nearest else None


def _method(table: Table, period: float, samples: int) -> Integrator | None:
    dt = table.raw.get("dt", "auto")
    if dt == "auto":
        if (fixed := table.raw.get("method")) in [name for name in METHODS if name != "sliding"]:
            raise ValueError(f"{table.at('method')} = {show(fixed)} needs a step: give clock.dt in s.")
        name = table.choice("method", ["auto", "adaptive", "sliding"], "auto")
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
            f"{table.at('dt')} = {dt:g} s makes {samples * substeps:.3g} steps; at most {MOST_STEPS:.0e} are allowed. "
            'Use dt = "auto", or shorten clock.duration.'
        )
    return method(substeps)
