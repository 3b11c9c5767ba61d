"""Imperfect sensors and amplifiers: each part against its definition, and the keys of the case file."""

import dataclasses
import decimal
import math
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sampled_oracle import conversion
from scipy.integrate import solve_ivp

import ambjax as amb
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.cases.warned import warnings_of
from ambjax.commands.check_text import machine
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble
from ambjax.ensemble.maps import Axis, with_method_for_axes
from ambjax.results.spread_runs import study_of
from ambjax.simulation.folds import Named
from ambjax.world.amplifier import Amplifier
from ambjax.world.sensor import Errors, Measurement, Sensor, converted
from tuning.problem.quantities import Typical


def motion(z=1e-3, z_dot=0.2, i=0.1):
    return Measurement(*(jnp.asarray(x) for x in (z, z_dot, i)))


def test_a_converter_rounds_to_its_steps_and_saturates_at_its_range():
    x = np.concatenate([np.linspace(-1.3, 1.3, 997), [0.0, -0.0, 1 / 16, -1 / 16, 3 / 16, -1.0, 1.0]])
    got = np.asarray(converted(jnp.asarray(x), 4, 1.0))
    np.testing.assert_array_equal(got, [conversion(a, 4, 1.0) for a in x])  # powers of 2: exact
    assert set(got) == set(np.arange(-8, 8) / 8)


def test_the_derivative_of_a_converter_is_that_of_the_saturation():
    slope = jax.vmap(jax.grad(lambda x: converted(x, 6, 1.0)))
    np.testing.assert_array_equal(slope(jnp.array([-1.5, -0.5, 0.01, 0.9, 1.5])), [0.0, 1.0, 1.0, 1.0, 0.0])


def test_default_ranges_of_converters_follow_from_the_plant():
    seen = Sensor(bits=8.0).converted(motion(z=1.0, i=1.0), 5e-3, 0.25)
    assert (float(seen.z), float(seen.i)) == (5e-3 * 127 / 128, 0.5 * 127 / 128)
    seen = Sensor(bits=8.0, range_z=1e-3, range_i=0.1).converted(motion(z=-1.0, i=-1.0), 5e-3, 0.25)
    assert (float(seen.z), float(seen.i)) == (-1e-3, -0.1)
    # the current may have a converter of its own
    for bits, z in ((16.0, 5e-3 * (1 - 2**-15)), (None, 1.0)):
        seen = Sensor(bits=bits, bits_i=4.0).converted(motion(z=1.0, i=1.0), 5e-3, 0.25)
        assert (float(seen.z), float(seen.i)) == (z, 0.5 * 7 / 8)


def test_a_reading_is_scaled_offset_and_noisy_and_a_velocity_not_measured_is_zero():
    errors = Errors(*map(jnp.asarray, (1e-6, 2e-6, 3e-6)))
    seen = Sensor(gain=1.1, offset=1e-5).reading(motion(), errors)
    np.testing.assert_allclose(seen, [1.1e-3 + 1e-5 + 1e-6, 0.2 + 2e-6, 0.1 + 3e-6], rtol=1e-14)
    assert float(Sensor(velocity=False).reading(motion(), errors).z_dot) == 0.0


SHORTNESS = np.concatenate([[0.0], np.geomspace(1e-18, 1e3, 64), [0.999, 1.001]])


def low_pass(y, before, after, h, bandwidth):
    """Return the output of the low-pass with 150 digits, from the moments of exp(-b (1 - s)), b = w h."""
    exact = decimal.Context(prec=150)
    c_1, end, rise = (exact.create_decimal(x) for x in (h * before[1], h * after[1], after[0] - before[0]))
    b = exact.create_decimal(2 * np.pi * bandwidth * h)
    with decimal.localcontext(exact):
        moments = [1 - (-b).exp()]
        for k in range(1, 4):
            moments.append(1 - k * moments[-1] / b if b else b)
        start = exact.create_decimal(before[0]) - exact.create_decimal(y)
        terms = start, c_1, 3 * rise - 2 * c_1 - end, c_1 + end - 2 * rise
        return float(exact.create_decimal(y) + sum(m * c for m, c in zip(moments, terms, strict=True)))


