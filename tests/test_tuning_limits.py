"""Limits: how they are read and measured, whether the search respects them, their price, and their report."""

import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bowl import Bowl, World, answer_of, study
from texts import case_and_tune, problem_from

from ambjax import rollout
from ambjax.linear import Injection
from ambjax.simulation.folds import Named
from ambjax.simulation.metrics import Metrics
from tuning.judge.peaks import MemberPeak, Sensitivity
from tuning.problem import config
from tuning.problem.config import LimitSettings, settings
from tuning.problem.lanes import Engine
from tuning.problem.limits import PENALTY, Limit, measures
from tuning.problem.quantities import KINDS, LimitContext, largest
from tuning.report import limit_table
from tuning.report.limit_table import MORE
from tuning.rounds import rounds
from tuning.solve import multipliers
from tuning.solve.course import Course, first_search, training
from tuning.solve.multipliers import breaking, optima, search_within_limits

# The voltage of a Bowl is proportional to k: 20 V at the best k, 60, and 10 V at k = 30.
TEN = {"limits": {"rms_u_V": 10.0, "margin": 0.002}}


# --- the limits of a case ---


def limits_of(limits, **tables):
    limits = {"sensitivity": math.inf} | limits
    document = {"sensor": {"std": 1e-6}, "clock": {"duration": 0.02}, **tables, "tune": {"limits": limits}}
    return case_and_tune(document)[1].limits


def test_a_supply_limits_the_voltage_by_default():
    supply = {"actuator": {"u_max": 200.0}}
    assert limits_of({}).each == ()
    (default,) = limits_of({}, **supply).each
    assert (default.name, default.threshold) == ("rms_u_V", 120.0)
    assert "60 %" in default.source
    assert limits_of({"rms_u_V": math.inf}, **supply).each == ()
    (given,) = limits_of({"rms_u_V": 150}, **supply).each
    assert (given.threshold, given.source) == (150.0, "tune.limits")


def test_limits_are_in_order_and_in_the_fingerprint():
    each = limits_of({"settling_s": 0.1, "max_u_V": 50.0, "margin": 0.1}).each
    assert [(one.name, one.margin) for one in each] == [("max_u_V", 0.1), ("settling_s", 0.1)]
    tune = case_and_tune({"tune": {"limits": {"max_u_V": 50.0, "sensitivity": math.inf, "survival": 0.99}}})[1]
    assert settings(tune)["limits"] == {"max_u_V": {"threshold": 50.0, "margin": KINDS["max_u_V"].margin}}
    assert settings(tune)["survival"] == 0.99
    assert limits_of({"settling_s": 0.1}).band == pytest.approx(45e-6)  # 1 % of 4.5 mm


# tests/test_tuning_config.py tests the range of each number.
@pytest.mark.parametrize(
    ("limits", "path", "words"),
    [
        *[({name: "80"}, name, "without quotes") for name in KINDS],
        ({"margin": 0.5}, "margin", "to 0.49"),
        ({"margin": 0.001}, "margin", "from 0.002"),
        ({"margin": 0}, "margin", "from 0.002"),
        ({"settling_band_m": 1e-5}, "settling_band_m", "Give both"),
        ({"settling_band_m": 1.0, "settling_s": 1.0}, "settling_band_m", "below the clearance"),
        ({"settling_band_m": -1.0, "settling_s": 1.0}, "settling_band_m", "from 1e-12"),
    ],
)
def test_wrong_limits_are_refused_in_one_line(limits, path, words):
    with pytest.raises(ValueError, match=r".") as caught:
        limits_of(limits)
    message = str(caught.value)
    assert message.startswith(f"tune.limits.{path}")
    assert words in message
    assert message.isprintable()


def test_limits_that_are_not_a_table_are_refused():
    with pytest.raises(ValueError, match=r"tune\.limits = 80: it must be a table"):
        case_and_tune({"tune": {"limits": 80}})


# --- how they are measured ---

SAMPLED = """
reference = { kind = "sine", amplitude = 1e-3, frequency = 5.0 }
sensor = { std = 1e-6, std_z_dot = 1e-4, std_i = 1e-4 }
actuator = { u_max = 200.0 }
clock = { duration = 0.02 }
run = { settle = 0.01 }
rotor = { speed = 12000.0 }
[controller]
position = { c = 1300.0, k = 11.0, p = inf }
inversion = { gamma = 6e6, p = inf }
current = { k_i = 900.0, p = inf }
[processor]
[tune]
objective = "least_error"
members = 4
stressed = 2
validation = 8
held_out = 8
screen = 0
[tune.limits]
rms_u_V = 80
sensitivity = inf
rms_error_m = 1e-6
max_u_V = 150
max_abs_i_A = 3
rms_coil_A = 1
chatter_V_per_s = 1e5
largest_error_m = 1e-5
settling_s = 0.1
overshoot_m = 1e-5
clearance_used = 0.6
z_1x_m = 1e-6
i_1x_A = 0.1
"""


