"""The delay margin of a cascade on a processor: the largest delay with which it still holds its rotor."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.processor import MOST_DELAY
from ambjax.ensemble.engine import run_ensemble
from ambjax.simulation.clock import Clock
from ambjax.theorem.processor import sampling_of
from ambjax.world.scenario import Scenario

# Delays of a pass, all run together; the step in which the first of them loses the rotor is divided once more.
DELAYS = 9


class DelayMargin(NamedTuple):
    """In samples: every delay tried from the case's own up to `held` holds, `lost` is the least that does not.

    Where the case's own loses the rotor: from 0 up, and `held` is None where that does too. `lost` is None where even
    the longest allowed holds.
    """

    held: float | None
    lost: float | None

    @property
    def resolution(self) -> float | None:
        """How far the two are apart, samples."""
        return None if self.held is None or self.lost is None else self.lost - self.held


def delay_margin(cascade: Cascade, scenario: Scenario, clock: Clock) -> DelayMargin:
    """The largest delay with which a cascade on a processor holds its rotor over the clock's horizon.

    All else stays: noise and disturbances, and whether the delay is predicted; the predictor knows it. Two or three
    passes over the horizon, of 9 members each. Raises ValueError as `rollout` does.
    """
    processor: Any = cascade.on_processor(0.0, MOST_DELAY).processor
    processor = dataclasses.replace(processor, predict=sampling_of(cascade, clock).predict)
    own = float(processor.delay)

    def tried(low: float, high: float) -> DelayMargin:
        delays = np.linspace(low, high, DELAYS)
        late = dataclasses.replace(cascade, processor=dataclasses.replace(processor, delay=delays))
        outcome = run_ensemble(late, scenario, clock, fold=None)
        lost = np.flatnonzero(np.isfinite(outcome.trajectory.lost_at))
        if not lost.size:
            return DelayMargin(float(delays[-1]), None)
        first = int(lost[0])
        return DelayMargin(float(delays[first - 1]) if first else None, float(delays[first]))

    found = tried(own, MOST_DELAY)
    if found.held is None and own:
        found = tried(0.0, own)
    if found.held is None or found.lost is None:
        return found
    finer = tried(found.held, found.lost)
    return DelayMargin(finer.held, finer.lost) if finer.held is not None and finer.lost is not None else found
