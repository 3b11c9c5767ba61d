"""Spreads: distributions, designs, the numbers that they move, and what is refused."""

import dataclasses
import tomllib

import jax
import numpy as np
import pytest
from scipy import stats

from ambjax import Cascade, Scenario
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.ensemble import Choice, LogUniform, Normal, Percent, Spread, Uniform, apply, draw
from ambjax.ensemble.design import DESIGNS, design_points
from ambjax.ensemble.spread import corners
from ambjax.laws import inversion, observer
from ambjax.sensors import Sensor
from ambjax.signals import Constant, Pulse, Sine, SmoothStep, Step, Sum

CASCADE = Cascade()
SMOOTH = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
SCENARIO = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.8, 1.3), sensor=Sensor(1e-6, 1e-4, 1e-4))
# name: distribution, nominal, the same by SciPy (cut at 6 standard deviations where normal)
CONTINUOUS = {
    "normal": (Normal(2e-4), 1e-3, stats.truncnorm(-6, 6, 1e-3, 2e-4)),
    "uniform": (Uniform(-3.0, 5.0), 7.0, stats.uniform(-3.0, 8.0)),
    "log-uniform": (LogUniform(1e-8, 1e-3), 0.0, stats.loguniform(1e-8, 1e-3)),
    "percent": (Percent(10.0), -754.0, stats.uniform(-829.4, 150.8)),
    "percent normal": (Percent(10.0, "normal"), -754.0, stats.truncnorm(-6, 6, -754.0, 75.4)),
}
SPREAD = Spread(
    (
        ("plant.m", Percent(10.0)),
        ("plant.k_z", Percent(10.0, "normal")),
        ("initial.z", Normal(1e-4)),
        ("sensor.std", LogUniform(1e-8, 1e-6)),
        ("disturbance.q_z.shift", Uniform(-0.1, 0.1)),
        ("actuator.u_max", Choice((100.0, 200.0, 500.0))),
        ("controller.position.c", Percent(5.0)),
    )
)


def drawn(design, members, total=1000, seed=3):
    return draw(dataclasses.replace(SPREAD, design=design), CASCADE, SCENARIO, seed, np.asarray(members), total)


# --- distributions ---


@pytest.mark.parametrize("name", CONTINUOUS)
def test_quantiles_agree_with_scipy(name):
    kind, nominal, theirs = CONTINUOUS[name]
    u = np.concatenate([np.linspace(0.001, 0.999, 99), [1e-7, 1 - 1e-7]])
    # five sizes of the spread's width times 1e-12: a few roundings, and near 1 those of u itself
    np.testing.assert_allclose(kind.quantile(u, nominal), theirs.ppf(u), rtol=1e-9)


# --- designs ---


@pytest.mark.parametrize("design", DESIGNS)
def test_member_k_is_the_same_for_all_chunks(design):
    whole = drawn(design, np.arange(1000))
    for size in (1, 7, 64, 999):
        picked = range(0, 1000, 100) if size == 1 else range(0, 1000, size)
        for first in picked:
            chunk = np.arange(first, min(first + size, 1000))
            for path, values in drawn(design, chunk).items():
                np.testing.assert_array_equal(values, whole[path][chunk])
    odd = np.array([999, 3, 4, 5, 3, 0, 500])  # out of order, with gaps, one twice
    for path, values in drawn(design, odd).items():
        np.testing.assert_array_equal(values, whole[path][odd])


@pytest.mark.parametrize("design", ["random", "sobol"])
def test_member_k_does_not_depend_on_the_number_of_members(design):
    few, many = drawn(design, np.arange(50), 50), drawn(design, np.arange(50), 10**9)
    for path in few:
        np.testing.assert_array_equal(few[path], many[path])


@pytest.mark.parametrize("design", DESIGNS)
def test_different_seeds_differ_and_equal_seeds_repeat(design):
    first = drawn(design, np.arange(20), seed=1)
    for path, values in drawn(design, np.arange(20), seed=2).items():
        assert not np.any(values == first[path]) or path == "actuator.u_max"
    again = drawn(design, np.arange(20), seed=1)
    assert all(np.array_equal(first[path], again[path]) for path in first)
    assert drawn(design, np.arange(2), seed=2**32 - 1)


