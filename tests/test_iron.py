"""The iron against closed forms: saturation, leakage, the lag of the flux, and energy."""

import dataclasses
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough
from structures import RIG

from ambjax import simulate
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.plants import Plant
from ambjax.solvers import RK4
from ambjax.world.amplifier import Amplifier
from ambjax.world.magnet import Iron
from ambjax.world.plant import TwoCoil
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement

# At the bias current, the flux density of the cores is 0.65 T.
LIMIT = 1.2
PLANTS = pytest.mark.parametrize("kind", [Plant, TwoCoil])


def made(kind, **iron):
    return kind(**RIG, iron=Iron(**iron))


@PLANTS
def test_the_force_follows_the_flux_densities(kind):
    plant = made(kind, saturation=LIMIT, leakage=1.2)
    z, i = 1e-4, 1.5
    forces, densities = [], []
    for current, gap in ((2.5 + i, 5e-4 - z), (2.5 - i, 5e-4 + z)):
        ideal = 1.2566e-6 * 208 * current / (2 * gap)
        core = 1.2566e-6 * 208 * current / 2 * (1 / gap + 0.2 / 5e-4)
        share = 0.98 * (1 + (core / LIMIT) ** 4) ** -0.25 + 0.02
        densities.append(core * share)
        forces.append(2.68e-4 * (ideal * share) ** 2 / 1.2566e-6)  # A B^2/mu_0: both poles
    state = plant.start(Measurement(*map(jnp.asarray, (z, 0.0, i))))
    assert float(plant.m * plant.a * plant.signals(state).v) == pytest.approx(forces[0] - forces[1], rel=1e-12)
    assert float(plant.flux_density(state)) == pytest.approx(max(densities), rel=1e-12)
    assert max(densities) > 0.9 * LIMIT
    # Eq. (1)
    assert float(plant.rates(state, 0.0).z_dot) == pytest.approx((forces[0] - forces[1]) / 1.64 - 9.81, rel=1e-11)


def test_the_voltage_of_a_coil_is_the_rate_of_its_flux_linkage():
    plant = made(TwoCoil, saturation=LIMIT, leakage=1.1)
    z, z_dot, i_1, i_2, u = 1e-4, 0.3, 4.0, 1.2, 20.0
    state = plant.start(Measurement(*map(jnp.asarray, (z, z_dot, 0.0))))._replace(
        i_1=jnp.asarray(i_1), i_2=jnp.asarray(i_2)
    )
    rates = plant.rates(state, u)

    def linkage(z, i, side):
        b = plant.iron.core(plant, i, 1 / (plant.s_0 - side * z))
        return plant.n * plant.A * b * plant.iron.share(b)

    for side, i, rate in ((1, i_1, rates.i_1), (-1, i_2, rates.i_2)):
        _, moved = jax.jvp(lambda z, i, side=side: linkage(z, i, side), (z, i), (z_dot, float(rate)))
        assert float(moved) == pytest.approx(side * u + plant.R * (plant.i_0 - i), rel=1e-11)


@PLANTS
def test_leakage_increases_the_time_constant_but_not_the_force(kind):
    bare, leaky = kind(**RIG), made(kind, leakage=1.25)
    state = bare.start(Measurement(*map(jnp.asarray, (0.0, 0.0, 0.7))))
    ours, theirs = (jax.grad(lambda u, p=p: p.measurement(p.rates(state, u)).i)(3.0) for p in (leaky, bare))
    assert float(theirs / ours) == pytest.approx(1.25, rel=1e-12)
    assert float(leaky.signals(state).v) == pytest.approx(float(bare.signals(state).v), rel=1e-14)


@PLANTS
def test_the_flux_follows_a_held_current_exponentially(kind):
    plant, tau = made(kind, eddy=2e-4), 2e-4
    state = plant.start(Measurement(*map(jnp.asarray, (0.0, 0.0, 0.5))))
    delayed = jax.tree.map(lambda x: 0.4 * x, state.delayed)
    rates = plant.rates(state._replace(delayed=delayed), 0.0).delayed
    for rate, whole in zip(jax.tree.leaves(rates), jax.tree.leaves(state.delayed), strict=True):
        assert float(rate) == pytest.approx(0.6 * float(whole) / tau, rel=1e-12)
    assert float(plant.flux_slope()) == pytest.approx(1 / tau)


