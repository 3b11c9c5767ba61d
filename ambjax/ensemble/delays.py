"""The delay margin of a cascade on a processor: the largest delay with which it still holds its rotor."""

import dataclasses
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.processor import MOST_DELAY
from ambjax.ensemble.engine import run_ensemble
from ambjax.simulation.clock import Clock
from ambjax.simulation.trajectory import STALLED
from ambjax.theorem.processor import Delays, sampling_of
from ambjax.world.scenario import Scenario

# Delays of a pass, all run together; the step in which the first of them does not hold is divided once more.
DELAYS = 9


def delay_margin(cascade: Cascade, scenario: Scenario, clock: Clock) -> Delays:
    """The largest delay with which a cascade on a processor holds its rotor over the clock's horizon.

    All else stays: noise and disturbances, and whether the delay is predicted; the predictor knows it. Two or three
    passes over the horizon, of 9 members each. Raises ValueError as `rollout` does.
    """
    processor: Any = cascade.on_processor(0.0, MOST_DELAY).processor
    processor = dataclasses.replace(processor, predict=sampling_of(cascade, clock).predict)
    own = float(processor.delay)

    def tried(low: float, high: float) -> Delays:
        delays = np.linspace(low, high, DELAYS)
        late = dataclasses.replace(cascade, processor=dataclasses.replace(processor, delay=delays))
        ending = run_ensemble(late, scenario, clock, fold=None).trajectory
        return _read(delays, np.asarray(ending.lost_at), np.asarray(ending.lost_code))

    found = tried(own, MOST_DELAY)
    if found.held is None and own:
        found = tried(0.0, own)
    first = found.lost if found.undecided is None else found.undecided
    if found.held is None or first is None:
        return found
    finer = tried(found.held, first)
    if finer.held is None:
        return found
    return finer if finer.lost is not None else finer._replace(lost=found.lost)


def _read(delays: np.ndarray, lost_at: np.ndarray, code: np.ndarray) -> Delays:
    """What the runs with these delays, ascending, say: [N] each, the time (s) at which a run ended early and why."""
    ended = np.isfinite(lost_at)
    if not ended.any():
        return Delays(float(delays[-1]), None)
    first, lost = int(np.argmax(ended)), delays[ended & (code != STALLED)]
    return Delays(
        float(delays[first - 1]) if first else None,
        float(lost[0]) if lost.size else None,
        float(delays[first]) if code[first] == STALLED else None,
    )
