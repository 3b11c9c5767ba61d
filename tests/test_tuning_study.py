"""Parts around the search: the judge, the step's error, descent, and the command's flags.

On losses that are formulas (`bowl.py`), so that each is known by hand.
"""

import json
import math
import os
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from bowl import FLOOR, S_0, World, case_file, document, study
from scipy import stats
from texts import piped
from tomlkit import dumps

import tuning.command
import tuning.judge.evaluate
import tuning.report.folder
import tuning.rounds
from ambjax.cases.tune_table import Budget
from tuning.judge.evaluate import RESOLVED, describe, judge, step_error, summarise
from tuning.problem.config import seeds
from tuning.problem.loss import TERMS
from tuning.report.judging import changed_gains
from tuning.solve import course
from tuning.solve.evolution import PATIENCE
from tuning.solve.refine import best_of, search


def at(made, c, k):
    """Coordinates of these gains."""
    return made.objective.space.encode(np.array([c, k]))


# --- the judge ---


def test_the_judge_evaluates_every_held_out_member_once(monkeypatch):
    """The judge also uses finer steps than the search, whose 3 substeps have an error here."""
    world = World(limit=lambda seed, number, *_: 40.0 if number == 5 else math.inf)
    world.bias = lambda substeps: 0.5 if substeps == 3 else 0.0
    made = study(monkeypatch, world)
    x = at(made, 80.0, 60.0)
    found = judge(made, x, 77, 10)
    np.testing.assert_array_equal(found["chatter_V"], 1 + np.arange(10))  # a Bowl's member k chatters by 1 + k
    assert found["lost"].tolist() == [k == 5 for k in range(10)]
    calls = [numbers for kind, seed, numbers, _ in world.calls if (kind, seed) == ("metrics", 77)]
    assert [number for numbers in calls for number in numbers] == list(range(10))
    assert {f"loss.{name}" for name in TERMS} <= set(found)
    tracking = FLOOR * (1 + math.log(0.8) ** 2)
    np.testing.assert_allclose(found["loss.tracking"], tracking)
    np.testing.assert_allclose(found["settled_rms_error_m"], S_0 * math.sqrt(tracking))


def test_a_summary_is_pooled_and_counts_the_lost_and_the_stalled():
    errors, lost_at = np.array([1.0, 2.0, 3.0, 6.0]) * 1e-6, np.array([np.inf, np.inf, 0.01, 0.02])
    found = {"settled_rms_error_m": errors, "settled_max_abs_error_m": 2 * errors}
    found |= {"lost_at_s": lost_at, "lost": lost_at == 0.01, "stalled": lost_at == 0.02}
    pooled = summarise(found)
    # the status of a stalled member is not known: it counts neither as lost nor as a survivor
    assert [pooled[one] for one in ("members", "lost", "stalled", "held", "survival")] == [4, 1, 1, 2, 0.5]
    theirs = stats.binomtest(2, 4).proportion_ci(0.95, method="wilson")
    assert (pooled["survival_low"], pooled["survival_high"]) == pytest.approx((theirs.low, theirs.high))
    assert pooled["settled_rms_error_m"] == pytest.approx(math.sqrt(2.5) * 1e-6)  # of the two that are held
    assert pooled["settled_rms_error_worst_member_m"] == 2e-6
    assert pooled["settled_max_abs_error_m"] == 4e-6
    assert (pooled["lost_at_s.mean"], pooled["lost_at_s.largest"]) == (0.015, 0.02)  # of those that are


@pytest.mark.parametrize("bias", [0.0, 0.06, -0.5, 0.4])
def test_the_error_of_the_step_is_measured_against_accurate_ones(monkeypatch, bias):
    made = study(monkeypatch, World(bias=lambda substeps: bias))
    error = step_error(made, at(made, 100.0, 60.0))
    assert error.relative == pytest.approx(bias, abs=1e-12)
    assert error.resolved == (abs(bias) <= RESOLVED)
    assert error.refuted == (
        "" if error.resolved else f"coarser steps give a settled rms error off by {100 * bias:.2g} %"
    )
    assert error.reference_m == pytest.approx(S_0 * math.sqrt(FLOOR))
    assert (error.members, error.lost) == (4, 0)


def test_members_that_only_accurate_steps_lose_are_named(monkeypatch):
    world = World(limit=lambda seed, number, stressed, accurate: 40.0 if accurate and number in (1, 3) else math.inf)
    made = study(monkeypatch, world)
    error = step_error(made, at(made, 80.0, 60.0))
    assert error.lost == 2
    assert error.unheld.member.tolist() == [1, 3]
    assert error.refuted  # whatever the error of the others
    error = step_error(made, at(made, 30.0, 60.0))
    assert error.lost == len(error.unheld.member) == 0


