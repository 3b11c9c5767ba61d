"""Limits on the linearised loop: values against the analysis, derivatives against differences, unstable loops."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough
from texts import case_and_tune

from ambjax.linear import analyse, frequency_lines, injected, linearise
from ambjax.results.operating import one_period
from tuning.judge.evaluate import JudgedMembers
from tuning.judge.peaks import injections
from tuning.problem.limits import PREFIX
from tuning.problem.loops import check_loops, loops
from tuning.problem.members import FEW
from tuning.problem.quantities import KINDS, LOOPS
from tuning.problem.tuning_problem import problem_of

NAMES = ["complementary", "control_sensitivity", "delay_margin_s", "sensitivity", "sensitivity_1x"]
PATHS = ["controller.position.c", "controller.position.k", "controller.inversion.gamma", "controller.current.k_i"]
GAINS = {
    "position": {"c": 200.0, "k": 63.0, "p": 5.0},
    "inversion": {"gamma": 2e6, "p": 1e-3},
    "current": {"k_i": 600.0, "p": 20.0},
    "model": {"m": 0.588},  # that of the rotor; in every document, so that all share one program
}
DOCUMENT = {
    "controller": GAINS,
    "processor": {"delay": 1.0, "discretisation": "explicit"},
    "sensor": {"std": 1e-6},
    "rotor": {"speed": 6000.0},
    "clock": {"duration": 0.004, "sample_period": 1e-4},
    "run": {"settle": 0.002},
    "spread": {"plant": {"m": {"percent": 10}}},
    "tune": {
        "objective": "least_error",
        "gains": PATHS,
        "bounds": {"controller.position.k": [1.0, 1e7]},
        "members": 12,
        "stressed": 2,
        "limits": {
            "sensitivity": 4.0,
            "complementary": 4.0,
            "control_sensitivity": 1e8,
            "delay_margin_s": 1e-4,
            "sensitivity_1x": 2.0,
        },
    },
}


@pytest.fixture(scope="module")
def made():
    """The problem, its start and its members."""
    problem = problem_of(*case_and_tune(DOCUMENT), threads=1)
    x = problem.objective.space.encode(problem.objective.space.values(problem.case.cascade))
    return problem, x, problem.objective.training(1, LOOPS + 4, 2, 1.2, 1.25)


@pytest.mark.slow
def test_a_search_does_not_begin_if_its_limits_cannot_be_evaluated(made):
    """The model is six times lighter than the rotor, so k = 5 m/s^2 cannot carry the rest of its weight."""
    problem, x, members = made
    check_loops(problem.objective, x[None], members.searched)
    laws = {"position": {"c": 200.0, "k": 5.0, "p": 5.0}, "model": {"m": 0.1}}
    problem = problem_of(*case_and_tune(DOCUMENT | {"controller": GAINS | laws}), threads=1)
    x = problem.objective.space.encode(problem.objective.space.values(problem.case.cascade))
    with pytest.raises(ValueError, match=r"tune\.limits: .*sensitivity.* cannot be evaluated.* none of the 1 starting"):
        check_loops(problem.objective, x[None], members.searched)


@pytest.mark.slow
def test_the_derivative_of_a_limit_agrees_with_differences(made):
    """The derivative of each limit's term of the goal is compared along each gain."""
    problem, x, members = made
    some, step = members.searched, 1e-3
    values, slopes = loops(problem.objective, x[None], some)
    both, _ = loops(problem.objective, np.concatenate([x + step * np.eye(len(x)), x - step * np.eye(len(x))]), some)
    assert len(some.member) == LOOPS < members.ordinary
    assert np.ptp(values["sensitivity"]) > 0.01  # the members' plants differ
    for name in NAMES:
        term = next(one for one in problem.goal.limits if one.name == name)
        term = dataclasses.replace(term, multiplier=500.0)  # its derivative is not 0 where the limit is held
        force = np.asarray(jax.grad(term)(jnp.asarray(values[name][0])))
        ends = [float(term(jnp.asarray(one))) for one in both[name]]
        differences = (np.array(ends[: len(x)]) - ends[len(x) :]) / (2 * step)
        # the step's error is about 1e-6; a peak's frequency is known to 1e-5, its height to 1e-10, over the step 1e-7
        assert force @ slopes[name][0] == pytest.approx(differences, rel=1e-4, abs=1e-5), name
        assert np.any(np.abs(differences) > 0.1), name


@pytest.mark.slow
def test_the_engine_adds_the_quantities_of_the_linear_loop_by_name(made, monkeypatch):
    """For LOOPS + 4 ordinary and 2 stressed members; the rollouts themselves are not simulated here."""
    problem, x, members = made
    count, m = len(members.member), len(x)
    objective = problem.objective
    objective = dataclasses.replace(objective, loss=dataclasses.replace(objective.loss, measures={"max_u_V": None}))
    engine = problem.engine
    monkeypatch.setattr(engine, "objective", objective)
    simulated = np.full((1, count, 2), 7.0), np.full((1, count, 2, m), 8.0), {PREFIX + "max_u_V": np.zeros((1, count))}
    monkeypatch.setattr(engine, "_lanes", lambda *args, **more: simulated)
    outcomes, slopes, terms = engine.gradient(x[None], members, problem.goal.weights)
    values, along = loops(objective, x[None], members.searched)
    assert sorted(terms) == [PREFIX + name for name in sorted([*NAMES, "max_u_V"])]
    assert np.all(outcomes[..., :2] == 7)
    assert np.all(slopes[..., :2, :] == 8)
    for k, name in enumerate(NAMES, 2):
        assert np.array_equal(outcomes[:, :LOOPS, k], values[name])
        assert np.array_equal(slopes[:, :LOOPS, k], along[name])
        assert np.all(slopes[:, LOOPS:, k] == 0)


