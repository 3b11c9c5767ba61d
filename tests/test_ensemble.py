"""Ensembles: a member does not depend on the other members, and finished chunks are never lost."""

import dataclasses
import itertools
import logging
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from scipy import linalg, stats

from ambjax import RK4, AdaptiveRodas3, Cascade, Clock, Initial, Scenario, Sensor, Sine, Standard, inversion, rollout
from ambjax.compiler import fast_path
from ambjax.control.processor import Processor
from ambjax.ensemble import Normal, Percent, Spread, map_members, run_ensemble
from ambjax.ensemble import study as ensemble_study
from ambjax.ensemble.batching import size
from ambjax.ensemble.store import Store
from ambjax.ensemble.study import COLUMNS, Study
from ambjax.host.sealed import difference
from ambjax.simulation.folds import Rms
from ambjax.simulation.loop import ClosedLoop, LoopState
from ambjax.simulation.rollout import Outcome
from ambjax.simulation.trajectory import Row, Trajectory

SMOOTH = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
NOISY = Scenario(reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-7, 1e-5, 1e-5), seed=7)
SHORT = Clock(40, 1e-4, RK4(2))
FOLD = Standard(2e-3)


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
    assert whole.measured["rms_error_m"].shape == (n,)
    assert len(set(whole.measured["rms_error_m"])) == n
    for threads, call in ((2, 64), (1, 128), (3, None)):
        # same operations on other lanes: only where XLA fuses differently may a last digit move
        same(run_ensemble(SMOOTH, members(n), SHORT, fold=FOLD, threads=threads, call=call), whole, 1e-12)
    some = jax.tree.map(lambda x: x[60:70] if np.ndim(x) else x, members(n))
    same(run_ensemble(SMOOTH, some, SHORT, fold=FOLD), jax.tree.map(lambda x: x[60:70], whole), 1e-12)


