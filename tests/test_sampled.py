"""The loop on a processor against an independent simulator, which shares no code with ambjax."""

import dataclasses
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough
from sampled_oracle import World, simulate
from test_oracle import adaptive, current, noise_of, pulse, sine, smc, smoothstep, twisting

import ambjax as amb
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.scenario_tables import SIGNALS
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble
from ambjax.linear import loop_matrices
from ambjax.simulation.integrate import Begin
from ambjax.simulation.rollout import prepare
from ambjax.simulation.system import system_of
from ambjax.simulation.trajectory import DIVERGED
from ambjax.solvers import RK4
from ambjax.world.amplifier import Amplifier
from ambjax.world.plant import TwoCoil

INF = math.inf


@dataclass(frozen=True)
class Case:
    name: str
    world: World
    samples: int = 2000
    std: tuple = (0.0, 0.0, 0.0)


def hard(c=200.0, k=25.0, gamma=2e6, k_i=2000.0):
    """Laws with set-valued signs, and gains that hold the rotor at 10 kHz."""
    return {"position": smc(c, k, INF), "inversion": adaptive(gamma, INF), "current": current(k_i, INF)}


def soft(gamma=2e5):
    return {"inversion": adaptive(gamma)}


TRACKING = {"reference": sine(), "q_v": pulse(1.0, 0.1, 0.15)}
SHIFTED = {"reference": sine(), "q_v": pulse(1.0, 0.10003, 0.15007)}  # its edges between samples
# Stepped explicitly, a sign turns over from sample to sample where its slope times the period is above 2: chaos, in
# which two programs part whatever they agree on. So these run fast, and are softer.
EXPLICIT = {
    "reference": sine(),
    "q_v": pulse(1.0, 0.02, 0.04),
    "inversion": adaptive(7.5e4, 2.0),
    "discretisation": "explicit",
    "period": 1e-5,
}
EARLY = {"reference": sine(), "q_v": pulse(1.0, 0.02001, 0.04003)}
NOISE = (1e-6, 1e-4, 1e-4)
CLOSED = {"inversion": ("closed-form", {})}
SLOW = ("complementary", {"l": 5.0})
DIFFERENCE, KALMAN, IRED2 = ("difference", {"w": 2000.0}), ("kalman", {"w": 800.0}), ("ired-2", {"L": 3e4})
PI = ("pi", {"k_p": 3e5, "k_int": 1e8, "k_aw": 200.0})
WRONG = {"m": 0.65, "R": 45.0, "n": 1400.0}
CASES = [
    Case(
        "edges between samples", World(**SHIFTED, q_i=pulse(0.5, 0.03004, 0.10008), initial=(2e-5, 0.0, 0.0), **soft())
    ),
    Case("half a sample", World(**TRACKING, delay=0.5, **soft())),
    Case("two samples", World(**TRACKING, delay=2.0, **soft())),
    Case("explicit", World(**EXPLICIT), 4500),
    Case("the sign itself, noise", World(**TRACKING, u_max=2e3, **hard(k_i=500.0)), std=NOISE),
    Case("wrong model", World(**TRACKING, model=WRONG, **soft())),
    Case("supply of 70 V", World(**TRACKING, u_max=70.0, **soft())),
    Case("PI", World(current=PI, u_max=300.0, reference=smoothstep(1e-3, 0.02, 0.1), **soft())),
    Case("super-twisting, the sign itself", World(**TRACKING, position=twisting(k_1=10.0, p=INF), **soft())),
    Case("two coils", World(kind="two-coil", **TRACKING, **soft())),
    Case("two coils, current pulse", World(kind="two-coil", q_i=pulse(1.0, 0.05002, 0.1), **hard()), std=NOISE),
    # Within a step of the converter nothing holds two programs together: they part at the rate of the unstable pole.
    Case("12 bits", World(**TRACKING, observer=SLOW, u_max=200.0, bits=12, **soft()), 250, (3e-6, 0.0, 1e-4)),
    Case("a real position sensor", World(**SHIFTED, bandwidth=5e3, offset=2e-6, gain=1.01, delay=1.5, **soft())),
    Case("a real amplifier", World(**EARLY, amplifier={"bandwidth": 2e3, "slew": 1e5}, delay=0.5, **soft()), 600),
    Case("dead band", World(kind="two-coil", **TRACKING, amplifier={"dead_band": 2.0}, **soft())),
    Case("difference", World(**TRACKING, observer=DIFFERENCE, **soft())),
    Case("Kalman under noise", World(**TRACKING, observer=KALMAN, u_max=2e3, **hard(k_i=500.0)), std=NOISE),
    Case("IRED of order 1 under noise", World(observer=("ired-1", {"L": 50.0}), u_max=300.0, **soft()), std=NOISE),
    # under more noise, or on less voltage, its loop is chaotic: rounding grows tenfold in 70 samples
    Case("IRED of order 2 under noise", World(**TRACKING, observer=IRED2, u_max=3e3, **soft()), 300, (1e-7, 0.0, 1e-4)),
    Case("closed form, no delay, 400 V", World(reference=sine(), **hard() | CLOSED, delay=0.0, u_max=400.0), 600),
    Case("closed form, explicit", World(**EXPLICIT | CLOSED), 2000),
]
# The fast tests; each law, part and delay stands in a case of the fast or slow tests.
FAST = {"explicit", "a real position sensor", "Kalman under noise", "closed form, explicit"}


