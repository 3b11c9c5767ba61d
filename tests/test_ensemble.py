"""Ensembles: a member does not depend on the other members, and finished chunks are never lost."""

import dataclasses
import logging
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, Initial, Metrics, Scenario, rollout
from ambjax.compiler import fast_path
from ambjax.compiler.fast_path import one_kernel
from ambjax.compiler.short_compilation import compiled_quickest, compiled_quickly
from ambjax.ensemble import Normal, Percent, Spread, map_members, run_ensemble
from ambjax.ensemble.batching import size
from ambjax.ensemble.store import Store
from ambjax.ensemble.study import COLUMNS, Study
from ambjax.laws import inversion
from ambjax.sensors import Sensor
from ambjax.signals import Sine
from ambjax.simulation.folds import Rms
from ambjax.solvers import RK4

SMOOTH = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
NOISY = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-7, 1e-5, 1e-5), seed=7)
SHORT = Clock(40, 1e-4, RK4(2))
FOLD = Metrics(2e-3)


def members(n, **leaves):
    z = 1e-6 * np.sin(np.arange(n))
    return dataclasses.replace(NOISY, member=np.arange(n), initial=Initial(z, 0.0, 0.0), **leaves)


def rounding():
    """What rounding alone does to some metrics of SMOOTH over SHORT, by name, in their units.

    v_tilde is a difference of the two terms of Eq. (3), (i_0 / s_0)^2 each: a few roundings of their sum. The loop's
    steepest slope makes of that i_ref', and the coil u; chatter adds up 2 |u| at every sample of the run.
    """
    plant = SMOOTH.model
    v_tilde = 4 * np.finfo(float).eps * 2 * (plant.i_0 / plant.s_0) ** 2
    u = plant.L * SMOOTH.slopes()["inversion"] / plant.dv_di(0.0, 0.0) * v_tilde
    voltages = dict.fromkeys(("max_abs_u_V", "rms_u_V", "settled_rms_u_V"), float(u))
    return voltages | {"chatter_V": float(2 * SHORT.samples * u), "settled_max_abs_v_tilde_A2_per_m2": v_tilde}


def same(a, b, rtol):
    """Check that all leaves agree.

    Metrics that are differences of large terms, and sums of such metrics, may differ by rounding.
    """
    absolute = rounding()
    for (path, x), y in zip(jax.tree.leaves_with_path(a), jax.tree.leaves(b), strict=True):
        name = getattr(path[-1], "key", None) if path else None
        np.testing.assert_allclose(x, y, rtol=rtol, atol=absolute.get(name, 1e-15), err_msg=str(name))


@pytest.mark.slow
def test_results_do_not_depend_on_calls_threads_or_other_members():
    n = 150  # no multiple of a block
    whole = run_ensemble(SMOOTH, members(n), SHORT, fold=FOLD, threads=1)
    assert whole.metrics["rms_error_m"].shape == (n,)
    assert len(set(whole.metrics["rms_error_m"])) == n
    for threads, call in ((2, 64), (1, 128), (3, None)):
        # same operations on other lanes: only where XLA fuses differently may a last digit move
        same(run_ensemble(SMOOTH, members(n), SHORT, fold=FOLD, threads=threads, call=call), whole, 1e-12)
    some = jax.tree.map(lambda x: x[60:70] if np.ndim(x) else x, members(n))
    same(run_ensemble(SMOOTH, some, SHORT, fold=FOLD), jax.tree.map(lambda x: x[60:70], whole), 1e-12)


@pytest.fixture
def fresh(monkeypatch):
    """The options of the fast path are found anew in the test, and after it."""
    fast_path.options.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    fast_path.options.cache_clear()


needs_fast_path = pytest.mark.skipif("fast_path.options() is None", reason="the fast path is not supported here")


@needs_fast_path
def test_the_plain_path_gives_the_same_numbers_and_logs_its_use(fresh, caplog):
    fast = run_ensemble(SMOOTH, members(20), SHORT, fold=Rms("e_z"))
    fresh.setenv("AMBJAX_PLAIN", "1")
    fast_path.options.cache_clear()
    with caplog.at_level(logging.WARNING):
        same(run_ensemble(SMOOTH, members(20), SHORT, fold=Rms("e_z")), fast, 1e-12)
    assert "AMBJAX_PLAIN" in caplog.text
    assert len(caplog.records) == 1


@needs_fast_path
@pytest.mark.parametrize(("flags", "level"), [("", 2), ("--xla_backend_optimization_level=1", None)])
def test_rollouts_are_compiled_without_unrolling_unless_the_flags_give_a_level(flags, level, fresh):
    fresh.setenv("XLA_FLAGS", flags)
    options = fast_path.options()
    assert options.get("xla_backend_optimization_level") == level
    assert ("xla_cpu_prefer_vector_width" in options) == fast_path.has_avx512()


def test_a_wrong_result_of_the_probe_disables_the_fast_path(fresh, caplog):
    right = fast_path._step
    fresh.setattr(
        fast_path, "_step", lambda y, lib: right(y, lib) if lib is np else jnp.where(y > 20, 0, right(y, lib))
    )
    with caplog.at_level(logging.WARNING):
        assert fast_path.options() is None
    assert "results are off by" in caplog.text


