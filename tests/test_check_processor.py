"""What decides on a processor: slopes, bands and the delay margin, against recursions and the loop itself."""

import dataclasses
import json
import math

import numpy as np
import pytest
from texts import write

import ambjax as amb
from ambjax.__main__ import main
from ambjax.control.processor import Processor
from ambjax.control.sampling import Sampling, limits, relay_band, twisting_band
from ambjax.ensemble import delays as searched
from ambjax.ensemble.delays import DELAYS, delay_margin
from ambjax.simulation.rollout import Outcome
from ambjax.simulation.trajectory import ALIVE, STALLED, TOUCHED, Trajectory
from ambjax.theorem import processor, verdict
from ambjax.theorem.processor import Delays, Sampled

INF = math.inf
LATE = [0.0, 0.2, 0.25, 0.4, 0.5, 0.8, 1.0, 1.3, 1.5, 2.0]


def roots(a, late):
    """Of x_{n+1} = x_n - a x(n - late), x between samples on the straight line, by the polynomial written out."""
    whole, share = int(late), late - int(late)
    coefficients = np.zeros(whole + 3)
    coefficients[[0, 1]] = 1.0, -1.0
    coefficients[1 + whole] += a * (1 - share)
    coefficients[2 + whole] += a * share
    return np.roots(coefficients)


@pytest.mark.parametrize("late", LATE)
def test_limits_are_where_the_recursion_turns_unstable_and_begins_to_oscillate(late):
    stable, quiet = limits(late)
    assert np.abs(roots(0.999 * stable, late)).max() < 1 < np.abs(roots(1.001 * stable, late)).max()
    # of two roots that meet, what rounding leaves of their imaginary parts is its square root
    dominant = lambda a: max(roots(a, late), key=abs)  # noqa: E731
    assert dominant(0.999 * quiet).real > 0
    assert abs(dominant(0.999 * quiet).imag) < 1e-6
    after = roots(1.001 * quiet, late)
    assert (np.abs(after.imag) > 1e-4).any() or after.real.min() < 0


def test_limits_in_round_numbers():
    assert limits(0.0) == (2.0, 1.0)
    assert limits(1.0) == (1.0, 0.25)


def driven(sampling, k, p, w, steps=400):
    """Largest |x| of x' = -k sgn_p + w over the last half, in substeps of 1/20 T: a sign that acts `delay` T late.

    The relay itself by a clip, the smoothed sign by bisection: nothing of the package.
    """
    sign = lambda x: np.sign(x) if math.isinf(p) else 2 / np.pi * np.arctan(p * x)  # noqa: E731
    T, d, sub = sampling.period, sampling.delay, 20

    def decided(x):
        if not sampling.implicit:
            return -k * sign(x)
        if math.isinf(p):
            return -np.clip(x / T, -k, k)
        low, high = min(x, 0.0), max(x, 0.0)
        for _ in range(80):
            middle = (low + high) / 2
            low, high = (middle, high) if middle + T * k * sign(middle) < x else (low, middle)
        return -k * sign(low)

    x, largest, late = 30 * T * k / 2, 0.0, round(d * sub)
    committed = [0.0] * late
    for n in range(steps):
        seen = x + T / sub * sum(committed) if sampling.predict else x
        committed += [decided(seen)] * sub
        for _ in range(sub):
            x += T / sub * (committed.pop(0) + w(n))
            if n > steps // 2:
                largest = max(largest, abs(x))
    return largest