def record_of(kinds, given, *more):
    kind, numbers = given
    return kinds[kind](*more, **numbers)


def sensor_of(world, std):
    names = ("offset", "gain", "bandwidth", "bits")
    given = {name: getattr(world, name) for name in names if getattr(world, name) != getattr(World, name)}
    if world.observer[0] not in ("direct", "complementary"):
        given["velocity"] = False
    return amb.sensors.Sensor(*std, **given) if any(std) or given else None


def loop_of(world, samples, std):
    """Return the same scenario as objects of ambjax."""
    laws = {stage: record_of(kinds, getattr(world, stage)) for stage, kinds in KINDS.items()}
    plant = {"lumped": amb.plants.Plant, "two-coil": TwoCoil}[world.kind](**world.plant)
    model = amb.plants.Plant(**(world.plant | world.model))
    processor = Processor(world.delay, world.discretisation == "implicit", world.predict)
    signals = {name: record_of(SIGNALS, getattr(world, name)) for name in ("reference", "q_z", "q_v", "q_i")}
    scenario = amb.Scenario(
        plant=plant,
        initial=amb.Initial(*world.initial),
        sensor=sensor_of(world, std),
        amplifier=Amplifier(**world.amplifier) if world.amplifier else None,
        u_max=world.u_max,
        seed=5,
        **signals,
    )
    return amb.Cascade(**laws, model=model, processor=processor), scenario, amb.Clock(samples, world.period)


def how_slow(name):
    return () if name in FAST else pytest.mark.slow


# The plant's integration is what differs: DOP853 at 1e-12 against the package's RK4.
@pytest.mark.parametrize("case", [pytest.param(case, id=case.name, marks=how_slow(case.name)) for case in CASES])
def test_sampled_loops_agree_with_the_independent_simulator(case):
    cascade, scenario, clock = loop_of(case.world, case.samples, case.std)
    rows = amb.rollout(cascade, scenario, clock).trajectory.rows
    run = simulate(case.world, case.samples, noise_of(scenario, case.samples))
    assert np.isinf(run.lost_at), run.lost_at
    assert np.asarray(rows.alive).all()
    np.testing.assert_allclose(rows.z, run.z, rtol=0, atol=1e-10)
    np.testing.assert_allclose(rows.i_ref, run.i_ref, rtol=0, atol=1e-9)
    largest = np.abs(run.u).max()
    np.testing.assert_allclose(rows.u, run.u, rtol=0, atol=1e-6 * largest)


def loop_with(c, k, gamma, k_i, p, **processor):
    return amb.Cascade(
        position=amb.laws.position.SlidingMode(c, k, p),
        inversion=amb.laws.inversion.Adaptive(gamma, p),
        current=amb.laws.current.SlidingMode(k_i, p),
        processor=Processor(**processor),
    )


def cascade_of(p=INF, **processor):
    """Gains that hold the rotor at 10 kHz with a sample of delay, under noise and on 200 V."""
    return loop_with(1440.0, 2.3, 8e5, 870.0, p, **processor)


@pytest.mark.parametrize("wrong", [{}, pytest.param({"predict": False, "model": WRONG}, marks=pytest.mark.slow)])
def test_a_delay_of_several_samples_agrees_with_the_independent_simulator(wrong):
    world = World(reference=sine(), q_v=pulse(1.0, 0.01, 0.015), delay=3.4, **soft(), **wrong)
    cascade, scenario, clock = loop_of(world, 300, (0.0, 0.0, 0.0))
    rows, run = amb.rollout(cascade, scenario, clock).trajectory.rows, simulate(world, 300)
    np.testing.assert_allclose(rows.z, run.z, rtol=0, atol=1e-12)
    np.testing.assert_allclose(rows.u, run.u, rtol=0, atol=1e-8 * np.abs(run.u).max())