@pytest.mark.parametrize(("design", "total"), [("latin-hypercube", 1000), ("latin-hypercube", 7), ("sobol", 256)])
def test_every_stratum_contains_exactly_one_member(design, total):
    u = design_points(design, 11, 5, np.arange(total), total)
    for column in u.T:
        np.testing.assert_array_equal(np.sort((column * total).astype(int)), np.arange(total))


def test_random_members_are_independent_of_each_other_and_of_the_noise():
    u = design_points("random", 0, 3, np.arange(4000), 4000)
    world = dataclasses.replace(SCENARIO, seed=0)

    def noise(member):
        scenario = dataclasses.replace(world, member=member)
        return scenario.sensor.noise(scenario.words(), 0).z

    w = np.asarray(jax.jit(jax.vmap(noise))(np.arange(4000)))
    columns = np.column_stack([u, u[:, 0] * 0 + np.roll(u[:, 0], 1), w])
    # five standard errors of a correlation: 5/sqrt(4000)
    assert np.max(np.abs(np.corrcoef(columns.T) - np.eye(5))) < 0.08


# --- what is moved ---


def test_an_ensemble_is_the_scenario_with_arrays_for_leaves():
    values = drawn("sobol", np.arange(32))
    cascade, scenario = apply(CASCADE, SCENARIO, values)
    np.testing.assert_array_equal(scenario.plant.m, values["plant.m"])
    np.testing.assert_array_equal(scenario.u_max, values["actuator.u_max"])
    np.testing.assert_array_equal(scenario.sensor.std, values["sensor.std"])
    np.testing.assert_array_equal(cascade.position.c, values["controller.position.c"])
    # nothing else moved, the nominal plant in particular
    assert cascade.model == CASCADE.model
    moved = [x for x in jax.tree.leaves((cascade, scenario)) if np.ndim(x)]
    assert len(moved) == len(values) + 1  # the shift moves start and stop
    assert all(np.shape(x) == (32,) for x in moved)


def test_the_nominal_model_is_spread_by_its_own_path_only():
    cascade, scenario = apply(CASCADE, SCENARIO, {"controller.model.m": np.ones(3)})
    np.testing.assert_array_equal(cascade.model.m, np.ones(3))
    assert scenario == SCENARIO


@pytest.mark.parametrize("signal", [Pulse(1.0, 0.8, 1.3), Step(1.0, 0.2), SmoothStep(1.0, 0.3, 0.2)])
def test_a_shift_moves_a_signal_in_time(signal):
    t = np.linspace(0, 2, 41)
    scenario = dataclasses.replace(SCENARIO, q_z=signal, q_v=Constant())
    shifted = apply(CASCADE, scenario, {"disturbance.q_z.shift": 0.25})[1].q_z
    np.testing.assert_allclose(shifted(t), signal(t - 0.25), atol=1e-12)


def test_disturbance_paths_follow_the_case_file():
    # the only disturbance of z is called q_z, in whatever unit; two at once have different names
    acceleration = dataclasses.replace(SCENARIO, q_z=Sine(1.0, 3.0), q_v=Constant())
    assert apply(CASCADE, acceleration, {"disturbance.q_z.phase": 0.5})[1].q_z.phase == 0.5
    assert apply(CASCADE, SCENARIO, {"disturbance.q_z.amplitude": 5.0})[1].q_v.amplitude == 5
    both = dataclasses.replace(SCENARIO, q_z=Constant(1.0))
    changed = apply(CASCADE, both, {"disturbance.q_z.value": 3.0, "disturbance.q_v.amplitude": 2.0})[1]
    assert (changed.q_z.value, changed.q_v.amplitude) == (3.0, 2.0)


