"""The plant against hand-derived formulas, autodiff and brute force. Eqs. (1)-(3), (9), Table 1."""

import dataclasses

import jax
import numpy as np
import pytest

from ambjax import Scenario
from ambjax.plants import Plant
from ambjax.simulation.metrics import Metrics
from ambjax.world.magnet import Iron
from ambjax.world.plant import Currents, TwoCoil
from ambjax.world.sensor import Measurement

PLANT = Plant()
OTHER = Plant(m=0.7, k_z=-900.0, n=1200.0, A=0.1, s_0=4e-3, i_0=0.4, R=30.0, g=3.0)
PLANTS = pytest.mark.parametrize("plant", [PLANT, OTHER], ids=["table 1", "other"])


def points(plant, n=400, reach=0.95, seed=0):
    """Random (z, i): |z| < reach s_0, |i| < 3 i_0."""
    z, i = np.random.default_rng(seed).uniform(-1, 1, (2, n))
    return z * reach * plant.s_0, 3 * i * plant.i_0


def test_a_plant_with_given_stiffness_force_per_current_and_inductance():
    """The formulas of docs/magnet.md, for any gap and any number of turns."""
    draw = np.random.default_rng(0)
    for _ in range(20):
        k_s, k_i, s_0, n = (10 ** draw.uniform(*ends) for ends in ((4, 7), (1, 3), (-4, -2), (1, 3)))
        leakage = draw.uniform(1.0, 2.0)
        L = leakage * k_i**2 / (2 * k_s)
        i_0, kappa, found = s_0 * k_s / k_i, s_0 * k_i**2 / k_s, 2 * k_s * L / k_i**2
        plant = TwoCoil(m=2.0, mu_0=1.2566e-6, n=n, A=kappa / (1.2566e-6 * n**2), s_0=s_0, i_0=i_0, R=0.5)
        plant = dataclasses.replace(plant, iron=Iron(leakage=found))
        np.testing.assert_allclose([plant.k_s, plant.k_i, found], [k_s, k_i, leakage], rtol=1e-12)  # rounding
        rest = plant.start(Measurement(*np.zeros(3)))
        # the rate of the current per volt is 1/L; 1e-9: the rate is a difference of R i_0 terms
        np.testing.assert_allclose(1 / plant.measurement(plant.rates(rest, 1.0)).i, L, rtol=1e-9)


@PLANTS
def test_closed_form_derivatives_equal_autodiff(plant):
    z, i = points(plant)
    by_z, by_i = jax.vmap(jax.grad(plant.v, (0, 1)))(z, i)
    # dv_di is a difference of two terms; its error is relative to the larger of them
    terms = 2 * (plant.i_0 + np.abs(i)) / (plant.s_0 - np.abs(z)) ** 2
    np.testing.assert_allclose(plant.dv_dz(z, i), by_z, rtol=1e-12)
    assert np.all(np.abs(plant.dv_di(z, i) - by_i) <= 1e-13 * terms)


@PLANTS
@pytest.mark.parametrize("share", [-0.9, -0.5, -1e-6, 0.0, 1e-6, 0.3, 0.9])
def test_the_rates_are_0_at_the_equilibrium(plant, share):
    z = share * plant.s_0
    i, u = plant.equilibrium(z)
    # relative to the largest term: a v is about 1e4 m/s^2 per magnet at 0.9 s_0
    terms = plant.a * ((plant.i_0 + abs(i)) / (plant.s_0 - abs(z))) ** 2 + plant.g
    assert abs(plant.z_ddot(z, i)) <= 1e-13 * terms
    assert abs(plant.i_dot(z, 0.0, i, u)) <= 1e-13 * 2 * (plant.s_0 + z) / plant.kappa * abs(u)


def test_rates_are_equations_1_and_2_written_out():
    p = OTHER
    z, z_dot, i, u, q = 1.1e-3, 0.2, 0.1, 30.0, 0.3
    force = ((p.i_0 + i) / (p.s_0 - z)) ** 2 - ((p.i_0 - i) / (p.s_0 + z)) ** 2
    z_ddot = 2 * p.k_z / p.m * z + p.mu_0 * p.n**2 * p.A / (4 * p.m) * force - p.g + q
    i_dot = 2 * z_dot / (p.s_0 + z) * i + 2 * (p.s_0 + z) / (p.mu_0 * p.n**2 * p.A) * (u - p.R * i) + q
    np.testing.assert_allclose(p.z_ddot(z, i, q), z_ddot, rtol=1e-14)
    np.testing.assert_allclose(p.i_dot(z, z_dot, i, u, q), i_dot, rtol=1e-14)
    np.testing.assert_allclose(p.copper_loss(i), p.R * ((p.i_0 + i) ** 2 + (p.i_0 - i) ** 2), rtol=1e-14)