NOISY = amb.Scenario(reference=amb.signals.Sine(2.5e-3, 2.0), sensor=amb.sensors.Sensor(*NOISE), u_max=200.0, seed=3)
SHORT = amb.Clock(300, 1e-4)


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 1.6, pytest.param(5.3, marks=pytest.mark.slow)])
def test_the_voltage_of_a_sample_acts_after_the_delay(delay):
    """u averaged over time is u_n shifted by the delay, and 0 before the first command."""
    outcome = amb.rollout(cascade_of(delay=delay), NOISY, SHORT)
    u, mean = (np.asarray(getattr(outcome.trajectory.rows, name)) for name in ("u", "u_mean"))
    acting = np.concatenate([np.zeros(math.floor(delay) + 1), u])
    share = delay % 1
    expected = share * acting[: len(u)] + (1 - share) * acting[1 : len(u) + 1]
    # a sum of two products in another order
    np.testing.assert_allclose(mean, expected, atol=1e-12 * 200)


@pytest.mark.slow
@pytest.mark.parametrize(
    "inversion",
    [amb.laws.inversion.Adaptive(8e5, INF), thorough(amb.laws.inversion.ClosedForm())],
    ids=lambda law: type(law).__name__,
)
def test_a_member_equals_its_rollout_for_any_delays_of_the_others(inversion):
    delays = np.array([0.0, 0.5, 2.0])
    scenario = dataclasses.replace(NOISY, member=np.arange(3))
    cascade = dataclasses.replace(cascade_of(delay=delays), inversion=inversion)
    fold = amb.simulation.folds.Rms("e_z")
    together = run_ensemble(cascade, scenario, SHORT, fold=fold).metrics
    for member, delay in enumerate(delays):
        one = dataclasses.replace(NOISY, member=member)
        cascade = dataclasses.replace(cascade_of(delay=delay, predict=True), inversion=inversion)
        alone = amb.rollout(cascade, one, SHORT, fold=fold).metrics
        # a sample is integrated in two parts, one of them empty, instead of in one: rounding
        np.testing.assert_allclose(together[member], alone, rtol=1e-9)


def test_a_part_of_an_ensemble_uses_the_program_of_the_whole():
    """This holds also if all delays of the part are whole numbers.

    Otherwise results would depend on the division of an ensemble.
    """
    spread = cascade_of(delay=0.0).on_processor(0.5, 2.0)
    for delay in (0.0, 1.0, np.array([0.0, 0.7])):
        part = spread.with_processor(delay=delay)
        processor = part.on_processor().processor
        assert (processor.whole, processor.most, processor.predicts) == (False, 2, True)
    alone = cascade_of(delay=0.0).on_processor().processor
    assert (alone.whole, alone.most, alone.predicts) == (True, 0, False)


DELAYS = np.array([1.0, 0.0, 1.5, 2.0, 3.0, -1.0])


@pytest.mark.parametrize("between", [False, True])
def test_a_traced_delay_that_the_program_does_not_support_makes_the_start_nan(between):
    prepared = amb.Cascade(processor=Processor(1.0)).on_processor(*[2.0] * between, between=between)
    scenario = amb.Scenario(initial=amb.Initial(z=1e-5))

    def start(delay):
        cascade = amb.with_gains(prepared, {"processor.delay": delay})
        return prepare(cascade, scenario, SHORT.with_method(RK4(1)))[0].loop.scenario.initial.z

    expected = np.where([True, True, between, between, False, False], 1e-5, np.nan)
    np.testing.assert_array_equal(jax.vmap(start)(DELAYS), expected)


@pytest.mark.slow
def test_a_traced_delay_that_the_program_does_not_support_gives_nan():
    prepared = amb.Cascade(processor=Processor(1.0)).on_processor()
    scenario, clock = amb.Scenario(initial=amb.Initial(z=1e-5)), amb.Clock(5, 1e-4, RK4(1))

    def cascade(delay):
        return amb.with_gains(prepared, {"processor.delay": delay})

    def z(delay):
        return amb.rollout(cascade(delay), scenario, clock).trajectory.rows.z[-1]

    found = jax.jit(jax.vmap(lambda delay: loop_matrices(cascade(delay), scenario, clock.sample_period, 0.0)[1]))(
        DELAYS
    )
    alone = [z(delay) for delay in DELAYS[:2]]
    np.testing.assert_allclose(jax.jit(jax.vmap(z))(DELAYS), [*alone, *[np.nan] * 4], rtol=1e-9)
    np.testing.assert_array_equal(found, [True, True, False, False, False, False])


@pytest.mark.parametrize("delay", ["a", np.nan, -1.0, 50.0])
def test_a_delay_out_of_range_is_refused(delay):
    with pytest.raises(ValueError, match=r"^delay = .*: it must be a finite number from 0 to 10 "):
        amb.Cascade(processor=Processor(1.0)).on_processor(delay, 2.0)


def test_a_delay_that_is_set_later_is_predicted():
    """An example is a map over the delay of a case without delay."""
    none = cascade_of(delay=0.0).on_processor()
    late = dataclasses.replace(none, processor=dataclasses.replace(none.processor, delay=1.0))
    fold = amb.simulation.folds.Rms("e_z")
    found, expected = (
        amb.rollout(c, NOISY, SHORT, fold=fold, record_every=0).metrics for c in (late, cascade_of(delay=1.0))
    )
    assert found == expected