@pytest.mark.slow
def test_an_unstable_loop_has_a_finite_value_whose_derivative_points_to_stability(made):
    """The loop diverges faster for larger k."""
    problem, x, members = made
    far = x + np.linspace(0.0, 9.0, 10)[:, None] * (np.array(PATHS) == "controller.position.k")
    values, slopes = loops(problem.objective, far, members.searched)
    S, along = values["sensitivity"][:, 0], slopes["sensitivity"][:, 0, 1]
    unstable = S >= 1e3
    assert unstable[-1]
    assert not unstable[0]
    assert all(np.isfinite(one).all() for one in [*values.values(), *slopes.values()])
    assert np.all(along[unstable] > 0)
    assert np.all(np.diff(S[unstable]) > 0)
    assert np.all(np.diff(values["delay_margin_s"][unstable, 0]) < 0)


def test_a_lower_limit_holds_for_larger_values():
    _, tune = case_and_tune(DOCUMENT)
    limit = next(one for one in tune.limits.each if one.name == "delay_margin_s")
    assert KINDS["delay_margin_s"].at_least
    assert limit.allowed > limit.threshold
    assert limit.log_excess(2e-4) < 0 < limit.log_excess(0.9e-4)
    assert limit.holds(1.01e-4)
    assert not limit.holds(0.99e-4)
    term = limit.term
    assert term.excess(jnp.full(8, 2e-4)) < 0 < term.excess(jnp.full(8, 0.9e-4))
    # the 16-norm of the inverses is not above the least value
    assert float(term.excess(jnp.array([1e-4] + [1e-3] * 7))) == pytest.approx(limit.log_excess(1e-4), abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("signs", [True, thorough(False)])
def test_injections_find_the_members_with_the_largest_injected_peak(signs):
    """Set-valued signs, or a voltage that saturates, without noise: one measurement of each plant.

    The order of the linear peaks differs from that of the injected ones.
    """
    laws = {"position": {"c": 200.0, "k": 30.0}, "inversion": {"gamma": 1e7}, "current": {"k_i": 2000.0}}
    chattering = {"controller": {stage: law | {"p": math.inf} for stage, law in laws.items()}}
    document = DOCUMENT | (chattering if signs else {"actuator": {"u_max": 75.0}})
    document |= {
        "processor": {"delay": 1.0},
        "sensor": {"std": 0.0},
        "sensitivity": {"f_low": 20.0, "amplitude": 5e-5},
        "spread": {"plant": {"m": {"percent": 30}}},
        "tune": DOCUMENT["tune"] | {"gains": PATHS[:1], "bounds": {}},
    }
    problem = problem_of(*case_and_tune(document), threads=1)
    x = problem.objective.space.encode(problem.objective.space.values(problem.case.cascade))
    count = 6
    columns = {"loss.limit.sensitivity": np.arange(count)[::-1] + 1.0, "lost_at_s": np.full(count, np.inf)}
    found = injections(JudgedMembers(problem, x, 1, columns))
    assert (found.decides, found.saturates) == (signs, not signs)
    case, masses = problem.case, problem.objective.chosen(1, np.arange(count), count).values["plant.m"]
    plants = [dataclasses.replace(case.scenario.plant, m=m) for m in masses]
    worlds, clock = [dataclasses.replace(case.scenario, plant=plant) for plant in plants], one_period(case)
    system = linearise(case.cascade, worlds[0], case.clock)
    linear = analyse(system, masses[0], float(case.clock.sample_period), case.zones).S
    at = frequency_lines(case.zones, clock, linear.frequency)
    each = [injected(case.cascade, world, clock, at, amplitude=5e-5) for world in worlds]
    expected = sorted(range(count), key=lambda k: -each[k].peak)[:FEW]
    assert [one.member for one in found.peaks] == expected
    # the same signal, amplitude and plant, in another program
    assert [one.injected.peak for one in found.peaks] == pytest.approx([each[k].peak for k in expected], rel=1e-6)
    columns = {"loss.limit.control_sensitivity": np.ones(count), "lost_at_s": columns["lost_at_s"]}
    by_KS = sorted(range(count), key=lambda k: -np.abs(each[k].KS).max())[:FEW]
    assert [one.member for one in injections(JudgedMembers(problem, x, 1, columns)).peaks] == by_KS
    assert signs == (by_KS != expected)


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({}, {"sensitivity": (3.0, "default, zone A of [sensitivity]")}),
        ({"sensitivity": math.inf}, {}),
        ({"sensitivity": 2.5}, {"sensitivity": (2.5, "tune.limits")}),
    ],
)
def test_the_sensitivity_has_a_default_limit(limits, expected):
    tune = case_and_tune(DOCUMENT | {"tune": {"limits": limits}})[1]
    assert {one.name: (one.threshold, one.source) for one in tune.limits.each} == expected
