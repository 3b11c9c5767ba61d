"""Conditions on a processor: poles, bands and the delay margin, compared with recursions and simulated loops."""

import dataclasses
import math
import tomllib

import numpy as np
import pytest
from profiles import thorough
from test_sampled import loop_with

import ambjax as amb
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.control.guard import Guard
from ambjax.control.observer import Direct
from ambjax.control.processor import Processor
from ambjax.control.sampling import Relay, band, disturbance
from ambjax.ensemble import delays as searched
from ambjax.ensemble.delays import DELAYS, delay_margin
from ambjax.linear.quiet_run import quiet
from ambjax.results.operating import sensitivity
from ambjax.simulation.rollout import Result, prepare, rollout
from ambjax.simulation.trajectory import ALIVE, STALLED, TOUCHED, Trajectory
from ambjax.theorem import advice, sampled_report
from ambjax.theorem.conditions import check
from ambjax.theorem.law_poles import law_poles
from ambjax.theorem.proof import LawSignalsRecorder
from ambjax.theorem.sampled_report import Delays, SampledReport, rolled
from ambjax.world.amplifier import Amplifier
from ambjax.world.faults import Outliers
from ambjax.world.plant import TwoCoil

INF = math.inf
LATE = [0.0, 0.2, 0.25, 0.4, 0.5, 0.8, 1.0, 1.3, 1.5, 2.0, 3.4]


def roots(a, late):
    """Return the roots of x_{n+1} = x_n - a x(n - late), with x interpolated linearly, from the explicit polynomial."""
    whole, share = int(late), late - int(late)
    coefficients = np.zeros(whole + 3)
    coefficients[[0, 1]] = 1.0, -1.0
    coefficients[1 + whole] += a * (1 - share)
    coefficients[2 + whole] += a * share
    return np.roots(coefficients)


def driven(implicit, T, k, p, w, x, steps=400):
    """Return x of x_{n+1} = x_n - T k s_n + T w_n: the relay by clipping, the smoothed sign by bisection."""

    def sign(x):
        return np.sign(x) if math.isinf(p) else 2 / np.pi * np.arctan(p * x)

    def used(x):
        if not implicit:
            return sign(x)
        if math.isinf(p):
            return np.clip(x / (T * k), -1.0, 1.0)
        low, high = min(x, 0.0), max(x, 0.0)
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if middle + T * k * sign(middle) < x else (low, middle)
        return sign(low)

    rows = [x]
    for n in range(steps):
        rows.append(rows[-1] - T * k * used(rows[-1]) + T * w(n))
    return np.array(rows)


