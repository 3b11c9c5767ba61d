"""Results in Python: numbers equal those of the commands, tables have units, and pictures match their data."""

import dataclasses
import json
import sys
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ambjax
from ambjax.__main__ import main
from ambjax.cases.reader import case_from, is_as_written
from ambjax.results.case_export import ExportedCase
from ambjax.simulation.trajectory import STALLED
from tuning.__main__ import main as tune_main
from tuning.command import TunedCase

CASE = """
reference = { kind = "sine", amplitude = 1e-4, frequency = 5.0 }
clock = { duration = 0.02 }
run = { settle = 0.01 }
spread = { plant.m = { percent = 5 } }
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
def test_a_check_returns_its_verdict_and_prints_nothing(path, capfd):
    case = ambjax.read_case(path)
    found = ambjax.check(case)
    assert capfd.readouterr() == ("", "")
    assert found.holds == found.summary["holds"]
    assert found.text.startswith("The check passes." if found.holds else "The check FAILS")
    assert found.summary["loop"]["peak"] == pytest.approx(ambjax.sensitivity(case).S.height)


@pytest.mark.thorough
def test_a_check_on_a_processor_evaluates_theorem_1_only_if_asked():
    case = case_from(tomllib.loads(CASE) | {"processor": {"delay": 0.5, "predict": False}})
    brief, full = ambjax.check(case), ambjax.check(case, full=True)
    assert ("Theorem 1" in brief.text, "Theorem 1" in full.text) == (False, True)
    assert full.summary["conditions"]
    # it changes nothing else
    assert full.summary | dict.fromkeys(("method", "conditions", "proof")) == brief.summary


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


def test_the_parts_of_a_case_stand_for_it(path, run):
    case = ambjax.read_case(path)
    parts = case.cascade, case.scenario, case.clock
    again = ambjax.simulate(*parts)
    np.testing.assert_array_equal(again.trajectory.rows.z, run.trajectory.rows.z)
    assert again.metrics["max_abs_i_A"] == run.metrics["max_abs_i_A"]
    inside = jax.jit(lambda: ambjax.simulate(ambjax.read_case(path)).trajectory.rows.z)()
    np.testing.assert_array_equal(inside, run.trajectory.rows.z)
    assert ambjax.sensitivity(*parts).S == ambjax.sensitivity(case).S


@ambjax.extend.record
class Growing:
    """A fold whose carry grows."""

    def init(self):
        return np.zeros(())

    def update(self, carry, row, span):
        return carry, row.z

    def result(self, carry, ending):
        return carry


@ambjax.extend.record
class Float(Growing):
    def update(self, carry, row, span):
        return float(row.z)


def test_bad_input_is_refused_by_name(path, run, monkeypatch):
    case = ambjax.read_case(path)
    cascade, scenario, clock = case.cascade, case.scenario, case.clock
    gains, two = {"controller.position.c": jnp.array([17.0, 18.0])}, dataclasses.replace(scenario, member=np.arange(2))
    none = dataclasses.replace(scenario, member=np.arange(0))
    late = dataclasses.replace(scenario, q_z=ambjax.signals.Pulse(1.0, 2.0, 1.0))
    short = dataclasses.replace(case, clock=dataclasses.replace(clock, samples=2))
    periods = float(clock.sample_period) * jnp.array([0.5, 1.0])
    A_CASE = r"give a case, .* a Cascade, a Scenario and a Clock"
    refused = [
        (lambda: ambjax.simulate_members(case, 0), "members = 0: it must be a whole number from 1 to"),
        (lambda: ambjax.compare([case, case], 1, seed=-1), "seed = -1: it must be a whole number from 0 to"),
        (lambda: ambjax.read_case(3), "path = 3: it must be the path of a file.* or a dict"),
        (lambda: run.save("nowhere/run.npz"), "nowhere/run.npz: the directory nowhere does not exist"),
        (lambda: run.save(3), "path = 3: it must be the path of a file"),
        (lambda: ambjax.save_controller("nowhere/p.npz", None), "nowhere/p.npz: the directory nowhere does not exist"),
        (lambda: ExportedCase.write(None, 3), "folder = 3: it must be the path of a folder"),
        (lambda: ambjax.Case("x", scenario, cascade, clock, 0.0), r"Case.cascade = Scenario.*: it must be a Cascade\."),
        (lambda: dataclasses.replace(case, settle=-1), "Case.settle = -1: it must be a finite number of at least 0"),
        (lambda: ambjax.vector_field(case).f(0.0, np.zeros(3)), r"y has the shape \[3\]: it must be \[4\]"),
        (lambda: ambjax.rollout(case, fold=ambjax.extend.Rms("foo")), "of = 'foo': it must be a signal of a row: t, "),
        (lambda: ambjax.rollout(ambjax.with_gains(case, {"controller.position.c": np.True_})), "c = .*True.*: it must"),
        (lambda: ambjax.ensemble.run_ensemble(cascade, none, clock, fold=None),
         r"scenario.member = array\(\[\].*: it must be a whole number from 0"),
        (lambda: ambjax.sensitivity(case, "a"), "r = 'a': it must be a finite number"),
        (lambda: ambjax.gains_of(cascade, "controller.position.c"), r'a list. Write \["controller.position.c"\]'),
        (lambda: ambjax.gains_of(3, []), "loop = int: it must be a Case"),
        (lambda: ambjax.with_gains(cascade, 3), "gains = 3: it must be a dict"),
        (lambda: ambjax.simulate(case, 3), "progress = 3: it must be a function"),
        (lambda: ambjax.export(case, prefix=3), "prefix = 3: it must be a C identifier"),
        (lambda: ambjax.survival_map(case, ("plant.m", 1), "plant.R=1:2"), "x = .*: it must be text. Write PATH=LOW"),
        (lambda: ambjax.Metrics.for_case(cascade), "case = Cascade: it must be a "),
        (lambda: ambjax.simulate(short), "run.settle = .* s: it must be at most"),
        (lambda: ambjax.Metrics.of(0.0, 3), "scenario = 3: it must be a Scenario"),
        (lambda: ambjax.template("rigg"), "template = 'rigg': it must be one of tracking"),
        (lambda: ambjax.compare(case), "cases = Case: it must be a list of 2 to 8 cases"),
        (lambda: ambjax.rollout(scenario, cascade, clock), "cascade = Scenario: it must be a Cascade"),
        (lambda: ambjax.rollout("case.toml"), A_CASE),
        (lambda: ambjax.rollout(case, scenario), A_CASE),
        *[(lambda of=of: of(ambjax.with_gains(case, gains)), r"c has the shape \[2\]: this function takes one member")
          for of in (ambjax.rollout, ambjax.simulate, ambjax.sensitivity, ambjax.check, ambjax.export,
                     ambjax.linear.linearise)],
        (lambda: ambjax.sensitivity(dataclasses.replace(case, clock=dataclasses.replace(clock, sample_period=periods))),
         r"clock.sample_period has the shape \[2\]: this function takes one member"),
        (lambda: ambjax.rollout(cascade, dataclasses.replace(scenario, reference=0.0), clock),
         r"scenario.reference = 0.0: it must be a record, such as Constant\(\)"),
        (lambda: ambjax.rollout(cascade, late, clock), "q_z.stop = 1.0: it must not be less than start = 2.0"),
        (lambda: ambjax.rollout(cascade, scenario, clock.with_method(ambjax.solvers.RK4(0))),
         r"clock\.method\.substeps = 0: it must be a whole number of at least 1"),
        (lambda: ambjax.rollout(cascade, scenario, dataclasses.replace(clock, samples=0)), "clock.samples = 0: it"),
        (lambda: ambjax.rollout(case, fold=ambjax.Metrics), "fold = .* a fold"),
        (lambda: ambjax.rollout(case, fold=ambjax.extend.Named({"a": 3})), "fold.a = 3: it must be a fold, "),
        (lambda: ambjax.rollout(case, fold=ambjax.extend.Named([])), r"fold.folds = \[\]: it must be a dict of folds"),
        (lambda: ambjax.rollout(case, fold=Float()), r"Float.update raised Concret.*\. Compute with jax.numpy w"),
        (lambda: ambjax.linear.injected(case, "a"), "injection.frequencies: they must be at least"),
        (lambda: ambjax.read_case({3: {}}), "case: the key 3 must be text"),
        (lambda: ambjax.simulate(cascade, dataclasses.replace(scenario, q_f=len), clock), "q_f = .*: it must be"),
        (lambda: ambjax.simulate(dataclasses.replace(cascade, position=ambjax.laws.position.PID), scenario, clock),
         r"position = the class PID: it is not a law of this stage\. Write PID\(\)"),
        (lambda: ambjax.rollout(case, fold=Growing()), r"Growing has the shapes .*`update` \(\(\), \(\)\)"),
        (lambda: jax.jit(lambda n: ambjax.rollout(case, record_every=n))(1), "record_every = a traced number: it must"),
        (lambda: ambjax.Scenario(seed=2.5), "Scenario.seed = 2.5: it must be a whole number"),
        (lambda: ambjax.ensemble.run_ensemble(cascade, two, clock, fold=None, threads=-1), "threads = -1"),
        (lambda: ambjax.ensemble.quantile(np.arange(3.0), -1), "q = -1: it must be from 0 to 1"),
    ]  # fmt: skip
    of_a_case = [ambjax.simulate, ambjax.sensitivity, ambjax.check, ambjax.vector_field, ambjax.export]
    refused += [(lambda f=f: f(cascade, clock, scenario), rf"\(Cascade, .*\): {A_CASE}") for f in of_a_case]
    of_a_case += [
        lambda given: ambjax.compare([given, given]),
        lambda given: ambjax.simulate_members(given, 1),
        lambda given: ambjax.survival_map(given, "plant.m=1:2", "plant.R=1:2"),
    ]
    refused += [(lambda f=f: f("case.toml"), "case = 'case.toml': it must be a Case, as ") for f in of_a_case]
    traceable = (ambjax.vector_field, ambjax.export, of_a_case[-1])
    for f in [*(f for f in of_a_case if f not in traceable), ambjax.linear.linearise, ambjax.theorem.check]:
        traced = jax.grad(lambda c, f=f: f(ambjax.with_gains(case, {"controller.position.c": c})))
        refused.append((lambda traced=traced: traced(17.0), r"a number is traced, .* Use ambjax\.rollout"))
    traced = jax.grad(
        lambda c: ambjax.ensemble.run_ensemble(dataclasses.replace(cascade, position=c), two, clock, fold=None)
    )
    refused.append((lambda: traced(cascade.position), "^ensemble: a number is traced"))
    read = jax.jit(lambda c: ambjax.read_case({"controller": {"position": {"c": c}}}).cascade)
    refused.append((lambda: read(17.0), "^controller.position.c: the number is traced. Read the case outside jit"))
    refused.append((lambda: jax.jit(lambda: ambjax.linear.linearise(case))(), "^linearise: a number is traced"))
    for call, said in refused:
        with pytest.raises(ValueError, match=said):
            call()
    for name in ("pandas", "xarray"):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(ValueError, match=rf"{name} is not installed. .*: pip install 'ambjax\[tables\]'"):
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
    for name, value in {"minutes": "3", "listen": 3}.items():
        with pytest.raises(ValueError, match=f"{name} = '?3'?: it must be"):
            ambjax.tune(path, **{name: value})


def test_a_case_with_other_gains_can_be_tuned_and_saved(path, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.command.run", lambda *words: words)
    case = ambjax.read_case(path)
    changed = ambjax.with_gains(case, {"controller.position.c": 20.0})
    assert not is_as_written(changed)
    ambjax.save_case(tmp_path / "mine.toml", changed)
    saved = ambjax.read_case(tmp_path / "mine.toml")
    assert is_as_written(dataclasses.replace(changed, text=saved.text))
    (tables, text), known = ambjax.tune(changed)[3:]
    assert known is changed
    assert text == saved.text
    assert tables["controller"]["position"]["c"] == 20.0
    for other, said in {"": "made of parts", text: "more than its gains"}.items():
        with pytest.raises(ValueError, match=said):
            ambjax.tune(dataclasses.replace(case, text=other, settle=0.0))
    with pytest.raises(ValueError, match="case = str: it must be a case"):
        ambjax.save_case(tmp_path / "mine.toml", str(path))


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
    hard = dataclasses.replace(cascade, position=dataclasses.replace(cascade.position, p=None))
    with pytest.raises(ValueError, match=r"^controller\.position\.p = None: it has no value"):
        ambjax.gains_of(hard, ["controller.position.p"])
    assert ambjax.with_gains(hard, {"controller.position.p": 3.0}).position.p == 3.0


def test_a_case_stands_for_its_cascade_scenario_and_clock():
    case = ambjax.read_case(
        {"initial": {"z": jnp.asarray(1e-4)}, "clock": {"duration": np.float64(0.005), "method": "adaptive"}}
    )
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