def test_terms_of_a_sum_and_optional_numbers_have_paths():
    scenario = dataclasses.replace(SCENARIO, reference=Sum((Constant(1e-3), Sine(1e-3, 2.0))))
    cascade = dataclasses.replace(CASCADE, observer=observer.Complementary())
    values = {"reference.terms.1.phase": 1.0, "controller.observer.z_hat": 1e-4, "run.clearance": 4e-3}
    cascade, scenario = apply(cascade, scenario, values)
    assert scenario.reference == Sum((Constant(1e-3), Sine(1e-3, 2.0, 1.0)))
    assert cascade.observer.z_hat == 1e-4
    assert scenario.touchdown == 4e-3


def test_corners_hold_every_combination_of_ends():
    spread = Spread(
        (("plant.m", Percent(10.0)), ("initial.z", Normal(1e-5)), ("controller.inversion.gamma", Percent(50)))
    )
    cascade, scenario = corners(spread, CASCADE, SCENARIO)
    products = np.asarray(cascade.inversion.gamma / 7.5e4 * scenario.plant.m / 0.588)
    np.testing.assert_allclose(np.sort(products.ravel()), np.sort(np.outer([0.5, 1.5], [0.9, 1.1]).ravel()))
    assert np.ndim(scenario.initial.z) == 0


# --- the case file ---

CASE = """
disturbance.q_z = { kind = "pulse", amplitude = 1.0, start = 0.8, stop = 1.3, unit = "A^2/m^2" }
sensor.std = 1e-6
"""
# What is wrong, the lines of [spread], what the message must contain: path, value, what is allowed or the fix.
BAD = {
    "unknown number": ("plant.mass = { percent = 10 }", ["spread.plant.mass", "Did you mean 'plant.m'", "plant.k_z"]),
    "value of a pulse": ("disturbance.q_z.value = { normal = 1 }", ["spread.disturbance.q_z.value", "q_z.shift"]),
    "bare value": ("plant.m = 0.1", ["spread.plant.m = 0.1", "{ percent = 10 }"]),
    "misspelt kind": ("plant.m = { precent = 10 }", ["spread.plant.m.precent", "Did you mean 'percent'"]),
    "unknown shape": ('plant.m = { percent = 1, shape = "flat" }', ["spread.plant.m.shape", '"flat"', "'uniform'"]),
    "word": ('plant.m = { normal = "wide" }', ["spread.plant.m.normal", '"wide"', "a number"]),
    "negative scale": ("plant.m = { normal = -0.1 }", ["spread.plant.m = { normal = -0.1 }", "at least 0"]),
    "NaN": ("plant.m = { normal = nan }", ["spread.plant.m = { normal = nan }", "finite"]),
    "percent of zero": ("initial.z = { percent = 10 }", ["spread.initial.z", "is 0", "normal or uniform"]),
    "percent of none": ("run.clearance = { percent = 10 }", ["spread.run.clearance", "no finite value", "uniform"]),
    "normal around infinity": ("actuator.u_max = { normal = 10 }", ["spread.actuator.u_max", "no finite value"]),
    "low above high": ("plant.m = { uniform = [0.7, 0.5] }", ["spread.plant.m", "[0.7, 0.5]", "low < high"]),
    "one end": ("plant.m = { uniform = [0.5] }", ["spread.plant.m.uniform = [0.5]", "[low, high]"]),
    "no list": ("plant.m = { uniform = 0.5 }", ["spread.plant.m.uniform = 0.5", "list"]),
    "log of zero": ("sensor.std = { log-uniform = [0, 1e-6] }", ["spread.sensor.std", "0 < low"]),
    "negative choice": ("actuator.u_max = { choices = [-5, 100] }", ["spread.actuator.u_max", "-5", "from 1e-09"]),
    "negative mass": ("plant.m = { percent = 150 }", ["spread.plant.m", "-0.294", "from 1e-06", "Narrow"]),
    "normal to below zero": ('plant.m = { percent = 20, shape = "normal" }', ["spread.plant.m", "-0.1176", "Narrow"]),
    "beyond the clearance": ("initial.z = { normal = 1e-3 }", ["spread.initial.z", "0.006", "0.0045"]),
    "the gap narrowed": ("plant.s_0 = { percent = 50 }\ninitial.z.uniform = [0, 3e-3]", ["initial.z", "0.00225"]),
    "clearance beyond the gap": ("run.clearance = { uniform = [1e-3, 6e-3] }", ["run.clearance", "0.006", "plant.s_0"]),
    "start after stop": ("disturbance.q_z.start = { uniform = [0.5, 1.4] }", ["q_z.start", "1.4", "1.3", "q_z.shift"]),
    "unknown design": ('design = "halton"', ["spread.design", '"halton"', "'sobol'"]),
}  # fmt: skip
BITS = "processor = {}\nsensor.bits = 12\nspread.sensor.bits = "
# Whole files.
UNFIT = {
    "number": ("spread = 3", ["spread = 3", "table"]),
    "no sensor": ("spread.sensor.std = { uniform = [0, 1e-6] }", ["spread.sensor.std", "add the table [sensor]"]),
    "unit": ('disturbance.q_z = { kind = "constant", unit = "A^2/m^2" }\nspread.disturbance.q_z.value.normal = 1',
             ["spread.disturbance.q_z.value", "m/s^2"]),
    "band": ('disturbance.q_z = { kind = "band-noise", std = 1, f_low = 5, f_high = 9 }\n'
             "spread.disturbance.q_z.f_low.uniform = [1, 9]", ["spread.disturbance.q_z.f_low", "Narrow the range."]),
    # the nominal 7.5e4 allows this step, 1.5 times it does not
    "step": ('clock = { dt = 2e-6, method = "rk4" }\nspread.controller.inversion.gamma.percent = 50',
             ["clock.dt = 2e-06", "stable only up to 1.56e-06"]),
    "range of bits": (BITS + "{ uniform = [8.0, 14.0] }",
                      ["spread.sensor.bits = { uniform = [8, 14] }", "a whole number from 2 to 32. Use choices"]),
    "half a bit": (BITS + "{ choices = [8, 8.5, 14] }",
                   ["spread.sensor.bits = { choices = [8, 8.5, 14] }", "a whole number from 2 to 32. Use choices"]),
}  # fmt: skip