@pytest.mark.parametrize("kind", ["float64", "float32"])
def test_the_low_pass_is_exact_and_has_derivatives_over_any_time(kind):
    """Times start at 0 s: after a ramp, or for a delay just below a whole number, a part may last 1e-15 s."""
    bandwidth, y, slope = 1e4, 2e-3, 2 * np.pi * 1e4
    with jax.enable_x64(kind == "float64"):
        h = (SHORTNESS / slope).astype(kind).astype(float)
        ends = [np.stack([1e-3 + 0.2 * t + 3 * t**2, 0.2 + 0.3 * np.sign(t)]) for t in (0 * h, h)]
        ends = [end.astype(kind).astype(float) for end in ends]

        def lagged(h, w, y, *ends):
            before, after = (motion(*end) for end in ends)
            return Sensor(bandwidth=w).lagged(jnp.asarray(y), before, after, h)

        given = [jnp.asarray(x, kind) for x in (h, 0 * h + bandwidth, 0 * h + y, ends[0].T, ends[1].T)]
        got = np.asarray(jax.vmap(lagged)(*given))
        slopes = [np.asarray(x) for x in jax.vmap(jax.grad(lagged, argnums=range(5)))(*given)]
    start = float(given[2][0])
    want = [low_pass(start, a, b, t, bandwidth) for a, b, t in zip(ends[0].T, ends[1].T, h, strict=True)]
    # some roundings of a number of 2e-3 m
    np.testing.assert_allclose(got, want, rtol=0, atol=8 * np.finfo(kind).eps * 2e-3)
    assert got[0] == start
    assert all(np.isfinite(x).all() for x in slopes)
    # at first y' = w (z - y)
    np.testing.assert_allclose(slopes[0][:10], slope * (1e-3 - y), rtol=1e-6)


FAST, SLOW = {"bandwidth": 5e3}, {"slew": 2e6}


@pytest.mark.parametrize("given", [FAST, SLOW, FAST | SLOW], ids=["bandwidth", "slew", "both"])
@pytest.mark.parametrize("ends", [(0.0, 100.0), (150.0, -30.0), (-5.0, -6.0), (7.0, 7.0)])
def test_the_voltage_of_an_amplifier_solves_its_equation(given, ends):
    u_a, u = ends
    w, slew = 2 * np.pi * given.get("bandwidth", 1e9), given.get("slew", math.inf)
    for time in (0.0, 1e-5, 1e-4):
        got = float(Amplifier(**given).followed(jnp.asarray(u_a), jnp.asarray(u), time))
        rate = lambda _, x: np.clip(w * (u - x), -slew, slew)  # noqa: E731
        run = solve_ivp(rate, (0, time), [u_a], "Radau", rtol=1e-10, atol=1e-10, max_step=max(time / 200, 1e-9))
        # SciPy's steps across the corner where the ramp ends; without a bandwidth, its 1 ns more
        assert got == pytest.approx(run.y[0, -1], abs=1e-4 if "bandwidth" in given else 5e-3)


def test_dead_band_and_current_limit():
    drive = Amplifier(dead_band=2.0, i_max=0.4)

    def at(u, i, hold=None):
        u, i = jnp.asarray(u), jnp.asarray(i)
        held = 50.0 * i if hold is None else jnp.asarray(hold)
        return float(drive.at_coil(u, i, 60.0, lambda: (-held, jnp.ones(()))))

    assert [at(u, 0.1) for u in (5.0, 1.0, -1.5, -9.0)] == [3.0, 0.0, 0.0, -7.0]
    assert [at(30.0, 0.4), at(30.0, -0.5), at(-30.0, -0.5), at(10.0, 0.4)] == [20.0, 28.0, -25.0, 8.0]
    # the voltage that holds the current exceeds that of the supply
    assert [at(30.0, 0.5, -78.0), at(-30.0, -0.5, 78.0), at(-30.0, -0.5, -78.0)] == [-60.0, 60.0, -28.0]


def laws(p=math.inf, **processor):
    return amb.Cascade(
        position=amb.laws.position.SlidingMode(1440.0, 2.3, p),
        inversion=amb.laws.inversion.Adaptive(8e5, p),
        current=amb.laws.current.SlidingMode(870.0, p),
        processor=Processor(**processor),
    )


