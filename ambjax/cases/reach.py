"""How far a case asks the rotor to go: a reference beyond the clearance is refused where the case is read."""

import math

import jax
import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.spread import Spread, ends
from ambjax.simulation.clock import Clock
from ambjax.world.scenario import Scenario
from ambjax.world.signals import BandNoise, Sum

# Instants at which a signal is sampled at a time.
BLOCK = 2**16
# Members at the ends of a spread whose sums are sampled.
MOST_CORNERS = 64


def reach(scenario: Scenario, clock: Clock) -> float:
    """A bound on |r| over the run, m; over all members where leaves are arrays. Reached but for sums and noise."""
    return max(map(abs, scenario.reference.span(float(clock.duration))))


def widest(spread: Spread, cascade: Cascade, scenario: Scenario) -> Scenario:
    """The scenario with the ends of every spread of reference and clearance, each on an axis of its own."""
    return ends(spread, cascade, scenario, ("reference.", "plant.s_0", "run.clearance"))[1]


def check_reference(spread: Spread, cascade: Cascade, scenario: Scenario, clock: Clock) -> None:
    """Raise ValueError for a reference that leaves the clearance, with how far it goes and the fix.

    Of a sum or of noise, whose bound may never be reached, samples decide: of the case, and of up to MOST_CORNERS
    combinations of the ends of its spread, where there are no more.
    """
    _compare("reference", scenario, clock)
    wide = widest(spread, cascade, scenario)
    what = "spread.reference: with the ends of its [spread] it"
    if not isinstance(scenario.reference, (Sum, BandNoise)):
        _compare(what, wide, clock)
    elif reach(wide, clock) >= np.min(wide.touchdown):
        shape = np.broadcast_shapes(*map(np.shape, jax.tree.leaves((wide.reference, wide.touchdown))))
        for corner in np.ndindex(shape) if math.prod(shape) <= MOST_CORNERS else ():
            _compare(what, jax.tree.map(lambda x, at=corner: np.broadcast_to(x, shape)[at], wide), clock)


def _compare(what: str, scenario: Scenario, clock: Clock) -> None:
    far, stop = reach(scenario, clock), float(np.min(scenario.touchdown))
    if far >= stop and isinstance(scenario.reference, (Sum, BandNoise)):
        far = sampled(scenario, clock)
    if not far < stop:
        raise ValueError(
            f"{what} reaches {far:.6g} m within clock.duration = {float(clock.duration):g} s, but the rotor "
            f"touches down at {stop:.6g} m (run.clearance, by default 0.9 of plant.s_0). Units are SI: make the "
            "reference smaller, or the gap wider."
        )


def sampled(scenario: Scenario, clock: Clock) -> float:
    """Largest |r| at the samples of the run, m."""
    signal, far = scenario.realised().reference, 0.0
    for first in range(0, clock.samples, BLOCK):
        t = np.arange(first, first + BLOCK).clip(max=clock.samples) * float(clock.sample_period)
        far = max(far, float(np.max(np.abs(signal(t)))))
    return far
