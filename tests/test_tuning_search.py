"""The tuner's gradients in three ways, and its search: no recompilation, equal results if resumed, and [tune]."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from texts import case_and_tune

from ambjax import Cascade, Clock, Initial, Scenario, rollout
from ambjax.ensemble import Percent, Spread
from ambjax.laws import inversion
from ambjax.sensors import Sensor
from ambjax.signals import Sine
from ambjax.solvers import Slide
from tuning.problem.goal import CVaR, Goal
from tuning.problem.lanes import Engine
from tuning.problem.loss import TERMS, loss_for, weigh
from tuning.problem.members import Objective
from tuning.problem.ranges import initial_points, ranges
from tuning.problem.space import Gain, Space
from tuning.problem.tuning_problem import problem_of
from tuning.solve.checkpoint import CheckpointFile
from tuning.solve.descent import JUMP, begin, continued, step
from tuning.solve.refine import best_of, screen, search

PATHS = ("position.c", "position.k", "inversion.gamma", "current.k_i")
SPACE = Space(tuple(Gain(f"controller.{path}", 0.0, 1e9) for path in PATHS))
CASCADE = Cascade(inversion=inversion.Adaptive(5e5, 25.0))
SCENARIO = Scenario(
    reference=Sine(2.5e-3, 2.0), sensor=Sensor(1e-6, 1e-4, 1e-4), u_max=300.0, initial=Initial(1e-4, 0.0, 0.0)
)
WEIGHTS = (1.0, 0.1, 0.1, 0.2, 1e-3, 1.0)


def objective(samples=120, spread=(), scenario=SCENARIO, method=None):
    clock = Clock(samples, 1e-4, method or Slide(2))
    return Objective(SPACE, CASCADE, scenario, clock, loss_for(scenario, 0.002), Spread(spread))


@pytest.fixture(scope="module")
def engines():
    """Forward and reverse lanes of one objective, its members, and a point."""
    problem = objective(spread=(("plant.m", Percent(10.0)),))
    made = [Engine(problem, settle=0.002, mode=mode, threads=1) for mode in ("forward", "reverse")]
    return *made, problem.members(3, 4), SPACE.encode(SPACE.values(CASCADE))


@pytest.mark.slow
def test_the_gradient_agrees_in_three_ways(engines):
    forward, reverse, members, x = engines
    value, slopes, _ = forward.gradient(x[None], members, WEIGHTS)
    other, back, _ = reverse.gradient(x[None], members, WEIGHTS)
    assert value.shape == (1, 4, 1)  # the loss, and no limits
    np.testing.assert_allclose(value, other, rtol=1e-12)
    size = np.abs(slopes).max()
    # the product of 240 step matrices, multiplied from either end
    np.testing.assert_allclose(slopes, back, rtol=1e-9, atol=1e-12 * size)
    h = 1e-3
    points = x + np.concatenate([s * h * np.eye(4) for s in (1, -1, 0.5, -0.5)])
    losses = weigh(WEIGHTS, forward.terms(points, members), members.stressed)
    up, down, half_up, half_down = losses.reshape(4, 4, -1)
    differences = (4 * (half_up - half_down) / h - (up - down) / (2 * h)) / 3
    # h^4 truncation of the extrapolated differences: measured 2e-7
    np.testing.assert_allclose(slopes[0, :, 0], differences.T, rtol=1e-6, atol=1e-6 * size)


def test_lanes_equal_rollouts(engines):
    """A lane, whose noise is drawn beforehand, equals the rollout of its member."""
    forward, _, members, x = engines
    problem = forward.objective
    terms = forward.terms(x[None], members)
    k = 2
    scenario = dataclasses.replace(
        SCENARIO, member=k, seed=3, plant=dataclasses.replace(SCENARIO.plant, m=float(members.values["plant.m"][k]))
    )
    alone = rollout(CASCADE, scenario, problem.clock, fold=problem.loss, record_every=0).metrics
    for name in TERMS:  # the same operations, fused differently
        assert terms[name][0, k] == pytest.approx(float(alone[name]), rel=1e-9)


LATE = {"controller": {"inversion": {"gamma": 7.5e4}}, "processor": {"delay": 1.0}, "clock": {"duration": 0.005}}


@pytest.mark.thorough
@pytest.mark.parametrize("delays", [[0.5, 1.5], pytest.param([1.0, 2.0], marks=pytest.mark.slow)])
def test_a_lane_has_the_delay_of_its_member(delays):
    """Spread delays are not rounded to whole samples and not limited to the nominal delay."""
    case, tune = case_and_tune(LATE | {"spread": {"processor": {"delay": {"uniform": delays}}}})
    problem = problem_of(case, tune)
    members = problem.objective.members(4, 8)
    x = problem.objective.space.encode(problem.objective.space.values(case.cascade))
    tracking = problem.engine.terms(x[None], members)["tracking"][0]
    delays = members.values["processor.delay"]
    assert np.all(delays != np.round(delays))
    for lane, delay in zip(tracking, delays, strict=True):
        processor = dataclasses.replace(case.cascade.processor, delay=float(delay))
        cascade = dataclasses.replace(case.cascade, processor=processor)
        alone = rollout(
            cascade, case.scenario, problem.objective.clock, fold=problem.objective.loss, record_every=0
        ).metrics
        assert lane == pytest.approx(float(alone["tracking"]), rel=1e-9)  # the same operations, fused differently


def test_stressed_members_have_more_noise_and_only_their_survival_counts():
    problem = objective()
    members = problem.training(5, 2, 2, 1.5, 1.25)
    np.testing.assert_array_equal(members.noise_factor, [1.0, 1.0, 1.5, 1.5])
    quiet, louder = (problem.world(jax.tree.map(lambda a, m=m: a[m], members))[1].sensor for m in (1, 2))
    for name in ("std", "std_z_dot", "std_i"):
        assert float(getattr(louder, name)) == 1.5 * float(getattr(quiet, name)) > 0
    scaled = {"std": 0.0, "std_z_dot": 0.0, "std_i": 0.0}  # and nothing else: it is the same sensor
    assert dataclasses.replace(louder, **scaled) == dataclasses.replace(quiet, **scaled)
    np.testing.assert_allclose(members.shift, np.log(1.25) * np.array([[0.0], [0.0], [1.0], [-1.0]]) * np.ones(4))
    # one in four of 20 and of 6, but no fewer than 4 of either
    assert problem.training(5, 20, 6, 1.5, 1.25).part.member.tolist() == [0, 1, 2, 3, 4, 20, 21, 22, 23]
    assert problem.training(5, 2, 1, 1.5, 1.25).part.member.tolist() == [0, 1, 2]
    terms = {name: np.ones((1, 4)) for name in TERMS}
    np.testing.assert_allclose(weigh(WEIGHTS, terms, members.stressed)[0], [1.1 * 1.3 + 1.001] * 2 + [1.001] * 2)


# --- optimisers ---


def descended(starts, centre, steps):
    """Return the first of these starts after steps on a quadratic with its minimum at `centre`, and its distance."""
    first = jax.tree.map(lambda a: a[0], starts)
    for _ in range(steps):
        x = first.trial - centre
        first = step(first, jnp.sum(SCALES * x**2), 2 * SCALES * x)
    return first, float(jnp.linalg.norm(first.best - centre))


SCALES = jnp.asarray([1.0, 9.0, 0.3])


def test_bfgs_solves_a_quadratic_in_few_steps_and_continues_with_its_inverse_hessian():
    # superlinear: measured 2e-10 of the loss at the start after 15 steps in three dimensions, without a line search
    centre, move = jnp.asarray([0.7, -0.4, 0.2]), jnp.asarray([0.1, 0.1, -0.1])  # within the first trust radius
    first, _ = descended(begin(jnp.zeros((1, 3))), centre, 20)
    assert float(first.value) < 1e-8 * float(jnp.sum(SCALES * centre**2))
    # if the minimum moves, a quasi-Newton step leads near it: measured 9 % of the distance are left
    again = continued(jax.tree.map(lambda a: a[None], first), first.best[None])
    left = [descended(starts, first.best + move, 2)[1] for starts in (again, begin(first.best[None]))]
    assert left[0] < 0.15 * float(jnp.linalg.norm(move)) < left[1]


def test_a_refused_trial_of_bfgs_updates_the_curvature():
    """On the parabola 50 x^2 the first step, 0.3, overshoots; from its gradient the next trial is the minimum."""

    def tried(start, value):
        return step(start, jnp.asarray(value), 100 * start.trial)

    first = tried(jax.tree.map(lambda a: a[0], begin(jnp.asarray([[0.1]]))), 0.5)
    np.testing.assert_allclose(first.trial, -0.2)
    after = tried(first, 0.5 + 0.9 * JUMP)
    np.testing.assert_allclose(after.trial, 0.0, atol=1e-12)
    assert (float(after.best[0]), float(after.value)) == (0.1, 0.5)
    # a trial beyond a jump, or with a loss that is not finite, only shortens the step, to a quarter
    for value in (0.5 + 1.1 * JUMP, np.nan):
        np.testing.assert_allclose(tried(first, value).trial, 0.1 - 0.3 / 4)


# --- the search ---


@pytest.fixture(scope="module")
def small(engines):
    """A search of the problem whose programs are compiled already."""
    problem = engines[0].objective
    engine = Engine(problem, settle=0.002, threads=2)
    goal = Goal((1.0, 0.0, 0.0, 0.0, 1e-3, 1.0), CVaR())
    return engine, goal, problem.training(3, 4, 1, 1.2, 1.25), SPACE.values(CASCADE)


def run(small, **more):
    engine, goal, members, start = small
    points = initial_points(SPACE, ranges(engine.objective, start), start, 8, seed=1)
    return search(engine, goal, members, points, **{"iterations": 9, "keep": 2, **more})


@pytest.mark.slow
def test_the_search_descends_and_keeps_the_best(small):
    found = run(small, keep=9)  # nine starts race on a pair of members, five and three of them on all
    engine, goal, members, _ = small
    counts = np.asarray(found.history["members"])
    assert counts.tolist() == [2] * 5 + [5] * (len(counts) - 5)
    value = np.asarray(found.history["value"])[5:]
    assert np.all(np.diff(value) <= 0)
    assert value[-1] < value[0] - 1e-3
    x, best = best_of(found)
    again = goal.score(engine.terms(x[None], members), members)[0]
    assert again == pytest.approx(best, rel=1e-9)


def test_the_screen_orders_the_points_by_their_goal(small):
    """With this few members, a part of them is all. Of many points, it sees the first and the best 16 on a pair."""
    engine, goal, members, start = small
    points = initial_points(SPACE, ranges(engine.objective, start), start, 8, seed=1)
    assert points.shape == (10, 4)
    np.testing.assert_allclose(points[0], SPACE.encode(start))
    ordered, _ = screen(engine, members, points, goal)
    values = goal.score(engine.terms(ordered, members), members)
    assert np.all(np.diff(values) >= 0)
    np.testing.assert_allclose(np.sort(values), np.sort(goal.score(engine.terms(points, members), members)))
    many = np.concatenate([ordered[::-1], points + 1.0, points - 1.0])
    many, pair = many[np.argsort(-goal.score(engine.terms(many, members.pair), members.pair))], members.pair.member
    ordered, _ = screen(engine, members, many, goal)
    assert (pair.tolist(), len(ordered), (ordered == many[0]).all(1).sum()) == ([0, 4], 17, 1)


@pytest.fixture
def logged_compilations():
    """Log all compilations, those of all threads."""
    jax.config.update("jax_log_compiles", True)
    yield
    jax.config.update("jax_log_compiles", False)


@pytest.mark.slow
def test_nothing_is_compiled_after_the_first_iteration(small, caplog, logged_compilations):
    run(small)
    engine, goal, members, start = small
    x = SPACE.encode(start * 1.3)[None]

    def kernels():
        names = ("Compiling jit(marked)", "Compiling jit(_blocks)")  # on the fast path, and without it
        return [message for message in caplog.messages if message.startswith(names)]

    with caplog.at_level("WARNING"):
        caplog.clear()
        engine.gradient(np.repeat(x, 2, axis=0), members, goal.weights)
        engine.terms(x, members)
        other = dataclasses.replace(SCENARIO, u_max=250.0)
        Engine(dataclasses.replace(engine.objective, scenario=other), settle=0.002).terms(x, members)  # nor for others
        assert not kernels()
        # the log does record compilations
        Engine(objective(7, method=Slide(3)), settle=0.0).terms(x, members)
        assert len(kernels()) == 1


@pytest.mark.slow
def test_a_resumed_search_is_the_uninterrupted_one(small, tmp_path):
    whole = run(small)
    facts = {"case": 1}

    class StopError(Exception):
        pass

    def stop(kept, seconds):
        if kept.iteration == 4:
            raise StopError

    checkpoint_file = CheckpointFile(tmp_path / "kept.npz", facts)
    with pytest.raises(StopError):
        run(small, checkpoint_file=checkpoint_file, on_iteration=stop)
    resumed = run(small, checkpoint_file=checkpoint_file, resume=True)
    for a, b in zip(jax.tree.leaves(whole.starts), jax.tree.leaves(resumed.starts), strict=True):
        np.testing.assert_array_equal(a, b)
    assert 0 < resumed.earlier < resumed.seconds  # what it took before counts
    assert not list(tmp_path.glob("*.part*"))
    with pytest.raises(ValueError, match="another search: case is 1 in the file and 2 in this run"):
        run(small, checkpoint_file=CheckpointFile(tmp_path / "kept.npz", {"case": 2}), resume=True)


# --- [tune] ---


C = "controller.position.c"


def bounds(**ends):
    return {"bounds": {"controller": {"position": ends}}}


def parsed(tune, **tables):
    document = {"sensor": {"std": 1e-6}, **tables, "tune": tune}
    return case_and_tune(document)[1]


def test_everything_in_tune_has_a_default():
    tune = parsed({})
    assert tune.space.paths == [f"controller.{path}" for path in PATHS]
    cvar = parsed({"risk": "cvar", "alpha": 0.8} | bounds(c=[1, 100]))
    assert cvar.risk == CVaR(0.8)
    assert (cvar.space.gains[0].low, cvar.space.gains[0].high) == (1.0, 100.0)


@pytest.mark.parametrize(
    ("tune", "says"),
    [
        ({"gains": []}, "tune.gains is empty"),
        ({"gains": [f"{C}c"]}, f"Did you mean '{C}'"),
        ({"gains": [C, "plant.m"]}, "tune.gains: 'plant.m': there is no such number to tune in this case. There are: "),
        (bounds(cc=[1, 2]), f"tune.bounds: '{C}c': there is no such number to tune in this case. Did you mean 'c"),
        ({"gains": "c"}, "give a list of paths"),
        ({"objective": "knees"}, "Did you mean 'knee'"),
        ({"weights": {"tracking": 0.0}}, "no term of the loss depends on the error"),
        ({"weights": {"survival": 0.0}}, "losing the rotor would cost nothing"),
        (bounds(c=[5, 2]), "low < high"),
        ({"gains": [C]} | bounds(k=[5, 9]), "not in tune.gains"),
        ({"alpha": 0.5}, "applies to risk"),
        ({"memebrs": 3}, "Did you mean 'members'"),
    ],
)
def test_bad_settings_are_refused_with_a_message(tune, says):
    with pytest.raises(ValueError, match="tune") as raised:
        parsed(tune)
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_gain_that_is_both_spread_and_tuned_is_refused():
    with pytest.raises(ValueError, match=r"spread\.controller\.position\.c"):
        parsed({}, spread={"controller.position.c": {"percent": 5}})
