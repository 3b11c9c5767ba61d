"""Delays up to which a loop on a processor is stable."""

import numpy as np

from ambjax.control.cascade import Cascade
from ambjax.ensemble.delays import DELAYS, at_delays
from ambjax.linear.stability import Findings, Stability, stability_of
from ambjax.simulation.clock import Clock
from ambjax.theorem.sampled_report import Delays
from ambjax.world.scenario import Scenario


def with_stability(
    margin: Delays, cascade: Cascade, scenario: Scenario, clock: Clock, *, known: bool
) -> tuple[Delays, Findings | None]:
    """Return a result of `delay_margin` with the delays, up to its `held`, up to which the loop is stable.

    `DELAYS` delays are tested; a second pass divides the step after the last one that is stable. `known`: as in
    `delay_margin`. Also returns the findings at the case's own delay; None if the rotor is not held there.
    """
    if margin.held is None:
        return margin, None
    own = float(cascade.timing.delay)
    first = own if margin.held >= own else 0.0

    def tried(low: float, high: float) -> tuple[np.ndarray, Stability]:
        delays = np.linspace(low, high, DELAYS)
        return delays, stability_of(at_delays(cascade, delays, known=known), scenario, clock)

    delays, found = tried(first, margin.held)
    at_own = found.of([0]).findings() if first == own else None
    if found.stable.all():
        return margin._replace(stable=margin.held, tested=DELAYS), at_own
    facts, at = found.findings(), int(np.argmin(found.stable))
    stable = None
    if at:
        finer, again = tried(delays[at - 1], delays[at])
        stable = float(finer[max(int(np.argmin(again.stable)) - 1, 0)])
    return margin._replace(stable=stable, swing_m=facts.swing_m, current_A=facts.current_A, tested=DELAYS), at_own
