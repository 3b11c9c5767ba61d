"""Error control of the adaptive method: the error is in proportion to the loop's amplification of a disturbance.

One step may leave an error of `tolerance` (scale + |z_dot|) in the velocity. From there on it is a kick, and no method
controls how far a loop carries that: near the edge of losing the rotor, without bound. So no tolerance per step gives
an error in metres that holds for every loop.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest

import ambjax as amb
from ambjax.ensemble import run_ensemble

T, SAMPLES = 1e-4, 500


class Loops(NamedTuple):
    """Columns of numbers [n]: smooth gains, a rotor off centre, a smooth step of the reference."""

    z: Any
    c: Any
    k: Any
    p: Any
    slope: Any  # of the inversion law, 1/s
    p_v: Any
    k_i: Any
    p_i: Any
    amplitude: Any
    start: Any
    duration: Any


# From 0.2 mm off centre onto a smooth step of 2 to 3 ms: the worst of 3000 drawn at random.
HARD = Loops(*np.array([
    (-2e-4, 87.9, 27.4, 13.7, 856.0, 2.16e-6, 162.0, 24.9, 3.89e-4, 1.38e-5, 2.27e-3),
    (2e-4, 49.8, 38.9, 34.1, 534.0, 4.9e-4, 212.0, 6.04, -3.58e-4, 7.37e-4, 2.93e-3),
    (2e-4, 19.1, 32.5, 17.0, 1460.0, 1.73e-5, 287.0, 1.56, -7.33e-4, 2.85e-5, 2.97e-3),
    (-2e-4, 16.2, 34.4, 11.6, 815.0, 3.45e-6, 132.0, 5.41, 2.44e-4, 1.8e-4, 1.63e-3),
]).T)  # fmt: skip


def motion(loops, method):
    """Return z [n, samples] of an adaptive method, NaN for lost rotors."""
    found = run_ensemble(*case_of(loops), amb.Clock(SAMPLES, T, method), fold=None, record_every=1).trajectory
    return np.where(np.isinf(found.lost_at)[:, None], found.rows.z, np.nan)


def case_of(loops):
    """Return the cascade and the scenario of all loops."""
    cascade = amb.Cascade(
        position=amb.laws.position.SlidingMode(loops.c, loops.k, loops.p),
        inversion=amb.laws.inversion.Adaptive(np.pi / 2 * loops.slope / loops.p_v, loops.p_v),
        current=amb.laws.current.SlidingMode(loops.k_i, loops.p_i),
    )
    reference = amb.signals.SmoothStep(loops.amplitude, loops.start, loops.duration)
    return cascade, amb.Scenario(initial=amb.Initial(z=loops.z), reference=reference)


def far(z, exact):
    """Largest distance over time, m; 0 for a lost rotor."""
    return np.nan_to_num(np.abs(z - exact)).max(axis=1)


@pytest.mark.slow
def test_the_automatic_choice_is_within_1e8_of_the_drops_that_amplify_most():
    """These loops are not stiff. The reference's third derivative jumps inside two samples; steps end there."""
    clock = amb.solvers.with_method(amb.Clock(SAMPLES, T), *case_of(HARD))
    assert isinstance(clock.method, amb.solvers.AdaptiveCashKarp)
    exact = motion(HARD, amb.solvers.AdaptiveCashKarp(1e-11))
    independent = motion(HARD, amb.solvers.AdaptiveRodas3(1e-10))
    assert far(independent, exact).max() < 2e-9  # RODAS3 falls with its tolerance to the same motion
    assert far(motion(HARD, clock.method), exact).max() <= 5e-9
