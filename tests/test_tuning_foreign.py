"""The tuner on other bearings than the paper's: ranges, defaults that follow the plant, complete answers, runs."""

import dataclasses
import json
import math
import pathlib
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from texts import problem_from
from tomlkit import dumps

from ambjax import Cascade
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.laws import position
from ambjax.plants import Plant
from tuning.__main__ import main
from tuning.problem.ranges import initial_points, theorem_bounds
from tuning.problem.space import MARGIN, read
from tuning.report.folder import all_laws, tuned

CASES = pathlib.Path(__file__).parent / "cases"
BEARINGS = {path.stem: path.read_text() for path in sorted(CASES.glob("*.toml"))}
COMMON = BEARINGS | {name: template(name) for name in ("regulation", "tracking")}
OTHER_LAWS = """
[controller]
observer.kind = "complementary"
position.kind = "super-twisting"
inversion.kind = "closed-form"
current.kind = "pi"
"""
SLOW = {"regulation": pytest.mark.slow}  # its first answers are held, but not stable
SCALES = {
    "position": lambda plant: (
        plant.s_0 * (plant.mu_0 * plant.n**2 * plant.A * plant.i_0**2 / plant.s_0**3 / plant.m) ** 0.5
    ),
    "inversion": lambda plant: (plant.i_0 / plant.s_0) ** 2,
    "current": lambda plant: plant.i_0,
}


@pytest.mark.parametrize("laws", ["", OTHER_LAWS], ids=["usual laws", "other laws"])
@pytest.mark.parametrize("name", COMMON)
def test_every_range_is_finite_and_positive(name, laws):
    text = COMMON[name]
    if laws and "[controller]" in text:
        head, _, rest = text.partition("[controller]")
        text = head + "[reference]" + rest.partition("[reference]")[2]
    found = problem_from(text + laws)
    names = [gain.name for gain in found.objective.space.gains]
    assert names == (["l", "c", "k_1", "k_2", "k_p", "k_int", "k_aw"] if laws else ["c", "k", "gamma", "k_i"])
    for where in found.ranges:
        assert 0 < where.low < where.high <= where.most < np.inf
        assert where.source
    points = initial_points(found.objective.space, found.ranges, found.tune.space.values(found.case.cascade), 16, 1)
    assert np.all(np.isfinite(points))


def gamma(name, **tune):
    found = problem_from(COMMON.get(name, name), **tune)
    return found.ranges[[gain.name for gain in found.objective.space.gains].index("gamma")], found


def test_the_range_of_gamma_starts_at_delta_1_of_the_motion():
    """With a moving reference it starts at Delta_1 along the reference.

    At rest, it starts at dv/dz z_dot of a rotor that falls from its initial position.
    """
    moving, found = gamma("tracking")
    assert moving.low == theorem_bounds(found.objective)["Delta_1"] > 0
    assert "Delta_1" in moving.source
    resting, found = gamma("rotor")
    plant = found.case.scenario.plant
    w = np.sqrt(4 * plant.a * plant.i_0**2 / plant.s_0**3)  # z_ddot = a dv/dz z
    assert resting.low == pytest.approx(float(plant.dv_dz(0.0, 0.0)) * w * 1e-4, rel=1e-12)
    assert "initial.z" in resting.source
    centred, _ = gamma(BEARINGS["rotor"].replace("z = 1e-4", "z = 0.0"))
    assert centred.low == pytest.approx(resting.low * 0.01 * 0.9 * 4e-4 / 1e-4, rel=1e-12)
    slow, _ = gamma(BEARINGS["rotor"] + '[reference]\nkind = "sine"\namplitude = 1e-9\nfrequency = 0.1\n')
    assert slow.low == resting.low


def test_bounds_outside_a_range_give_a_range_at_the_nearest_bound():
    where, _ = gamma("rotor", bounds={"controller": {"inversion": {"gamma": [1e20, float("inf")]}}})
    assert 1e20 < where.low < where.high <= where.most < np.inf
    where, _ = gamma("rotor", bounds={"controller": {"inversion": {"gamma": [0.0, 1.0]}}})
    assert 0 < where.low < where.high < where.most == 1.0
    where, _ = gamma("rotor", bounds={"controller": {"inversion": {"gamma": [2.0, 3.0]}}})
    assert (where.low, where.high, where.source) == (2.0, 3.0, "tune.bounds")


def test_sources_name_the_pole_and_the_cap():
    found = problem_from(BEARINGS["rotor"])
    c, k, *_ = found.ranges
    w = float(found.case.scenario.plant.pole)
    assert f"w = {w:.3g} 1/s: pole of the unstable plant" in c.source
    assert "1/(5 T)" in c.source
    assert c.high * (1 + MARGIN) == c.most == pytest.approx(1 / (5 * 1e-4))
    assert f"tuned gain at most {k.most:.3g}" in k.source
    # where the clock is fast enough, the plant sets the end
    c = problem_from(BEARINGS["rotor"] + "[clock]\nsample_period = 1e-5\nduration = 0.1\n").ranges[0]
    assert c.high * (1 + MARGIN) == pytest.approx(10 * w)
    assert "1/(5 T)" not in c.source


