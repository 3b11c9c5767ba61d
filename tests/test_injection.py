"""The measured sensitivity: against the linear one, and against an independent simulator driven by the same signal."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
import pytest
from oracle import TABLE_1, Body
from profiles import thorough
from sampled_oracle import World, simulate
from structures import SMOOTH
from test_oracle import adaptive, current, smc
from test_sampled import loop_of

from ambjax import Cascade, Clock, Scenario, paper
from ambjax.control import current as current_laws
from ambjax.control import inversion, position
from ambjax.control.observer import Kalman
from ambjax.control.processor import Processor
from ambjax.linear import Zones, frequency_lines, injected, injected_members, linearise, peak
from ambjax.linear.member_responses import multisine
from ambjax.sensors import Sensor
from ambjax.simulation.sliding import Slide

T = 1e-4
LAWS = {"position": smc(200.0, 63.0, 5.0), "inversion": adaptive(2e6, 1e-3), "current": current(600.0, 20.0)}
SIGNS = {
    "position": position.SlidingMode(c=200.0, k=30.0, p=np.inf),
    "inversion": inversion.Adaptive(gamma=1e7, p=np.inf),
    "current": current_laws.SlidingMode(k_i=2000.0, p=np.inf),
}
WORLDS = {
    "complementary": {"observer": ("complementary", {"l": 300.0}), "delay": 0.0},
    "one and a half": {"delay": 1.5, "predict": False},
    "two coils, lags": {
        "kind": "two-coil", "observer": ("kalman", {"w": 3000.0}), "bandwidth": 3e3, "gain": 1.02,
        "amplifier": {"bandwidth": 3e3}, "delay": 1.0,
    },
}  # fmt: skip
INJECTED = ("complementary",)  # each is another program to compile


def largest(system):
    return peak(system, lambda f: np.abs(system.sensitivity(f)), 1.0, 2000.0)


def top(f, size):
    """Height and frequency of the parabola through the largest of the points and its neighbours."""
    k = int(np.clip(np.argmax(size), 1, len(f) - 2))
    a, b, c = np.polyfit(f[k - 1 : k + 2] - f[k], size[k - 1 : k + 2], 2)
    return c - b * b / (4 * a), f[k] - b / (2 * a)


def measured_by_the_oracle(world, harmonics, samples, amplitude):
    """S at the harmonics of 1/(samples T), over the second period; the start is the rotor at rest."""
    body = Body(TABLE_1 | world.plant)
    i = body.current(0.0, body.g / body.a)
    world = dataclasses.replace(world, initial=(0.0, 0.0, i), inversion=adaptive(2e6, 1e-3, i_ref=i))
    turns = 2 * np.pi / samples * np.outer(harmonics, np.arange(2 * samples))
    e = amplitude * np.cos(turns + np.arange(len(harmonics))[:, None] ** 2).sum(axis=0)
    run = simulate(world, 2 * samples, np.stack([e, 0 * e, 0 * e], axis=1), fast=True)
    assert run.lost_at == math.inf
    read, e = (np.exp(-1j * turns[:, samples:]) @ x[samples:] for x in (run.read, e))
    return read / e


@pytest.mark.slow
@pytest.mark.parametrize("name", ["complementary", thorough("one and a half"), "two coils, lags"])
def test_the_peak_agrees_with_the_independent_simulator(name):
    """Driven at nine lines around the peak. The parabola through three of them is within 0.2 % of the peak."""
    world = World(**LAWS, **WORLDS[name])
    cascade, scenario, _ = loop_of(world, 1, (0.0, 0.0, 0.0))
    system = linearise(cascade, scenario, Clock(1, T))
    expected = largest(system)
    harmonics = np.arange(6, 15)
    samples = round(10 / (expected.frequency * T))
    f = harmonics / (samples * T)
    S = measured_by_the_oracle(world, harmonics, samples, 1e-7)
    assert np.abs(S / system.sensitivity(f) - 1).max() < 1e-3
    height, at = top(f, np.abs(S))
    assert height == pytest.approx(expected.height, rel=1e-3)
    assert at == pytest.approx(expected.frequency, rel=0.01)
    if name in INJECTED:
        found = injected(cascade, scenario, Clock(samples, T), f, amplitude=1e-6)
        assert np.abs(found.S / S - 1).max() < 1e-3
        assert found.peak == pytest.approx(np.abs(S).max(), rel=1e-3)


SLOW = Clock(1000, 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cascade", "amplitude", "r"),
    [(Cascade(**SMOOTH), 1e-6, 0.0), (Cascade(**SMOOTH), 1e-6, 1e-3), (Cascade(), 1e-7, 0.0)],
    ids=["smooth", "at 1 mm", "repaired"],
)
def test_the_measured_peak_in_continuous_time_is_the_linear_peak(cascade, amplitude, r):
    """All cases share one program.

    The error of S is of second order in the signs' arguments; that of u is the integration error of the stiff i.
    """
    found = injected(cascade, Scenario(), SLOW, [1.0, 2.0, 5.0, 17.0, 31.0, 100.0], amplitude=amplitude, r=r)
    system = linearise(cascade, Scenario(), SLOW, r)
    expected = system.response(found.frequency)
    assert np.abs(found.S / expected[:, 0, 0] - 1).max() < 1e-3
    assert pytest.approx(expected[:, 2, 0], rel=1e-2) == found.KS
    assert pytest.approx(found.S - 1) == found.T
    assert (found.peak, found.peak) == (found.peak_low, found.peak_high)
    assert (found.lost, found.members, found.saturated, found.amplitude) == (0, 1, 0.0, amplitude)
    # another method is chosen in place of one that evaluates the laws without e
    sliding = injected(cascade, Scenario(), SLOW.with_method(Slide(10)), found.frequency, amplitude=amplitude, r=r)
    assert np.array_equal(sliding.S, found.S)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("processor", "period"), [(Processor(0.0), T), thorough(None, 1e-3)], ids=["processor", "continuous"]
)
def test_the_sensitivity_at_the_velocity_sensor(processor, period):
    """At 1 mm. The tolerances are those of continuous time above: 1e-3 for S, 1e-2 for u."""
    cascade, clock, f = Cascade(**SMOOTH, processor=processor), Clock(1000, period), [20.0, 50.0, 100.0]
    found = injected(cascade, Scenario(), clock, f, reading="z_dot", amplitude=1e-5, r=1e-3)
    H = linearise(cascade, Scenario(), clock, 1e-3).response(found.frequency)
    assert np.abs(found.S / H[:, 1, 1] - 1).max() < 1e-3
    assert pytest.approx(H[:, 2, 1], rel=1e-2) == found.KS
    assert np.abs(H[:, 1, 1] / H[:, 0, 0] - 1).max() > 0.1


def noisy(std, **more):
    return Scenario(sensor=Sensor(std=std, std_z_dot=0.0, std_i=0.0), **more)


@pytest.mark.slow
def test_set_valued_signs_under_noise_and_a_lost_rotor():
    """Within their bands, the implicit signs act as the linear gains of the linear analysis."""
    cascade = Cascade(**SIGNS, processor=Processor(0.0))
    clock, f = Clock(500, T), [20.0, 40.0, 80.0, 160.0]
    found = injected(cascade, noisy(1e-8), clock, f, amplitude=1e-7, members=8, settle=4)
    system = linearise(cascade, noisy(0.0), clock)
    assert found.lost == 0
    at = np.abs(system.sensitivity(np.array([found.peak_frequency])))[0]
    assert found.peak_low < at < found.peak_high
    assert found.peak_low < found.peak < found.peak_high
    assert found.peak_high - found.peak_low < 0.1 * found.peak
    assert found.saturated == 0
    limited = injected(cascade, noisy(1e-8, u_max=8.0), clock, f, amplitude=1e-7, members=8, settle=4)
    assert 0 < limited.saturated < 0.1
    lost = injected(cascade, noisy(1e-8, u_max=1e-3), clock, f, amplitude=1e-7, members=8, settle=4)
    assert (lost.lost, lost.members) == (8, 8)
    assert lost.S is lost.T is lost.KS is lost.peak is lost.peak_low is None


@pytest.mark.slow
def test_each_member_of_a_spread_has_its_own_peak():
    """The tolerances are those of continuous time above. The last member has no voltage, and its rotor is lost."""
    cascade, clock, f = Cascade(**SMOOTH, processor=Processor(0.0)), Clock(4000, T), [20.0, 50.0, 100.0]
    masses = np.array([0.5, 0.588, 0.7, 0.588])
    plants = [dataclasses.replace(Scenario().plant, m=m) for m in (masses, *masses[:3])]
    scenario = Scenario(plant=plants[0], member=np.arange(4), u_max=np.array([200.0, 200.0, 200.0, 1e-9]))
    found = injected_members(cascade, scenario, clock, f, amplitude=1e-6)
    assert found.lost.tolist() == [False, False, False, True]
    assert found.peak[3] == math.inf
    for k, plant in enumerate(plants[1:]):
        S = np.abs(linearise(cascade, Scenario(plant=plant), clock).sensitivity(np.asarray(f)))
        assert found.peak[k] == pytest.approx(S.max(), rel=1e-3)
        assert found.frequency[k] == f[S.argmax()]
    assert np.ptp(found.peak[:3]) > 0.1


@pytest.mark.slow
def test_a_slow_observer_starts_at_rest_under_noise():
    """The estimate must not start at the first noisy reading.

    It would then be wrong by 0.3 mm, which loses rotors of the reading `sampled`.
    """
    world = paper.scenario("regulation", "sampled", pulse=False)
    found = injected(paper.cascade("sampled"), world, Clock(500, T), [20.0, 100.0], members=8)
    assert found.lost == 0


def test_the_wave_repeats_exactly_and_has_the_stated_amplitude():
    wave = multisine(np.array([1, 7, 333]), 1000, T, 2e-5)
    e = np.array([wave.at(jnp.asarray(n)) for n in range(0, 3000, 10)])
    assert np.array_equal(e[:100], e[200:])
    every = np.cos(2 * np.pi / 1000 * np.outer(np.arange(1000), [1, 7, 333]) + wave.phases).sum(axis=1)
    assert np.abs(wave.size * every).max() == pytest.approx(2e-5, rel=1e-12)
    assert e[:100] == pytest.approx(wave.size * every[::10], abs=1e-17)
    assert float(wave(7 * T)) == pytest.approx(wave.size * every[7], abs=1e-16)


def test_lines_are_dense_near_the_peak_and_whole_harmonics():
    clock = Clock(10_000, T)
    f = frequency_lines(Zones(), clock, 40.0)
    assert f[0] == 1.0
    assert f[-1] == 4500.0  # 0.45 of the sampling rate
    assert f == pytest.approx(np.round(f))
    near = (f > 29) & (f < 54)
    assert near.sum() >= 11
    assert len(frequency_lines(Zones(), clock)) < len(f) <= 47


def test_impossible_measurements_are_refused_in_one_line():
    clock = Clock(100, T)
    for f in ([20.0], [5000.0], [], [math.nan]):
        with pytest.raises(ValueError, match=r"injection.frequencies: .* at least 100 Hz, .* below 5000 Hz"):
            injected(Cascade(), Scenario(), clock, f)
    estimating = Cascade(observer=Kalman())
    with pytest.raises(ValueError, match=r"injection.reading = 'z_dot': the observer Kalman estimates"):
        injected(estimating, Scenario(), clock, [100.0], reading="z_dot")
    with pytest.raises(ValueError, match="amplitude = 0:"):
        injected(Cascade(), Scenario(), clock, [100.0], amplitude=0.0)
    with pytest.raises(ValueError, match="members = 0"):
        injected(Cascade(), Scenario(), clock, [100.0], members=0)
