"""Maps: the basin's known law, cells against ensembles of their own, and refusals."""

import dataclasses

import numpy as np
import pytest

from ambjax import RK4, Adaptive, Cascade, Clock, Initial, Plant, Scenario, Sensor, inversion, paper, rollout
from ambjax.__main__ import main
from ambjax.ensemble import Normal, Spread
from ambjax.ensemble.maps import PERIOD, Axis, grid
from ambjax.ensemble.study import Study

PLANT = Plant()
CURRENT = float(PLANT.equilibrium(0.0)[0])
# The unstable pole that a saturated inversion cannot hold: 528 1/s.
POLE = float(np.sqrt(PLANT.k_s / PLANT.m))


def basin(reading):
    cascade = paper.cascade(reading)
    cascade = dataclasses.replace(cascade, inversion=dataclasses.replace(cascade.inversion, i_ref=CURRENT))
    quiet = dataclasses.replace(paper.scenario("regulation", reading, pulse=False), initial=Initial(0.0, 0.0, CURRENT))
    return Study(cascade, quiet, Clock(800, 1e-4, Adaptive()), 0.05, Spread(), 0, 1)


@pytest.mark.parametrize("reading", ["literal", "repaired"])
def test_the_basin_is_a_strip_of_known_width(reading):
    """While v_tilde is saturated, z + z_dot/pole runs away unless gamma outweighs dv/dz pole |z + z_dot/pole|."""
    study = basin(reading)
    width = study.cascade.inversion.gamma / (PLANT.dv_dz(0.0, 0.0) * POLE)
    z = Axis("initial.z", np.linspace(-1.5, 1.5, 31) * width)
    found = grid(study, z, Axis("initial.z_dot", np.linspace(-1.5, 1.5, 7) * width * POLE))
    along = np.abs(found.x.values / width + found.y.values[:, None] / (width * POLE))
    # The smoothed sign gives less than gamma near zero error, and gravity's working point shifts the strip by 1 %.
    assert np.all(found.survival[along < 0.85] == 1)
    assert np.all(found.survival[along > 1.05] == 0)
    low, high = found.reach()
    assert 0.85 < high / width < 1.05
    assert 0.85 < -low / width < 1.05


SMOOTH = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
NOISY = Scenario(sensor=Sensor(1e-7, 0.0, 0.0))
SMALL = Study(SMOOTH, NOISY, Clock(50, 1e-4, RK4(5)), 1e-3, Spread((("initial.z", Normal(1e-6)),)), 5, 3)


def test_a_cell_is_the_members_of_its_case_run_alone():
    x, y = Axis("plant.m", np.array([0.5, 0.6, 0.7])), Axis("sensor.std", np.array([1e-8, 1e-7]), True)
    found = grid(SMALL, x, y)
    errors = []
    for k in range(SMALL.members):
        cascade, scenario = SMALL.member(k)
        plant, sensor = dataclasses.replace(scenario.plant, m=0.7), Sensor(1e-7, 0.0, 0.0)
        errors.append(
            rollout(cascade, dataclasses.replace(scenario, plant=plant, sensor=sensor), SMALL.clock)
            .trajectory.rows.e_z[10:]
            .__abs__()
            .max()
        )
    # the same members in another program: rounding
    np.testing.assert_allclose(found.error[1, 2], np.median(errors), rtol=1e-11)
    assert found.survival.shape == (2, 3)
    np.testing.assert_array_equal(found.survival, 1.0)
    np.testing.assert_allclose(found.low, 3 / (3 + 1.959964**2))  # Wilson's bound for 3 of 3


def test_the_sample_period_is_an_axis_either_way():
    period, std = Axis(PERIOD, np.array([1e-4, 5e-4])), Axis("sensor.std", np.array([1e-8, 1e-7, 1e-6]))
    one, other = grid(SMALL, std, period), grid(SMALL, period, std)
    np.testing.assert_array_equal(one.survival, other.survival.T)
    np.testing.assert_array_equal(one.error, other.error.T)
    slow = dataclasses.replace(SMALL, clock=dataclasses.replace(SMALL.clock, samples=10, sample_period=5e-4))
    alone = grid(slow, std, Axis("plant.m", np.array([0.588])))
    np.testing.assert_allclose(
        one.error[1], alone.error[0], rtol=1e-11
    )  # the mass is shared in one, an array in the other


CASE = """
[controller.inversion]
gamma = 1e9
p = 25e-6
[clock]
duration = 2e-3
[run]
settle = 1e-3
"""
X, Y = "initial.z=-1e-5:1e-5:3", "initial.z_dot=-1e-3:1e-3:3"


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        ("initial.z", Y, "it must be a path and a range"),
        ("initial.z=1e-5:-1e-5", Y, "the range must rise"),
        ("initial.z=0:nan", Y, "the range must rise"),
        ("initial.z=0:abc", Y, "could not convert"),
        ("initial.z=0:1e-5:1", Y, "2 to 1,000,000 values"),
        ("initial.z=0:1e-5:2.5", Y, "invalid literal"),
        ("initial.z=0:1e-5:5:log", Y, "must begin above 0"),
        ("initial.z=-10%:10%", Y, "per cent need a number other than 0"),
        ("initial.zz=0:1e-5", Y, "Did you mean 'initial.z'"),
        (X, X, "it is the quantity of --x too"),
        ("plant.m=-120%:10%", Y, "from 1e-06"),
        ("sensor.std=0:1e-6", Y, "no sensor noise"),
    ],
)
def test_bad_axes_are_refused_in_one_line(x, y, words, tmp_path, capsys):
    (tmp_path / "case.toml").write_text(CASE)
    out = tmp_path / "out"
    assert main(["map", str(tmp_path / "case.toml"), "--x", x, "--y", y, "--out", str(out)]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("ambjax: ")
    assert words in error
    assert not out.exists()


def test_the_command_draws_and_prints_two_cases_side_by_side(tmp_path, capsys):
    for name, gamma in (("one", "1e9"), ("two", "5e8")):
        (tmp_path / f"{name}.toml").write_text(CASE.replace("1e9", gamma))
    one, two, out = (str(tmp_path / name) for name in ("one.toml", "two.toml", "out"))
    assert main(["map", one, "--against", two, "--x", X, "--y", Y, "--out", out]) == 0
    text = capsys.readouterr().out
    assert "one" in text
    assert "two" in text
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"map.png", "map.json"}