@pytest.mark.parametrize("p", [INF, 300.0, 30.0])
@pytest.mark.parametrize("implicit", [True, False])
def test_a_sign_law_stays_in_its_band_and_reaches_its_ends(implicit, p):
    k, W, T = 20.0, 6.0, 1e-3
    relay = Relay(k, None if math.isinf(p) else p)
    limit = band(relay, W, T, implicit)
    draw = np.random.default_rng(1).choice([-W, W], 400)
    disturbances = [lambda n: W, lambda n: draw[n], lambda n: W * (-1) ** (n // 40)]
    runs = [driven(implicit, T, k, p, w, limit) for w in disturbances]
    for x in runs:
        # what is measured of a run is what disturbed it, to rounding of x / T
        assert disturbance(relay, x, T, implicit) == pytest.approx(W, rel=1e-9)
        assert np.abs(x).max() <= limit * (1 + 1e-12)
        # from outside, too, x grows no further
        outside = driven(implicit, T, k, p, disturbances[1], 3 * limit)
        assert np.abs(outside).max() <= 3 * limit * (1 + 1e-12)
    # tight where the sign is that of the step's end; else a bound, no further off than this
    assert max(np.abs(x[200:]).max() for x in runs) >= (0.999 if implicit else 0.3) * limit


HARD, SOFT = (200.0, 25.0, 2e6, 2000.0, INF), (17.0, 25.0, 2e5, 152.0, 25.0)
WORLD = amb.Scenario(reference=amb.signals.Sine(2.5e-3, 2.0))
CLOCK, LONG = (amb.Clock(samples, 1e-4, amb.solvers.RK4(4)) for samples in (600, 3000))


def random_loop(name, draw):
    """Return the cascade and the scenario of a random loop.

    It has one of three structures, so that few programs are compiled.
    """
    c, k, k_i = 10 ** draw.uniform(1.2, 3.0), 10 ** draw.uniform(0.5, 2.5), 10 ** draw.uniform(2.3, 3.5)
    gamma, p = 10 ** draw.uniform(5.0, 7.0), 10 ** draw.uniform(0.5, 2.0)
    world = {"reference": amb.signals.Sine(draw.uniform(0.5e-3, 2.5e-3), 2.0), "u_max": draw.uniform(100.0, 2e3)}
    if name == "estimated, two coils":
        cascade = loop_with(c, k, gamma, k_i, INF, delay=draw.uniform(0.1, 0.9))
        cascade = dataclasses.replace(cascade, observer=amb.laws.observer.Kalman(draw.uniform(300.0, 1500.0)))
        sensor = amb.sensors.Sensor(10 ** draw.uniform(-8, -6), 0.0, 1e-5, bits=16, velocity=False)
        return cascade, amb.Scenario(plant=TwoCoil(m=draw.uniform(0.5, 0.7)), sensor=sensor, **world)
    if name == "late, amplifier":
        cascade = loop_with(c, k, gamma, k_i, p, delay=draw.uniform(0.1, 0.9), predict=False)
        cascade = dataclasses.replace(cascade, observer=amb.laws.observer.Complementary(draw.uniform(1.0, 50.0)))
        amplifier = Amplifier(bandwidth=draw.uniform(1e3, 5e3))
        return cascade, amb.Scenario(sensor=amb.sensors.Sensor(1e-6, 1e-4, 1e-4), amplifier=amplifier, **world)
    return loop_with(c, k, gamma, k_i, p, implicit=False, delay=draw.uniform(0.1, 0.9), predict=True), amb.Scenario(
        initial=amb.Initial(draw.uniform(-1e-4, 1e-4)), **world
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["estimated, two coils", thorough("late, amplifier"), "explicit"])
def test_measured_signals_do_not_exceed_their_bounds(name):
    """The text and the verdict also agree. The tolerance 1e-12 is for rounding."""
    draw, bounds = np.random.default_rng(7), 0
    for _ in range(10):
        cascade, world = random_loop(name, draw)
        sampled = sampled_report.check_sampled(cascade, world, CLOCK, 0.02)
        for line in sampled.bands:
            assert line.computed <= line.band * (1 + 1e-12), line
            assert line.largest <= line.bound * (1 + 1e-12), line
            assert math.isinf(line.band) == (line.gain <= line.disturbance)
            bounds += not math.isinf(line.band)
        said = advice.processor_lines(sampled, Delays(2.0, None, None, 0.1), None)
        assert sampled.holds == ("The rotor is held." in said and not any(" No" in line for line in said)), said
    assert bounds >= 5


def test_bounds_are_tight_without_an_estimate():
    """An implicit set-valued sign reaches its bound. With smoothed signs, the signal reaches at least half of it."""
    for gains, share in ((HARD, 0.999), (SOFT, 0.5)):
        lines = sampled_report.check_sampled(loop_with(*gains, delay=0.0), WORLD, LONG, 0.1).bands
        assert [line.signal for line in lines] == ["sigma", "v_tilde", "e"]
        for line in lines:
            # u is 0 before the first sample, so the sensors' signals are the plant's: nothing is off but i_ref's sample
            assert line.difference <= 1e-12 * line.bound
            assert share * line.bound <= line.largest <= line.bound * (1 + 1e-12), line
        # the theorem's own Delta_1 on this reference is 6.231e4, at 0.25 s
        assert lines[1].disturbance == pytest.approx(6.231e4, rel=0.05)


@pytest.mark.parametrize("late", LATE)
def test_the_poles_of_a_current_law_are_those_of_the_delayed_recursion(late):
    """Without resistance, the law that removes a share of the error makes x_{n+1} = x_n - share x(n - late)."""
    without_gains = {
        "position": amb.laws.position.LinearController(output="voltage"),
        "inversion": amb.laws.inversion.Linearised(),
    }
    others = {"model": amb.plants.Plant(R=0.0), "processor": Processor(late, predict=False)}
    for share in (0.2, 0.6, 1.0):
        law, z = amb.laws.current.DeadBeat(share=share), roots(share, late)
        (found,) = law_poles(amb.Cascade(current=law, **without_gains, **others), CLOCK)
        assert found.radius == pytest.approx(np.abs(z).max(), abs=1e-7)  # a double root is exact to 1e-8
        s = np.log(z[np.abs(z) > 1e-9] + 0j)
        assert found.damping == pytest.approx((-s.real / np.abs(s)).min(initial=1.0), abs=1e-6)
        assert found.remedies[2:] == ("set predict = true",) * (late > 0)


T0, SIGN = 1e-4, 2 / np.pi


def moved(k_p, k_d):
    """Return the largest |pole| of z+ = z + T z_dot + T^2/2 z_ddot with z_ddot = -k_p z - k_d z_dot in a step."""
    step = [[1 - T0**2 / 2 * k_p, T0 - T0**2 / 2 * k_d], [-T0 * k_p, 1 - T0 * k_d]]
    return max(abs(np.linalg.eigvals(step)))


# Poles that the theory of each law gives, for T = 1e-4 s without delay: law, implicit steps, largest |pole|.
KNOWN = [
    (amb.laws.observer.Complementary(l=300.0), True, 1 - 300 * T0),
    (amb.laws.observer.Difference(w=2e3), True, math.exp(-0.2)),
    (amb.laws.observer.Difference(w=2e3), False, 0.8),
    (amb.laws.observer.Kalman(w=500.0), True, math.exp(-0.05)),
    (amb.laws.observer.Kalman(w=500.0), False, 0.95),
    (amb.laws.inversion.Adaptive(2e5, 0.1), True, 1 / (1 + SIGN * 2e5 * 0.1 * T0)),
    (amb.laws.inversion.Adaptive(2e5, 0.1), False, abs(1 - SIGN * 2e5 * 0.1 * T0)),
    (amb.laws.inversion.FeedForwardAdaptive(2e5, 0.1), True, 1 / (1 + SIGN * 2e5 * 0.1 * T0)),
    (amb.laws.inversion.Adaptive(2e5, INF), True, 0.0),
    (amb.laws.inversion.Adaptive(2e5, INF), False, INF),
    (amb.laws.current.SlidingMode(200.0, 10.0), True, 1 / (1 + SIGN * 200 * 10 * T0)),
    (amb.laws.current.SlidingMode(200.0, 10.0), False, 1 - SIGN * 200 * 10 * T0),
    # L = 33.13 H: x+ = x + T (u - k_p x)/L, u+ = u - T k_int x
    (amb.laws.current.ProportionalIntegral(3e4, 1e6, 0.0), True,
     max(abs(np.linalg.eigvals([[1 - T0 * 3e4 / 33.1298, T0 / 33.1298], [-T0 * 1e6, 1]])))),
    # z_ddot = -c z_dot - K (z_dot + c z) with the slope K of the sign
    (amb.laws.position.SlidingMode(200.0, 30.0, 5.0), False, moved(200 * SIGN * 150, 200 + SIGN * 150)),
    (amb.laws.position.FeedbackLinearisation(4e4, 500.0), True, moved(4e4, 500)),
    (amb.laws.position.SlidingMode(200.0, 30.0, INF), False, INF),
    (amb.laws.position.SuperTwisting(17.0, 40.0, 50.0, INF), False, INF),
]  # fmt: skip


@pytest.mark.parametrize(("law", "implicit", "radius"), KNOWN)
def test_the_poles_of_a_law_are_those_of_its_theory(law, implicit, radius):
    stage = type(law).__module__.rpartition(".")[2]
    stage = stage if stage in ("observer", "inversion", "current") else "position"
    cascade = amb.Cascade(**{stage: law}, model=amb.plants.Plant(R=0.0), processor=Processor(0.0, implicit=implicit))
    (found,) = (one for one in law_poles(cascade, CLOCK) if one.stage == stage)
    # 1e-5: the triple pole of the Kalman filter is exact to the cube root of rounding errors
    assert found.radius == pytest.approx(radius, rel=1e-5, abs=1e-7)
    assert found.implicit == (implicit and law.own_steps != ())


def test_a_sign_one_sample_late_is_unstable():
    hard, soft = loop_with(*HARD, delay=1.0), loop_with(*SOFT, delay=1.0, predict=False)
    late = dataclasses.replace(hard, processor=Processor(1.0, predict=False))
    assert [one.holds for one in law_poles(hard, CLOCK)] == [True, True, True]
    assert [one.holds for one in law_poles(late, CLOCK)] == [False, True, False]
    assert [one.holds for one in law_poles(soft, CLOCK)] == [True, True, True]
    # the term c e_dot of the position law acts at the start of a sample: 1 - c T = -2 beside the sign
    (position, *_) = law_poles(loop_with(3e4, 25.0, 2e6, 2000.0, 25.0), CLOCK)
    assert position.radius > 1.9
    assert not position.holds


def test_alternation_is_1_for_an_alternating_voltage_and_sin_squared_for_a_sine():
    n = np.arange(1000)
    assert sampled_report.alternation((-1.0) ** n) == pytest.approx(1.0)
    for cycles in (10, 100, 250):  # a sine of f has sin(pi f T)^2, whole periods
        u = np.sin(2 * np.pi * cycles / 1000 * n)
        assert sampled_report.alternation(u) == pytest.approx(np.sin(np.pi * cycles / 1000) ** 2, rel=0.02)
    assert sampled_report.alternation(np.zeros(10)) == 0.0


# The noise of the velocity turns a sign of 1000 m/s^2 over: forces that no current gives at 2 mm are wanted.
BEYOND = amb.Scenario(
    reference=amb.signals.Constant(2e-3), initial=amb.Initial(2e-3, 0.0, -0.1), sensor=amb.sensors.Sensor(0.0, 1e-2)
)


def test_the_distance_to_the_singular_curve_is_that_of_the_sampled_run():
    clock, world = amb.Clock(300, 1e-4), dataclasses.replace(BEYOND, u_max=500.0)
    crossing = loop_with(200.0, 1000.0, 1e8, 2000.0, INF, delay=0.0)
    sampled = sampled_report.check_sampled(crossing, world, clock, 0.005)
    trajectory = amb.rollout(crossing, world, clock).trajectory
    assert np.isfinite(trajectory.singular_at)
    assert math.isinf(sampled.lost_at)
    assert (sampled.distance[0] < 0, sampled.holds) == (True, False)
    said = "".join(advice.processor_lines(sampled, Delays(2.0, None, None, 0.1), None))
    assert "(z/s_0, i_ref/i_0) stay off the singular curve C at all samples? No: " in said
    world = dataclasses.replace(world, sensor=amb.sensors.Sensor(0.0, 1e-4))
    calm = sampled_report.check_sampled(crossing, world, clock, 0.005)
    assert (calm.distance[0] > 0, calm.holds) == (True, True)


def test_a_linear_inversion_may_cross_the_singular_curve():
    """It does not divide by dv/di. The textbook's loop lifts the rotor from beyond half of the gap."""
    laws = amb.laws.position.FeedbackLinearisation(4e5, 2e3), amb.laws.inversion.Linearised()
    cascade = amb.Cascade(amb.laws.observer.Direct(), *laws, amb.laws.current.ProportionalIntegral())
    clock, world = amb.Clock(300, 1e-4), amb.Scenario(initial=amb.Initial(-3e-3))
    sampled = dataclasses.replace(cascade, processor=amb.Processor(0.0))
    assert np.isfinite(amb.rollout(sampled, world, clock).trajectory.singular_at)
    report = sampled_report.check_sampled(sampled, world, clock, 0.005)
    assert report.distance[0] == math.inf
    assert not any("singular" in line for line in advice.processor_lines(report, Delays(2.0, None, None, 0.1), None))
    in_time = check(cascade, world, clock)
    assert not any(line.holds is False for line in in_time.conditions)
    assert "No condition applies" in advice.theorem_lines(in_time, "case.toml")[0]


def test_the_margin_is_between_a_delay_that_holds_and_one_that_does_not():
    cascade, clock = loop_with(*HARD, delay=0.0, predict=False), amb.Clock(600, 1e-4, amb.solvers.RK4(1))
    margin = delay_margin(cascade, WORLD, clock)
    # the sign itself, one sample late: an oscillation that does not decay, and the steps of the position law on top
    assert 0.5 < margin.held < margin.lost <= 1.0
    assert margin.step == pytest.approx(2 / (DELAYS - 1))
    assert margin.resolution == pytest.approx(margin.step / (DELAYS - 1))
    for delay, lost in zip(margin[:2], (False, True), strict=True):
        late = loop_with(*HARD, delay=delay, predict=False)
        assert np.isfinite(amb.rollout(late, WORLD, clock, record_every=0).trajectory.lost_at) == lost
    # if the rotor is lost at the delay of the case, the answer names the delays at which it is held
    beyond = delay_margin(loop_with(*HARD, delay=1.5, predict=False), WORLD, clock)
    assert 0.5 < beyond.held < beyond.lost < 1.1


@pytest.mark.slow
def test_the_delay_margin_without_a_known_delay_is_smaller():
    cascade, clock = loop_with(*HARD, delay=1.0), amb.Clock(600, 1e-4, amb.solvers.RK4(1))
    margin = delay_margin(cascade, WORLD, clock, known=False)
    # a prediction that knows it holds the rotor up to 2 samples and more
    assert 1.0 < margin.held < margin.lost < 1.9
    gone = dataclasses.replace(WORLD, initial=amb.Initial(4e-3))
    assert delay_margin(cascade, gone, clock, known=False).held is None


def test_a_loss_in_a_narrow_interval_of_delays_is_found(monkeypatch):
    """The loop is replaced by one that is lost from 0.704 to 0.716 samples only, and stalls at one delay."""
    monkeypatch.setattr(searched, "run_ensemble", delays)
    delays.stalled, delays.lost = (-1.0, -1.0), (0.704, 0.716)
    cascade, clock = loop_with(*HARD, delay=0.0), amb.Clock(300, 1e-4, amb.solvers.RK4(1))
    margin = delay_margin(cascade, WORLD, clock)
    assert 0.704 - 2 / 256**2 <= margin.held < 0.704 <= margin.lost < 0.704 + 2 / 256**2
    # beyond two samples the steps are longer, and the result says so
    delays.lost = (3.7, 3.74)
    margin = delay_margin(cascade, WORLD, clock)
    assert margin.step == pytest.approx(8 / 257)
    assert 3.7 - 8 / 256**2 <= margin.held < 3.7 <= margin.lost < 3.7 + 8 / 256**2
    delays.lost = (INF, INF)
    assert delay_margin(cascade, WORLD, clock)[:4] == (10.0, None, None, pytest.approx(8 / 257))


def test_a_delay_whose_run_stalls_is_neither_held_nor_lost(monkeypatch):
    """The loop is replaced by one that is lost from 1.5 samples on and stalls between 0.6 and 0.9."""
    monkeypatch.setattr(searched, "run_ensemble", delays)
    delays.stalled, delays.lost = (0.6, 0.9), (1.5, INF)

    def margin(own):
        return delay_margin(loop_with(*HARD, delay=own), WORLD, amb.Clock(300, 1e-4, amb.solvers.RK4(1)))

    near = 2 / 256**2
    stall, loss = pytest.approx(0.6, abs=near), pytest.approx(1.5, abs=near)
    assert margin(0.0)[:3] == (stall, pytest.approx(1.5, abs=2 / 256), stall)
    assert margin(1.0)[:3] == (loss, loss, None)
    assert margin(0.75)[:3] == (stall, None, stall)
    delays.stalled, delays.lost = (0.0, 3.0), (3.0, INF)
    assert margin(0.0)[:3] == (None, None, 0.0)
    words = advice.processor_lines(SampledReport([], [], math.inf, ""), margin(0.0), None)[-1]
    assert words.startswith("Delay margin: the rotor is not decided at 0, where the integrator stalled (tested")
    words = advice.processor_lines(SampledReport([], [], math.inf, ""), Delays(0.5, 1.5, 0.75, 0.1), None)[-1]
    assert "held up to 0.5 samples, not decided at 0.75, where the integrator stalled, lost at 1.5" in words


def delays(cascade, scenario, clock, *, fold):
    """Return the result of `run_ensemble` for each delay of a cascade."""
    late, (begin, end) = np.asarray(cascade.processor.delay), delays.stalled
    lost = (delays.lost[0] <= late) & (late <= delays.lost[1])
    code = np.where((begin <= late) & (late <= end), STALLED, np.where(lost, TOUCHED, ALIVE))
    return Result(Trajectory(None, np.where(code == ALIVE, np.inf, 0.01), code, np.inf), None)


@pytest.mark.slow
def test_a_stalled_run_on_a_processor_is_reported_as_undecided():
    sampled = SampledReport([], [], 0.01, "stalled: ...", stalled=True)
    assert not sampled.holds
    said = " ".join(advice.processor_lines(sampled, Delays(None, None, 0.0, 0.1), None))
    assert "not decided: at 0.01 s the integrator stalled" in said
    assert "lost" not in said
    assert "gamma" not in said  # laws that are stepped stall no integrator
    # one trial step a sample, where the tolerance takes more
    stalling = amb.Clock(10, 1e-4, amb.solvers.AdaptiveRodas3(1e-12, most_steps=1))
    found = sampled_report.check_sampled(loop_with(*HARD, delay=1.0), WORLD, stalling, 0.0)
    assert found.stalled
    assert not found.bands


CASE = """[controller.position]
c = 200.0
p = 25.0
[controller.inversion]
gamma = 2e5
p = 25.0
[reference]
kind = "sine"
amplitude = 2.5e-3
frequency = 2.0
[clock]
duration = 0.03
[run]
settle = 0.01
[processor]
"""


@pytest.mark.parametrize("guarded", [False, True])
def test_the_computed_signals_are_those_of_the_readings_that_the_laws_receive(guarded):
    # one outlier of 0.1 mm at sample 50 moves sigma = z_dot - r_dot + c (z - r), unless it is refused
    c, size, at = 17.0, 1e-4, 50
    processor = Processor(guard=Guard(speed=1e-3) if guarded else None)
    cascade = dataclasses.replace(amb.paper.cascade("sampled"), processor=processor, observer=Direct())
    cascade = dataclasses.replace(cascade, position=dataclasses.replace(cascade.position, c=c))
    scenario = amb.Scenario(sensor=amb.sensors.Sensor(outliers=Outliers(rate=0.0, size=size, at=at * 1e-4)))
    loop, clock = prepare(cascade, scenario, amb.Clock(80, 1e-4))
    rows = rolled(LawSignalsRecorder(loop), clock).trajectory.rows
    apart = np.asarray(rows.computed.sigma - rows.true.sigma)
    # The computed sigma is that at the end of the delay, one sample later. In the last 30 samples before the outlier,
    # sigma changes by less than 1e-5 m/s in a sample.
    np.testing.assert_allclose(apart[at - 30 : at], 0.0, atol=1e-5)
    # the prediction over the delay adds the motion away from the outlier, so c times its size is a lower bound
    assert abs(apart[at]) < 2e-5 if guarded else abs(apart[at]) > c * size


def test_a_linear_delay_margin_below_the_simulated_one_is_explained():
    """The sets of 1 sample of delay, T = 50 us: stable up to 1.5 samples, that is 25 us later."""
    tested = Delays(2.0, None, None, 0.1, stable=1.5, tested=257)
    assert advice.delay_difference(3e-5, tested, 1.0, 5e-5) == ""
    assert advice.delay_difference(None, tested, 1.0, 5e-5) == ""
    assert advice.delay_difference(1e-5, tested._replace(stable=None), 1.0, 5e-5) == ""
    assert "1e-05 s, is smaller than the 2.5e-05 s tested" in advice.delay_difference(1e-5, tested, 1.0, 5e-5)


@pytest.mark.slow
def test_beyond_the_linear_delay_margin_the_voltage_of_a_set_valued_sign_alternates():
    """The rig: the margin at the command is 9.9 us, the simulated loop is stable at all delays that are tested."""
    case = case_from(tomllib.loads(template("rig")))
    linear = sensitivity(case).margins_at.command.delay
    assert linear == pytest.approx(9.9e-6, rel=0.01)
    processor, size = case.cascade.processor, []
    for share in (0.9, 1.1):
        delay = float(processor.delay) + share * linear / float(case.clock.sample_period)
        late = dataclasses.replace(processor, delay=delay, assumed=processor.ahead, predict=True)
        cascade = dataclasses.replace(case.cascade, processor=late)
        u = np.asarray(rollout(cascade, quiet(case.scenario), case.clock).trajectory.rows.u)
        size.append(np.std(u[-len(u) // 4 :]))
    assert size[0] < 1e-3  # V: it has decayed, up to rounding
    assert size[1] > 10