def test_an_error_without_a_relative_value_is_given_in_metres(monkeypatch):
    """This is the case if the reference error is 0, or if there is none."""
    error = step_error(study(monkeypatch, World()), np.zeros(2))
    zero = error._replace(search_m=1e-6, reference_m=0.0, relative=math.nan)
    assert zero.refuted == "coarser steps give a settled rms error of 1e-06 m against 0 m"
    assert describe(zero._replace(search_m=0.0)) == "settled rms error of 0 m against 0 m on 4 members"
    assert "of 1e-06 m against no number" in describe(zero._replace(reference_m=math.nan))
    # errors below the resolution of the reference
    assert error._replace(search_m=2e-11, reference_m=1e-11, relative=1.0, negligible_m=1e-10).refuted == ""


# --- around the optimum ---


def test_the_effect_of_a_change_of_each_gain(monkeypatch):
    """The risk of a Bowl is 1 + the squared logarithms; a change of c by e^0.25 = 1.28 loses one member."""
    world = World(limit=lambda seed, number, *_: 120.0 if number == 1 else math.inf)
    made = study(monkeypatch, world, bounds={"controller": {"position": {"c": [1e-3, 1e9], "k": [1e-3, 1e9]}}})
    grows, lost = changed_gains(made, at(made, *world.best), made.objective.training(1, 4, 0, 1.2, 1.25))
    assert grows[1] == pytest.approx(6.25, rel=1e-6)
    assert grows[0] > 1e4
    np.testing.assert_array_equal(lost, [1, 0])


# --- descent ---


def test_the_race_is_decided_on_all_members(monkeypatch):
    """The lower of two optima loses a member that is not in the part."""
    world = World(limit=lambda seed, number, *_: 500.0 if number == 15 else math.inf, valley=4.0)
    made = study(monkeypatch, world, bounds={"controller": {"position": {"c": [1e-3, 1e9], "k": [1e-3, 1e9]}}})
    begins = np.stack([at(made, 90.0, 60.0), at(made, 5000.0, 60.0)])
    members = made.objective.training(1, 16, 8, 1.2, 1.25)
    found = search(made.engine, made.goal, members, begins, keep=2, iterations=12)
    race = made.objective.space.gains_at(found.history["x"][PATIENCE - 1])
    np.testing.assert_allclose(race, [world.best[0] * math.exp(4.0), world.best[1]], rtol=0.05)
    np.testing.assert_allclose(made.objective.space.gains_at(best_of(found)[0]), world.best, rtol=0.05)
    assert int(found.history["lost"][-1]) == 0


@pytest.mark.parametrize(("valley", "loses"), [(-6.0, False), (4.0, False), (4.0, True)])
def test_a_change_of_one_gain_leads_to_a_lower_optimum(monkeypatch, valley, loses):
    """The descent ends at the optimum nearby; no point between it and the lower one has a lower loss.

    If the lower one loses a member that is not in the part of the screen, no further search begins.
    """
    bounds = {"controller": {"position": {"c": [1e-3, 1e9], "k": [1e-3, 1e9]}}}
    world = World(limit=lambda seed, number, *_: 500.0 if loses and number == 15 else math.inf, valley=valley)
    made = study(monkeypatch, world, bounds=bounds, screen=8, members=16)
    monkeypatch.setattr(course, "initial_points", lambda space, *_: at(made, 90.0, 50.0)[None])
    found = course.Course(made, course.training(made), 1)
    x = course.first_search(found, np.array([90.0, 50.0]))
    gains = np.asarray(made.objective.space.gains_at(x))
    lower = World.best * np.array([np.exp(valley), 1.0])
    np.testing.assert_allclose(gains, World.best if loses else lower, rtol=0.02)
    assert len(found.past) == 2 - loses


def test_a_further_search_that_does_not_lower_the_loss_is_the_last(monkeypatch):
    """The comparison finds lower losses than the searches, whose best one is always 1."""
    made = study(monkeypatch, World(), screen=8)
    found = course.Course(made, course.training(made), 1)
    ends = [at(made, 90.0, 50.0), at(made, 80.0, 40.0)]

    def searched(points):
        x = ends[len(found.past)]  # a third search would raise IndexError
        found.past.append(SimpleNamespace(history={"value": [0.0], "x": [x]}, interrupted=False))
        return x

    monkeypatch.setattr(found, "search", searched)
    np.testing.assert_array_equal(course.first_search(found, np.array([90.0, 50.0])), ends[0])
    assert len(found.past) == 2


