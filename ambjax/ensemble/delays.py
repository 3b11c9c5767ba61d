"""The delay margin of a cascade on a processor: the largest delay up to which the rotor survives."""

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

# Number of delays of one pass, which are simulated together in one ensemble. The first pass has steps of 1/128 sample
# or less, because the rotor may be lost only in a narrow interval of delays. An interval that lies between two
# neighbouring delays is not found. The second pass divides one step of the first by 256.
DELAYS = 257


def delay_margin(cascade: Cascade, scenario: Scenario, clock: Clock, *, known: bool = True) -> Delays:
    """Compute the largest delay up to which the rotor survives the clock's horizon with a cascade on a processor.

    The search scans `DELAYS` delays, from the case's own delay to the longest one allowed, in one ensemble. A second
    pass divides the step that ends at the first delay at which the rotor is lost or the integrator stalls. If this is
    the case's own delay, the search scans from 0 to that delay. A run that diverges counts as lost; a run that stalls
    is undecided. All other inputs stay as in the case.

    The controller predicts over the delay unless the processor's `predict` is False, as in a map over delays.

    - `known`: whether the controller predicts over the delay of each run (True) or over the case's own delay (False).

    Returns the Delays, in samples. Raises ValueError as `rollout` does.
    """
    processor: Any = cascade.processor
    own = float(processor.delay)

    def tried(low: float, high: float) -> Delays:
        delays = np.linspace(low, high, DELAYS)
        ending = run_ensemble(at_delays(cascade, delays, known=known), scenario, clock, fold=None).trajectory
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


def at_delays(cascade: Cascade, delays: np.ndarray, *, known: bool) -> Cascade:
    """Return the cascade with these delays [N] (samples) of its processor. `known`: as in `delay_margin`."""
    processor: Any = cascade.on_processor(0.0, MOST_DELAY).processor
    # an array in both cases, so that both use the same compiled program
    assumed = delays if known else np.full(len(delays), float(processor.ahead))
    late = dataclasses.replace(processor, predict=processor.predict is not False, delay=delays, assumed=assumed)
    return dataclasses.replace(cascade, processor=late)


def _read(delays: np.ndarray, lost_at: np.ndarray, code: np.ndarray) -> Delays:
    """Return the margin from runs at ascending `delays` [N], the time (s) of each early end [N] and its code [N]."""
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