@pytest.mark.parametrize(
    ("eddy", "most"), [pytest.param(2e-4, 2, marks=pytest.mark.slow), (5e-5, 2), thorough(1e-5, 10)]
)
def test_the_chosen_step_resolves_the_lag_of_the_flux(eddy, most):
    """Against 25 times as many steps: z in the first 30 samples, as the rotor leaves the centre and the voltage limits.

    The error of RK4 falls with the fourth power of the step, so that of the finer run is negligible. Tolerance: that
    of `simulation.method.LAGGED`, an eighth of the rig's smallest noise.
    """
    raw = tomllib.loads(template("rig"))
    raw["plant"]["iron"] = {"eddy": eddy}
    raw["clock"]["duration"], raw["run"]["settle"] = 1.5e-3, 1e-3
    del raw["sensor"]["bits"], raw["spread"]  # a converter rounds differently after any difference
    case = case_from(raw)
    steps = case.clock.method.substeps
    assert steps <= most
    finer = dataclasses.replace(case, clock=case.clock.with_method(RK4(25 * steps)))
    z, reference = (np.asarray(simulate(one).trajectory.rows.z) for one in (case, finer))
    np.testing.assert_allclose(z, reference, rtol=0, atol=1.3e-11)
    assert np.ptp(z) > 1e-6


def test_the_iron_of_a_case_is_not_in_the_model_of_the_controller():
    raw = tomllib.loads("[plant.iron]\nsaturation = 1.2\n[spread]\nplant.iron.saturation = { percent = 5 }\n")
    case = case_from(raw)
    assert case.scenario.plant.iron == Iron(saturation=1.2)
    assert case.cascade.model.iron is None
    assert case.spread.paths == ("plant.iron.saturation",)
    for text, words in (
        ("saturation = 0.0", "plant.iron.saturation = 0: it must be a finite number from 0.001 to 1000 (T)"),
        ("leakage = 0.9", "plant.iron.leakage = 0.9"),
        ("hysteresis = 1.0", "plant.iron.hysteresis = 1.0: unknown key. Keys allowed here: saturation, leakage, eddy."),
    ):
        with pytest.raises(ValueError, match=r"plant\.iron") as error:
            case_from(tomllib.loads(f"[plant.iron]\n{text}\n"))
        assert words in str(error.value)


def test_the_largest_force_is_that_at_the_bias_or_the_limit():
    plant = Plant(**RIG)
    assert float(plant.largest_force()) == pytest.approx(float(plant.k_i) * 2.5, rel=1e-12)
    assert float(plant.largest_force(1.0)) == pytest.approx(float(plant.k_i) * 1.0, rel=1e-12)
    limits = {"u_max": 0.8 * plant.R, "amplifier": Amplifier(dead_band=0.1 * plant.R)}  # 0.7 A at rest
    assert float(Scenario(plant, **limits).largest_force) == pytest.approx(float(plant.k_i) * 0.7, rel=1e-12)
    saturated = dataclasses.replace(plant, iron=Iron(saturation=LIMIT))
    b = 1.2566e-6 * 208 * 5.0 / (2 * 5e-4)
    share = 0.98 * (1 + (b / LIMIT) ** 4) ** -0.25 + 0.02
    assert float(saturated.largest_force()) == pytest.approx(2.68e-4 * (b * share) ** 2 / 1.2566e-6, rel=1e-12)


def test_the_derivatives_of_saturation_are_those_of_its_formula():
    """The rules of the code against JAX's own of the formula in `Iron`: they differ in rounding only, below 1e-13."""
    iron = Iron(saturation=1.4)
    formula = lambda b: b * (0.02 + (1 - 0.02) * (1 + (b / 1.4) ** 4) ** -0.25)  # noqa: E731
    b = jnp.array([-30.0, -1.4, -0.2, 1e-3, 0.7, 1.4, 3.0, 1e3])
    value, first, second = formula, jax.grad(formula), jax.grad(jax.grad(formula))
    for ours, theirs in (
        (lambda b: b * iron.share(b), value),
        (jax.grad(lambda b: b * iron.share(b)), first),
        (iron.slope, first),
        (jax.grad(iron.slope), second),
    ):
        np.testing.assert_allclose(jax.vmap(ours)(b), jax.vmap(theirs)(b), rtol=1e-13, atol=1e-13)