# --- the command ---


def command(monkeypatch, tmp_path, world, force=False):
    """`ambjax tune` in this process, its engine a Bowl, without pictures: whether it is good, report, directory."""
    study(monkeypatch, world)
    monkeypatch.setattr(tuning.report.folder, "_pictures", lambda *_: None)
    path, out = case_file(tmp_path)
    tuned = tuning.tune(path, out, force=force)
    return tuned.good, json.loads(json.dumps(tuned.report)), out


def test_a_case_from_a_pipe_is_read_once(monkeypatch, tmp_path):
    """A second read would be empty, and tuned.toml would contain the gains only."""
    study(monkeypatch, World())
    monkeypatch.setattr(tuning.command, "_tune", lambda plan, *_: (plan.facts, plan.problem.case.text))
    text = dumps(document())
    facts, read = tuning.tune(piped(text), tmp_path / "out")
    assert read == text
    assert facts["case"] == tuning.tune(document(), tmp_path / "again")[0]["case"] == tomllib.loads(text)


def test_a_file_whose_gains_could_not_be_written_is_refused_at_the_start(monkeypatch, tmp_path):
    """The error occurs before the search."""
    broken = "[plant]\nm = 1.0\nx = 1.0\n"
    monkeypatch.setattr("tuning.report.folder.tuned", lambda *_: broken)
    with pytest.raises(ValueError, match=r"case.toml: plant.x = 1.0: unknown key"):
        command(monkeypatch, tmp_path, World())
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_unfinished_search_is_kept_and_only_resumed_with_resume(monkeypatch, tmp_path):
    *_, out = command(monkeypatch, tmp_path, World())
    left = {path.name for path in (out / "checkpoints").glob("*.npz")}
    mine = out / "checkpoints" / "round-my-net.npz"
    mine.touch()
    with pytest.raises(ValueError, match=r"it has tuned.toml, .* of an earlier run. .* overwrite them with force=True"):
        command(monkeypatch, tmp_path, World())
    assert {path.name for path in (out / "checkpoints").glob("*.npz")} == left | {mine.name}
    command(monkeypatch, tmp_path, World(), force=True)  # it has ended: its checkpoints go
    report = out / "report.json"
    for spoil in (lambda: os.utime(report, (0, 0)), report.unlink):  # of the search before that of these checkpoints
        spoil()
        with pytest.raises(ValueError, match=r"not ended. Continue it with resume=True, discard it with force=True"):
            command(monkeypatch, tmp_path, World())
    assert {path.name for path in (out / "checkpoints").glob("*.npz")} == left | {mine.name}
    (out / "checkpoints" / "round-99.npz").touch()
    command(monkeypatch, tmp_path, World(), force=True)
    assert {path.name for path in (out / "checkpoints").glob("*.npz")} == left | {mine.name}


def test_a_search_killed_before_its_first_checkpoint_is_resumed(monkeypatch, tmp_path):
    study(monkeypatch, World())
    path, out = case_file(tmp_path)
    with pytest.raises(ValueError, match=r"resume=True: out .* contains no search"):
        tuning.tune(path, out, resume=True)

    def killed(*_):
        raise SystemExit(137)

    with monkeypatch.context() as patch:
        patch.setattr(tuning.command, "rounds", killed)
        with pytest.raises(SystemExit):
            tuning.tune(path, out)
    monkeypatch.setattr(tuning.command, "_tune", lambda *_: "resumed")
    assert tuning.tune(path, out, resume=True) == "resumed"


HELD_OUT = seeds(Budget())[2]


@pytest.mark.slow
@pytest.mark.parametrize("status", ["lost", "stalled"])
def test_a_member_that_accurate_steps_do_not_hold_is_not_a_survivor(monkeypatch, tmp_path, status):
    """The member is one of those that are simulated again."""
    mine = (HELD_OUT, 1)
    if status == "lost":
        world = World(limit=lambda seed, number, _, accurate: 40.0 if accurate and (seed, number) == mine else math.inf)
    else:
        world = World(stalls=lambda seed, number, accurate: accurate and (seed, number) == mine)
    good, summary, _ = command(monkeypatch, tmp_path, world)
    assert not good
    assert summary["step_error"]["refuted"] == ""
    assert summary["verified"] is False
    assert summary["after"]["survival"] == "not verified"
    assert {"lost": "lose 1 of 4", "stalled": "cannot decide 1 of 4"}[status] in summary["verified_reason"]
    assert summary["worst_step_error"][status] == 1
