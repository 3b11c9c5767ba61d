"""The rollout: rows, folds, members, the status of the rotor, the paper's numbers, float32 and the fast path."""

import dataclasses
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Clock, Initial, Metrics, Processor, Scenario, rollout
from ambjax.actuators import CoilLimits
from ambjax.compiler import fast_path
from ambjax.compiler.fast_path import one_kernel
from ambjax.laws import inversion, position
from ambjax.plants import Plant
from ambjax.sensors import Dropouts, Sensor
from ambjax.signals import Pulse, Recorded, Sine, Sum
from ambjax.simulation.explicit import Euler
from ambjax.simulation.folds import Lowest, Named, Rms, Variation
from ambjax.simulation.trajectory import DIVERGED, TOUCHED, Row
from ambjax.solvers import RK4, AdaptiveRodas3

ROOT = pathlib.Path(__file__).parent.parent
REPAIRED = Cascade()
LITERAL = Cascade(inversion=inversion.Adaptive(gamma=1e3))
SMOOTH = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
TRACKING = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.8, 1.3))
NOISY = dataclasses.replace(TRACKING, sensor=Sensor(1e-6, 1e-4, 1e-4))


# One structure, so one compiled rollout, for most of what follows: 203 samples, noise, a supply limit, all metrics.
METRICS = Metrics(settle=0.01)
SHORT = Clock(203, 1e-4, AdaptiveRodas3())
# Another, cheap to compile, where the method does not matter: explicit steps on smooth gains.
LIGHT_FOLDS = Named({"rms": Rms("e_z"), "variation": Variation(2e-3), "lowest": Lowest("z")})
LIGHT = Clock(203, 5e-5, Euler(1))


def light(scenario=None, clock=None, record_every=1):
    """A rollout with little computation."""
    return rollout(SMOOTH, scenario or NOISY, clock or LIGHT, fold=LIGHT_FOLDS, record_every=record_every)


@pytest.fixture(scope="module")
def short():
    """A noisy tracking run and its metrics."""
    return rollout(REPAIRED, NOISY, SHORT, fold=METRICS)


@pytest.fixture(scope="module")
def lost():
    """The printed gains, with the same compiled rollout."""
    return rollout(LITERAL, NOISY, SHORT, fold=METRICS)