# --- inversion ---


@PLANTS
def test_current_for_inverts_v_on_the_branch_through_zero_current(plant):
    z, i = points(plant, 2000)
    on_branch = plant.singularity(z, i) > 0.02
    z, i = z[on_branch], i[on_branch]
    assert on_branch.sum() > 1000
    # conditioning: di = dv / (dv/di), and this near to C, dv/di is as small as 1/50 of its usual size
    np.testing.assert_allclose(plant.current_for(z, plant.v(z, i)), i, rtol=1e-11, atol=1e-12 * plant.i_0)


def test_current_for_is_smooth_through_z_zero():
    # the derivative at v is di/dz = -dv_dz/dv_di and di/dv = 1/dv_di (implicit function theorem), at z = 0 too
    z = np.concatenate([[-1e-4, -1e-9, 0.0, 1e-9, 1e-4], np.logspace(-300, -2, 40) * PLANT.s_0])
    v = np.full_like(z, 1e4)
    i = PLANT.current_for(z, v)
    by_z, by_v = jax.jit(jax.vmap(jax.grad(PLANT.current_for, (0, 1))))(z, v)
    np.testing.assert_allclose(by_z, -PLANT.dv_dz(z, i) / PLANT.dv_di(z, i), rtol=1e-12)
    np.testing.assert_allclose(by_v, 1 / PLANT.dv_di(z, i), rtol=1e-12)


@pytest.mark.parametrize("share", [-0.5, -0.05, 0.05, 0.5])
def test_an_unreachable_force_gives_the_current_of_the_nearest_force(share):
    z = share * PLANT.s_0
    on_C = -(share + 1 / share) / 2 * PLANT.i_0
    nearest = PLANT.v(z, on_C)
    # at C dv/di = 0, so the error of v is rounding, and the error of i is the square root of rounding
    for excess in (1.0, 1.5, 10.0, 1e3):
        i = PLANT.current_for(z, excess * nearest)
        np.testing.assert_allclose(i, on_C, rtol=1e-6)
        np.testing.assert_allclose(PLANT.v(z, i), nearest, rtol=1e-10)


# --- the singular curve C ---


@PLANTS
def test_dv_di_vanishes_exactly_where_singularity_does(plant):
    z, i = points(plant)
    # dv/di = 4 i_0 s_0^2 singularity / ((s_0 - z)^2 (s_0 + z)^2): one positive factor apart
    factor = 4 * plant.i_0 * plant.s_0**2 / ((plant.s_0 - z) * (plant.s_0 + z)) ** 2
    size = 1 + 6 * np.abs(z) / plant.s_0  # of the terms of singularity at |i| <= 3 i_0
    assert np.all(np.abs(plant.dv_di(z, i) / factor - plant.singularity(z, i)) <= 1e-13 * size)
    x = np.array([-0.9, -0.3, 0.1, 0.5, 0.99])
    i_C = -(x + 1 / x) / 2 * plant.i_0
    np.testing.assert_allclose(plant.singularity(x * plant.s_0, i_C), 0, atol=1e-14)
    assert plant.singularity(0.0, 0.0) == 1


def test_distance_to_C_is_zero_on_C_and_known_at_the_origin():
    # distance^2 at the origin: x^2 + (x + 1/x)^2/4, least at x^4 = 1/5: (sqrt 5 + 1)/2
    np.testing.assert_allclose(PLANT.distance_to_C(0.0, 0.0), np.sqrt((np.sqrt(5) + 1) / 2), rtol=1e-8)
    x = np.concatenate([np.linspace(0.05, 1.5, 30), -np.linspace(0.05, 1.5, 30)])
    on = jax.jit(jax.vmap(PLANT.distance_to_C))(x * PLANT.s_0, -(x + 1 / x) / 2 * PLANT.i_0)
    # here the distance is first order in the error of x: what four Newton steps leave (1.1e-8 measured)
    np.testing.assert_allclose(on, 0, atol=1e-7)


