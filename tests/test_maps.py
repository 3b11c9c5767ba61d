"""Maps: a basin with a known formula, cells compared with separate ensembles, and refused input."""

import dataclasses
import json

import numpy as np
import pytest
from profiles import thorough
from test_synchronous_notch import ON_PROCESSOR, with_notch
from texts import refusal
from tomlkit import dumps

import ambjax
from ambjax import Cascade, Clock, Initial, Scenario, paper, rollout
from ambjax.__main__ import main
from ambjax.cases.reader import cascade_at, case_from
from ambjax.commands import map as commands
from ambjax.ensemble import Normal, Spread, maps, wilson
from ambjax.ensemble import study as studies
from ambjax.ensemble.maps import Axis, grid
from ambjax.ensemble.study import PERIOD, Study
from ambjax.laws import current, inversion
from ambjax.plants import Plant
from ambjax.results.case_map import study_and_axes, survival_map
from ambjax.results.cell_gains import default_gains
from ambjax.results.runs import simulate
from ambjax.sensors import Sensor
from ambjax.simulation.folds import Peak
from ambjax.solvers import RK4, AdaptiveRodas3

PLANT = Plant()
CURRENT = float(PLANT.equilibrium(0.0)[0])
# The unstable pole that a saturated inversion cannot hold: 528 1/s.
POLE = float(np.sqrt(PLANT.k_s / PLANT.m))


