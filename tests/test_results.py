"""Results in Python: numbers equal those of the commands, tables have units, and pictures match their data."""

import dataclasses
import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ambjax
from ambjax.__main__ import main
from ambjax.cases.reader import case_from
from ambjax.linear import linearise
from ambjax.simulation.trajectory import STALLED
from tuning.__main__ import main as tune_main
from tuning.command import TunedCase

CASE = """
[reference]
kind = "sine"
amplitude = 1e-4
frequency = 5.0
[clock]
duration = 0.02
[run]
settle = 0.01
[spread]
plant.m = { percent = 5 }
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("results") / "case.toml"
    path.write_text(CASE)
    return path


@pytest.fixture(scope="module")
def run(path):
    return ambjax.simulate(ambjax.read_case(path))


@pytest.fixture(scope="module")
def members(path):
    return ambjax.simulate_members(ambjax.read_case(path), 8, seed=3)


def test_a_run_equals_that_of_the_command(path, run, tmp_path, capsys):
    main(["simulate", str(path), "--json", "--out", str(tmp_path / "out")])
    printed = json.loads(capsys.readouterr().out)
    finite = {name: value for name, value in run.metrics.items() if np.isfinite(value)}
    assert {name: printed[name] for name in finite} == finite
    with np.load(tmp_path / "out" / "trajectory.npz") as saved:
        frame = run.to_pandas()
        assert np.array_equal(frame.index, saved["t"])
        for name in frame.columns:
            assert np.array_equal(frame[name], saved[name])
        assert {*frame.columns, "t", "lost_at", "lost_why", "singular_at"} == set(saved.files)
    assert not run.lost


def test_the_dataset_has_the_signals_with_units(run):
    data = run.to_xarray()
    assert data["z"].attrs["units"] == "m"
    assert np.array_equal(data["z"].sel(t=0.01, method="nearest"), run.to_pandas()["z"].iloc[100])
    assert {name: data[name].attrs["units"] for name in data} == run.to_pandas().attrs["units"]


@pytest.mark.slow
def test_a_comparison_equals_that_of_the_command_and_prints_nothing(path, tmp_path, capfd):
    case = ambjax.read_case(path)
    other = ambjax.with_gains(case, {"controller.position.c": 20.0})
    found = ambjax.compare([case, other], 4)
    assert capfd.readouterr() == ("", "")
    assert [row["case"] for row in found.summary["cases"]] == ["case (1)", "case (2)"]
    alone = ambjax.simulate_members(other, 4).columns["settled_rms_error_m"]
    assert np.array_equal(found.compared[1].columns["settled_rms_error_m"], alone)
    assert found.summary["cases"][1]["peak"] == ambjax.sensitivity(other).S.height
    assert "case (2)" in found.table()
    with pytest.raises(ValueError, match="1 case: give 2 to 8 cases"):
        ambjax.compare([case])


@pytest.mark.slow
def test_a_check_returns_its_verdict_and_prints_nothing(path, capfd):
    case = ambjax.read_case(path)
    found = ambjax.check(case)
    assert capfd.readouterr() == ("", "")
    assert found.holds == found.summary["holds"]
    assert found.text.startswith("The check passes." if found.holds else "The check FAILS")
    assert found.summary["loop"]["peak"] == pytest.approx(ambjax.sensitivity(case).S.height)


def test_the_pictures_show_the_results(run, members):
    axes = run.plot().axes
    assert any("position" in ax.get_ylabel() for ax in axes)
    rows, whole = run.trajectory.rows, run.plot_phase().axes[0]
    (line,) = whole.collections
    _, rate = (label.rpartition("(")[2] for label in (whole.get_xlabel(), whole.get_ylabel()))
    factors = {"µm)": 1e6, "mm/s)": 1e3}
    ends = np.array([factors["µm)"] * rows.z[-1], factors[rate] * rows.z_dot[-1]])
    np.testing.assert_allclose(line.get_segments()[-1][-1], ends)
    axes = members.plot("rms_u_V", "max_abs_i_A").axes
    assert [ax.patches[0].get_data().values.sum() for ax in axes] == [8, 8]
    with pytest.raises(ValueError, match=r"none of rms_u is a column. The columns are .*rms_u_V"):
        members.plot("rms_u")


def test_a_notebook_shows_the_metrics(run):
    page = run._repr_html_()
    assert "case: the rotor is held" in page
    stalled = dataclasses.replace(run.trajectory, lost_code=jnp.asarray(STALLED), lost_at=jnp.asarray(0.01))
    page = dataclasses.replace(run, trajectory=stalled)._repr_html_()
    assert "case: not decided, stalled: the integrator could not meet its tolerance" in page
    assert f"<td>rms_u_V</td><td>{run.metrics['rms_u_V']:.6g}</td><td>V</td>" in page


def test_the_sensitivity_equals_the_linear_analysis(path):
    case = ambjax.read_case(path)
    at = ambjax.sensitivity(case)
    system = linearise(case.cascade, case.scenario, case.clock)
    assert at.S.height == pytest.approx(abs(system.sensitivity(np.array([at.S.frequency]))[0]))


def test_the_parts_of_a_case_stand_for_it(path, run):
    case = ambjax.read_case(path)
    parts = case.cascade, case.scenario, case.clock
    again = ambjax.simulate(*parts)
    np.testing.assert_array_equal(again.trajectory.rows.z, run.trajectory.rows.z)
    assert again.metrics["max_abs_i_A"] == run.metrics["max_abs_i_A"]
    assert ambjax.sensitivity(*parts).S == ambjax.sensitivity(case).S


def test_bad_input_is_refused_by_name(path, run, monkeypatch):
    case = ambjax.read_case(path)
    wrong: Any = "case.toml"
    members: tuple[tuple[Any, int, str], ...] = (
        (0, 0, "members = 0: it must be a whole number from 1 to"),
        (2.5, 0, "members = 2.5: it"),
        ("ten", 0, "members = 'ten': it"),
        (1, -1, "seed = -1: it must be a whole number from 0 to"),
    )
    for given, seed, said in members:
        with pytest.raises(ValueError, match=said):
            ambjax.simulate_members(case, given, seed=seed)  # pyright: ignore[reportArgumentType]
    numbers: tuple[tuple[Any, Any, str], ...] = (
        (ambjax.read_case, 3, "path = 3: it must be the path of a file"),
        (ambjax.tune, 3, "case = 3: it must be the path of a file"),
        (lambda r: ambjax.sensitivity(case, r), "a", "r = 'a': it must be a finite number"),
        (lambda paths: ambjax.gains_of(case.cascade, paths), 3, "paths = 3: it must be a list"),
        (lambda gains: ambjax.with_gains(case.cascade, gains), 3, "gains = 3: it must be a dict"),
        (lambda loop: ambjax.gains_of(loop, []), 3, "loop = int: it must be a Case"),
        (lambda progress: ambjax.simulate(case, progress), 3, "progress = 3: it must be a function"),
        (lambda prefix: ambjax.export(case, prefix=prefix), 3, "prefix = 3: it must be a C identifier"),
    )
    for function, value, said in numbers:
        with pytest.raises(ValueError, match=said):
            function(value)
    with pytest.raises(ValueError, match=r"x = .*: it must be text. Write PATH=LOW:HIGH"):
        ambjax.survival_map(case, ("plant.m", 1, 2), "plant.R=1:2")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r'it must be a list. Write \["controller.position.c"\]'):
        ambjax.gains_of(case.cascade, "controller.position.c")
    with pytest.raises(ValueError, match="case = Cascade: it must be a "):
        ambjax.Metrics.for_case(case.cascade)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="template = 'rigg': it must be one of tracking"):
        ambjax.template("rigg")
    for function in (
        ambjax.simulate,
        ambjax.check,
        lambda given: ambjax.compare([given, given]),
        ambjax.sensitivity,
        ambjax.vector_field,
        ambjax.export,
        lambda given: ambjax.simulate_members(given, 1),
        lambda given: ambjax.survival_map(given, "plant.m=1:2", "plant.R=1:2"),
    ):
        with pytest.raises(ValueError, match=r"case = 'case.toml': it must be a Case, as ambjax.read_case"):
            function(wrong)
    with pytest.raises(ValueError, match="cases = Case: it must be a list of 2 to 8 cases"):
        ambjax.compare(case)  # pyright: ignore[reportArgumentType]
    for function in (ambjax.simulate, ambjax.sensitivity, ambjax.check, ambjax.vector_field, ambjax.export):
        with pytest.raises(ValueError, match=r"\(Cascade, .*\): give a case, .* a Cascade, a Scenario and a Clock"):
            function(case.cascade, case.clock, case.scenario)
    with pytest.raises(ValueError, match="cascade = Scenario: it must be a Cascade"):
        ambjax.rollout(case.scenario, case.cascade, case.clock)  # pyright: ignore[reportArgumentType]
    for given in (("case.toml",), (case.cascade,), ((case.cascade, case.scenario, case.clock),), (case, case.scenario)):
        with pytest.raises(ValueError, match=r"give a case, .* or a Cascade, a Scenario and a Clock"):
            ambjax.rollout(*given)
    two, plain = jnp.array([17.0, 18.0]), dataclasses.replace(case.scenario, reference=0.0)
    with pytest.raises(ValueError, match=r"controller.position.c has the shape \[2\]: rollout simulates one member"):
        ambjax.rollout(ambjax.with_gains(case, {"controller.position.c": two}))
    with pytest.raises(ValueError, match=r"scenario.reference = 0.0: it must be a record, such as Constant\(\)"):
        ambjax.rollout(case.cascade, plain, case.clock)
    whole: tuple[Any, ...] = (
        ambjax.simulate,
        ambjax.sensitivity,
        ambjax.check,
        lambda given: ambjax.compare([given, case]),
        lambda given: ambjax.simulate_members(given, 2),
        ambjax.linear.linearise,
        ambjax.theorem.check,
    )
    for function in whole:
        with pytest.raises(ValueError, match=r"a number is traced, .* Use ambjax\.rollout"):
            jax.grad(lambda c, f=function: f(ambjax.with_gains(case, {"controller.position.c": c})))(17.0)
    with pytest.raises(ValueError, match=r"clock\.method\.substeps = 0: it must be a whole number of at least 1"):
        ambjax.rollout(case.cascade, case.scenario, case.clock.with_method(ambjax.solvers.RK4(0)))
    for named, said in (({"fold": ambjax.Metrics}, "fold = .* a fold"), ({"record_every": -1}, "record_every = -1")):
        with pytest.raises(ValueError, match=said):
            ambjax.rollout(case, **named)
    two = dataclasses.replace(case.scenario, member=np.arange(2))
    refused: tuple[tuple[Any, Any, str], ...] = (
        (lambda x: ambjax.rollout(case, record_every=x), 2.5, "record_every = 2.5: it must be a whole number"),
        (lambda x: ambjax.Scenario(seed=x), 2.5, "Scenario.seed = 2.5: it must be a whole number"),
        (lambda x: ambjax.Metrics.of(0.0, x), 3, "scenario = 3: it must be a Scenario"),
        (lambda x: ambjax.linear.linearise(case, x), [0.0], r"r = \[0.0\]: it must be a finite number"),
        (lambda x: ambjax.linear.injected(case, [100.0], periods=x), 0, "periods = 0: it must be a whole number of"),
        (lambda x: ambjax.linear.injected(case, [100.0], members=x), "a", "members = 'a': it must be a whole"),
        (
            lambda x: ambjax.ensemble.run_ensemble(case.cascade, two, case.clock, fold=None, threads=x),
            -1,
            "threads = -1",
        ),
        (lambda x: ambjax.ensemble.quantile(np.arange(3.0), x), -1, "q = -1: it must be from 0 to 1"),
    )
    for function, value, said in refused:
        with pytest.raises(ValueError, match=said):
            function(value)
    late = dataclasses.replace(case.scenario, q_z=ambjax.signals.Pulse(1.0, 2.0, 1.0))
    with pytest.raises(ValueError, match=r"q_z.stop = 1.0: it must not be less than start = 2.0"):
        ambjax.rollout(case.cascade, late, case.clock)
    for samples in (0, 10.5):
        with pytest.raises(ValueError, match=f"clock.samples = {samples}: it must be a whole number of at least 1"):
            ambjax.rollout(case.cascade, case.scenario, dataclasses.replace(case.clock, samples=samples))
    for name in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(
            ValueError, match=rf"{name} is not installed. Install it with: pip install 'ambjax\[tables\]'"
        ):
            getattr(run, f"to_{name}")()


def test_tune_is_the_command_as_a_function(path, tmp_path, monkeypatch):
    """The search itself is that of the command, which tests/test_tuning_search.py tests."""
    given = []

    def tuned(*words):
        given.append(words[:2])
        return TunedCase(ambjax.read_case(path), False, {"verdict": "none"}, tmp_path)

    monkeypatch.setattr("tuning.command.run", tuned)
    flags = dict.fromkeys(("resume", "force", "pareto", "page"), True)
    assert ambjax.tune(path, tmp_path, **flags, settings_of=path, minutes=2.0).directory == tmp_path
    words = ["--resume", "--force", "--pareto", "--page", "--settings-of", str(path), "--budget", "2"]
    assert tune_main([str(path), "--out", str(tmp_path), *words]) == 1
    assert given[0] == given[1]


@pytest.mark.slow
def test_the_vector_field_gives_the_solution_of_simulate():
    """The solution by SciPy agrees with that by adaptive steps of ambjax to 1e-8 of the sizes of the states."""
    from scipy.integrate import solve_ivp

    case = case_from({"initial": {"z": 1e-4}, "clock": {"duration": 0.005, "method": "adaptive"}})
    field = ambjax.vector_field(case)
    ends = solve_ivp(field.f, (0.0, 0.0049), np.asarray(field.y_0), "Radau", rtol=1e-8, atol=1e-11).y[:, -1]
    rows = ambjax.simulate(case).trajectory.rows
    motion = field.named(jnp.asarray(ends)).plant
    # our steps keep errors below 1e-4 of 2 % of the gap and of 4 % of the bias
    assert float(motion.z) == pytest.approx(float(rows.z[49]), abs=1e-8)
    assert float(motion.i) == pytest.approx(float(rows.i[49]), abs=1e-5)
    with pytest.raises(ValueError, match="vector_field: this controller runs on a processor"):
        ambjax.vector_field(case_from({"processor": {"delay": 1.0}}))


def test_derivatives_with_respect_to_named_gains_only():
    cascade = ambjax.Cascade()
    paths = ["controller.position.c", "controller.current.k_i"]
    found = ambjax.gains_of(cascade, paths)

    def product(gains):
        laws = ambjax.with_gains(cascade, gains)
        return laws.position.c**2 * laws.current.k_i

    slopes = jax.grad(product)(found)
    c, k_i = float(cascade.position.c), float(cascade.current.k_i)
    assert {path: float(x) for path, x in slopes.items()} == {paths[0]: pytest.approx(2 * c * k_i), paths[1]: c**2}
    with pytest.raises(ValueError, match=r"^controller\.position\.cc: .*Did you mean 'controller\.position\.c'"):
        ambjax.gains_of(cascade, ["controller.position.cc"])


def test_a_case_stands_for_its_cascade_scenario_and_clock():
    case = ambjax.read_case({"initial": {"z": 1e-4}, "clock": {"duration": 0.005, "method": "adaptive"}})
    faster = ambjax.with_gains(case, {"controller.position.c": 50.0})
    assert (float(faster.cascade.position.c), faster.clock) == (50.0, case.clock)
    assert ambjax.gains_of(faster) == ambjax.gains_of(faster.cascade)
    one, other = ambjax.rollout(faster), ambjax.rollout(faster.cascade, case.scenario, case.clock)
    np.testing.assert_array_equal(one.trajectory.rows.z, other.trajectory.rows.z)
    assert ambjax.rollout(case, record_every=0).trajectory.rows is None
    both = jax.tree.map(lambda *x: jnp.stack(x), case, faster)  # a case is a pytree, also of arrays
    shapes = jax.eval_shape(jax.vmap(ambjax.rollout), both).trajectory.rows
    assert (both.cascade.position.c[1], shapes.z.shape) == (50.0, (2, case.clock.samples))
    assert jax.jit(lambda case: case)(faster) == faster
    loop = ambjax.linear.linearise(case, r=1e-5)
    np.testing.assert_array_equal(loop.A, ambjax.linear.linearise(case.cascade, case.scenario, case.clock, 1e-5).A)


def test_a_run_is_saved_for_other_programs(run, tmp_path):
    import scipy.io

    for name in ("run.mat", "run.csv", "run.npz"):
        run.save(tmp_path / name)
    z = np.asarray(run.trajectory.rows.z)
    np.testing.assert_array_equal(scipy.io.loadmat(tmp_path / "run.mat")["z"][:, 0], z)
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(table["z"], z)
    with np.load(tmp_path / "run.npz") as saved:
        np.testing.assert_array_equal(saved["z"], z)
    with pytest.raises(ValueError, match=r"must end in \.npz, \.mat, \.csv or \.parquet"):
        run.save(tmp_path / "run.txt")


def test_a_notebook_shows_the_case(path):
    page = ambjax.read_case(path)._repr_html_()
    assert "<td>plant</td><td>Plant: m = 0.588 kg," in page
    assert "<td>reference (m)</td><td>Sine: amplitude = 0.0001, frequency = 5 Hz, phase = 0 rad</td>" in page
    assert "<td>spread</td><td>plant.m</td>" in page
    assert "model" not in page  # that of the plant
    assert "q_z" not in page  # zero
