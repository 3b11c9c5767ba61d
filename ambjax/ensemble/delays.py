"""The delay margin of a cascade on a processor: the largest delay with which it still holds its rotor."""

import dataclasses
from typing import Any

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.processor import MOST_DELAY
from ambjax.ensemble.batching import run_ensemble
from ambjax.simulation.clock import Clock
from ambjax.simulation.trajectory import STALLED
from ambjax.theorem.sampled_report import Delays
from ambjax.world.scenario import Scenario

# Delays of a pass, which run together. The scan's are 1/128 sample apart or less: a rotor may be lost in a narrow
# interval of delays, and one between two that are tried is not seen. The second pass divides a step of the scan by 256.
DELAYS = 257


def delay_margin(cascade: Cascade, scenario: Scenario, clock: Clock, *, known: bool = True) -> Delays:
    """The largest delay with which a cascade on a processor holds its rotor over the clock's horizon.

    Scans the delays from the case's own to the longest there is, `DELAYS` of them in one ensemble; then divides the
    first step in which the rotor is lost as finely. A run that diverges is a loss. Where the case's own delay loses the
    rotor the scan goes from 0 to it. All else stays. Delays are predicted unless `predict` is False, as in a map over
    them: with `known` by the delay that is tried, else by the case's own.

    Raises ValueError as `rollout` does.
    """
    processor: Any = cascade.on_processor(0.0, MOST_DELAY).processor
    processor, own = dataclasses.replace(processor, predict=processor.predict is not False), float(processor.delay)
    if not known:
        processor = dataclasses.replace(processor, assumed=processor.ahead)

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
    finer = tried(found.held, first)._replace(step=found.step)
    if finer.held is None:
        return found
    return finer if finer.lost is not None else finer._replace(lost=found.lost)


def _read(delays: np.ndarray, lost_at: np.ndarray, code: np.ndarray) -> Delays:
    """What the runs with these delays, ascending, say: [N] each, the time (s) at which a run ended early and why."""
    ended, step = np.isfinite(lost_at), float(delays[1] - delays[0])
    if not ended.any():
        return Delays(float(delays[-1]), None, None, step)
    first, lost = int(np.argmax(ended)), delays[ended & (code != STALLED)]
    return Delays(
        float(delays[first - 1]) if first else None,
        float(lost[0]) if lost.size else None,
        float(delays[first]) if code[first] == STALLED else None,
        step,
    )