WORLD = amb.Scenario(reference=amb.signals.Sine(2.5e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=200.0, seed=3)
CLOCK = amb.Clock(400, 1e-4)


def run(sensor=None, amplifier=None, clock=CLOCK, **processor):
    scenario = dataclasses.replace(WORLD, amplifier=amplifier)
    if sensor:
        scenario = dataclasses.replace(scenario, sensor=dataclasses.replace(WORLD.sensor, **sensor))
    return amb.rollout(laws(**processor), scenario, clock).trajectory.rows


def test_the_current_stays_within_its_limit():
    rows = run()
    assert np.abs(rows.i).max() > 0.055
    held = run(amplifier=Amplifier(i_max=0.05))
    # overshoot of a step of RK4 that begins below the limit: L di/dt = 200 V for 33 us is 2e-4 A
    assert 0.05 <= np.abs(held.i).max() < 0.0502


@pytest.mark.slow
def test_the_largest_voltage_is_that_at_the_coils_and_within_the_supply():
    case = case_from(tomllib.loads(template("rig")))
    # fast away from the wider gap, at the limit: 78 V less would keep the current
    falling = dataclasses.replace(case.scenario, initial=amb.Initial(-2e-4, 0.2, 2.5))
    clock, fold = dataclasses.replace(case.clock, samples=4), amb.Metrics()
    assert amb.rollout(case.cascade, falling, clock, fold=fold).metrics["max_abs_u_V"] == 48.0
    # 1 V per sample, and one sample late
    slow = dataclasses.replace(falling, amplifier=Amplifier(slew=2e4), initial=amb.Initial(1e-4))
    found = amb.rollout(case.cascade, slow, clock, fold=Named({"judge": fold, "search": Typical("u_peak", 3.0)}))
    assert np.abs(found.trajectory.rows.u).max() > 10
    u_peak = found.trajectory.rows.u_peak
    np.testing.assert_allclose(u_peak, [0.0, 1.0, 2.0, 3.0], rtol=0, atol=1e-9)
    assert found.metrics["judge"]["max_abs_u_V"] == u_peak.max()
    np.testing.assert_allclose(found.metrics["search"], np.mean(u_peak**16) ** (1 / 16), rtol=1e-12)


CASE = {"processor": {}, "clock": {"duration": 0.01}}


@pytest.mark.parametrize(
    ("table", "key", "value", "words"),
    [
        ("sensor", "bits", 14.5, "a whole number from 2 to 32"),
        ("sensor", "bandwidth", 0.1, "Hz"),
        ("sensor", "velocity", 1, "true or false"),
        ("sensor", "velocity", False, 'kind = "kalman"'),
        ("sensor", "bit", 14, "Did you mean 'bits'"),
        ("actuator", "dead_band", "1", "without quotes"),
        ("actuator", "i_min", 1, "Did you mean 'i_max'"),
    ],
)
def test_a_wrong_key_is_refused_with_its_path(table, key, value, words):
    with pytest.raises(ValueError, match=rf"^{table}\.{key} = ") as error:
        case_from(CASE | {table: {key: value}})
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [("sensor", "bits", 12), ("sensor", "bits_i", 12), ("sensor", "bandwidth", 1e4), ("actuator", "slew", 1e6)],
)
def test_keys_that_need_a_processor_are_refused_without_one(table, key, value):
    with pytest.raises(ValueError, match=rf"^{table}\.{key} is for a controller on a processor"):
        case_from({table: {key: value}})
    assert case_from(CASE | {table: {key: value}}).scenario.on_processor == f"{table}.{key}"


# 0.25 um on average over 1,000 members of the rig. Of the bearing 1.5 um over the whole run: the transient of the step
# of force is a third of what is averaged here.
@pytest.mark.parametrize(("name", "most"), [("rig", 5e-7), ("bearing", 3e-6)])
def test_the_machines_of_the_templates_are_plausible_and_hold_rotors_off_their_model(name, most):
    case = case_from(tomllib.loads(template(name)))
    plant = case.scenario.plant
    assert not case.scenario.sensor.velocity
    assert warnings_of(case) == []
    facts = {fact.key: fact.value for fact in machine(case)}
    assert facts["bias_flux_T"] < 1.2
    assert facts["force_reserve"] > 2
    start, heavy = np.array([-1e-4, 0.0, 1e-4]), plant.m * np.array([0.9, 1.1, 1.1])
    spread = dataclasses.replace(case.scenario, initial=amb.Initial(z=start), member=np.arange(3))
    spread = dataclasses.replace(spread, plant=dataclasses.replace(plant, m=heavy))
    clock, fold = dataclasses.replace(case.clock, samples=2000), amb.Metrics(0.05)
    found = run_ensemble(case.cascade, spread, clock, fold=fold).metrics
    assert np.isinf(found["lost_at_s"]).all()
    assert np.max(found["settled_rms_error_m"]) < most


def test_the_step_is_small_enough_for_the_ends_of_an_amplifier_s_spread():
    raw = CASE | {"actuator": {"bandwidth": 1e3}}
    wide = case_from(raw | {"spread": {"actuator": {"bandwidth": {"log-uniform": [500.0, 2e4]}}}}).clock.method
    assert wide == case_from(CASE | {"actuator": {"bandwidth": 2e4}}).clock.method == amb.solvers.RK4(26)
    assert case_from(raw).clock.method == amb.solvers.RK4(3)
    given, bandwidth = {"clock": {"duration": 0.01, "dt": 2e-5}}, Axis("actuator.bandwidth", np.array([500.0, 2e4]))
    start, period = Axis("initial.z", np.zeros(2)), Axis("clock.sample_period", np.array([5e-5, 2e-4]))
    for tables, other, substeps in (({}, start, 26), ({}, period, 51), (given, start, 5)):
        study = study_of(case_from(raw | tables), None, 1)
        assert with_method_for_axes(study, bandwidth, other).clock.method == amb.solvers.RK4(substeps)


@pytest.mark.parametrize(("table", "loud"), [({"std": 1e-6}, True), ({"std_z_dot": 1e-4}, False), (None, True)])
def test_a_velocity_measured_without_error_causes_a_warning(table, loud):
    raw = CASE | ({} if table is None else {"sensor": table})
    assert any("VELOCITY" in line for line in warnings_of(case_from(raw))) == loud
