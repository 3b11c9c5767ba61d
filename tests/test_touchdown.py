"""The touchdown bearing: its force, the energy of a rotor that bounces on it, and lift-off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ambjax as amb
from ambjax.cases.reader import case_from
from ambjax.ensemble.spread import apply
from ambjax.numerics.linear import rk4_step
from ambjax.simulation.method import TOUCHED
from ambjax.world.sensor import Measurement
from ambjax.world.touchdown import DAMPING_DEPTH

GAP = 2e-3


def force(stop, z, z_dot):
    return np.asarray(stop.force(Measurement(np.asarray(z), np.asarray(z_dot), 0.0), GAP))


def test_the_elastic_force_is_the_slope_of_its_energy():
    stop = amb.plants.Stop(2e5)
    z = np.array([-2.5e-3, -2.1e-3, -1e-3, 0.0, 1.9e-3, 2.2e-3])
    h = 1e-8  # of a quadratic: exact but for rounding, 1e-16 of 0.025 J / h
    energy = [2e5 / 2 * np.maximum(np.abs(z + s * h) - GAP, 0) ** 2 for s in (-1, 1)]
    np.testing.assert_allclose(force(stop, z, 3.0), -(energy[1] - energy[0]) / (2 * h), rtol=1e-6, atol=1e-6)
    gradient = jax.vmap(jax.grad(lambda z: stop.force(Measurement(z, 0.0, 0.0), GAP)))(z)
    np.testing.assert_array_equal(gradient, np.where(np.abs(z) > GAP, -2e5, 0.0))


def test_the_stop_pushes_and_never_pulls():
    stop = amb.plants.Stop(2e5, 50.0)
    deep = GAP * (1 + 10 * DAMPING_DEPTH)
    coming, rest, leaving, fleeing = (force(stop, -deep, v) for v in (-0.01, 0.0, 0.01, 1.0))
    assert (coming - rest, rest - leaving) == pytest.approx((0.5, 0.5))  # 50 N s/m at 0.01 m/s
    assert fleeing == 0
    assert force(stop, deep, 0.01) == pytest.approx(-coming)
    # continuous at the touch, whatever the velocity
    assert abs(force(stop, GAP * (1 + 1e-9), 5.0)) < 1e-3
    assert force(stop, GAP * (1 - 1e-9), 5.0) == 0


# A rotor whose magnets are off, 1e-13 N, and that falls 2 mm onto its stop: 2 g h = (0.198 m/s)^2.
FALLING = {
    "plant": {"m": 0.5, "k_z": 0.0, "i_0": 1e-6, "s_0": 5e-3, "g": 9.81},
    "controller": {"model": {"i_0": 0.25}, "inversion": {"kind": "closed-form"}, "current": {"kind": "pi"}},
    "actuator": {"u_max": 1e-9},
    "clock": {"duration": 0.09, "sample_period": 1e-4},
}
STOP = {"clearance": GAP, "stop_stiffness": 2e5}


def bounce(damping):
    """The largest height after the first touch, m, from an independent solution in three smooth parts."""

    def fall(t, x):
        depth = max(-x[0] - GAP, 0.0)
        s = min(depth / (DAMPING_DEPTH * GAP), 1.0)
        return [x[1], -9.81 + max(2e5 * depth - damping * s * s * (3 - 2 * s) * x[1], 0.0) / 0.5]

    found = solve_ivp(fall, (0, 0.09), [0.0, 0.0], "RK45", rtol=1e-9, atol=1e-12, max_step=1e-5)
    return np.max(found.y[0][found.t > 0.03])


@pytest.mark.parametrize(
    "processor", [pytest.param(False, marks=pytest.mark.slow), True], ids=["continuous", "processor"]
)
def test_an_elastic_stop_conserves_energy_and_a_damped_one_loses_it(processor):
    raw = FALLING | ({"processor": {"delay": 0.0}} if processor else {})
    case = case_from(raw | {"run": STOP | {"stop_damping": 0.0}})
    for damping, height in ((0.0, 0.0), (100.0, None)):
        scenario = apply(case.cascade, case.scenario, {"run.stop_damping": damping})[1]
        found = amb.rollout(case.cascade, scenario, case.clock).trajectory
        assert np.isinf(found.lost_at)
        z = np.asarray(found.rows.z)
        # k d^2/2 = m g (GAP + d): the elastic stop is pressed in by 0.34 mm
        assert -GAP - 0.35e-3 < np.min(z) < -GAP
        top = np.max(z[300:])
        expected = bounce(damping) if height is None else height
        # elastic: back at the height of the start, to the error of the step in which the contact begins, 1e-3 of 2 mm
        assert top == pytest.approx(expected, abs=4e-6)
    assert top < -0.2e-3  # the damped rotor has lost a tenth of its energy or more


@pytest.mark.parametrize(("damping", "largest"), [(0.0, 1.1e-4), (500.0, 1.2e-3)])
def test_the_step_of_a_stop_resolves_its_contact(damping, largest):
    """Rebounds at 0.1 m/s for 41 phases of the contact in the step, against steps that are 50 times as short.

    `largest`: relative error of the velocity after the contact, as stated at `simulation.method.TOUCHED`. The error
    exceeds half of it, so that the statement is not too cautious either.
    """
    stop, m, gap = amb.plants.Stop(1e7, damping), 2.4, 2.5e-4
    slope = float(stop.slope(m))

    def rebound(phase, step):
        rates = lambda y: (y[1], stop.force(Measurement(y[0], y[1], 0.0), gap) / m)  # noqa: E731
        start = (gap - 0.1 * phase * step, jnp.full_like(phase, 0.1))
        return jax.lax.fori_loop(0, int(5 / (slope * step)), lambda _, y: rk4_step(rates, y, step), start)[1]

    phases = jnp.linspace(0.0, 1.0, 41)
    coarse, fine = (np.asarray(rebound(phases, share * TOUCHED / slope)) for share in (1.0, 0.02))
    error = np.max(np.abs(coarse - fine)) / 0.1
    assert largest / 2 < error < largest
    assert np.all(fine < -0.08)


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"run": {"stop_damping": 10.0}}, "run.stop_damping = 10.0: there is no stop to damp. Give run.stop_stiffness"),
        ({"run": {"stop_stiffness": -1.0}}, "run.stop_stiffness = -1: it must be"),
        ({"run": STOP, "initial": {"z": 4.99e-3}}, "initial.z = 0.00499 m: the rotor would touch a magnet"),
        ({"run": STOP | {"clearance": 4.96e-3}}, "run.clearance = 0.00496 m: with a stop it must be below 0.00495 m"),
        ({"run": STOP, "clock": {"method": "sliding"}}, "sliding.*does not resolve run.stop_stiffness"),
    ],
)
def test_wrong_stops_are_refused(tables, said):
    with pytest.raises(ValueError, match=said):
        case_from(tables)


def test_a_rotor_can_start_on_its_stop():
    assert case_from({"run": STOP, "initial": {"z": -GAP}}).scenario.initial.z == -GAP
    with pytest.raises(ValueError, match="the rotor would touch its stop at the start"):
        case_from({"run": {"clearance": GAP}, "initial": {"z": -GAP}})