@pytest.mark.parametrize("wrong", [*BAD, *UNFIT])
def test_a_bad_spread_is_refused_in_one_line(wrong):
    lines, wanted = (BAD | UNFIT)[wrong]
    with pytest.raises(ValueError) as refused:  # noqa: PT011 (the words are in the table)
        case_from(tomllib.loads(f"{CASE}[spread]\n{lines}\n" if wrong in BAD else lines))
    message = str(refused.value)
    assert "\n" not in message
    assert message.startswith("spread.") or wrong in UNFIT
    for part in wanted:
        assert part in message


def test_whole_numbers_are_spread_by_choices():
    text = "processor = {}\nsensor.bits = 12\nspread.sensor.bits = { choices = [14, 8] }"
    assert case_from(tomllib.loads(text)).spread.paths == ("sensor.bits",)


def test_spreads_are_printed_as_in_the_case_file():
    for path, kind in SPREAD.entries:
        text = f"{CASE}[spread]\n{path} = {kind}\n"
        assert case_from(tomllib.loads(text)).spread == Spread(((path, kind),))


@pytest.mark.parametrize("name", ["tracking", "regulation"])
def test_the_spread_of_the_template_is_valid(name):
    head, found, tail = template(name).partition("# [spread]")
    lines = [line for line in (found + tail).splitlines() if line]
    assert all(line.startswith("# ") for line in lines)
    case = case_from(tomllib.loads(head + "\n".join(line.removeprefix("# ") for line in lines)))
    spread = tail.partition("# [tune]")[0]
    assert len(case.spread.entries) == len(spread.strip().splitlines()) - 2  # the heading's comment and the design
    assert case_from(tomllib.loads(template(name))).spread == Spread()