def test_a_lost_rotor_is_frozen_with_its_drive_off():
    cascade = dataclasses.replace(cascade_of(25.0), inversion=amb.laws.inversion.Adaptive(1000.0))
    trajectory = amb.rollout(cascade, NOISY, SHORT).trajectory
    assert 0 < trajectory.lost_at < 0.03
    after = jax.tree.map(lambda x: np.asarray(x)[trajectory.rows.t > trajectory.lost_at], trajectory.rows)
    assert np.ptp([after.z, after.i, after.i_ref], axis=1).max() == 0  # NaN is not 0
    assert not after.u.any()


def test_a_divergent_loop_is_a_loss_with_finite_values():
    scenario = dataclasses.replace(NOISY, initial=amb.Initial(1e-3), u_max=math.inf)
    wild = dataclasses.replace(cascade_of(), current=amb.laws.current.ProportionalIntegral(1e30, 1e30, 1e30))
    trajectory = amb.rollout(wild, scenario, amb.Clock(20, 1e-4)).trajectory
    assert np.isfinite(trajectory.lost_at)
    for name, signal in trajectory.rows._asdict().items():
        assert np.isfinite(np.asarray(signal, float)).all(), name


def test_a_large_gain_of_a_set_valued_sign_does_not_change_the_run():
    """An implicit step uses only the share of the gain that the error requires: 1e6 and 1e30 A/s give the same run."""
    scenario = dataclasses.replace(NOISY, u_max=math.inf)
    runs = [
        amb.rollout(dataclasses.replace(cascade_of(), current=amb.laws.current.SlidingMode(k_i, INF)), scenario, SHORT)
        for k_i in (1e6, 1e30)
    ]
    z = [np.asarray(run.trajectory.rows.z) for run in runs]
    np.testing.assert_allclose(*z, rtol=0, atol=1e-15)


def test_a_law_whose_result_is_not_finite_keeps_its_state_and_ends_the_run():
    system = system_of(cascade_of(), NOISY, SHORT).realised()
    start = system.start()
    lost = start._replace(plant=start.plant._replace(i=jnp.asarray(jnp.inf)))
    after = system.jump(0.0, lost, system.sensor_errors(0))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((after.control, after.command)))
    ended = system.advance(RK4(1), system.sensor_errors(0), Begin(0.0, after, (), jnp.asarray(0)), 1e-4)
    assert ended.code == DIVERGED


@pytest.mark.slow
@pytest.mark.parametrize("implicit", [True, False])
def test_the_sampled_loop_converges_to_the_continuous_one(implicit):
    """The order in the period is 1, without delay and noise, and with smooth signs.

    All periods have the same number of samples, and so the same program. The errors are those of the first 25 ms.
    """
    laws = {"inversion": amb.laws.inversion.Adaptive(7.5e4, 0.5)}
    scenario = amb.Scenario(reference=amb.signals.Sine(1e-3, 2.0), initial=amb.Initial(1e-5))
    clock = amb.Clock(25, 1e-3, amb.solvers.AdaptiveRodas3(1e-9))
    exact = amb.rollout(amb.Cascade(**laws), scenario, clock).trajectory.rows.z
    errors = []
    for divisor in (20, 40, 80):
        cascade = amb.Cascade(**laws, processor=Processor(0.0, implicit))
        rows = amb.rollout(cascade, scenario, amb.Clock(25 * 80, 1e-3 / divisor)).trajectory.rows
        errors.append(np.abs(np.asarray(rows.z)[::divisor][:25] - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 0.8) & (orders < 1.3)).all(), (errors, orders)


def test_a_set_valued_sign_is_refused_in_continuous_time():
    hard_sign = amb.Cascade(position=amb.laws.position.SlidingMode(17.0, 25.0, INF))
    with pytest.raises(ValueError, match=r"controller.position.p = inf: in continuous time a sign must be smoothed"):
        amb.rollout(hard_sign, NOISY, SHORT)
    mixed = dataclasses.replace(cascade_of(), current=amb.laws.current.SlidingMode(870.0, np.array([25.0, INF])))
    with pytest.raises(ValueError, match="inf for some members"):
        run_ensemble(mixed, dataclasses.replace(NOISY, member=np.arange(2)), SHORT, fold=None)


def test_a_traced_delay_is_refused_if_its_program_is_not_chosen():
    def run(delay):
        return amb.rollout(cascade_of(delay=delay), NOISY, amb.Clock(3, 1e-4, RK4(1))).trajectory.lost_at

    with pytest.raises(ValueError, match=r"processor\.delay is traced"):
        jax.jit(run)(0.5)