def basin(reading):
    cascade = paper.cascade(reading)
    cascade = dataclasses.replace(cascade, inversion=dataclasses.replace(cascade.inversion, i_ref=CURRENT))
    quiet = dataclasses.replace(paper.scenario("regulation", reading, pulse=False), initial=Initial(0.0, 0.0, CURRENT))
    return Study(cascade, quiet, Clock(800, 1e-4, AdaptiveRodas3()), 0.05, Spread(), 0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("reading", [thorough("literal"), "repaired"])
def test_the_basin_of_attraction_is_a_strip_of_known_width(reading):
    """While v_tilde is saturated, z + z_dot/pole diverges unless gamma exceeds dv/dz pole |z + z_dot/pole|."""
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


@pytest.mark.slow
def test_a_cell_equals_an_ensemble_of_its_own_case():
    x, y = Axis("plant.m", np.array([0.5, 0.6, 0.7])), Axis("sensor.std", np.array([1e-8, 1e-7]), True)
    found = grid(SMALL, x, y)
    errors = []
    for k in range(SMALL.members):
        cascade, scenario = SMALL.member(k)
        plant, sensor = dataclasses.replace(scenario.plant, m=0.7), Sensor(1e-7, 0.0, 0.0)
        world = dataclasses.replace(scenario, plant=plant, sensor=sensor)
        errors.append(
            float(rollout(cascade, world, SMALL.clock, fold=Peak("e_z", SMALL.settle), record_every=0).metrics)
        )
    # the same members in another program: rounding
    np.testing.assert_allclose(found.error[1, 2], np.median(errors), rtol=1e-11)
    assert found.survival.shape == (2, 3)
    np.testing.assert_array_equal(found.survival, 1.0)
    np.testing.assert_allclose(found.low, 3 / (3 + 1.959964**2))  # Wilson's bound for 3 of 3


@pytest.mark.slow
def test_one_member_is_the_nominal_case():
    """Without --members, a map of a case with [spread] shows the nominal case instead of a random member."""
    x, y = Axis("plant.m", np.array([0.5, 0.6])), Axis("sensor.std", np.array([1e-8, 1e-7]))
    wide = dataclasses.replace(SMALL, spread=Spread((("initial.z", Normal(1e-4)),)), members=1)
    bare = dataclasses.replace(wide, spread=Spread())
    found, nominal = grid(wide, x, y), grid(bare, x, y)
    np.testing.assert_array_equal(found.error, nominal.error)
    assert found.drawn == ()
    several = grid(dataclasses.replace(wide, members=2), x, y)
    assert several.drawn == ("initial.z",)
    assert np.all(several.error > 10 * nominal.error)  # thrown off by 100 times what noise does


CLOCK = {"duration": 0.1, "sample_period": 1e-4}
TURNING = with_notch(ON_PROCESSOR, "displacement-free") | {"clock": CLOCK, "run": {"settle": 0.08}}


@pytest.mark.thorough
@pytest.mark.parametrize("y", ["rotor.speed=3000:9000:2", "clock.sample_period=1e-4:2e-4:2"])
def test_each_cell_has_the_default_gains_and_a_notch_for_its_controller_and_its_speed(y):
    """A cell equals the case whose file has its numbers."""
    found = survival_map(case_from(TURNING, text=dumps(TURNING)), "controller.position.k_p=6e4:2e5:2", y).map
    (table, key), laws = y.partition("=")[0].split("."), TURNING["controller"]
    for row, column in ((0, 1), (1, 0)):
        own = {"controller": laws | {"position": laws["position"] | {"k_p": float(found.x.values[column])}}}
        raw = TURNING | own | {table: TURNING[table] | {key: float(found.y.values[row])}}
        alone = simulate(case_from(raw)).metrics["settled_max_abs_error_m"]
        # the steps of the map are those for all cells
        assert found.error[row, column] == pytest.approx(alone, rel=1e-3)


@pytest.mark.parametrize(
    ("path", "low", "gain"), [(PERIOD, 2e-4, "w"), ("processor.delay", 0.5, "share"), ("controller.model.m", 3.0, "w")]
)
def test_the_default_gains_of_a_cell_are_those_of_a_file_with_its_numbers(path, low, gain):
    raw = {"clock": TURNING["clock"], "processor": {"delay": 1.0, "predict": False}}
    raw |= {"controller": {"current": {"kind": "dead-beat"}}}
    case, axes = case_from(raw, text=dumps(raw)), {path: np.array([low, 1.3 * low])}
    study, name = Study(case.cascade, case.scenario, case.clock, 0.0, case.spread, 0, 1), f"controller.current.{gain}"
    found = default_gains(case, study, axes)[name]
    for ours, value in zip(found, axes[path], strict=True):
        changed = (value, {}) if path == PERIOD else (1e-4, {path: value})
        assert ours == getattr(cascade_at(case, *changed).current, gain) != getattr(case.cascade.current, gain)
    own = dataclasses.replace(case.cascade, current=current.DeadBeat(3.0, 0.3))  # set in Python
    assert name not in default_gains(case, dataclasses.replace(study, cascade=own), axes)


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
        ("initial.z", Y, "it must be a path, '=' and a range"),
        ("initial.z=1e-5:-1e-5", Y, "LOW must be less than HIGH"),
        ("initial.z=0:nan", Y, "LOW must be less than HIGH"),
        ("initial.z=0:abc", Y, "could not convert"),
        ("initial.z=0:1e-5:1", Y, "COUNT must be 2 to 1,000,000"),
        ("initial.z=0:1e-5:2.5", Y, "invalid literal"),
        ("initial.z=0:1e-5:5:log", Y, "must begin above 0"),
        ("initial.z=-10%:10%", Y, "per cent need a number other than 0"),
        ("initial.zz=0:1e-5", Y, "Did you mean 'initial.z'"),
        ("plant.mm=-20%:20%", Y, "--x plant.mm: there is no such number in this case. Did you mean 'plant.m'"),
        ("plant.mm=a:b", Y, "Did you mean 'plant.m'"),
        ("clock.sample_perio=-20%:20%", Y, "Did you mean 'clock.sample_period'"),
        (X, X, "--x has the same quantity"),
        ("plant.m=-120%:10%", Y, "from 1e-06"),
        ("sensor.std=0:1e-6", Y, "no sensor noise"),
        ("run.clearance=1e-3:5e-2:3", Y, "--x run.clearance=0.001:0.05: run.clearance reaches 0.05 m, but must stay"),
        (X, "plant.s_0=1e-6:1e-5", "--x initial.z=-1e-05:1e-05: |initial.z| reaches 1e-05 m, but must stay below"),
        ("disturbance.q_z.start=0.1:0.3", Y, "--x disturbance.q_z.start=0.1:0.3: disturbance.q_z.start reaches 0.3"),
        ("clock.sample_period=1e-4:2e-3:5", Y, "a run needs 2 samples. Set HIGH to at most 0.001 s"),
        (Y, "clock.sample_period=1e-4:2e-3:5", "a run needs 2 samples. Set HIGH to at most 0.001 s"),
        ("clock.sample_period=1e-4:9e-4:5", Y, "with 0.0007 s no sample is at or after run.settle = 0.0015 s"),
    ],
)
def test_bad_axes_are_refused_in_one_line(x, y, words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(studies, "run_ensemble", None)  # before anything is computed
    pulse = '[disturbance.q_z]\nkind = "pulse"\namplitude = 0.1\nstart = 0.1\nstop = 0.2\n'
    (tmp_path / "case.toml").write_text(CASE.replace("settle = 1e-3", "settle = 1.5e-3") + pulse)
    out = tmp_path / "out"
    said = refusal(capsys, "map", tmp_path / "case.toml", "--x", x, "--y", y, "--out", out)
    assert said.startswith("ambjax: ")
    assert words in said
    assert not out.exists()


def test_per_cent_of_a_negative_number_make_an_ascending_axis():
    _, x, y = study_and_axes(case_from({}), "plant.k_z=-20%:10%:2", "plant.m=-20%:10%:2", 1, 0)
    np.testing.assert_allclose([x.values, y.values], [np.array([1.1, 0.8]) * -754.0, np.array([0.8, 1.1]) * 0.588])


@pytest.mark.parametrize(
    ("x", "y", "words"),
    [
        ("sensor.bits=8:14:6", X, "--x sensor.bits=8:14: sensor.bits must be a whole number from 2 to 32"),
        (X, "reference.amplitude=0:1e-4", "--y reference.amplitude: there is no such number in this case"),
    ],
)
def test_the_axes_are_checked_for_every_case_before_any_run(x, y, words, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(studies, "run_ensemble", None)
    rounded = CASE + "[processor]\n[sensor]\nbits = 12\n"
    sine = rounded + '[reference]\nkind = "sine"\namplitude = 1e-5\nfrequency = 2.0\n'
    for name, text in (("one", sine), ("two", rounded)):
        (tmp_path / f"{name}.toml").write_text(text)
    one, two, out = (str(tmp_path / name) for name in ("one.toml", "two.toml", "out"))
    assert words in refusal(capsys, "map", one, "--against", two, "--x", x, "--y", y, "--out", out)
    assert not (tmp_path / "out").exists()


def made(survival, members, **changes):
    """Return a map with these survivals [ny, nx]."""
    survival = np.asarray(survival, float)
    _, low, high = wilson(survival * members, members)
    y, x = (Axis(path, np.arange(float(n))) for path, n in zip(("initial.z", "plant.m"), survival.shape, strict=True))
    lost = np.round((1 - survival) * members).astype(int)
    return maps.Map(x, y, survival, low, high, survival, lost, 0 * lost, 0 * lost, members, **changes)


@pytest.mark.parametrize("members", [1, 72, 73])
def test_a_map_is_decisive_if_the_number_of_its_members_allows_it(members):
    """Wilson's lower end for n of n is n / (n + 1.96^2): 0.95 from n = 73 on."""
    one = made([[1, 1], [1, 0]], members)
    assert one.decisive == (members >= 73)
    # where all members are alike, many are as good as one
    assert commands._summary(case_from({}, "one"), one._replace(varied=False))["decisive"] is False


@pytest.mark.thorough
def test_the_command_draws_and_prints_two_cases_side_by_side(tmp_path, capsys):
    for name, gamma in (("one", "1e9"), ("two", "5e8")):
        (tmp_path / f"{name}.toml").write_text(CASE.replace("1e9", gamma))
    one, two, out = (str(tmp_path / name) for name in ("one.toml", "two.toml", "out"))
    assert main(["map", one, "--against", two, "--x", X, "--y", Y, "--out", out]) == 0
    text = capsys.readouterr().out
    assert "one" in text
    assert "two" in text
    assert "one: nominal: no quantity is drawn" in text
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"map.png", "map.json"}
    # the function gives the same numbers
    written = json.loads((tmp_path / "out" / "map.json").read_text())["cases"][0]
    found = ambjax.survival_map(ambjax.read_case(one), X, Y)
    table = found.to_xarray()
    for name in maps.GRIDS:
        np.testing.assert_array_equal(table[name], np.array(written[name], float))
        assert table[name].dims == (written["y"]["path"], written["x"]["path"])
    assert table["initial.z_dot"].attrs["units"] == "m/s"
    assert table["error"].attrs["units"] == "m"
    shown = found.plot().axes[0].collections[0]
    np.testing.assert_array_equal(np.ravel(shown.get_array()), 100 * np.ravel(found.map.survival))
    assert f"<td>{found.map.survival.min():.6g}</td>" in found._repr_html_()
    with pytest.raises(ValueError, match=r"^x = plant\.m=2:1: LOW must be less than HIGH"):
        ambjax.survival_map(found.case, "plant.m=2:1", Y)


@pytest.mark.thorough
def test_the_command_states_the_drawn_outlines_and_the_undecided_cells(tmp_path, capsys, monkeypatch):
    (tmp_path / "case.toml").write_text(CASE + "[spread]\nplant.m = { percent = 1 }\n")
    argv = ["map", str(tmp_path / "case.toml"), "--x", X, "--y", Y, "--out", str(tmp_path / "out"), "--force"]
    assert main(argv) == 0
    said = capsys.readouterr()
    assert "one member does not draw the [spread]; --members 2" in said.err
    assert "case: nominal: no quantity is drawn" in said.out
    run = studies.run_ensemble

    def stalling(*args, **options):
        outcome = run(*args, **options)
        first = np.arange(len(outcome.metrics["lost_at_s"])) == 0
        status = {"lost_at_s": np.where(first, 1e-3, np.inf), "stalled": first}
        return outcome._replace(metrics=outcome.metrics | status)

    monkeypatch.setattr(studies, "run_ensemble", stalling)
    assert main([*argv, "--members", "2"]) == 0
    text = capsys.readouterr().out
    assert "case: drawn for each member: plant.m" in text
    assert "case: 0 runs lost, 1 not decided (in 1 cells): the integrator stalled there" in text
    (found,) = json.loads((tmp_path / "out" / "map.json").read_text())["cases"]
    assert found["stalled"] == [[1, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert found["survival"][0][0] == 0.5
    assert found["drawn"] == ["plant.m"]