@pytest.fixture(scope="module")
def tracking():
    """The paper's tracking scenario, gains repaired."""
    return rollout(REPAIRED, TRACKING, Clock(20_000, 1e-4, AdaptiveRodas3()), fold=Metrics())


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def near(a, b, rtol, atol=0.0):
    """Check that all leaves agree, relative to the largest entry of each."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x, float), np.asarray(y, float)
        finite = np.isfinite(y)
        np.testing.assert_array_equal(x[~finite], y[~finite])
        size = np.max(np.abs(y[finite]), initial=0.0)
        np.testing.assert_allclose(x[finite], y[finite], rtol=0, atol=rtol * size + atol)


# --- rows ---


def test_rows_are_samples_at_whole_multiples_of_the_period(short):
    rows = short.trajectory.rows
    assert isinstance(rows, Row)
    assert all(np.shape(x) == (203,) for x in jax.tree.leaves(rows))
    np.testing.assert_array_equal(rows.t, np.arange(203) * 1e-4)
    assert rows.alive.dtype == rows.refused.dtype == bool
    assert all(x.dtype == np.float64 for x in jax.tree.leaves(rows._replace(alive=rows.t, refused=rows.t)))


def test_rows_are_consistent_with_the_plant_and_the_scenario(short):
    rows, plant = short.trajectory.rows, Plant()
    np.testing.assert_allclose(rows.v, plant.v(rows.z, rows.i), rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(rows.r, 2.5e-3 * np.sin(4 * np.pi * rows.t), rtol=1e-12, atol=1e-17)
    np.testing.assert_allclose(rows.heat, plant.copper_loss(rows.i), rtol=1e-12)
    np.testing.assert_array_equal(rows.e_z, rows.z - rows.r)
    np.testing.assert_array_equal(rows.e, rows.i - rows.i_ref)
    r_dot = 2.5e-3 * 4 * np.pi * np.cos(4 * np.pi * rows.t)
    np.testing.assert_allclose(rows.sigma, rows.z_dot - r_dot + 17 * rows.e_z, rtol=1e-9, atol=1e-14)
    # v_tilde is the controller's own: from the measured position
    np.testing.assert_allclose(rows.v_tilde, rows.v_star - plant.v(rows.z_measured, rows.i_ref), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("every", [7, 10, 500])
def test_every_nth_row_is_the_row_of_that_sample(every):
    # 203 = 29 * 7 divides, 10 leaves 3, 500 leaves all; the loops differ, so XLA may round differently: 1e-9
    dense, sparse = light(), light(record_every=every)
    near(sparse.trajectory.rows, jax.tree.map(lambda x: x[::every], dense.trajectory.rows), 1e-9)
    near(sparse.metrics, dense.metrics, 1e-9)


# --- members ---


def test_rows_carry_the_noise_of_their_sample(short):
    rows = short.trajectory.rows
    drawn = jax.jit(jax.vmap(lambda k: NOISY.sensor.noise(NOISY.words(), k).z))(jnp.arange(203))
    # z + w - z rounds at eps z = 5e-19
    np.testing.assert_allclose(rows.z_measured - rows.z, drawn, rtol=0, atol=1e-18)


def with_member(member, seed=0):
    return dataclasses.replace(NOISY, seed=jnp.asarray(seed), member=jnp.asarray(member))


def test_vmap_equals_the_loop_over_members():
    batch = jax.jit(jax.vmap(lambda m: light(with_member(m))))(jnp.arange(3))
    for m in range(3):
        alone = light(with_member(m))
        # the noise is the same to the last bit; the rest is compiled anew for vectors, which may fuse a product into
        # a sum and move last bits: 1e-16 grows in this loop (peak sensitivity 41) to 1e-12 at most
        near(jax.tree.map(lambda x, m=m: x[m], batch), alone, 1e-9)
        same(batch.trajectory.rows.t[m], alone.trajectory.rows.t)
    assert len({float(x) for x in batch.metrics["rms"]}) == 3


# --- the status of the rotor ---


def test_a_lost_rotor_is_frozen_and_finite(lost):
    rows, lost_at = lost.trajectory.rows, float(lost.trajectory.lost_at)
    assert 0 < lost_at < 0.02
    assert int(lost.trajectory.lost_code) == TOUCHED
    assert "touched down" in lost.trajectory.lost_why
    assert all(np.all(np.isfinite(x)) for x in rows)
    before, after = rows.t < lost_at, rows.t >= lost_at
    np.testing.assert_array_equal(rows.alive, before)
    assert after.sum() > 50
    for name in ("z", "z_dot", "i", "i_ref"):
        frozen = np.asarray(getattr(rows, name))[after]
        assert np.all(frozen == frozen[0]), name
    np.testing.assert_allclose(np.abs(rows.z[after]), 0.9 * 5e-3, rtol=1e-15)
    assert np.all(rows.z_dot[after] == 0)
    assert np.all(rows.u[after] == 0)
    assert np.all(rows.heat[after] == 0)
    assert np.all(np.abs(rows.z[before]) < 0.9 * 5e-3)


def test_a_rotor_that_starts_against_the_stop_is_lost_at_once():
    out = rollout(REPAIRED, dataclasses.replace(NOISY, initial=Initial(z=-4.6e-3)), SHORT, fold=METRICS)
    assert out.trajectory.lost_at == 0
    assert not np.any(out.trajectory.rows.alive)
    assert np.all(np.asarray(out.trajectory.rows.u) == 0)
    assert all(np.all(np.isfinite(x)) for x in out.trajectory.rows)
    assert out.metrics["lost"]


def test_a_state_outside_the_range_of_the_model_is_reported():
    out = rollout(REPAIRED, dataclasses.replace(NOISY, initial=Initial(i=1e5)), SHORT, fold=METRICS)
    assert int(out.trajectory.lost_code) == DIVERGED
    assert out.trajectory.lost_at == 0
    assert all(np.all(np.isfinite(x)) for x in out.trajectory.rows)


def test_the_clearance_moves_the_stop():
    # thrown at 2 m/s, it is there within a millisecond
    out = light(dataclasses.replace(NOISY, clearance=1e-3, initial=Initial(z_dot=-2.0))).trajectory
    assert out.lost_at < 1e-3
    np.testing.assert_allclose(out.rows.z[-1], -1e-3, rtol=1e-15)


# --- the paper's numbers ---


def test_repaired_tracking_meets_the_paper_s_claims(tracking):
    rows = tracking.trajectory.rows
    assert tracking.trajectory.lost_at == np.inf
    late = rows.t >= 0.5
    assert 2.2e-5 < np.max(np.abs(rows.e_z[late])) < 2.4e-5  # paper: 2.3e-5 m
    # paper: zero within 10 ms. Below 0.1 in 2.2 ms; then tan(pi/2 d/gamma)/p, 0.21 at the largest d = 6.6e4
    assert np.any(np.abs(rows.v_tilde[rows.t <= 5e-3]) < 0.1)
    assert np.all(np.abs(rows.v_tilde[rows.t >= 5e-3]) < 0.22)
    assert tracking.metrics["settled_rms_u_V"] < 70  # the reference alone requires L max|di_ref/dt|, 33 H * 2 A/s


def test_repaired_regulation_offset_in_the_pulse(tracking):
    # the same structure and numbers of the same type: the compiled tracking run is used again
    regulation = dataclasses.replace(TRACKING, reference=Sine(0.0, 2.0))
    out = rollout(REPAIRED, regulation, Clock(20_000, 1e-4, AdaptiveRodas3()), fold=Metrics()).trajectory
    at_stop = int(np.argmin(np.abs(np.asarray(out.rows.t) - 1.2999)))
    # at rest a q_v = k S(c z): z = tan(pi/2 a/k)/(c p) = 2.08e-5 m, up to a few time constants c
    steady = np.tan(np.pi / 2 * Plant().a / 25.0) / (17 * 25)
    np.testing.assert_allclose(steady, 2.08e-5, rtol=2e-3)
    np.testing.assert_allclose(out.rows.z[at_stop], 2.08e-5, rtol=0.01)


def test_the_supply_limits_the_voltage_that_is_applied(short):
    limited = rollout(REPAIRED, dataclasses.replace(NOISY, u_max=40.0), SHORT, fold=METRICS).trajectory
    assert np.max(np.abs(short.trajectory.rows.u)) > 40
    assert np.max(np.abs(limited.rows.u)) == 40


# --- errors at the boundary ---


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"cascade": Cascade(position=position.SlidingMode(c=np.array(-1.0)))}, r"controller\.position\.c"),
        ({"scenario": Scenario(plant=Plant(m=np.zeros(2)))}, r"scenario\.plant\.m"),
        ({"scenario": Scenario(reference=Sine(np.array(np.nan), 2.0))}, r"scenario\.reference\.amplitude"),
        ({"clock": Clock(0, 1e-4)}, r"clock\.samples"),
        ({"clock": Clock(10, np.array(-1e-4))}, r"clock\.sample_period"),
        ({"clock": Clock(10, 1e-4, RK4(1))}, r"clock\.dt"),
        ({"clock": Clock(10, 1e-4, Euler(4))}, r"clock\.dt"),
    ],
)
def test_bad_input_is_refused_with_its_path(change, path):
    given = {"cascade": REPAIRED, "scenario": TRACKING, "clock": Clock(10, 1e-4)} | change
    with pytest.raises(ValueError, match=path):
        rollout(**given)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Plant(m=0.0), r"^Plant\.m = 0: it must be a finite number from 1e-06 to 1e\+06 \(kg\)\.$"),
        (lambda: Plant(m="4"), r"^Plant\.m = '4': it must be"),
        (lambda: Plant(m=True), r"^Plant\.m = True: it must be"),
        (lambda: Plant(m=["4", 1.0]), r"^Plant\.m = \['4', 1\.0\]: it must be"),
        (lambda: dataclasses.replace(Plant(), n=np.float32(-1.0)), r"^Plant\.n = .*-1.*: it must be"),
        (lambda: Scenario(u_max=None), r"^Scenario\.u_max = None: it must be"),
        (lambda: Sine(np.nan, 2.0), r"^Sine\.amplitude = nan: it must be"),
        (lambda: Processor(implicit="explicit"), r"^Processor\.implicit = 'explicit': it must be True or False\.$"),
        (lambda: Processor(predict="no"), r"^Processor\.predict = 'no': it must be True or False or None\.$"),
        (lambda: Sensor(velocity="no"), r"^Sensor\.velocity = 'no': it must be True or False\.$"),
        (lambda: CoilLimits(unidirectional=1), r"^CoilLimits\.unidirectional = 1: it must be True or False\.$"),
        (lambda: Dropouts(value="foo"), r"^Dropouts\.value = 'foo': it must be one of 'hold', 'nan', 'zero', "),
        (lambda: Processor(guard=3), r"^Processor\.guard = 3: it must be a record of type Guard or None\.$"),
        (lambda: Sum(Sine(1.0, 2.0)), r"^Sum\.terms = Sine\(.*: it must be a tuple\.$"),
        (lambda: Recorded(3), r"^Recorded\.samples = 3: it must be a record of type Samples\.$"),
    ],
)
def test_a_record_refuses_a_value_that_a_field_does_not_allow(build, message):
    with pytest.raises(ValueError, match=message):
        build()


# --- float32 ---

IN_FLOAT32 = """
import sys
import numpy as np
from ambjax import *
from ambjax.laws import *
from ambjax.plants import *
from ambjax.sensors import *
from ambjax.signals import *
from ambjax.solvers import *
tracking = Scenario(reference=Sine(2.5e-3, 2.0), q_v=Pulse(1.0, 0.8, 1.3))
smooth = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
out = {}
for name, cascade, method in (("repaired", Cascade(), AdaptiveRodas3()), ("smooth", smooth, RK4(4))):
    trajectory = rollout(cascade, tracking, Clock(20_000, 1e-4, method), record_every=10).trajectory
    assert trajectory.rows.z.dtype == np.float32
    assert trajectory.lost_at == np.inf
    out[name] = np.asarray(trajectory.rows.z)