def test_the_search_computes_the_quantities_of_the_judge():
    made = problem_from(SAMPLED)
    case = made.case
    context = LimitContext(
        case.settle, float(case.clock.duration), float(case.scenario.touchdown), 45e-6, case.scenario.rotor
    )
    folds = measures([limit.name for limit in made.limits], made.limits, context)
    fold = Named({"ours": Named(folds), "theirs": Metrics.of(case.settle, case.scenario)})
    both = rollout(case.cascade, case.scenario, case.clock, fold=fold, record_every=0).metrics
    ours, theirs = ({name: float(value) for name, value in both[part].items()} for part in ("ours", "theirs"))
    assert set(ours) == {name for name, kind in KINDS.items() if kind.fold is not None}
    for name, kind in KINDS.items():
        if kind.exact and name != "max_u_V":
            assert ours[name] == pytest.approx(theirs[kind.exact], rel=1e-12), name
    # per second of the settled half of 20 ms
    assert ours["chatter_V_per_s"] == pytest.approx(theirs["chatter_V"] / 0.01, rel=1e-12)
    # a 16-norm over 200 samples: at most 200^(1/16) = 1.39 times below the largest, at its stop
    assert theirs["max_abs_u_V"] / 1.4 < ours["max_u_V"] <= theirs["max_abs_u_V"] == 200.0


@pytest.mark.thorough
@pytest.mark.parametrize("iron", ["", "[plant.iron]\nsaturation = 1.2\nleakage = 1.1\neddy = 1e-4\n"])
def test_derivatives_of_limited_quantities_agree_in_both_modes(iron):
    made = problem_from(SAMPLED + iron)
    x, members = made.objective.space.encode(made.tune.space.values(made.case.cascade)), made.objective.members(1, 2)
    forward, reverse = (Engine(made.objective, settle=0.01, mode=mode, threads=1) for mode in ("forward", "reverse"))
    value, slopes, _ = forward.gradient(x[None], members, made.goal.weights)
    other, back, _ = reverse.gradient(x[None], members, made.goal.weights)
    assert value.shape == (1, 2, 1 + sum(kind.fold is not None for kind in KINDS.values()))
    np.testing.assert_allclose(value, other, rtol=1e-12)
    size = np.abs(slopes).max(axis=-1, keepdims=True)
    np.testing.assert_allclose(slopes / size, back / size, atol=1e-9)


def test_the_smooth_maximum_over_members_is_at_least_the_maximum():
    values = jnp.asarray([1.0, 2.0, 2.0])
    assert float(largest(values)) == pytest.approx(2 * (2 + 2**-16) ** (1 / 16))
    slopes = jax.grad(largest)(values)
    assert float(slopes @ values) == pytest.approx(float(largest(values)))  # twice the values, twice the largest
    np.testing.assert_array_equal(jax.grad(largest)(0 * values), 0.0)  # no member overshoots
    np.testing.assert_array_equal(jax.grad(largest)(jnp.asarray([0.0, 3.0])), [0.0, 1.0])
    assert float(largest(1e-200 * values)) >= 0.0  # neither under- nor overflow
    assert np.isfinite(float(largest(1e200 * values)))


@pytest.mark.parametrize(("name", "sign"), [("rms_u_V", 1), ("delay_margin_s", -1)])
def test_the_reserve_of_a_limit_is_half_of_its_margin(name, sign):
    limit = Limit(name, 10.0, margin=0.04)
    # in logarithms the reserve is log(1 - sign margin) + margin / 2
    boundary = math.log(10.0 * (1 - sign * 0.04)) + sign * 0.02
    assert limit.has_reserve(math.exp(boundary - sign * 1e-9))
    assert not limit.has_reserve(math.exp(boundary + sign * 1e-9))
    assert limit.holds(math.exp(boundary))


