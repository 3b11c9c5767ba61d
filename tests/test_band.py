"""Maxima at an end of the frequency band, and larger ones outside it, in the analysis, the commands and the tuner."""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import cont2discrete
from texts import write

from ambjax import Cascade, Clock, Scenario
from ambjax.__main__ import main
from ambjax.cases.reader import read_case
from ambjax.commands.check_text import acceptance
from ambjax.control import current, inversion, position
from ambjax.linear import StateSpace, Zones, frequency_lines, linearise, loop_quantities, peak
from ambjax.linear.margins import DECAYED, decayed_end, whole_end

PERIOD = 2e-5
# |S| of a resonance at 5150 Hz with 6 % damping: its largest value at most 2 kHz is at 2 kHz.
W, DAMPING = 2 * np.pi * 5150.0, 0.06
BEARING = """
plant = { m = 0.03, k_z = 0.0, mu_0 = 1.25663706e-6, n = 100.0, A = 4e-5, s_0 = 2e-4, i_0 = 1.0, R = 1.0 }
controller.observer = { kind = "difference", w = 5e4 }
controller.position = { kind = "chain", k_p = 363248.0, k_d = 69.375, k_int = 1e5, w_f = 3e5, w_lp = 1e9 }
controller.inversion = { kind = "linearised" }
actuator = { mode = "current", bandwidth = 2e4 }
processor = { predict = false }
sensor = { velocity = false }
sensitivity = { f_high = 2e3, f_low = 100.0 }
clock = { duration = 0.001, sample_period = 2e-5 }
"""


def resonance(period):
    """S = 1 + a resonance. The other outputs are those of S."""
    A, b = np.array([[0.0, 1.0], [-W * W, -2 * DAMPING * W]]), np.array([[0.0], [W * W]])
    if period is not None:
        A, b, *_ = cont2discrete((A, b, np.eye(1, 2), np.zeros((1, 1))), period)
    B, C, D = np.zeros((2, 3)), np.zeros((5, 2)), np.zeros((5, 3))
    B[:, 0], C[:, 0], D[:, 0] = b[:, 0], 1.0, 1.0
    return StateSpace(A, B, C, D, np.array([1.0, W]), None if period is None else np.asarray(period))


@pytest.mark.parametrize("period", [None, PERIOD])
def test_a_maximum_at_an_end_of_the_band_is_marked_and_the_larger_one_outside_is_found(period):
    system = resonance(period)

    def S(f):
        return np.abs(system.sensitivity(f))

    fine = np.linspace(5000.0, 5300.0, 30_001)  # a tenth of a hertz apart: |S| is found to 1e-8
    end = whole_end(system)
    whole, part = peak(system, S, 1.0, end, end), peak(system, S, 1.0, 2000.0, end)
    assert whole.height == pytest.approx(S(fine).max(), rel=1e-7)
    assert (whole.at_edge, whole.outside) == (False, None)
    assert part.frequency == pytest.approx(2000.0, rel=1e-5)
    assert part.at_edge
    assert part.outside.height == pytest.approx(whole.height, rel=1e-9)
    assert not part.outside.at_edge
    # a band above the peak: it lies below the band
    above = peak(system, S, 7000.0, end, end)
    assert above.frequency == 0.0  # |S| = 2
    assert above.outside.height == pytest.approx(whole.height, rel=1e-9)
    # a peak outside a narrow band that is not the largest value is not reported
    assert peak(system, S, 4000.0, 6000.0, end).outside is None


def test_a_response_that_rises_up_to_the_end_has_no_peak():
    """1 - |S - 1| rises from the resonance on to its limit at high frequency."""
    system = resonance(None)
    end = whole_end(system)
    found = peak(system, lambda f: 1 - np.abs(system.sensitivity(f) - 1), 5200.0, end, end)
    assert found.at_edge


@pytest.mark.parametrize("gamma", [2e6, 7.5e4])
def test_in_continuous_time_the_band_ends_where_S_is_1_for_good(gamma):
    laws = position.SlidingMode(c=200.0, k=63.0, p=5.0), inversion.Adaptive(gamma=gamma, p=1e-3)
    cascade = Cascade(position=laws[0], inversion=laws[1], current=current.SlidingMode(k_i=600.0, p=20.0))
    system = linearise(cascade, Scenario(), Clock(10, 1e-4))
    end, shown = whole_end(system), decayed_end(system, 1.0)
    beyond = np.abs(system.sensitivity(np.geomspace(end, 1e4 * end, 1000)) - 1)
    assert beyond.max() < DECAYED
    assert 10 < shown < end
    assert np.abs(system.sensitivity(np.geomspace(shown, end, 1000)) - 1).max() < DECAYED
    assert np.abs(system.sensitivity(np.array([0.9 * shown])) - 1)[0] > DECAYED


def test_the_limits_of_the_tuner_see_a_peak_outside_the_band_of_the_case():
    """The derivative-free search of the tuner finds the peak of the analysis over the whole range, to 1e-6."""
    system = jax.tree.map(jnp.asarray, resonance(PERIOD))
    found = jax.jit(lambda system: loop_quantities(system, jnp.asarray(True), 1.0, 5e2, 1.0, delay=False))(system)
    one = resonance(PERIOD)
    expected = peak(one, lambda f: np.abs(one.sensitivity(f)), 1.0, 0.5 / PERIOD)
    assert found.sensitivity == pytest.approx(expected.height, rel=1e-6)
    assert found.delay_margin_s == np.inf


def test_the_lines_of_an_injection_reach_the_end_of_the_band():
    clock = Clock(50_000, PERIOD)
    assert frequency_lines(Zones(), clock)[-1] == 22_500.0
    assert frequency_lines(Zones(f_high=2e3), clock)[-1] == 2000.0


@pytest.mark.thorough
def test_the_commands_say_that_a_larger_peak_lies_outside_the_band_of_the_case(elsewhere, capsys):
    """A 50 kHz bearing with a peak above 5 kHz, and a case whose band ends at 2 kHz."""
    assert main(["sensitivity", write(BEARING), "--out", "out"]) == 0
    text = capsys.readouterr().out
    summary = json.loads(pathlib.Path("out/sensitivity.json").read_text())
    loop, verdict, _ = acceptance(read_case("case.toml"))  # the first part of `ambjax check`
    main(["sensitivity", write(BEARING.replace("f_high = 2e3, ", ""), "whole.toml"), "--json"])
    full = json.loads(capsys.readouterr().out)
    assert full["zone"] == "D"
    assert 5000 < full["frequency_hz"] < 5300
    assert not full["at_band_edge"]
    for one in (summary, loop):
        assert (one["zone"], one["at_band_edge"], one["outside_zone"]) == ("A", True, "D")
        assert one["outside_peak"] == pytest.approx(full["peak"], rel=1e-6)
        assert one["outside_frequency_hz"] == pytest.approx(full["frequency_hz"], rel=1e-3)
    assert loop["delay_margin_samples"] == pytest.approx(50e3 * loop["delay_margin_s"])
    assert f"({loop['delay_margin_samples']:.4g} samples)" in text
    said = f"|S| is larger: {full['peak']:.4g} at {full['frequency_hz']:.4g} Hz (zone D)."
    assert said in text
    assert any(said in line for line in verdict)
    assert summary["injected_at_band_edge"]
    assert 5000 < full["injected_frequency_hz"] < 5300
