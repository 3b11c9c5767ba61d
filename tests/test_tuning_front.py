"""The front of error against voltage, and its knee: on formulas with a known answer, in report and case files."""

import math

import numpy as np
import pytest
from bowl import FLOOR, RARE_FROM, S_0, World, command, document, study
from texts import case_and_tune

from ambjax.cases.reader import read_case
from tuning.front import KNEE, FrontPoint, chosen, least_of
from tuning.problem.config import seeds
from tuning.problem.limits import FRONT
from tuning.problem.tuning_problem import problem_of
from tuning.report import front_table, limit_table
from tuning.rounds import rounds

BOUNDLESS = {"controller": {"position": {"c": [1.0, 1000.0], "k": [0.1, 1000.0]}}}


@pytest.fixture
def ran(monkeypatch, tmp_path, capsys):
    return lambda *flags, **tune: command(monkeypatch, tmp_path, capsys, World(), *flags, **tune)


def least_voltage(factor):
    """Return the least voltage of a Bowl.

    Its error is S_0 sqrt(FLOOR (1 + a^2 + b^2)) and its voltage 20 e^b, with the logarithms a and b of the gains.
    """
    return 20 * math.exp(-math.sqrt(factor**2 - 1))


@pytest.mark.thorough
def test_the_knee_is_the_least_voltage_within_25_percent_of_the_least_error(ran):
    code, facts, out, _, folder = ran("--pareto", objective="knee", front=3, bounds=BOUNDLESS)
    rows = {row["factor"]: row for row in facts["front"]}
    least = S_0 * math.sqrt(FLOOR)
    assert code == 0
    assert sorted(rows) == [1, 1.1, 1.25, 1.5]
    assert rows[1]["settled_rms_error_m"] == pytest.approx(least, rel=1e-3)
    for factor in (1.1, 1.25, 1.5):
        # the search meets a limit to 1 % below its margin of 0.5 %; the voltage follows with an elasticity up to 2.4
        assert factor * least * 0.98 < rows[factor]["settled_rms_error_m"] <= factor * least
        assert rows[factor]["settled_rms_u_V"] == pytest.approx(least_voltage(factor), rel=0.06)
    assert [row["factor"] for row in facts["front"] if row["taken"]] == [1.25]
    tuned = {row["path"]: row["after"] for row in facts["gains"]}
    assert rows[1.25]["gains"] == pytest.approx(tuned, rel=1e-12)
    assert read_case(folder / "tuned.toml").cascade.position.k == tuned["controller.position.k"]
    # every place says the same
    sentence = front_table.sentence(facts["front"])
    assert sentence in facts["verdict"]
    assert sentence in out
    text = (folder / "report.md").read_text()
    assert sentence in text
    assert text.index("## Error against voltage") < text.index("## Limits")
    assert text.count("**selected**") == 1
    # the limit by which the front is traced is no requirement
    assert [row["name"] for row in facts["limits"]] == ["rms_u_V", "survival"]
    for row in facts["front"]:
        law = read_case(folder / row["file"]).cascade.position
        assert {"controller.position.c": law.c, "controller.position.k": law.k} == row["gains"]


@pytest.mark.slow
def test_members_of_rare_large_errors_join_the_search(monkeypatch, tmp_path):
    """One of ten validation members limits the voltage, and no training member does."""
    slope, validation = 100.0, seeds(case_and_tune(document())[1].budget)[1]
    world = World(rare=lambda seed, number: slope if (seed, number) == (validation, 3) else 0.0)
    problem = study(monkeypatch, world, objective="knee", front=1, bounds=BOUNDLESS)
    answer = rounds(problem, problem.tune.space.values(problem.case.cascade), tmp_path, {}, False)
    # at the knee b^2 + slope^2 (-b - RARE_FROM)^2 / 10 = KNEE^2 - 1, where b is the logarithm of the last gain
    share = slope**2 / 10
    roots = np.roots([1 + share, 2 * share * RARE_FROM, share * RARE_FROM**2 - KNEE**2 + 1])
    knee = min(answer.front, key=lambda one: one.volts)
    # the tolerances of the test above
    assert knee.volts == pytest.approx(20 * math.exp(roots.min()), rel=0.06)
    assert knee.error_m <= KNEE * answer.front[0].error_m