@pytest.mark.parametrize(
    "cpu",
    [
        "AuthenticAMD avx512f",
        pytest.param("GenuineIntel avx512f", marks=pytest.mark.thorough),
        pytest.param("AuthenticAMD avx2", marks=pytest.mark.thorough),
    ],
)
def test_results_do_not_depend_on_the_length_of_blocks(cpu, monkeypatch):
    expected = {"AuthenticAMD avx512f": 128}.get(cpu, 64)
    here = run_ensemble(SMOOTH, members(300), SHORT, fold=FOLD, threads=1)
    monkeypatch.setattr(fast_path, "_cpuinfo", lambda: cpu)
    assert [fast_path.block_length(n) for n in (1, 16, 17, 64, 255, 256, 4096)] == [
        16,
        16,
        32,
        64,
        64,
        expected,
        expected,
    ]
    same(run_ensemble(SMOOTH, members(300), SHORT, fold=FOLD, threads=1), here, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("method", [RK4(2), pytest.param(AdaptiveRodas3(), marks=pytest.mark.thorough)], ids=str)
def test_a_member_of_an_ensemble_equals_its_own_rollout(method):
    clock = Clock(40, 1e-4, method)
    found = run_ensemble(SMOOTH, members(66), clock, fold=FOLD, every=10)
    for k in (0, 33, 65):
        alone = jax.tree.map(lambda x, k=k: x[k] if np.ndim(x) else x, members(66))
        one = rollout(SMOOTH, alone, clock, fold=FOLD, every=10)
        # noise is bit for bit the same; an adaptive step's length depends on rounding, within its tolerance
        np.testing.assert_array_equal(found.trajectory.rows.z_measured[k][0], one.trajectory.rows.z_measured[0])
        same(jax.tree.map(lambda x, k=k: x[k], found.measured), one.measured, 1e-12 if method.limit else 1e-9)
        assert found.trajectory.rows.z[k].shape == (4,)


def test_the_plain_path_gives_the_same_numbers_and_logs_its_use(monkeypatch, caplog):
    if fast_path.options() is None:
        pytest.skip("the fast path is not supported here")
    fast = run_ensemble(SMOOTH, members(20), SHORT, fold=Rms("e_z"))
    monkeypatch.setenv("AMBJAX_PLAIN", "1")
    fast_path.options.cache_clear()
    try:
        with caplog.at_level(logging.WARNING):
            same(run_ensemble(SMOOTH, members(20), SHORT, fold=Rms("e_z")), fast, 1e-12)
        assert "AMBJAX_PLAIN" in caplog.text
        assert len(caplog.records) == 1
    finally:
        monkeypatch.undo()
        fast_path.options.cache_clear()


def test_a_wrong_result_of_the_probe_disables_the_fast_path(monkeypatch, caplog):
    right = fast_path._step
    wrong = lambda y, lib: right(y, lib) if lib is np else jnp.where(y > 20, 0.0, right(y, lib))  # noqa: E731
    monkeypatch.setattr(fast_path, "_step", wrong)
    fast_path.options.cache_clear()
    try:
        with caplog.at_level(logging.WARNING):
            assert fast_path.options() is None
        assert "results are off by" in caplog.text
    finally:
        monkeypatch.undo()
        fast_path.options.cache_clear()


@pytest.mark.slow
def test_several_devices_give_the_results_of_one(tmp_path):
    code = """
import sys, jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import numpy as np
from test_ensemble import *
assert len(jax.devices()) == int(sys.argv[1])
np.save(sys.argv[2], run_ensemble(SMOOTH, members(70), SHORT, fold=Rms("e_z")).measured)
"""
    env = os.environ | {"JAX_ENABLE_X64": "1", "PYTHONPATH": os.path.dirname(__file__)}  # noqa: PTH120
    for n in (1, 2):
        subprocess.run([sys.executable, "-c", code, str(n), str(tmp_path / f"{n}.npy")], env=env, check=True)
    np.testing.assert_allclose(np.load(tmp_path / "1.npy"), np.load(tmp_path / "2.npy"), rtol=1e-12)


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


@pytest.mark.parametrize("plain", [False, True])
def test_any_function_of_a_member_is_mapped_over_all_and_compiled_once(plain):
    x = np.arange(70.0 * 3).reshape(70, 3)
    for threads, call, block in ((1, None, None), (2, 32, 32), (3, 10, 4)):
        cut, seen = {"threads": threads, "call": call, "block": block, "plain": plain}, []
        for scale in (2.0, 3.0):
            found = map_members(Scaled(2), {"x": x, "scale": np.asarray(scale)}, **cut)
            np.testing.assert_array_equal(found["x"], x)
            np.testing.assert_array_equal(found["sum"], scale * x.sum(axis=1) ** 2)  # whole numbers
            seen.append(Scaled.traces)
        assert seen[0] == seen[1]
    with pytest.raises(ValueError, match="leaves: 69 and 70"):
        map_members(Scaled(2), {"x": x, "scale": np.arange(69.0)})


class ScaledBlock(Scaled):
    """The same for a block of members, which it maps itself."""

    def __call__(self, tree, axes):
        return jax.vmap(super().__call__, (axes,))(tree)


@pytest.mark.parametrize("plain", [False, True])
def test_a_vectorised_function_receives_blocks_and_their_axes(plain):
    x = np.arange(70.0 * 3).reshape(70, 3)
    tree = {"x": x, "scale": np.asarray(2.0)}
    found = map_members(ScaledBlock(2), tree, call=32, block=16, plain=plain, vectorised=True)
    np.testing.assert_array_equal(found["x"], x)
    np.testing.assert_array_equal(found["sum"], 2 * x.sum(axis=1) ** 2)  # whole numbers


def test_the_noise_of_each_member_is_independent_and_white():
    rows = run_ensemble(SMOOTH, members(200), SHORT, fold=None, every=1).trajectory.rows
    w = (rows.z_measured - rows.z) / 1e-7
    assert stats.kstest(w.ravel(), "norm").pvalue > 1e-3
    # products of distinct members and of distinct samples average to 0 +- 1/sqrt(count); five of those
    assert abs((w[:100] * w[100:]).mean()) < 5 / np.sqrt(w.size / 2)
    assert abs((w[:, 1:] * w[:, :-1]).mean()) < 5 / np.sqrt(w.size)


@pytest.mark.slow
def test_settled_rms_agrees_with_the_lyapunov_equation():
    """Held noise in the linearised loop: P = A P A' + B S B' at the samples."""
    n, std, period = 200, 1e-8, 1e-4
    current = float(SMOOTH.model.equilibrium(0.0)[0])
    cascade = dataclasses.replace(SMOOTH, inversion=inversion.Adaptive(1e9, 25e-6, i_ref=current))
    still = Scenario(initial=Initial(i=current), sensor=Sensor(std, 0.0, 0.0), member=np.arange(n))
    loop = ClosedLoop(cascade, Scenario(initial=Initial(i=current), sensor=Sensor()))
    tree = jax.tree.structure(loop.start())

    def rates(x, w):
        state = LoopState(*jax.tree.unflatten(tree, list(x)))
        errors = loop.sensor_errors(0)._replace(z=w)
        return jnp.stack(jax.tree.leaves(loop.rates(loop.inputs(0.0), state, errors)))

    x_0 = jnp.stack(jax.tree.leaves(loop.start()))
    assert np.abs(rates(x_0, 0.0)[:3]).max() < 1e-9  # at rest: rounding of 9.81 m/s^2 and of currents
    A, B = jax.jacfwd(rates, (0, 1))(x_0, 0.0)
    held = linalg.expm(period * np.block([[A, np.asarray(B)[:, None]], [np.zeros((1, 5))]]))
    P = linalg.solve_discrete_lyapunov(held[:4, :4], std**2 * np.outer(held[:4, 4], held[:4, 4]))
    # 1/c = 59 ms is the slowest time constant: e^-8.5 of a start at zero is left after 0.5 s
    clock = Clock(10_000, period, RK4(2))
    rms = run_ensemble(cascade, still, clock, fold=Rms("e_z", 0.5)).measured
    mean, error = np.mean(rms**2), np.std(rms**2) / np.sqrt(n)
    assert error < 0.05 * P[0, 0]  # sharp enough for the comparison
    assert abs(mean - P[0, 0]) < 3 * error


SPREAD = Spread((("plant.m", Percent(1.0)), ("initial.z", Normal(1e-7))), "sobol")
STUDY = Study(SMOOTH, NOISY, SHORT, 2e-3, SPREAD, 11, 150)


def run(study, directory, chunk=64, resume=False, stop_after=None):
    store = Store(directory, study.fingerprint(), study.members, chunk)
    store.check(COLUMNS, resume)
    store.begin()
    for span in store.survey().missing[:stop_after]:
        store.put(span, study.columns(*span, call=64))
    if not store.survey().missing:
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
    assert set(columns) == {"index", "lost_at", "spread.plant.m", "spread.initial.z", *alone.measured}
    np.testing.assert_array_equal(columns["index"], np.arange(150))
    assert len(columns) <= COLUMNS
    assert all(len(x) == 150 for x in columns.values())
    np.testing.assert_allclose(columns["rms_error_m"][77], alone.measured["rms_error_m"], rtol=1e-12)
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


def test_the_fingerprint_of_a_study_contains_its_flags():
    """Flags are, for example, the discretisation, the prediction and the measured signals.

    They cannot differ between members.
    """
    sampled = [dataclasses.replace(STUDY.cascade, processor=Processor(implicit=x)) for x in (True, False)]
    one, other = (dataclasses.replace(STUDY, cascade=cascade).fingerprint() for cascade in sampled)
    assert difference(one, other) == "controller.processor.implicit is True in the file and False in this run"


def test_a_store_refuses_another_study_and_a_full_disk(tmp_path):
    run(STUDY, tmp_path, stop_after=1)
    with pytest.raises(ValueError, match=r"already holds a study\. Add --resume"):
        run(STUDY, tmp_path)
    with pytest.raises(ValueError, match="another study: chunk is 64 in the file and 32 in this run"):
        run(STUDY, tmp_path, chunk=32, resume=True)
    huge = Store(tmp_path / "huge", {}, 2**50, 1024)
    with pytest.raises(ValueError, match=r"GB free. At most [\d,]+ members fit"):
        huge.check(COLUMNS, resume=False)
    assert not (tmp_path / "huge").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(ValueError, match="there is no study in"):
        run(STUDY, tmp_path / "other", resume=True)


def test_a_study_is_not_resumed_with_another_version_of_jax(tmp_path, monkeypatch):
    run(STUDY, tmp_path, stop_after=1)
    monkeypatch.setattr(jax, "__version__", "0.0.0")
    with pytest.raises(ValueError, match="another study: jax is"):
        run(STUDY, tmp_path, resume=True)


@pytest.mark.slow
def test_the_variation_of_the_voltage_over_parts_of_the_run_adds_up():
    study = Study(SMOOTH, NOISY, SHORT, 0.0, Spread((("plant.m", Percent(10.0)),)), 3, 5)
    bands = study.bands(5, 40)
    rate = bands.signals["variation of u"]
    assert rate.shape == (5, len(bands.t)) == (5, 40)
    chatter = study.columns(0, 5)["chatter_V"]
    # the rate at an instant is that of the two samples before it; the odd instants cover the run but its first step
    first = np.abs(np.diff(bands.trajectory.rows.u_mean[:, :2]))[:, 0]
    np.testing.assert_allclose(first + 2e-4 * rate[:, 3::2].sum(1), chatter, rtol=1e-9)  # another order and program
    assert np.isnan(rate[:, :2]).all()
    assert np.all(chatter > 0)
    assert np.isinf(bands.trajectory.lost_at).all()


def test_bands_at_few_instants_include_the_extremes_between_them(monkeypatch):
    """The runs are constructed; the third one is lost in the middle of a block."""
    n, lost_at = 41, np.array([np.inf, np.inf, 16.5e-4])
    made = np.random.default_rng(0).normal(size=(len(Row._fields), 3, n))
    t = 1e-4 * np.arange(n)
    alive = t < lost_at[:, None]
    whole = Row(*made)._replace(t=np.tile(t, (3, 1)), alive=alive)

    def pretend(cascade, scenario, clock, *, fold, every):
        rows = jax.tree.map(lambda x: x[:, : clock.samples], whole)

        def one(rows):
            carry, _ = lax.scan(lambda carry, row: (fold.update(carry, row, None), None), fold.init(), rows)
            return fold.result(carry, None)

        recorded = Trajectory(jax.tree.map(lambda x: x[:, ::every], rows), lost_at, np.zeros(3), lost_at)
        return Outcome(recorded, jax.tree.map(np.asarray, jax.vmap(one)(rows)))

    monkeypatch.setattr(ensemble_study, "run_ensemble", pretend)
    study = Study(SMOOTH, NOISY, dataclasses.replace(SHORT, samples=n), 0.0, Spread(), 3, 3)
    for samples, until, at in ((n, np.inf, [0, 6, 12, 18, 24, 30, 36, 40]), (18, 16.5e-4, [0, 3, 6, 9, 12, 15, 17])):
        bands = study.bands(3, 7 if samples == n else 6, until)
        np.testing.assert_array_equal(bands.t, t[at])
        edges = [*at[:-1], samples]  # of the blocks
        for name, of in ensemble_study.FAN_SIGNALS.items():
            values = np.where(alive, getattr(whole, of), np.nan)[:, :samples]
            np.testing.assert_array_equal(bands.signals[name], values[:, at])
            for k in range(len(at)):
                beside = values[:, edges[max(k - 1, 0)] : edges[min(k + 1, len(edges) - 1)]]
                low, high = bands.extremes[name]
                assert (low[k], high[k]) == (np.nanmin(beside), np.nanmax(beside))
        steps, rate = np.abs(np.diff(whole.u_mean)), bands.signals["variation of u"]
        assert np.isnan(rate[:, 0]).all()
        for k, (begin, end) in enumerate(itertools.pairwise(at), 1):
            before = steps[:2, begin:end].sum(1) / (1e-4 * (end - begin))
            np.testing.assert_allclose(rate[:2, k], before, rtol=1e-12)  # sums in another order
            assert np.isfinite(rate[2, k]) == alive[2, end]
