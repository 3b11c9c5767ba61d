"""Theorem 1 monitored: conditions, margins and the identities of its proof."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, paper, rollout
from ambjax.laws import inversion, position
from ambjax.plants import Plant
from ambjax.sensors import Sensor
from ambjax.signals import Pulse, SmoothStep
from ambjax.solvers import AdaptiveRodas3
from ambjax.theorem.conditions import check, delta_1_on_reference

CLOCK = Clock(1000, 1e-4, AdaptiveRodas3(1e-8))


def short(gamma=paper.REPAIRED_GAMMA, **changes):
    """0.1 s of tracking with a pulse; one structure, so that the tests share one compilation."""
    cascade = dataclasses.replace(paper.cascade("repaired"), inversion=inversion.Adaptive(gamma))
    scenario = dataclasses.replace(paper.scenario("tracking", "repaired"), q_v=Pulse(1.0, 0.05, 0.08))
    return cascade, dataclasses.replace(scenario, **changes)


def lines(report):
    return {c.name: c for c in report.conditions}


def test_repaired_holds_and_literal_does_not():
    repaired, literal = check(*short(), CLOCK), check(*short(gamma=1000.0), CLOCK)
    assert repaired.holds
    assert all(c.margin > 0 for c in repaired.conditions if c.holds)
    assert not literal.holds
    failing = [c for c in literal.conditions if c.holds is False]
    assert {c.name for c in failing} == {"inversion", "inversion, ideal"}
    # |dv/dz z_dot| alone is 2.0e6 * 0.0314 = 6.3e4 at t = 0; the diverging run exceeds it.
    assert next(c for c in failing if c.name == "inversion").against >= 6.3e4
    assert literal.lost_at < 0.02


@pytest.mark.slow
def test_suprema_and_their_times():
    cascade, scenario = short(q_i=Pulse(0.05, 0.02, 0.03))
    report = lines(check(cascade, scenario, CLOCK))
    a = float(Plant().a)
    assert report["disturbance of z"].against == pytest.approx(a, rel=1e-12)
    assert report["disturbance of z"].at_s == pytest.approx(0.05, abs=1e-12)
    assert report["disturbance of i"].against == 0.05
    assert report["disturbance of i"].at_s == pytest.approx(0.02, abs=1e-12)


@pytest.mark.slow
def test_delta_1_is_the_derivative_of_a_trajectory():
    """d = v_star' - dv/dz z_dot, against central differences of the recorded v_star (error ~ h^2 v_star'''/6)."""
    cascade, scenario = short()
    fine = Clock(20_000, 5e-6, AdaptiveRodas3(1e-9))
    rows = rollout(cascade, scenario, fine).trajectory.rows
    plant = Plant()
    slope = np.gradient(np.asarray(rows.v_star), 5e-6, edge_order=2)
    slope -= np.asarray(plant.dv_dz(rows.z, rows.i_ref) * rows.z_dot)
    report = lines(check(cascade, scenario, CLOCK))
    worst = report["inversion"]
    assert worst.at_s > 0.01
    assert min(abs(worst.at_s - 0.05), abs(worst.at_s - 0.08)) > 1e-4
    at = np.abs(np.asarray(rows.t) - worst.at_s).argmin()
    assert abs(slope[at]) == pytest.approx(worst.against, rel=1e-5)
    # at the samples of CLOCK; both runs agree to their tolerances
    distance = jax.vmap(plant.signed_distance_to_C)(rows.z[::20], rows.i_ref[::20])
    assert report["singular curve C"].gain == pytest.approx(float(distance.min()), rel=1e-4)


def test_delta_1_on_reference_by_hand():
    """On r = A sin(w t), at t = 0, z = 0: v_star' = -(2 k_z/m + w^2) A w / a, and dv/dz(0, i) is known."""
    cascade, scenario = short()
    plant, w = Plant(), 2 * np.pi * 2
    speed = 2.5e-3 * w
    i = float(plant.current_for(0.0, plant.g / plant.a))
    by_hand = abs(-(2 * plant.k_z / plant.m + w**2) * speed / plant.a - float(plant.dv_dz(0.0, i)) * speed)
    value, at = delta_1_on_reference(cascade, scenario, Clock(1, 1e-4, AdaptiveRodas3()))
    assert at == 0
    assert value == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.slow
def test_identities_hold_to_integration_error_and_tighten_with_tolerance():
    cascade, scenario = short(q_i=Pulse(0.05, 0.02, 0.03))

    def residuals(tolerance):
        report = check(cascade, scenario, CLOCK.with_method(AdaptiveRodas3(tolerance)))
        return np.array([c.against for c in report.proof[:3]])

    loose, tight = residuals(1e-5), residuals(1e-8)
    # sigma is of size 0.04 m/s, v_tilde 200 A^2/m^2, e 0.05 A: eight digits and more.
    assert (tight < [1e-9, 1e-4, 1e-11]).all()
    assert tight[1] < 0.05 * loose[1]
    bound = check(cascade, scenario, CLOCK).proof[3]
    assert -1e-9 < bound.against < np.inf  # V' stays below its bound to rounding


def test_identities_fail_if_their_assumptions_fail():
    cascade, scenario = short()
    wrong = dataclasses.replace(cascade, model=Plant(m=0.6))
    assert check(wrong, scenario, CLOCK).proof[0].against > 1e-4
    limited = dataclasses.replace(scenario, u_max=jnp.asarray(40.0))
    assert check(cascade, limited, CLOCK).proof[2].against > 1e-6


@pytest.mark.slow
def test_other_laws_are_not_applicable_and_noise_is_monitored():
    cascade = Cascade(position=position.SuperTwisting(), inversion=inversion.ClosedForm())
    _, scenario = short(reference=SmoothStep(1e-3, 0.0, 0.05), sensor=Sensor(1e-7))
    report = check(cascade, scenario, CLOCK)
    judged = lines(report)
    assert judged["disturbance of z"].holds is None
    assert judged["inversion"].holds is None
    assert judged["disturbance of i"].holds
    assert report.holds
