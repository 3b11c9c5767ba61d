"""Linear analysis: margins against python-control, the tuner's quantities, noise. Matrices: tests/test_injection.py."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from structures import SMOOTH

from ambjax import Cascade, Clock, Scenario, rollout
from ambjax.compiler.short_compilation import QUICKEST, supported
from ambjax.control import current, inversion, observer, position
from ambjax.control.processor import Processor
from ambjax.linear import StateSpace, Zones, analyse, linearise, loop_quantities, margins_of, noise_gain, peak
from ambjax.linear.equilibrium import newton_of
from ambjax.linear.matrices import rest
from ambjax.plants import Plant
from ambjax.sensors import Sensor
from ambjax.world.amplifier import Amplifier
from ambjax.world.plant import TwoCoil
from ambjax.world.scenario import Initial

T = 1e-4
QUICK = supported(QUICKEST)  # each program runs once
CLOCK = Clock(samples=10, sample_period=T)
SLUGGISH = Sensor(bandwidth=2000.0, gain=1.05, offset=1e-5)
# name: cascade's processor and laws, scenario, reference (m)
LOOPS = {
    "true signs": (Processor(0.0), {"position": position.SlidingMode(c=200.0, k=30.0, p=np.inf)}, Scenario(), 0.0),
    "two coils off the model": (Processor(0.5), {"current": current.ProportionalIntegral()},
                                Scenario(plant=TwoCoil(m=0.6, A=0.12)), 1e-3),
    "not predicted": (Processor(1.5, predict=False), {"observer": observer.Complementary(l=300.0, z_hat=0.0)},
                      Scenario(sensor=Sensor()), -1e-3),
    "lags": (Processor(1.0), {"observer": observer.Kalman(w=1000.0)},
             Scenario(sensor=SLUGGISH, amplifier=Amplifier(bandwidth=1500.0, slew=1e6, dead_band=0.1)), 5e-4),
}  # fmt: skip


def loop_of(name):
    processor, laws, scenario, r = LOOPS[name]
    return Cascade(**(SMOOTH | laws), processor=processor), scenario, r


NAMES = [pytest.param(x, marks=pytest.mark.slow if x == "lags" else pytest.mark.thorough) for x in LOOPS]


@pytest.mark.parametrize("name", NAMES)
def test_the_differentiable_quantities_agree_with_the_analysis(name):
    cascade, scenario, r = loop_of(name)
    system = linearise(cascade, scenario, CLOCK, r)
    expected = analyse(system, Plant().m, T)
    speeds = jnp.asarray([20.0, 150.0])
    find = jax.jit(
        lambda system: loop_quantities(system, jnp.asarray(True), 1.0, 5e2, 1e6, speeds=speeds), compiler_options=QUICK
    )
    found = find(system)
    # a peak's frequency is found to 1e-5; the zeros of a deadbeat loop, all at 0, to 1e-5 too, and KS from them to 3e-4
    tolerance = 3e-4 if name == "true signs" else 1e-6
    peaks = [(peak.outside or peak).height for peak in (expected.S, expected.T, expected.KS)]
    assert np.allclose(found[:3], peaks, rtol=tolerance)
    assert found.delay_margin_s == pytest.approx(expected.margins.delay, rel=max(1e-7, tolerance / 100))
    at_speeds = np.abs(np.asarray(system.response(np.asarray(speeds)))[:, 0, 0])
    assert found.sensitivity_1x == pytest.approx(at_speeds.max(), rel=1e-7)
    assert found.growth == pytest.approx(expected.poles[0].real, rel=1e-9)


def test_the_repaired_gains_amplify_sensor_errors_41_times():
    """In continuous time at frequency 0.

    The factor is the force per error, 2.8e5 1/s^2, divided by the stiffness of the loop, c k 2p/pi = 6.8e3.
    """
    analysis = analyse(linearise(Cascade(), Scenario(), CLOCK), Plant().m, T, velocity=True)
    k_s, stiffness = 2.817e5 - 1282.0 * 2, 17 * 25 * 2 * 25 / np.pi
    assert pytest.approx(41, rel=0.02) == analysis.S.height
    assert analysis.S.height == pytest.approx(k_s / stiffness, rel=0.02)
    assert analysis.S.frequency == 0.0
    assert analysis.zone == "D"
    assert analysis.stiffness == pytest.approx(Plant().m * stiffness, rel=1e-6)


@pytest.mark.parametrize("name", [pytest.param("two coils off the model", marks=pytest.mark.slow), "continuous"])
def test_margins_agree_with_python_control(name):
    import control

    if name == "continuous":
        system = linearise(Cascade(**SMOOTH), Scenario(), CLOCK)
    else:
        cascade, scenario, r = loop_of(name)
        system = linearise(cascade, scenario, CLOCK, r)
    scaled = system.scaled()
    A, B, C = scaled.A, scaled.B[:, :1], scaled.C[:1]
    S = control.StateSpace(A, B, C, np.eye(1), 0 if system.period is None else T)
    L = control.StateSpace(A - B @ C, B, -C, 0, S.dt)  # 1/S - 1
    f = np.geomspace(1.0, 0.45 / T, 50)
    at = 2j * np.pi * f if system.period is None else np.exp(2j * np.pi * f * T)
    assert system.sensitivity(f) == pytest.approx(S(at), rel=1e-9)
    assert 1 / system.sensitivity(f) - 1 == pytest.approx(L(at), rel=1e-9)
    # python-control takes the least over a grid of frequencies; ours lies below, by the grid's spacing at most
    found, fine = margins_of(system).reading, np.geomspace(1e-3, 0.4999 / T, 40_000)
    disk = np.min(control.disk_margins(L, 2 * np.pi * fine, skew=0.0)[0])
    assert disk == pytest.approx(np.min(1 / np.abs(system.sensitivity(fine) - 0.5)), rel=1e-9)
    assert disk * (1 - 1e-3) < found.dm <= disk * (1 + 1e-9)
    if name == "continuous":  # of a sampled loop python-control finds roots of polynomials that it warns about
        gain, phase, *_ = control.stability_margins(L)
        assert found.gm == pytest.approx(gain, rel=1e-9)
        assert found.pm == pytest.approx(abs(phase), rel=1e-9)


def test_python_control_gets_the_same_system():
    cascade, scenario, r = loop_of("true signs")
    system = linearise(cascade, scenario, CLOCK, r)
    exported, f = system.to_control(), np.array([10.0, 300.0])
    assert exported.input_labels == ["e_z", "e_z_dot", "q_z"]
    assert exported.dt == T
    response = exported(np.exp(2j * np.pi * f * T)).transpose(2, 0, 1)
    assert response == pytest.approx(np.asarray(system.response(f)), rel=1e-8)


def test_a_narrow_peak_is_found_and_refined():
    """x'' + 2 d w x' + w^2 x = w^2 e, read as x + e: |S| has its peak near w, with a width of 2 d w."""
    w, d = 2 * np.pi * 123.4, 1e-5
    A = np.array([[0.0, 1.0], [-w * w, -2 * d * w]])
    B, C, D = np.zeros((2, 3)), np.zeros((4, 2)), np.zeros((4, 3))
    B[1, 0], C[0, 0], D[0, 0] = w * w, 1.0, 1.0
    system = StateSpace(A, B, C, D, np.array([1.0, w]))
    found = peak(system, lambda f: np.abs(system.sensitivity(f)), 1.0, 2000.0)
    assert found.height == pytest.approx(1 / (2 * d), rel=1e-3)
    assert found.frequency == pytest.approx(123.4, rel=1e-4)


