"""Error control of the adaptive method: the error is in proportion to the loop's amplification of a disturbance.

One step may leave an error of `tolerance` (scale + |z_dot|) in the velocity. From there on it is a kick, and no method
controls how far a loop carries that: near the edge of losing the rotor, without bound. So no tolerance per step gives
an error in metres that holds for every loop.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest
from profiles import examples

import ambjax as amb
from ambjax.ensemble import run_ensemble
from ambjax.simulation.method import QUIET_TOLERANCE

T, SAMPLES = 1e-4, 500
KICKS, SPEED = np.arange(20) * 25, 1e-7  # samples at which a kick begins, and its speed, m/s


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


def random_loops(n):
    rng = np.random.default_rng(3)
    lows = [1e-4, 10, 10, 5, 300, 1e-6, 60, 1, 1e-4, 1e-5, 5e-4]
    highs = [1e-3, 100, 60, 50, 2e4, 1e-1, 300, 25, 2e-3, 1e-2, 1e-2]
    drawn = np.exp(rng.uniform(np.log(lows)[:, None], np.log(highs)[:, None], (len(lows), n)))
    signs = rng.choice([-1, 1], (2, n))
    return Loops(*drawn)._replace(z=signs[0] * drawn[0], amplitude=signs[1] * drawn[8] * rng.choice([0, 1], n))


def motion(loops, method, start=0.0, speed=0.0):
    """Return z and z_dot [n, samples] of an adaptive method, NaN for lost rotors.

    `speed` (m/s) is added to the velocity within a sample.
    """
    cascade, scenario = case_of(loops, start, speed)
    found = run_ensemble(cascade, scenario, amb.Clock(SAMPLES, T, method), fold=None, every=1).trajectory
    held = np.isinf(found.lost_at)[:, None]
    return np.where(held, found.rows.z, np.nan), np.where(held, found.rows.z_dot, np.nan)


def case_of(loops, start=0.0, speed=0.0):
    """Return the cascade and the scenario of all loops."""
    cascade = amb.Cascade(
        position=amb.position.SlidingMode(loops.c, loops.k, loops.p),
        inversion=amb.inversion.Adaptive(np.pi / 2 * loops.slope / loops.p_v, loops.p_v),
        current=amb.current.SlidingMode(loops.k_i, loops.p_i),
    )
    none = np.zeros_like(loops.z)
    scenario = amb.Scenario(
        initial=amb.Initial(z=loops.z),
        reference=amb.SmoothStep(loops.amplitude, loops.start, loops.duration),
        q_z=amb.Pulse(none + speed / T, none + start, none + start + T),
    )
    return cascade, scenario


def far(z, exact):
    """Largest distance over time, m; 0 for a lost rotor."""
    return np.nan_to_num(np.abs(z - exact)).max(axis=1)


def carried(loops, exact, z_dot):
    """Return the displacements (m) caused by one allowed error of the velocity and by a change of 1 m/s."""
    n, exact_steps = len(loops.z), amb.AdaptiveRodas3(1e-9)
    all_ = Loops(*(np.tile(x, len(KICKS)) for x in loops))
    kicked, _ = motion(all_, exact_steps, np.repeat(KICKS * T, n), SPEED)
    gain = far(kicked, np.tile(exact, (len(KICKS), 1))).reshape(-1, n) / SPEED
    scale = float(amb.Plant().sizes().z_dot)
    allowed = QUIET_TOLERANCE * (scale + np.abs(np.nan_to_num(z_dot[:, KICKS]).T))
    return (gain * allowed).max(axis=0), gain.max(axis=0)


@pytest.mark.thorough
def test_the_error_of_a_run_is_at_most_that_of_100_steps():
    exact, z_dot = motion(HARD, amb.AdaptiveRodas3(1e-10))
    assert np.isfinite(exact).all()
    errors = [far(motion(HARD, amb.AdaptiveRodas3(x))[0], exact) for x in (1e-6, QUIET_TOLERANCE, 1e-8, 1e-9)]
    step, gain = carried(HARD, exact, z_dot)
    print(f"\n{errors[1]} m; of one step {step} m; of 1 m/s {gain} m")
    assert (errors[1] > 5e-9).all()  # so RODAS3 promises no error in metres
    assert (gain > 0.3).all()
    assert (errors[1] <= 100 * step).all()
    # Errors of a step fall as the tolerance, and their number grows as its cube root: over three decades to 1/100.
    # Single decades vary, as errors cancel.
    assert (errors[-1] < errors[0] / 100).all(), errors


@pytest.mark.slow
def test_the_automatic_choice_is_within_1e8_of_the_drops_that_amplify_most():
    """These loops are not stiff. The reference's third derivative jumps inside two samples; steps end there."""
    clock = amb.with_method(amb.Clock(SAMPLES, T), *case_of(HARD))
    assert isinstance(clock.method, amb.AdaptiveCashKarp)
    exact = motion(HARD, amb.AdaptiveCashKarp(1e-11))[0]
    independent = motion(HARD, amb.AdaptiveRodas3(1e-10))[0]
    assert far(independent, exact).max() < 2e-9  # RODAS3 falls with its tolerance to the same motion
    assert far(motion(HARD, clock.method)[0], exact).max() <= 5e-9


@pytest.mark.thorough
def test_the_errors_of_many_loops_are_bounded_by_those_of_a_step():
    loops = random_loops(examples(10, 300))
    exact, z_dot = motion(loops, amb.AdaptiveRodas3(1e-9))
    errors = far(motion(loops, amb.AdaptiveRodas3(QUIET_TOLERANCE))[0], exact)
    held = np.isfinite(exact).all(axis=1)
    step, gain = (x[held] for x in carried(loops, exact, z_dot))
    errors = errors[held]
    print(f"\nheld {held.sum()}; error over that of a step {np.max(errors / step):.3g}; gain {gain.max():.3g} s")
    for most in (0.03, 0.1, 0.3, np.inf):
        print(f"gain up to {most} s: {(gain <= most).sum()} loops, error {errors[gain <= most].max():.1e} m")
    assert held.sum() > len(held) / 3
    assert (errors <= 100 * step).all()
    assert errors[gain <= 0.1].max() <= 1e-8