@pytest.mark.parametrize("p", [INF, 300.0])
@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("form", ["implicit", "explicit", "explicit, predicted", "not predicted"])
def test_a_sign_law_stays_in_its_band_and_fills_it(form, delay, p):
    k, W, T = 20.0, 6.0, 1e-3
    sampling = Sampling(
        T, delay, not form.startswith("explicit"), delay > 0 and form in ("implicit", "explicit, predicted")
    )
    band = relay_band(k, p, W, sampling)
    draw = np.random.default_rng(1).choice([-W, W], 400)
    seen = [driven(sampling, k, p, w) for w in (lambda n: W, lambda n: draw[n], lambda n: W * (-1) ** (n // 40))]
    assert max(seen) <= band * (1 + 1e-9)
    # tight where the sign is that of the step's end and not late; else a bound, no further off than this
    assert (
        max(seen)
        >= (0.999 if form == "implicit" else 0.3 if not sampling.late or not sampling.implicit else 0.03) * band
    )


def test_no_band_where_the_gain_does_not_exceed_the_disturbance():
    sampling = Sampling(1e-3, 0.0, True, False)
    assert relay_band(20.0, INF, 20.0, sampling) == INF
    assert twisting_band(10.0, 5.0, INF, 6.0, sampling) == INF
    assert twisting_band(10.0, 5.0, INF, 2.0, sampling) == pytest.approx(2e-6)
    assert twisting_band(10.0, 5.0, 25.0, 2.0, sampling) is None


def cascade_of(c, k, gamma, k_i, p, **how):
    return amb.Cascade(
        position=amb.position.SlidingMode(c, k, p),
        inversion=amb.inversion.Adaptive(gamma, p),
        current=amb.current.SlidingMode(k_i, p),
        processor=Processor(**how),
    )


HARD, SOFT = (200.0, 25.0, 2e6, 2000.0, INF), (17.0, 25.0, 2e5, 152.0, 25.0)
WORLD = amb.Scenario(reference=amb.Sine(2.5e-3, 2.0))
# over the largest Delta_1 of this reference, at 0.25 s, so that nothing is left of what was before `settle`
CLOCK, FAST = amb.Clock(3000, 1e-4), amb.Clock(30_000, 1e-5)
LOOPS = {
    "no delay": (cascade_of(*HARD, delay=0.0), 0.9),
    "predicted": (cascade_of(*HARD, delay=1.0), 0.4),
    "predicted, one and a half": (cascade_of(*HARD, delay=1.5), 0.2),
    "smoothed": (cascade_of(*SOFT, delay=1.0), 0.7),
    "smoothed, no delay": (cascade_of(*SOFT, delay=0.0), 0.7),
    "smoothed, not predicted": (cascade_of(*SOFT, delay=1.0, predict=False), 0.0),
    # the inversion's slope T is 12, and its sign turns over from sample to sample: that band is as wide
    "explicit": (cascade_of(17.0, 25.0, 7.5e4, 152.0, 25.0, implicit=False, predict=True), 0.5),
}


@pytest.mark.parametrize("name", LOOPS)
def test_the_loop_stays_in_its_bands(name):
    """Without noise. W is from the run itself: what is tested is that the bands hold what they say, and are tight."""
    cascade, share = LOOPS[name]
    sampled = processor.check(cascade, WORLD, FAST if name == "explicit" else CLOCK, 0.1)
    assert math.isinf(sampled.lost_at)
    assert [band.signal for band in sampled.bands] == ["sigma", "v_tilde", "e"]
    for band in sampled.bands:
        # late, what the laws predicted is taken from the run: a few parts in a thousand of W
        assert share * band.band <= band.seen <= band.band * (1 + 1e-3), band
        assert band.noisy == band.seen
    # the theorem's own Delta_1 on this reference is 6.231e4
    assert sampled.bands[1].disturbance == pytest.approx(6.231e4, rel=0.05)


def test_an_implicit_step_is_no_steeper_than_one():
    """a/(1 + a): stable unless the sign itself is a sample late."""
    hard, soft = cascade_of(*HARD, delay=1.0), cascade_of(*SOFT, delay=1.0, predict=False)
    late = dataclasses.replace(hard, processor=Processor(1.0, predict=False))
    assert [slope.stepped for slope in processor.slopes(hard, CLOCK)] == [1.0, 1.0, 1.0]
    assert [slope.holds for slope in processor.slopes(hard, CLOCK)] == [True, True, True]
    assert [slope.holds for slope in processor.slopes(late, CLOCK)] == [False, True, False]
    for slope in processor.slopes(soft, CLOCK):
        assert slope.holds
        assert slope.stepped == pytest.approx(slope.slope / (1 + slope.slope))
    # what stays explicit in the position law, c T, may be all that is steep
    (position, *_) = processor.slopes(cascade_of(3e4, 25.0, 2e6, 2000.0, 25.0), CLOCK)
    assert position.stepped == pytest.approx(3.0)
    assert not position.holds


@pytest.mark.parametrize(
    ("delay", "expected"),
    [(0.0, [1, 2, 3, 4]), (1.0, [0, 1, 2, 3]), (1.5, [0, 0.5, 1.5, 2.5]), (0.25, [0.75, 1.75, 2.75, 3.75])],
)
def test_what_a_law_asks_for_acts_late(delay, expected):
    # over a sample, for a share of it what was decided a sample before the rest
    np.testing.assert_allclose(processor._acting(np.array([1.0, 2.0, 3.0, 4.0]), delay), expected, rtol=1e-15)


def test_noise_comes_on_top_and_the_band_is_without_it():
    noisy = dataclasses.replace(WORLD, sensor=amb.Sensor(1e-6, 1e-4, 1e-4))
    calm, rough = (processor.check(LOOPS["predicted"][0], world, CLOCK, 0.1).bands for world in (WORLD, noisy))
    for one, other in zip(calm, rough, strict=True):
        assert (other.disturbance, other.band, other.seen) == pytest.approx(
            (one.disturbance, one.band, one.seen), rel=1e-9
        )
        assert other.noisy > 5 * other.seen


def test_the_margin_is_between_a_delay_that_holds_and_one_that_does_not():
    cascade, clock = cascade_of(*HARD, delay=0.0), amb.Clock(600, 1e-4, amb.RK4(1))
    margin = delay_margin(cascade, WORLD, clock)
    # the sign itself, one sample late: an oscillation that does not decay, and the steps of the position law on top
    assert 0.5 < margin.held < margin.lost <= 1.0
    assert margin.resolution == pytest.approx(2 / (DELAYS - 1) ** 2)
    for delay, lost in zip(margin[:2], (False, True), strict=True):
        late = cascade_of(*HARD, delay=delay, predict=False)
        assert np.isfinite(amb.rollout(late, WORLD, clock, every=0).trajectory.lost_at) == lost
    # a case whose own delay is lost is told what would hold
    beyond = delay_margin(cascade_of(*HARD, delay=1.5, predict=False), WORLD, clock)
    assert 0.5 < beyond.held < beyond.lost < 1.1


def test_predicted_it_holds_with_the_longest_delay():
    assert delay_margin(cascade_of(*HARD, delay=1.0), WORLD, amb.Clock(300, 1e-4, amb.RK4(1))) == (2.0, None, None)
    gone = dataclasses.replace(WORLD, initial=amb.Initial(4e-3))
    assert delay_margin(cascade_of(*HARD, delay=1.0), gone, amb.Clock(300, 1e-4, amb.RK4(1))).held is None


def test_a_delay_whose_run_stalls_is_neither_held_nor_lost(monkeypatch):
    """A stand-in for the loop, lost from 1.5 samples on and given up between 0.6 and 0.9: the margin says both."""
    delays.stalled, delays.lost = (0.6, 0.9), 1.5

    def margin(own):
        monkeypatch.setattr(searched, "run_ensemble", delays)
        return delay_margin(cascade_of(*HARD, delay=own), WORLD, amb.Clock(300, 1e-4, amb.RK4(1)))

    assert margin(0.0) == (pytest.approx(0.59375), 1.5, pytest.approx(0.625))
    assert margin(1.0) == (pytest.approx(1.484375), pytest.approx(1.5), None)
    assert margin(0.75) == (pytest.approx(0.59375, abs=0.02), None, pytest.approx(0.6, abs=0.02))
    delays.stalled, delays.lost = (0.0, 3.0), 3.0
    assert margin(0.0) == (None, None, 0.0)
    words = verdict.on_processor(Sampled([], [], math.inf, ""), margin(0.0))[-1]
    assert words == "Delay margin: it is not decided at 0, where the integrator stalled."
    words = verdict.on_processor(Sampled([], [], math.inf, ""), Delays(0.5, 1.5, 0.75))[-1]
    assert words.endswith("held up to 0.5 samples, not decided at 0.75, where the integrator stalled, lost at 1.5.")


def delays(cascade, scenario, clock, *, fold):
    """What `run_ensemble` says of each delay of a cascade."""
    late, (begin, end) = np.asarray(cascade.processor.delay), delays.stalled
    code = np.where((begin <= late) & (late <= end), STALLED, np.where(late >= delays.lost, TOUCHED, ALIVE))
    return Outcome(Trajectory(None, np.where(code == ALIVE, np.inf, 0.01), code, np.inf), None)


def test_a_stalled_run_on_a_processor_decides_nothing():
    sampled = Sampled([], [], 0.01, "stalled: ...", stalled=True)
    assert not sampled.holds
    said = " ".join(verdict.on_processor(sampled, Delays(None, None, 0.0)))
    assert "not decided: at 0.01 s the integrator stalled" in said
    assert "lost" not in said
    assert "gamma" not in said  # laws that are stepped stall no integrator
    # one trial step a sample, where the tolerance takes more
    stalling = amb.Clock(10, 1e-4, amb.AdaptiveRodas3(1e-12, most_steps=1))
    found = processor.check(cascade_of(*HARD, delay=1.0), WORLD, stalling, 0.0)
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


@pytest.mark.usefixtures("elsewhere")
def test_check_says_no_where_an_explicit_slope_is_beyond_its_limit(capsys):
    # gamma 2 p/pi T is 318; nothing loses the rotor in this time, the theorem's conditions hold, and the answer is no
    assert main(["check", write(CASE + 'discretisation = "explicit"\npredict = true\n')]) == 1
    theorem, _, said = capsys.readouterr().out.partition("On the processor")
    assert "Yes, all 5" in theorem
    assert "about continuous time" in theorem
    assert "- inversion: slope T as stepped, 318.3, must stay below 2" in said
    assert "1 of 3 is not" in said
    assert "The rotor is held." in said
    assert "Delay margin" in said


@pytest.mark.slow
@pytest.mark.usefixtures("elsewhere")
def test_check_says_yes_on_a_processor(capsys):
    assert main(["check", write(CASE), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["holds"]
    assert [slope["stage"] for slope in told["processor"]["slopes"]] == ["position", "inversion", "current"]
    assert set(told["processor"]) == {"lost_at_s", "lost_why", "stalled", "slopes", "bands", "delay_margin"}
    assert told["processor"]["delay_margin"] == {"held": 2.0, "lost": None, "undecided": None, "resolution": None}