def test_the_noise_gain_agrees_with_a_long_run():
    """White noise passes the matrices for 200,000 samples. The tolerance is three standard errors."""
    cascade, scenario, r = loop_of("true signs")
    system = linearise(cascade, scenario, CLOCK, r).scaled()
    e, x, z = np.random.default_rng(1).normal(size=200_000), np.zeros(len(system.A)), []
    A, b, c = np.asarray(system.A), np.asarray(system.B)[:, 0], np.asarray(system.C)[3]
    for one in e:
        z.append(c @ x)
        x = A @ x + b * one
    assert np.std(z) == pytest.approx(noise_gain(system, T), rel=0.03)


@pytest.mark.parametrize(("steepness", "slope"), [(1e2, 1e-4), (1e4, 1e-2), (1e6, 1e-2)])
def test_the_search_of_an_equilibrium_ends_from_far_outside_the_band_of_a_sign(steepness, slope):
    """Damped steps alone end at a residual of 0.99 and above: without the homotopy, the sign hides the root near 1."""
    found = newton_of(lambda y: jnp.tanh(steepness * (y - 1)) + slope * y, jnp.zeros(1))
    assert float(found.y[0]) == pytest.approx(1.0, abs=2 * slope)
    assert float(found.error) < 1e-9  # the rounding of y near 1, times the steepness