@pytest.mark.slow
def test_several_devices_give_the_results_of_one(tmp_path):
    code = """
import sys, jax
jax.config.update("jax_num_cpu_devices", 2)
import numpy as np
from test_ensemble import *
assert len(jax.devices()) == 2
np.save(sys.argv[1], run_ensemble(SMOOTH, members(70), SHORT, fold=Rms("e_z")).metrics)
"""
    env = os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": os.path.dirname(__file__)}  # noqa: PTH120
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "2.npy")], env=env, check=True)
    one = run_ensemble(SMOOTH, members(70), SHORT, fold=Rms("e_z")).metrics
    np.testing.assert_allclose(np.load(tmp_path / "2.npy"), one, rtol=1e-12)


def test_lengths_that_differ_or_are_missing_are_named():
    assert size(members(5)) == 5
    for scenario, words in ((NOISY, "leaves: none"), (members(3, u_max=np.full(4, 200.0)), "leaves: 3 and 4")):
        with pytest.raises(ValueError, match=words):
            run_ensemble(SMOOTH, scenario, SHORT, fold=FOLD)


@dataclasses.dataclass(frozen=True)
class Scaled:
    """A function of a member; two of these functions are equal if their powers are."""

    power: int
    traces = 0

    def __call__(self, tree):
        Scaled.traces += 1
        return {"sum": tree["scale"] * jnp.sum(tree["x"]) ** self.power, "x": tree["x"]}


@pytest.mark.parametrize("compiled", [one_kernel, compiled_quickly, compiled_quickest])
def test_any_function_of_a_member_is_mapped_over_all_and_compiled_once(compiled):
    x = np.arange(70.0 * 3).reshape(70, 3)
    for threads, call, block in ((1, None, None), (2, 32, 32), (3, 10, 4)):
        cut, seen = {"threads": threads, "call": call, "block": block, "compiled": compiled}, []
        for scale in (2.0, 3.0):
            found = map_members(Scaled(2), {"x": x, "scale": np.asarray(scale)}, **cut)
            np.testing.assert_array_equal(found["x"], x)
            np.testing.assert_array_equal(found["sum"], scale * x.sum(axis=1) ** 2)  # whole numbers
            seen.append(Scaled.traces)
        assert seen[0] == seen[1]
    with pytest.raises(ValueError, match="leaves: 69 and 70"):
        map_members(Scaled(2), {"x": x, "scale": np.arange(69.0)})


SPREAD = Spread((("plant.m", Percent(1.0)), ("initial.z", Normal(1e-7))), "sobol")
STUDY = Study(SMOOTH, NOISY, SHORT, 2e-3, SPREAD, 11, 150)


def run(study, directory, chunk=64, resume=False, stop_after=None):
    store = Store(directory, study.fingerprint(), study.members, chunk)
    store.check(COLUMNS, resume)
    store.begin()
    for span in store.survey()[0][:stop_after]:
        store.put(span, study.columns(*span, call=64))
    if not store.survey()[0]:
        store.finish()
    return directory / "members.npz"


def test_a_study_interrupted_and_resumed_is_the_same_file(tmp_path):
    whole = run(STUDY, tmp_path / "whole")
    for finished in (0, 1, 2):
        cut = tmp_path / f"cut {finished}"
        assert not run(STUDY, cut, stop_after=finished).exists()
        (cut / "chunks" / "000000000128-000000000150.npz.part").write_bytes(b"torn")  # killed while writing
        assert run(STUDY, cut, resume=True).read_bytes() == whole.read_bytes()
        assert not (cut / "chunks").exists()


def test_members_npz_has_a_row_per_member_and_every_metric(tmp_path):
    with np.load(run(STUDY, tmp_path)) as kept:
        columns = dict(kept)
    alone = rollout(*STUDY.member(77), SHORT, fold=FOLD)
    assert set(columns) == {"index", "lost_at", "spread.plant.m", "spread.initial.z", *alone.metrics}
    np.testing.assert_array_equal(columns["index"], np.arange(150))
    assert len(columns) <= COLUMNS
    assert all(len(x) == 150 for x in columns.values())
    np.testing.assert_allclose(columns["rms_error_m"][77], alone.metrics["rms_error_m"], rtol=1e-12)
    assert STUDY.member(77)[1].plant.m == columns["spread.plant.m"][77]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"seed": 12}, "seed"),
        ({"members": 151}, "members"),
        ({"settle": 1e-3}, "run.settle"),
        ({"cascade": Cascade(inversion=inversion.Adaptive(2e9, 25e-6))}, "controller.inversion.gamma"),
        ({"cascade": Cascade(inversion=inversion.ClosedForm())}, "controller.inversion.kind"),
        ({"spread": Spread((("plant.m", Percent(2.0)),), "sobol")}, "spread.plant.m"),
        ({"scenario": dataclasses.replace(STUDY.scenario, sensor=Sensor(velocity=False))}, "sensor.velocity"),
        ({"clock": Clock(41, 1e-4, RK4(2))}, "clock.samples"),
    ],
)
def test_resuming_another_study_is_refused_by_the_key_that_differs(change, key, tmp_path):
    run(STUDY, tmp_path, stop_after=1)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=rf"another study: {key} is .* in the file and .* in this run"):
        run(dataclasses.replace(STUDY, **change), tmp_path, resume=True)
    assert sorted(tmp_path.rglob("*")) == before