@pytest.mark.parametrize("beside", [True, False], ids=["gains too", "p alone"])
def test_on_a_processor_a_steepness_is_searched_by_its_slope(beside):
    """2/pi gain p ranges from w/3 to 10/T for every value of the gain, drawn by the screen or given by the case."""
    names = ["position.k", "inversion.gamma", "current.k_i"]
    paths = [f"controller.{name}" for name in (names if beside else [])]
    paths += [f"controller.{name.partition('.')[0]}.p" for name in names]
    found = problem_from(COMMON["tracking"] + "\n[processor]\n", gains=paths)
    for where in found.ranges:
        assert 0 < where.low < where.high <= where.most < np.inf
    space, start = found.objective.space, found.tune.space.values(found.case.cascade)
    screen = initial_points(found.objective.space, found.ranges, start, 64, 1)[1:]
    gains = np.array([space.gains_at(jnp.asarray(x)) for x in screen])
    case = np.array([read(found.case.cascade, f"controller.{name}") for name in names])
    slopes = 2 / np.pi * gains[:, -3:] * (gains[:, :3] if beside else case)
    low, high = found.case.scenario.plant.pole / 3, 10 / found.case.clock.sample_period
    # 64 points of a Sobol sequence come within 2/64 of the ends, of a range of a factor of 570: 22 %; coordinates bend
    # within a quarter of a bound, in logarithms
    assert np.all(slopes >= 0.9 * low)
    assert np.all(slopes <= 1.1 * high)
    np.testing.assert_allclose(slopes.min(axis=0), low, rtol=0.25)
    np.testing.assert_allclose(slopes.max(axis=0), high, rtol=0.25)


# --- defaults that follow the plant ---


@pytest.mark.parametrize("name", BEARINGS)
def test_the_default_p_follows_from_the_scales_of_the_plant(name):
    case = case_from(tomllib.loads(BEARINGS[name]))
    plant = case.scenario.plant
    # a given k does not determine the slope of the sign, so p has the scale of the plant
    k = case_from(tomllib.loads(BEARINGS[name] + "[controller.position]\nk = 3.0\n")).cascade
    for stage, scale in SCALES.items():
        law = getattr(k, stage)
        assert law.p == pytest.approx(25.0 * scale(Plant()) / scale(plant), rel=1e-12)
        assert getattr(case.cascade, stage) == getattr(Cascade(model=plant), stage)
    laws = '[controller.position]\nkind = "super-twisting"\nk_2 = 3.0\n'
    assert case_from(tomllib.loads(BEARINGS[name] + laws)).cascade.position.p == pytest.approx(4 * k.position.p)


def test_default_laws_are_made_once_from_the_first_model():
    cascade = Cascade(model=Plant(i_0=0.5))
    assert cascade.current.p == 12.5
    assert dataclasses.replace(cascade, model=Plant()).current.p == 12.5
    doubled = jax.tree.map(lambda x: 2 * x, cascade)
    assert (doubled.current.p, doubled.model.i_0) == (25.0, 1.0)
    own = position.SlidingMode(1.0, 2.0, 3.0)
    assert Cascade(position=own, model=Plant(i_0=0.5)).position is own


# --- a complete answer ---


@pytest.mark.parametrize("laws", ["", OTHER_LAWS], ids=["usual laws", "other laws"])
def test_the_tuned_file_gives_the_tuned_cascade(laws):
    found = problem_from(BEARINGS["fan"] + laws)
    space = found.objective.space
    x = space.encode(space.clip(found.tune.space.values(found.case.cascade))) + 0.1
    gains = dict(zip(space.paths, np.asarray(space.gains_at(jnp.asarray(x))).tolist(), strict=True))
    text = tuned(BEARINGS["fan"] + laws, all_laws(found, gains), "fan", "held")
    again = case_from(tomllib.loads(text)).cascade
    assert again == jax.tree.map(float, space.decode(jnp.asarray(x), found.case.cascade))
    if not laws:
        assert tomllib.loads(text)["controller"]["inversion"]["p"] == found.case.cascade.inversion.p


def write(path, text, **tune):
    document = tomllib.loads(text)
    budget = {"members": 8, "held_out": 100, "validation": 100, "screen": 32, "iterations": 8}
    document["tune"] = {"objective": "least_error", "limits": {"sensitivity": math.inf}} | budget | tune
    document["clock"] = {"duration": 0.2}
    document["run"] = {"settle": 0.05}
    if "start" in (pulse := document.get("disturbance", {}).get("q_z", {})):
        pulse |= {"start": 0.08, "stop": 0.13}
    path.write_text(dumps(document))
    return path


@pytest.mark.parametrize("name", [pytest.param(x, marks=SLOW.get(x, pytest.mark.thorough)) for x in COMMON])
def test_common_bearings_are_tuned_without_settings(name, tmp_path):
    out = tmp_path / "out"
    assert main([str(write(tmp_path / "case.toml", COMMON[name])), "--out", str(out), "--json"]) == 0
    facts = json.loads((out / "report.json").read_text())
    assert facts["verified"] is True
    assert facts["after"]["lost"] == 0
    assert facts["step_error"]["tried"] == 8
    assert 4 <= facts["worst_step_error"]["tried"] <= 8  # the worst four and the first four of those held
    for row in facts["gains"]:
        assert 0 < row["low"] < row["high"] <= row["most"]
        assert row["source"]
