"""The guard and the faults of a position sensor: refused readings, survival of faults, and their random numbers."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough
from sampled_oracle import simulate
from test_oracle import noise_of
from test_sampled import DIFFERENCE, KALMAN, NOISE, TRACKING, World, hard, loop_of, soft

import ambjax as amb
from ambjax.cases.reader import case_from
from ambjax.control.guard import Guard
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble
from ambjax.simulation.folds import Count, Named, Rms
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.system import guarded, system_of
from ambjax.world.faults import VALUES, Dropouts, Outliers
from ambjax.world.sensor import Errors, Measurement, Sensor
from ambjax.world.waveforms import reference_at

T = 1e-4
CLOCK = amb.Clock(160, T, amb.solvers.RK4(3))
SHARES = np.concatenate([[0.98, 1.2, 1.5, 1.98], [-1.2, -1.5, -1.98]])


def struck(guard=Guard(), observer=None, **faults):
    """Return a case with a faulty sensor: the gains of docs/export.md, or gains for a Kalman filter."""
    laws = amb.laws.position.SlidingMode(1440.0, 2.307, math.inf), amb.laws.inversion.Adaptive(7.97e5, math.inf)
    laws = observer or amb.laws.observer.Direct(), *laws, amb.laws.current.SlidingMode(870.6, math.inf)
    cascade = amb.Cascade(*laws, processor=Processor(guard=guard))
    sensor = Sensor(*NOISE, velocity=observer is None, **faults)
    return cascade, amb.Scenario(reference=amb.signals.Sine(2.5e-3, 2.0), sensor=sensor, u_max=200.0, seed=3)


KALMAN_OBSERVER = thorough(amb.laws.observer.Kalman(500.0), id="Kalman")


@pytest.mark.slow
@pytest.mark.parametrize("observer", [pytest.param(None, id="direct"), KALMAN_OBSERVER])
def test_one_impossible_reading_is_refused_and_the_rotor_is_held(observer):
    """Outliers of both signs at several samples; without a guard, the same readings lose rotors."""
    found = {}
    for guard in (Guard(), None):
        at = T * (60 + np.arange(SHARES.size))
        cascade, scenario = struck(guard, observer, outliers=Outliers(0.0, np.abs(SHARES) * 5e-3, at))
        fold = Metrics.of(0.0, scenario)
        many = dataclasses.replace(scenario, member=np.arange(SHARES.size))
        found[guard is None] = run_ensemble(cascade, many, CLOCK, fold=fold).metrics
    assert found[True]["lost"].sum() > SHARES.size / 2
    assert not found[False]["lost"].any()
    np.testing.assert_array_equal(found[False]["refused"], 1.0)
    assert not found[True]["refused"].any()
    # the error is at most that of the transient to the reference
    assert found[False]["max_abs_error_m"].max() < 6e-5


WORLDS = {
    "delay 1": World(**TRACKING),
    "the sign itself, one and a half, noise": World(**TRACKING, delay=1.5, u_max=2e3, **hard(k_i=500.0)),
    "Kalman, half a sample": World(**TRACKING, observer=KALMAN, delay=0.5, **soft()),
    "difference, no delay": World(**TRACKING, observer=DIFFERENCE, delay=0.0, **soft()),
}
REPEATED = ("the sign itself, one and a half, noise", "difference, no delay")
EACH_WORLD = [pytest.param(x, marks=pytest.mark.thorough if x in REPEATED else ()) for x in WORLDS]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_WORLD)
def test_guard_and_faults_agree_with_the_independent_simulator(name):
    """The faults are an outlier, a short dropout, and a dropout that lasts until the safe command."""
    std = NOISE if "noise" in name else (0.0, 0.0, 0.0)
    dropouts = {"value": "nan", "duration": 5 * T, "at": 0.012}
    cascade, scenario, clock = loop_of(WORLDS[name], 200, std)
    sensor = scenario.sensor or Sensor()
    for samples, value in ((3.0, "nan"), (8.0, "full-scale")):
        faults = {"outliers": Outliers(at=0.006, size=9.9e-3), "dropouts": Dropouts(**(dropouts | {"value": value}))}
        world = dataclasses.replace(scenario, sensor=dataclasses.replace(sensor, **faults))
        guard = guarded(cascade, world, T).processor.guard
        guard = dataclasses.replace(guard, samples=samples)
        own = dataclasses.replace(cascade, processor=dataclasses.replace(cascade.processor, guard=guard))
        fold = Count("refused")
        rows, measured = (lambda x: (x.trajectory.rows, x.metrics))(amb.rollout(own, world, clock, fold=fold))
        words, read = world.words(), {"nan": math.nan, "full-scale": 5e-3}[value]
        outlier = float(world.sensor.fault_onsets(words, 60, T).outlier)
        assert abs(outlier) == 9.9e-3
        given = dataclasses.replace(
            WORLDS[name], guard={f.name: float(getattr(guard, f.name)) for f in dataclasses.fields(guard)},
            outliers={60: outlier}, dropouts=dict.fromkeys(range(120, 125), read),
        )  # fmt: skip
        run = simulate(given, 200, noise_of(world, 200))
        assert np.isinf(run.lost_at)
        assert measured == 6
        assert np.sum(np.asarray(rows.u)[120:125] == 0) == (2 if samples == 3 else 0)
        np.testing.assert_allclose(rows.z, run.z, rtol=0, atol=1e-10)
        np.testing.assert_allclose(rows.u, run.u, rtol=0, atol=1e-6 * np.abs(run.u).max())


@pytest.mark.parametrize("delay", [0.0, 0.5, 1.0, 1.5, 2.0, 3.4])
def test_the_expected_current_uses_the_voltages_that_act_within_the_sample(delay):
    """Eq. (2), written out, under the mean of the voltages that act: u_n after the delay, before it earlier ones."""
    cascade, scenario, clock = loop_of(World(**TRACKING, delay=delay, **soft()), 5, (0.0, 0.0, 0.0))
    cascade = dataclasses.replace(cascade, processor=dataclasses.replace(cascade.processor, guard=Guard()))
    system = system_of(guarded(cascade, scenario, T), scenario, clock).realised()
    state = system.start()
    last, *earlier = [7.0, -3.0, 5.0, 2.0, 11.0][: 1 + len(state.past)]
    state = state._replace(command=state.command._replace(u=jnp.asarray(last)), past=tuple(map(jnp.asarray, earlier)))
    z, z_dot, i = 1e-4, 0.01, 0.2
    measured = Measurement(*map(jnp.asarray, (z, z_dot, i)))
    after = system.with_command(measured, reference_at(scenario.reference, 0.0), state)
    u = float(after.command.u)
    mean = np.interp(delay, np.arange(2 + len(earlier)), [u, last, *earlier])
    plant = scenario.plant
    gap = plant.s_0 + z
    rate = 2 * z_dot * i / gap + 2 * gap * (mean - plant.R * i) / plant.kappa
    assert float(after.watch.expected.i) == pytest.approx(i + T * rate, rel=1e-12)


def test_default_limits_accept_every_reading_of_a_sensor_without_faults():
    rng = np.random.default_rng(2)
    for _ in range(200):
        bits, std = float(rng.integers(6, 20)), 10 ** rng.uniform(-8, -4)
        sensor = Sensor(std, gain=rng.uniform(0.8, 1.2), offset=rng.normal() * 1e-5, bits=bits, range_z=1e-2)
        scenario = amb.Scenario(sensor=sensor)
        guard = Guard().with_limits(amb.plants.Plant(), scenario, T, True)
        ends = [
            float(sensor.converted(sensor.reading(Measurement(z, 0.0, 0.0), Errors(e, 0.0, 0.0)), 5e-3, 0.25).z)
            for z in (-4.5e-3, 4.5e-3)
            for e in (-6.8 * std, 6.8 * std)
        ]
        assert np.abs(ends).max() <= guard.z
        high = sensor.converted(Measurement(0.0, 0.0, 1e3), 5e-3, 0.25).i
        assert float(high) < float(guard.i) <= 1.2 * 2 * 0.25  # a range of two bias currents
        assert max(ends[1] - ends[0], ends[3] - ends[2]) <= guard.noise * (1 + 1e-9)


def test_the_laws_start_at_the_first_accepted_reading():
    cascade, scenario = struck(dropouts=Dropouts(at=0.0, duration=3 * T, value="nan"))
    scenario = dataclasses.replace(scenario, initial=amb.Initial(1e-4))
    rows = amb.rollout(cascade, scenario, CLOCK).trajectory.rows
    np.testing.assert_array_equal(rows.u[:3], 0.0)
    assert rows.u[3] != 0
    assert np.asarray(rows.refused).nonzero()[0].tolist() == [0, 1, 2]
    assert np.asarray(rows.alive).all()


def test_faults_depend_on_the_member_and_the_sample_only():
    """Rates within 5 standard deviations of a binomial; both signs; one at a given time; no effect of other members."""
    sensor = Sensor(outliers=Outliers(500.0, 1e-3, 0.0205), dropouts=Dropouts(200.0, 3e-4, 0.0305))
    _, scenario = struck()
    draw = jax.jit(jax.vmap(lambda n: sensor.fault_onsets(scenario.words(), n, T)))
    outlier, drops = (np.asarray(x) for x in draw(jnp.arange(100_000)))
    for hits, rate in ((outlier != 0, 0.05), (outlier > 0, 0.025), (drops, 0.02)):
        assert abs(hits.mean() - rate) < 5 * math.sqrt(rate / 1e5)
    assert outlier[205] != 0
    assert drops[305]
    assert not np.any(np.asarray(draw(jnp.arange(10_000)).drops) != drops[:10_000])
    cascade, scenario = struck(outliers=Outliers(500.0, 9e-3), dropouts=Dropouts(200.0, 3e-4, value="nan"))
    fold = Named({"refused": Count("refused"), "rms": Rms("z_measured")})
    many = dataclasses.replace(scenario, member=np.arange(5))
    together = run_ensemble(cascade, many, CLOCK, fold=fold, threads=1).metrics
    alone = amb.rollout(cascade, dataclasses.replace(scenario, member=3), CLOCK, fold=fold, record_every=0).metrics
    assert together["refused"][3] == alone["refused"] > 5
    np.testing.assert_allclose(together["rms"][3], alone["rms"], rtol=1e-9)
    assert len(set(together["refused"])) > 1


@pytest.mark.parametrize("value", VALUES)
def test_the_readings_during_a_dropout(value):
    cascade, scenario = struck(dropouts=Dropouts(at=5e-3, duration=4.4e-4, value=value))
    rows = amb.rollout(cascade, scenario, CLOCK).trajectory.rows
    seen, hold = np.asarray(rows.z_measured), np.asarray(rows.z_measured)[49]
    read = {"hold": hold, "nan": 0.0, "zero": 0.0, "full-scale": 5e-3}[value]
    np.testing.assert_array_equal(seen[50:54], read)
    assert not np.any(np.delete(seen, np.s_[49:54]) == read)
    assert np.asarray(rows.alive).all()
    # the reading 0 is wrong by 157 um; a held reading is plausible
    assert np.asarray(rows.refused)[50:54].all() == (value != "hold")


CASE = {"processor": {}, "clock": {"duration": 0.01}, "sensor": {"outliers": {"rate": 3.0}}}


def test_a_case_file_sets_guard_and_faults():
    case = case_from(CASE | {"processor": {"guard": {"z": 4e-3, "samples": 7}}})
    assert case.cascade.processor.guard == Guard(z=4e-3, samples=7.0)
    assert case.scenario.sensor.outliers == Outliers(rate=3.0)
    assert case.scenario.random
    assert case_from(CASE).cascade.processor.guard == Guard()
    assert case_from(CASE | {"processor": {"guard": False}}).cascade.processor.guard is None
    spread = case_from(CASE | {"spread": {"sensor.outliers.size": {"uniform": [1e-3, 9e-3]}}}).spread
    assert spread.paths == ("sensor.outliers.size",)
    faults = {"dropouts": {"value": "nan", "at": 1e-3}}
    assert case_from(CASE | {"sensor": faults}).scenario.sensor.dropouts == Dropouts(at=1e-3, value="nan")


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({"sensor": {"outliers": {"rate": 1.0}}}, r"sensor\.outliers is for a controller on a processor"),
        ({"sensor": {"dropouts": {}}}, r"sensor\.dropouts is for a controller on a processor"),
        (CASE | {"sensor": {"dropouts": {"value": "none"}}}, r"sensor\.dropouts\.value = .*'hold', 'nan', 'zero'"),
        (CASE | {"sensor": {"outliers": {"rate": -1.0}}}, r"sensor\.outliers\.rate = -1"),
        (CASE | {"sensor": {"outliers": {"sise": 1.0}}}, r"Did you mean 'size'"),
        (CASE | {"processor": {"guard": {"samples": 0}}}, r"processor\.guard\.samples = 0: it must be a whole number"),
        (CASE | {"processor": {"guard": 3}}, r"processor\.guard = 3: it must be a table"),
    ],
)
def test_bad_guards_and_faults_are_refused(raw, message):
    with pytest.raises(ValueError, match=message):
        case_from(raw)