def test_a_missing_equilibrium_is_reported_in_one_line():
    """The rotor is heavier than the model by 6 m/s^2 of force, and the switching gain gives 5."""
    heavy, laws = Scenario(plant=Plant(m=1.5)), SMOOTH | {"position": position.SlidingMode(c=200.0, k=5.0, p=5.0)}
    with pytest.raises(ValueError, match=r"no equilibrium at r = 0\.001 m .* ended where plant\.z_dot still changes"):
        linearise(Cascade(**laws), heavy, CLOCK, 1e-3)


@pytest.mark.parametrize(("factor", "offset"), [(0.8, 0.0), (3.0, 0.0), (1.0, 1e-5)])
def test_set_valued_signs_rest_where_the_simulation_settles_also_with_wrong_models_and_sensors(factor, offset):
    """At z = 0, and at the current that the model expects, a sign is outside its band."""
    plant = Plant(1.64, 0.0, 1.2566e-6, 208.0, 2.68e-4, 5e-4, 2.5, 1.0)
    clock = Clock(samples=4000, sample_period=5e-5)
    laws = {
        "observer": observer.Kalman(w=1000.0),
        "position": position.SlidingMode(c=2900.0, k=9.0, p=np.inf),
        "inversion": inversion.Adaptive(gamma=7e11, p=np.inf),
        "current": current.SlidingMode(k_i=1100.0, p=np.inf),
    }
    model = dataclasses.replace(plant, m=factor * plant.m)
    cascade = Cascade(**laws, model=model, processor=Processor(1.0))
    scenario = Scenario(plant=plant, sensor=Sensor(offset=offset, velocity=False), initial=Initial(z=0.0, i=0.0))
    point = rest(cascade.on_processor(), scenario, clock.sample_period, 0.0)
    assert point.found
    settled = rollout(cascade, scenario, clock).trajectory.rows.z[-1]
    # the model moves the point of rest by 1e-7 m; the simulation still approaches it
    assert settled == pytest.approx(float(point.point.plant.z), rel=1e-3)


def test_ranges_and_zones():
    zones = Zones()
    assert [zones.zone(x) for x in (2.9, 3.0, 4.5, 5.0)] == ["A", "B", "C", "D"]
    assert [zones.clearance_zone(x) for x in (0.29, 0.35, 0.45, 0.6)] == ["A", "B", "C", "D"]
    assert zones.range(None, 7e3) == (1.0, 7e3)
    assert zones.range(1e-5) == (1.0, 45e3)
    assert Zones(f_high=2e3).range(1e-5) == (1.0, 2e3)
    assert Zones(f_high=2e3).whole(None) == zones
    assert Zones(f_high=2e3).whole(1e-5).range(1e-5) == (1.0, 0.5 / 1e-5)
    with pytest.raises(ValueError, match="at most half the sampling rate, 500 Hz"):
        Zones(f_high=600.0).range(1e-3)
    with pytest.raises(ValueError, match="must be below f_high"):
        Zones(f_low=10.0, f_high=5.0).range(1e-3)


def test_an_unstable_loop_has_no_margins():
    system = StateSpace(np.array([[1.01]]), np.eye(1, 3), np.ones((4, 1)), np.zeros((4, 3)), np.ones(1), np.asarray(T))
    analysis = analyse(system, 0.588, T)
    assert not analysis.stable
    assert analysis.zone == "D"
    assert analysis.margins.pm == 0
    assert analysis.noise == np.inf
