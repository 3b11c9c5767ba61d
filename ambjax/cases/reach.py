"""Check that the reference of a case stays within the clearance."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.spread import Spread, ends
from ambjax.simulation.clock import Clock
from ambjax.world.ramps import Trapezoid
from ambjax.world.recorded import BandNoise, Recorded
from ambjax.world.scenario import Scenario
from ambjax.world.waveforms import Sum

# Signals whose bound (`span`) need not be reached within the run.
BOUNDED = (Sum, BandNoise, Recorded, Trapezoid)
# Instants per block at which a signal is sampled.
BLOCK = 2**16
# Largest number of combinations of the ends of a spread at which a sum is sampled.
MOST_CORNERS = 64


def reach(scenario: Scenario, clock: Clock) -> float:
    """Return a bound on |r| over the run and over all members, m.

    Not every signal reaches it: a sum or a noise need not, nor a recorded signal or a trapezoid whose largest value is
    after the run.
    """
    return max(map(abs, scenario.reference.span(float(clock.duration))))


def widest(spread: Spread, cascade: Cascade, scenario: Scenario) -> Scenario:
    """Return the scenario at the two ends of each spread of the reference or clearance, one array axis per spread."""
    return ends(spread, cascade, scenario, ("reference.", "plant.s_0", "run.clearance"))[1]


def check_reference(spread: Spread, cascade: Cascade, scenario: Scenario, clock: Clock) -> None:
    """Raise ValueError, with the largest |r| and the fix, if the reference leaves the clearance.

    A signal in BOUNDED need not reach its bound, so its values at the samples decide. They are computed for the case
    and for each combination of the ends of its spread. More than MOST_CORNERS combinations are not checked.
    """
    _compare("reference", scenario, clock)
    wide = widest(spread, cascade, scenario)
    what = "spread.reference: at the ends of its [spread], the reference"
    if not isinstance(scenario.reference, BOUNDED):
        _compare(what, wide, clock)
    elif reach(wide, clock) >= np.min(wide.touchdown):
        shape = np.broadcast_shapes(*map(np.shape, jax.tree.leaves((wide.reference, wide.touchdown))))
        for corner in np.ndindex(shape) if math.prod(shape) <= MOST_CORNERS else ():
            _compare(what, jax.tree.map(lambda x, at=corner: np.broadcast_to(x, shape)[at], wide), clock)


def _compare(what: str, scenario: Scenario, clock: Clock) -> None:
    far, stop = reach(scenario, clock), float(np.min(scenario.touchdown))
    if far >= stop and isinstance(scenario.reference, BOUNDED):
        far = largest_at_samples(scenario, clock)
    if not far < stop:
        raise ValueError(
            f"{what} reaches {far:.6g} m within clock.duration = {float(clock.duration):g} s, but the rotor "
            f"touches down at {stop:.6g} m (run.clearance, by default 0.9 of plant.s_0). Units are SI: make the "
            "reference smaller, or the gap wider."
        )


def largest(scenario: Scenario, clock: Clock) -> float:
    """Return the largest |r| of the run, m; of a signal in BOUNDED, the largest at the samples."""
    return (largest_at_samples if isinstance(scenario.reference, BOUNDED) else reach)(scenario, clock)


def largest_at_samples(scenario: Scenario, clock: Clock) -> float:
    """Return the largest |r| at the samples of the run, m."""
    signal, far = scenario.realised().reference, 0.0
    for first in range(0, clock.samples, BLOCK):
        t = np.arange(first, first + BLOCK).clip(max=clock.samples) * float(clock.sample_period)
        far = max(far, float(np.max(np.abs(signal(jnp.asarray(t))))))
    return far