np.savez(sys.argv[1], **out)
"""


@pytest.mark.slow
def test_float32_is_within_20_nm_of_float64(tracking, tmp_path):
    path = tmp_path / "single.npz"
    env = os.environ | {"JAX_ENABLE_X64": "0"}
    subprocess.run([sys.executable, "-c", IN_FLOAT32, str(path)], cwd=ROOT, env=env, check=True)
    smooth = rollout(SMOOTH, TRACKING, Clock(20_000, 1e-4, RK4(4)), record_every=10).trajectory
    # measured: 0.96e-8 m repaired, 1.04e-8 m smooth, of 2.5e-3 m: t = 2 s is rounded to 6e-8 s, and r moves at 31 mm/s
    with np.load(path) as single:
        assert np.max(np.abs(single["repaired"] - tracking.trajectory.rows.z[::10])) < 2e-8
        assert np.max(np.abs(single["smooth"] - smooth.rows.z)) < 2e-8


# --- the fast path ---


def end_of(c):
    """Return a number at the end of the light rollout as a function of one gain."""
    cascade = dataclasses.replace(SMOOTH, position=position.SlidingMode(c=c))
    return rollout(cascade, NOISY, LIGHT, fold=LIGHT_FOLDS, record_every=0).metrics["rms"]


FAST = {
    "plain": lambda: end_of(17.0),
    "constant inside jit": lambda: jax.jit(lambda: end_of(17.0))(),
    "jvp": lambda: jax.jvp(end_of, (17.0,), (1.0,)),
    "kernel of vmap": lambda: one_kernel(jax.vmap(end_of))(jnp.array([15.0, 17.0, 20.0])),
}


@pytest.mark.parametrize("result", FAST.values(), ids=FAST)
def test_the_fast_path_changes_nothing(result, monkeypatch):
    if fast_path.options() is None:
        pytest.skip("the fast path is not supported here")
    fast = result()
    monkeypatch.setattr(fast_path, "options", lambda: None)
    # the same operations, fused differently: relative to the largest entry
    near(fast, result(), 1e-12)
