"""The delay margin of a cascade on a processor: the largest delay up to which the rotor survives."""

import itertools

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.control.processor import MOST_DELAY, USUAL_DELAY
from ambjax.ensemble.batching import run_ensemble
from ambjax.ensemble.blocks import quarters
from ambjax.simulation.clock import Clock
from ambjax.simulation.trajectory import STALLED
from ambjax.theorem.sampled_report import Delays
from ambjax.world.scenario import Scenario

# Number of delays of one ensemble. Up to USUAL_DELAY, the steps are 1/128 sample or less, because the rotor may be lost
# only in a narrow interval of delays; from there to MOST_DELAY they are at most 1/32 sample. An interval that lies
# between two neighbouring delays is not found. The last ensemble divides one step by 256.
DELAYS = 257
# The ranges of delays end at these numbers of samples. All delays share one compiled program.
ENDS = (USUAL_DELAY, MOST_DELAY)


def delay_margin(cascade: Cascade, scenario: Scenario, clock: Clock, *, known: bool = True) -> Delays:
    """Compute the largest delay up to which the rotor survives the clock's horizon with a cascade on a processor.

    The search scans `DELAYS` delays from the case's own delay to USUAL_DELAY in one ensemble. If the rotor survives
    all of them, a second ensemble continues to MOST_DELAY. A last one divides the step that ends at the first delay at
    which the rotor is lost or the integrator stalls. If this is the case's own delay, the search scans from 0 to that
    delay. A run that diverges counts as lost; a run that stalls is undecided. All other inputs stay as in the case.

    The controller predicts over the delay unless the processor's `predict` is False, as in a map over delays.

    - `known`: whether the controller predicts over the delay of each run (True) or over the case's own delay (False).

    Returns the Delays, in samples. Raises ValueError as `rollout` does.
    """
    own = float(cascade.timing.delay)

    def tried(*ends: float) -> Delays:
        runs = []
        for low, high in itertools.pairwise(ends):
            first = len(runs) > 0  # `low` was simulated before
            delays = np.linspace(low, high, DELAYS + first)[first:]
            late = at_delays(cascade, delays, known=known)
            # the fold of `stability_of`, which tests these delays in the same compiled program
            ending = run_ensemble(late, scenario, clock, fold=quarters(clock)).trajectory
            runs.append((delays, np.asarray(ending.lost_at), np.asarray(ending.lost_code)))
            if np.isfinite(runs[-1][1]).any():
                break
        return _read(*map(np.concatenate, zip(*runs, strict=True)))

    found = tried(own, *([end for end in ENDS if end > own] or ENDS[-1:]))
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
    cascade = cascade.on_processor(0.0, MOST_DELAY, between=True)
    # an array in both cases, so that both use the same compiled program
    assumed = delays if known else np.full(len(delays), float(cascade.timing.ahead))
    return cascade.with_processor(predict=cascade.timing.predict is not False, delay=delays, assumed=assumed)


def _read(delays: np.ndarray, lost_at: np.ndarray, code: np.ndarray) -> Delays:
    """Return the margin from runs at ascending `delays` [N], the time (s) of each early end [N] and its code [N]."""
    ended, step = np.isfinite(lost_at), float(np.max(np.diff(delays)))
    if not ended.any():
        return Delays(float(delays[-1]), None, None, step)
    first, lost = int(np.argmax(ended)), delays[ended & (code != STALLED)]
    return Delays(
        float(delays[first - 1]) if first else None,
        float(lost[0]) if lost.size else None,
        float(delays[first]) if code[first] == STALLED else None,
        step,
    )
