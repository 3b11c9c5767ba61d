"""Amplitude and phase once and twice per revolution, and the fold that computes them."""

import tomllib

import jax
import numpy as np
import pytest

from ambjax.cases.machine_case import machine_from
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.commands.check_text import acceptance
from ambjax.linear import analyse, linearise
from ambjax.pictures.run_up_picture import once_per_turn
from ambjax.results.runs import simulate_machine
from ambjax.signals import Rotation
from ambjax.simulation.folds import Ending
from ambjax.simulation.response import SIGNALS, UNITS, Orders
from ambjax.simulation.trajectory import Row

T, NEVER = 1e-4, np.inf


def folded(fold, signal, samples, alive=None):
    """Return the result of the fold for a signal(t), the same in all channels."""
    nothing = Row(*[np.zeros(samples)] * len(Row._fields))
    t = T * np.arange(samples)
    held = np.ones(samples, bool) if alive is None else alive(t)
    rows = nothing._replace(t=t, alive=held, **dict.fromkeys(SIGNALS, signal(t)))
    carry, _ = jax.lax.scan(lambda carry, row: (fold.update(carry, row, None), None), fold.init(), rows)
    return fold.result(carry, Ending(0, t[~held].min(initial=NEVER), NEVER, samples * T))


def angle(rotor, t):
    return 2 * np.pi * (rotor.speed * t + rotor.acceleration * t**2 / 2) / 60


@pytest.mark.parametrize("rotor", [Rotation(2971.0), Rotation(-2971.0), Rotation(2000.0, 3e4)])
def test_the_fit_is_exact_for_a_signal_of_these_orders(rotor):
    """No whole number of samples in a revolution, an offset, an angle at the start that is not 0, a rotor lost."""

    def signal(t):
        return 0.7 + 3.0 * np.cos(angle(rotor, t) - 2.0) + 0.2 * np.cos(2 * angle(rotor, t) + 0.5)

    for alive in (None, lambda t: t < 0.15):
        found = folded(Orders(rotor, 0.0123), signal, 2000, alive)
        assert found.keys() == UNITS.keys()
        for name, expected in (("z_1x_m", 3.0), ("z_2x_m", 0.2), ("i_1x_A", 3.0)):
            assert found[name] == pytest.approx(expected, rel=1e-10)
        assert found["z_1x_deg"] == pytest.approx(np.degrees(-2.0), rel=1e-9)
        assert found["u_2x_deg"] == pytest.approx(np.degrees(0.5), rel=1e-9)


@pytest.mark.parametrize(
    ("advance", "resolved"),
    [(0.2, (1, 2)), (0.249, (1, 2)), (0.25, (1,)), (0.3, (1,)), (1 / 3, (1,)), (0.499, (1,)), (0.5, ()), (0.7, ())],
)
def test_an_order_that_the_samples_do_not_resolve_is_0(advance, resolved):
    """`advance`: turns between two samples."""
    rotor = Rotation(60 * advance / T)
    found = folded(
        Orders(rotor, 0.0), lambda t: sum((k * np.cos(k * angle(rotor, t) - 2.0) for k in resolved), 0 * t), 2000
    )
    assert all(np.isfinite(x) for x in found.values())
    for k in (1, 2):
        assert found[f"z_{k}x_m"] == pytest.approx(k if k in resolved else 0.0, rel=1e-6)


def test_other_orders_do_not_leak_into_the_fit():
    """At 40 samples in a revolution, over whole revolutions, the third order is orthogonal to the first two."""
    rotor = Rotation(60 / (40 * T))
    found = folded(Orders(rotor, 0.0), lambda t: np.cos(angle(rotor, t)) + np.cos(3 * angle(rotor, t) + 1), 1999)
    assert found["z_1x_m"] == pytest.approx(1.0, rel=1e-10)
    assert found["z_2x_m"] == pytest.approx(0.0, abs=1e-10)


def test_without_a_whole_revolution_nothing_is_known():
    found = folded(Orders(Rotation(60.0), 0.0), np.cos, 2000)
    assert not any(found.values())


@pytest.mark.slow
def test_every_axis_of_a_machine_has_them():
    case = machine_from(tomllib.loads(template("machine")), "m")
    run = simulate_machine(case)
    settled = run.signals["t"] >= case.settle  # fifteen revolutions
    turn = 2 * np.pi * 100.0 * run.signals["t"][settled]
    basis = np.stack([np.ones_like(turn), *(f(k * turn) for k in (1, 2) for f in (np.cos, np.sin))], 1)
    fits = np.linalg.lstsq(basis, run.signals["z"][settled], rcond=None)[0]
    for k, own in enumerate(run.metrics["axes"][name] for name in case.axes):
        assert own["z_1x_m"] == pytest.approx(np.hypot(*fits[1:3, k]), rel=1e-9, abs=1e-15)
    assert run.metrics["z_1x_m"] == max(own["z_1x_m"] for own in run.metrics["axes"].values())


@pytest.mark.slow
def test_a_peak_of_the_sensitivity_near_the_speed_is_named():
    laws = {"position": {"kind": "pid"}, "inversion": {"kind": "closed-form"}, "current": {"kind": "pi"}}
    clock = {"duration": 0.01, "sample_period": 1e-4}
    case = case_from({"controller": laws, "clock": clock})
    system = linearise(case.cascade, case.scenario, case.clock)
    peak = analyse(system, case.scenario.plant.m, case.clock.sample_period).S.frequency
    for factor, named in ((0.95, True), (1.05, True), (0.85, False), (1.15, False)):
        turning = case_from({"controller": laws, "clock": clock, "rotor": {"speed": 60 * factor * peak}})
        summary, lines, _ = acceptance(turning)
        (at,) = summary["running_speed"]
        expected = abs(system.sensitivity(np.array([factor * peak]))[0])
        assert at == {"frequency_hz": pytest.approx(factor * peak), "S": pytest.approx(expected, rel=1e-9)}
        assert ("WARNING: the peak of |S|" in "\n".join(lines)) == named


def test_the_amplitude_in_each_turn_of_a_run_up_is_that_of_the_signal():
    rotor = Rotation(600.0, 12000.0)
    t = np.arange(0.0, 1.0, 1e-4)
    turns = np.asarray(rotor.turns(t))
    found = once_per_turn(3e-6 * np.cos(2 * np.pi * turns + 0.4) + 1e-5 * turns, turns)
    assert len(found) == int(turns[-1])
    np.testing.assert_allclose(found, 3e-6, rtol=1e-9)