def test_multipliers_are_extrapolated_through_the_last_two_optima():
    """The goal kappa (g_0 - g)^2 / 2 has the multiplier kappa (g_0 - g) at each optimum, and kappa g_0 at the limit."""
    limit, kappa, g_0 = Limit("rms_u_V", 10.0), 60.0, 0.3
    for _ in range(2):
        g = (kappa * g_0 - limit.multiplier) / (kappa + PENALTY)  # optimum of the goal with the term of the limit
        limit = limit.updated(10.0 * math.exp(g), 10.0 * math.exp(g))
    assert limit.multiplier == pytest.approx(kappa * g_0)
    stuck = Limit("rms_u_V", 10.0)  # a search that hardly moved: its line leads too far
    for g in (0.2, 0.19):
        stuck = stuck.updated(10.0 * math.exp(g), 10.0 * math.exp(g))
    assert stuck.multiplier == pytest.approx(PENALTY * (0.2 + 0.19))


def test_the_penalty_of_a_limit_is_that_of_an_augmented_lagrangian():
    limit, values = Limit("rms_u_V", 10.0), jnp.full(3, 10.0 * math.exp(0.1))
    assert float(limit.term(values)) == pytest.approx(PENALTY * 0.1**2 / 2)
    assert float(limit.term(0.5 * values)) == 0.0
    # the multiplier follows from the value that the search computed at the optimum
    assert limit.updated(10.0 * math.exp(0.05), 10.0 * math.exp(0.1)).multiplier == pytest.approx(PENALTY * 0.05)
    tighter = limit.updated(10.0, 10.0 * math.exp(0.1))
    assert tighter.multiplier == pytest.approx(0.0)
    # the judged value is 10 % larger than that of the search: from now on the search corrects its values by this ratio
    assert float(tighter.term.excess(jnp.full(3, 10.0))) == pytest.approx(0.1)
    again = Limit("rms_u_V", 10.0, ratio=tighter.ratio).updated(9.9, 10.0 * math.exp(0.09))
    assert again.multiplier == pytest.approx(PENALTY * (0.1 + math.log(0.99)))
    assert limit.updated(5.0, 5.0).multiplier == 0.0
    # an injection loses the rotor: the value is ten times the limit, so that the search continues
    lost = limit.updated(5.0, math.inf)
    assert lost.ratio == pytest.approx(10 * limit.threshold / 5.0)


# --- that they are kept, and what they cost ---


def test_a_limit_is_met_and_its_multiplier_is_the_price(monkeypatch, tmp_path):
    answer, (c, k) = answer_of(monkeypatch, tmp_path, World(), **TEN)
    assert k == pytest.approx(30.0, rel=0.012)  # as near as an active limit is met, 1 %
    assert c == pytest.approx(100.0, rel=0.05)
    (limit,) = answer.problem.limits
    y = math.log(0.5)  # the error goes as 1 + y^2, y = log(k / 60), and k as the limit
    assert limit.multiplier == pytest.approx(-2 * y / (1 + y**2), rel=0.1)
    # against a problem whose limit is 10 % looser
    looser, _ = answer_of(monkeypatch, tmp_path / "looser", World(), limits={"rms_u_V": 11.0, "margin": 0.002})
    ours, theirs = (
        math.sqrt(1 + math.log(np.asarray(one.problem.objective.space.gains_at(one.x))[1] / 60) ** 2)
        for one in (answer, looser)
    )
    # to first order in log 1.1 beyond the optima on the way, and both within 1 % of k
    assert limit.error_reduction(MORE) == pytest.approx(1 - theirs / ours, rel=0.2)


def test_the_price_follows_from_the_interpolated_multiplier():
    """A multiplier that falls from 20 at 10 V to 0 at 11 V, linearly in ln b, gives half the price of a constant 20."""
    limit = Limit("rms_u_V", 10.0, multiplier=20.0, history=((11.0, 0.0), (10.0, 20.0)))
    # 200 segments of a straight line
    assert limit.error_reduction(0.1) == pytest.approx(1 - 1.1 ** (-20 / 2 / 2), rel=1e-9)
    alone = Limit("rms_u_V", 10.0, multiplier=2.0, history=((10.0, 2.0),))
    assert alone.error_reduction(0.1) == pytest.approx(1 - 1 / 1.1, rel=1e-9)
    assert Limit("rms_u_V", 10.0).error_reduction(0.1) == 0.0


def test_a_limit_is_active_if_its_multiplier_is_positive_and_it_is_reached():
    """The limit 10 has a margin of 3 %. With a tolerance of 1 % plus the margin, it is active from 9.7 e^-0.04 on."""
    pulls = Limit("max_u_V", 10.0, margin=0.03, multiplier=0.2)
    assert [pulls.active(reached) for reached in (9.3, 9.35, 10.5, None)] == [False, True, True, True]
    assert not Limit("max_u_V", 10.0, margin=0.03).active(10.0)