@pytest.mark.slow
@pytest.mark.parametrize("pareto", [False, True])
def test_least_error_is_the_answer_with_and_without_its_front(pareto, ran):
    code, facts, out, _, folder = ran(*["--pareto"] * pareto, front=1, bounds=BOUNDLESS)
    assert code == 0
    rows = facts.get("front", [])
    assert [(row["factor"], row["taken"]) for row in rows] == ([(1, True), (1.25, False)] if pareto else [])
    assert ("This answer has the least error: " in out) == pareto
    assert len(list(folder.glob("tuned_*"))) == len(rows)


@pytest.mark.slow
def test_the_other_limits_stay_in_the_search_of_the_knee(monkeypatch, tmp_path):
    """The answer of least error already meets a limit of 15 V. The voltage of the knee must not exceed this limit."""
    study(monkeypatch, World(), objective="knee", bounds=BOUNDLESS, limits={"largest_error_m": 1.0})
    problem = problem_of(
        *case_and_tune(document(objective="knee", bounds=BOUNDLESS, limits={"rms_u_V": 15.0, "rms_error_m": 5.3e-5}))
    )
    towards = problem.towards_voltage(5e-5, 20.0, 1.25, 3.0)
    limits = {limit.name: limit for limit in towards.limits}
    assert limits["rms_u_V"].threshold == 15.0
    # the user's limit is the tighter one
    assert (limits["rms_error_m"].threshold, limits["rms_error_m"].source) == (5.3e-5, FRONT)
    assert towards.goal.minimised == "rms_u_V"
    assert [limit.threshold for limit in limit_table._asked(towards)] == [5.3e-5, 15.0]
    tighter = problem.towards_voltage(3e-5, 20.0, 1.25, 3.0)
    assert tighter.limits[0].threshold == pytest.approx(1.25 * 3e-5)
    assert [limit.threshold for limit in limit_table._asked(tighter)] == [5.3e-5, 15.0]
    assert problem.error_goal.weights == problem.tune.weights
    answer = rounds(problem, problem.tune.space.values(problem.case.cascade), tmp_path, {}, False)
    assert answer.front[0].volts <= 15.0
    assert all(one.volts <= 15.0 for one in answer.front)


def point(error, volts, lost=0, within=True, reserve=True):
    return FrontPoint(1.0, np.zeros(2), error, volts, None, lost, 0, 100, within, reserve)


def test_the_knee_holds_as_many_members_and_limits_as_the_point_of_least_error():
    seen = [point(1.0, 20.0), point(1.2, 10.0, lost=1), point(1.2, 11.0, within=False), point(1.26, 9.0)]
    assert chosen(seen, 1.25) is seen[0]
    assert chosen(seen, 1.3) is seen[3]
    seen.append(point(1.24, 12.0))
    assert chosen(seen, 1.25) is seen[4]
    assert chosen([*seen[:3], point(math.nan, math.nan)], 1.25) is seen[0]
    loses = [point(1.0, 20.0, lost=1, within=False), *seen[1:]]
    assert chosen(loses, 1.25) is loses[1]
    # half of the margin is a reserve for the held-out members, unless the point of least error has no reserve either
    tight = [point(1.0, 20.0), point(1.2, 10.0, reserve=False), point(1.2, 12.0)]
    assert chosen(tight, 1.25) is tight[2]
    tight[0] = point(1.0, 20.0, reserve=False)
    assert chosen(tight, 1.25) is tight[1]
    # a search for less voltage has found a smaller error than the first answer's
    better = [point(2.0, 20.0), point(0.5, 15.0, lost=1), point(1.0, 15.0), point(1.2, 10.0), point(2.4, 5.0)]
    assert least_of(better) is better[2]
    assert chosen(better, 1.25) is better[3]