# --- at and beyond the gap ---

SHARES = np.array([0.9, 0.995, 1.0, 1.0000001, 2.0, 100.0])
# every (z, i) of +-SHARES s_0 and 0, and some currents, none of them on C
BEYOND = np.stack(np.meshgrid([0.0, *SHARES * PLANT.s_0, *-SHARES * PLANT.s_0], [-100.0, -0.26, 0.0, 0.26, 100.0]))


FUNCTIONS = {
    "v": PLANT.v,
    "dv_dz": PLANT.dv_dz,
    "dv_di": PLANT.dv_di,
    "z_ddot": PLANT.z_ddot,
    "i_dot": lambda z, i: PLANT.i_dot(z, 1.0, i, 10.0),
    "current_for": lambda z, v: PLANT.current_for(z, 1e4 * v),
    "current_for, out of reach": lambda z, v: PLANT.current_for(z, 1e10 * v),
    "equilibrium": lambda z, i: sum(PLANT.equilibrium(z)) + 0 * i,
    "singularity": PLANT.singularity,
    "distance_to_C": PLANT.distance_to_C,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_finite_with_finite_derivatives_at_and_beyond_the_gap(name):
    z, i = BEYOND.reshape(2, -1)
    value, slopes = jax.jit(jax.vmap(jax.value_and_grad(FUNCTIONS[name], (0, 1))))(z, i)
    assert np.all(np.isfinite(np.stack([value, *slopes])))


def test_thresholds_follow_the_plant():
    """The bands are the same share of the sizes of sigma, v and i for every plant; the defaults are of Table 1."""
    paper = Metrics.of(0.5, Scenario(clearance=4.5e-3))
    assert dataclasses.replace(paper, largest_force=np.inf) == Metrics()
    assert float(paper.largest_force) == pytest.approx(PLANT.k_i * PLANT.i_0, rel=1e-12)
    small = Plant(m=1.2, s_0=4e-4, i_0=1.5, n=180.0, A=4e-4, R=0.9, k_z=0.0)
    bands = Metrics.of(0.5, Scenario(plant=small))
    assert bands.touchdown == 0.9 * small.s_0
    # gap x pole, with the pole of k_s = kappa i_0^2 / s_0^3 over m
    kappa = small.mu_0 * 180.0**2 * 4e-4
    pole = (kappa * 1.5**2 / 4e-4**3 / 1.2) ** 0.5
    assert bands.sigma_band / (pole * 4e-4) == pytest.approx(Metrics().sigma_band / (528.0 * 5e-3), rel=6e-3)
    assert bands.v_tilde_band == pytest.approx(0.1 * (1.5 / 4e-4) ** 2 / (0.25 / 5e-3) ** 2)
    assert bands.e_band == pytest.approx(1e-3 * 1.5 / 0.25)


@PLANTS
def test_the_equations_of_two_coils_in_half_their_difference_and_half_their_sum(plant):
    """The equations of docs/magnet.md for i = (i_1 - i_2)/2 and j = (i_1 + i_2)/2 - i_0."""
    coils = TwoCoil(**dataclasses.asdict(plant))
    z, i = points(plant)
    j, z_dot, u = np.random.default_rng(2).uniform(-1, 1, (3, z.size)) * [[0.1], [0.1], [200.0]]
    rates = coils.rates(Currents(z, z_dot, plant.i_0 + j + i, plant.i_0 + j - i), u)
    s_0, i_0, R, kappa = plant.s_0, plant.i_0, plant.R, plant.kappa
    over = z_dot / (s_0**2 - z**2)
    i_dot = 2 * s_0 / kappa * (u - R * i) + 2 * z / kappa * R * j - over * ((i_0 + j) * s_0 + i * z)
    j_dot = -2 * z / kappa * (u - R * i) - 2 * s_0 / kappa * R * j - over * ((i_0 + j) * z + i * s_0)
    # sums of terms that cancel; the error is relative to the largest of them
    size = 1e-12 * (np.abs(rates.i_1) + np.abs(rates.i_2)).max()
    np.testing.assert_allclose((rates.i_1 - rates.i_2) / 2, i_dot, rtol=0, atol=size)
    np.testing.assert_allclose((rates.i_1 + rates.i_2) / 2, j_dot, rtol=0, atol=size)