def test_a_limit_far_from_the_value_causes_no_search(monkeypatch, tmp_path):
    far, free = World(), World()
    first, _ = answer_of(monkeypatch, tmp_path, far, limits={"rms_u_V": 30.0})
    second, _ = answer_of(monkeypatch, tmp_path / "free", free, limits={"rms_u_V": math.inf})
    np.testing.assert_array_equal(first.x, second.x)
    gradients = [[one for one in world.calls if one[0] == "gradient"] for world in (far, free)]
    assert gradients[0] == gradients[1]


def test_the_judged_value_corrects_the_search(monkeypatch, tmp_path):
    _, (_, k) = answer_of(monkeypatch, tmp_path, World(louder=1.25), **TEN)
    assert k == pytest.approx(30.0 / 1.25, rel=0.012)


def test_members_that_break_a_limit_on_the_worst_member_join(monkeypatch):
    """The largest values first, without members that are lost or that have joined before; they are then searched."""
    problem = study(monkeypatch, World(), limits={"settling_s": 1.0, "rms_u_V": math.inf})
    (limit,), count = problem.limits, problem.tune.budget.validation
    course = Course(problem, training(problem), 1)
    values = np.full(count, 0.5)
    values[[1, 4, 7]] = 2.0, 3.0, 9.0
    columns = {"lost_at_s": np.where(np.arange(count) == 7, 0.01, np.inf), f"loss.limit.{limit.name}": values}
    beyond, inside = ({limit.name: (0.6, judged)} for judged in (3.0, 0.5))
    more = breaking(course, beyond, columns)
    assert more.member.tolist() == [1, 4]
    assert set(more.seed) == {config.seeds(problem.tune.budget)[1]}
    course.members = course.members.joined(more, stressed=False)
    assert course.members.searched.member[:2].tolist() == [1, 4]
    assert course.members.part.member[:2].tolist() == [1, 4]
    assert breaking(course, beyond, columns) is None
    assert breaking(course, inside, columns) is None  # it is held


def test_after_saturated_injections_the_search_limits_the_voltage(monkeypatch):
    """The linear peak is 8/V at a voltage of V volts. Injections saturate above 12 V and then measure more.

    The least error is at 20 V. A smaller linear peak needs more volts, a smaller injected one fewer.
    """
    terms, peak = Bowl._terms, "settling_s"

    def with_peak(self, x, members, along=None):
        found = terms(self, x, members, along)
        return found | {f"limit.{peak}": 8.0 / found["limit.rms_u_V"]}

    def reached_of(limit, columns, injected):
        more = max(8.0 / limit.reached(columns) / 12.0, 1.0) ** 4 if limit.name == peak else 1.0
        return more * limit.reached(columns)

    monkeypatch.setattr(Bowl, "_terms", with_peak)
    saturating = SimpleNamespace(decides=False, saturates=True)
    for name, one in (("injects", lambda problem: True), ("injections", lambda of: saturating)):
        monkeypatch.setattr(multipliers, name, one)
    monkeypatch.setattr(multipliers, "reached_of", reached_of)
    problem = study(monkeypatch, World(), limits={peak: 1.0, "rms_u_V": 50.0})
    course = Course(problem, training(problem), 1)
    x, within = search_within_limits(course, first_search(course, np.array(World.best)))
    assert within
    # 20 V and 16 V are lowered to 80 %; one search of the method of multipliers leaves an excess of 2 %
    assert problem.objective.space.gains_at(x)[1] == pytest.approx(60 * 0.8**2, rel=0.03)
    (row,) = (row for row in limit_table._asked(course.problem) if row.name == "rms_u_V")
    assert row.threshold == 50.0  # the report states the limit of the case


@pytest.mark.parametrize(
    "ends", [(60.0, 20.0, 60.0, 25.0, 60.0, 22.0, 60.0), (60.0, 20.0, 60.0, 45.0, 25.0, 60.0, 22.0)]
)
def test_the_best_answer_within_the_limits_is_taken_if_the_multipliers_do_not_converge(monkeypatch, ends):
    """Searches that alternate between 20 V, the least goal, and less than the limit of 10 V: k = 20, 22 and 25.

    `ends`: k of the start and of the answers. The last one is within the limit or not.
    """
    problem = study(monkeypatch, World(), **TEN)
    course = Course(problem, training(problem), 1)
    course.past.append(SimpleNamespace(interrupted=False, starts=None, converged=False))
    at = {
        k: np.asarray(problem.objective.space.encode(np.array([World.best[0], k])))
        for k in (20.0, 22.0, 25.0, 45.0, 60.0)
    }
    found = iter(ends[1:])
    monkeypatch.setattr(course, "search", lambda points, earlier, evolve: at[next(found)])
    x, within = search_within_limits(course, at[ends[0]])
    np.testing.assert_array_equal(x, at[25.0])
    (limit,) = course.problem.limits  # that of the search which ended there
    assert len(limit.history) == ends.index(25.0)
    assert within
    assert next(found, None) is None


def test_a_search_begins_at_the_optimum_of_least_goal(monkeypatch):
    """A search ends at 200 V, far from the limit of 10 V; the next one begins at 15 V."""
    problem = study(monkeypatch, World(), **TEN)
    course = Course(problem, training(problem), 1)
    course.past.append(SimpleNamespace(interrupted=False, starts=None, converged=False))
    at = [np.asarray(problem.objective.space.encode(np.array([World.best[0], k]))) for k in (60.0, 45.0, 600.0, 29.9)]
    starts, found = [], iter(at[1:])

    def searched(points, earlier, evolve):
        starts.append(points[0])
        return next(found)

    monkeypatch.setattr(course, "search", searched)
    optima(course, at[0], 3)
    np.testing.assert_allclose(starts, [at[0], at[1], at[1]])


@pytest.mark.parametrize(
    ("limits", "ends", "joining"),
    [({"rms_u_V": 10.0}, (29.9, 29.9), 0), ({"settling_s": 10.0}, (60.0, 29.0), 8)],
    ids=["the descent has ended early within the limit", "members have joined, and the search ends where it began"],
)
def test_cma_es_continues_a_search_that_ends_early(monkeypatch, limits, ends, joining):
    """The descent ends at k = ends[0]; CMA-ES continues it, to k = ends[1], and converges. Members join once."""
    problem = study(monkeypatch, World(), limits={"rms_u_V": math.inf} | limits)
    course, asked, found = Course(problem, training(problem), 1), [], iter(ends)
    before = len(course.members.member)
    state = {"interrupted": False, "converged": True}
    steep = SimpleNamespace(value=np.zeros(1), gradient=np.ones((1, 2)))
    course.past.append(SimpleNamespace(**state, evolution=None, starts=steep))

    def searched(points, earlier, evolve):
        asked.append(evolve)
        course.past.append(SimpleNamespace(**state, evolution="CMA-ES", starts=None) if evolve else course.past[-1])
        x = problem.objective.space.encode(np.array([World.best[0], next(found)]))
        return points[0] if np.allclose(x, points[0]) else np.asarray(x)

    monkeypatch.setattr(course, "search", searched)
    _, met = optima(course, np.asarray(problem.objective.space.encode(np.array([World.best[0], 60.0]))))
    assert met
    assert asked == [False, True]
    assert len(course.members.member) == before + joining


def test_a_resumed_search_with_limits_gives_the_same_result(monkeypatch, tmp_path):
    made = study(monkeypatch, World(), **TEN)
    start = made.tune.space.values(made.case.cascade)
    whole = rounds(made, start, tmp_path, {"of": "ten"}, False)
    again = rounds(study(monkeypatch, World(), **TEN), start, tmp_path, {"of": "ten"}, True)
    np.testing.assert_array_equal(again.x, whole.x)
    assert again.problem.limits == whole.problem.limits


# --- the command ---


def test_the_allowed_number_of_lost_members_is_a_whole_number():
    """In floating point, (1 - 0.9) 2000 is 199.99999999999997."""
    assert [LimitSettings(survival=0.9).may_lose(n) for n in (2000, 1000, 19)] == [200, 100, 1]
    assert [LimitSettings(survival=s).may_lose(1000) for s in (1.0, 0.999, 0.9995)] == [0, 1, 0]


def test_the_reported_saturation_is_that_of_the_deciding_injection():
    def peak(size, share):
        one = np.array([size])
        return MemberPeak(0, "", Injection(one, one, one, one, size, None, None, 1.0, 0, 8, 1e-6, share))

    peaks = [peak(2.5, 0.1), peak(3.2, 0.15)]
    limit = SimpleNamespace(name="sensitivity")
    assert limit_table._saturated(limit, 3.2, Sensitivity(tuple(peaks), False)) == 0.15
    assert limit_table._saturated(limit, 3.3, Sensitivity(tuple(peaks), False)) is None  # a linear value decides
    assert limit_table._saturated(limit, 3.2, None) is None
