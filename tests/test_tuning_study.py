"""Parts around the search: ranges, the judge, the step's error, the front, descent, and the command's flags.

On losses that are formulas (`bowl.py`), so that each is known by hand.
"""

import json
import math
import os
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bowl import FLOOR, S_0, World, document, study
from scipy import stats
from texts import piped
from tomlkit import dumps

import tuning.command
import tuning.judge.evaluate
import tuning.report.folder
import tuning.rounds
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.cases.tune_table import Budget
from tuning.judge.evaluate import RESOLVED, describe, judge, step_error, summarise
from tuning.problem.config import seeds
from tuning.problem.loss import TERMS
from tuning.problem.ranges import END_FACTOR, initial_points, theorem_bounds
from tuning.report.judging import changed_gains
from tuning.solve.descent import begin, step
from tuning.solve.refine import RACE, best_of, search


def at(made, c, k):
    """Coordinates of these gains."""
    return made.objective.space.encode(np.array([c, k]))


# --- where it starts ---

GAINS = ("position.c", "position.k", "position.p", "inversion.gamma", "current.k_i")


def begins(monkeypatch, count, tables=None, **tune):
    """Gains [count + 2] by name at the points of the first screen, and the study."""
    paths = [f"controller.{path}" for path in GAINS]
    made = study(monkeypatch, World(), tables, **{"gains": paths, "bounds": {}} | tune)
    start = made.tune.space.values(made.case.cascade)
    points = initial_points(made.objective.space, made.ranges, start, count, 1)
    gains = np.array([made.objective.space.gains_at(jnp.asarray(x)) for x in points])
    np.testing.assert_allclose(gains[0], start, rtol=1e-9)
    assert np.all(np.isfinite(gains))
    assert np.all(gains > 0)
    return dict(zip(GAINS, gains[1:].T, strict=True)), made


def test_starts_cover_the_ranges_derived_from_the_plant(monkeypatch):
    given = {"bounds": {"controller": {"position": {"p": [2.0, 90.0]}}}}
    found, made = begins(monkeypatch, 64, **given)
    for name, gains in found.items():
        assert gains.max() > 5 * gains.min(), name
    w = math.sqrt(made.case.scenario.plant.k_s / made.case.scenario.plant.m)
    # the pole of the unstable plant, 528 1/s; 64 points of a Sobol sequence come within 2/64 of the ends of log c,
    # whose range is a factor of 114: 16 %
    assert found["position.c"].min() == pytest.approx(w / 30, rel=0.16)
    # the sampled loop cannot slide faster than 1/(5 T), here 2000 1/s, at 1 ms 200
    assert 0.8 * 2000 < found["position.c"].max() <= 2000
    slow, _ = begins(monkeypatch, 64, {"clock": {"duration": 0.02, "sample_period": 1e-3}}, **given)
    assert 0.8 * 200 < slow["position.c"].max() <= 200
    delta_1 = theorem_bounds(made.objective)["Delta_1"]
    assert found["inversion.gamma"].min() >= delta_1 > 0
    assert 2.0 < found["position.p"].min() < 2.5 < 80.0 < found["position.p"].max() < 90.0  # bounds that are given hold


def test_a_rotor_at_rest_has_starts(monkeypatch):
    """Delta_1 is 0 for a rotor at rest, but no range starts at 0."""
    found, _ = begins(monkeypatch, 16, {"reference": {"kind": "constant", "value": 0.0}})
    for name, gains in found.items():
        assert gains.max() > 3 * gains.min(), name


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
    found = {
        "settled_rms_error_m": errors,
        "settled_max_abs_error_m": 2 * errors,
        "lost_at_s": lost_at,
        "lost": lost_at == 0.01,
        "stalled": lost_at == 0.02,
    }
    pooled = summarise(found)
    # the status of a stalled member is not known: it counts neither as lost nor as a survivor
    assert (
        pooled["members"],
        pooled["lost"],
        pooled["stalled"],
        pooled["held"],
        pooled["survival"],
    ) == (4, 1, 1, 2, 0.5)
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


def test_without_members_held_by_both_steps_there_is_no_step_error(monkeypatch):
    made = study(monkeypatch, World(limit=lambda *_: 1e-3))
    error = step_error(made, at(made, 80.0, 60.0))
    assert math.isnan(error.relative)
    assert not error.resolved


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


def test_after_some_iterations_only_the_best_start_continues(monkeypatch):
    world = World()
    made = study(monkeypatch, world)
    begins = np.stack([at(made, c, k) for c, k in ((3.0, 3.0), (60.0, 50.0), (900.0, 2.0), (2.0, 700.0))])
    members = made.objective.training(1, 4, 2, 1.2, 1.25)
    found = search(made.engine, made.goal, members, begins, keep=4, iterations=12)
    starts = [points for kind, *_, points in world.calls if kind == "gradient"]
    assert starts == [4] * RACE + [1] * (len(starts) - RACE)
    assert len(found.starts.value) == 1
    np.testing.assert_allclose(made.objective.space.gains_at(best_of(found)[0]), world.best, rtol=0.05)


def test_the_path_of_bfgs_does_not_depend_on_the_unit_of_the_loss():
    """The first pair of points sets the scale of the curvature. After it, the paths for f and 1000 f are equal."""
    hessian, centre = jnp.diag(jnp.asarray([4.0, 60.0, 900.0])), jnp.asarray([0.5, -0.3, 0.2])

    def way(unit):
        start, found = jax.tree.map(lambda a: a[0], begin(jnp.zeros((1, 3)))), []
        for n in range(6):  # every value is better than the last
            start = step(start, jnp.asarray(-0.1 * n), unit * hessian @ (start.trial - centre))
            found.append(np.asarray(start.trial))
        return np.array(found)

    # the first step is as long as allowed in either unit; the same numbers but for rounding
    np.testing.assert_allclose(way(1e3), way(1.0), rtol=1e-9)


# --- the command ---


def command(monkeypatch, tmp_path, world, force=False, pareto=False, **tune):
    """`ambjax tune` in this process, its engine a Bowl: exit code, summary, output directory."""
    made = study(monkeypatch, world, **tune)
    path, out = tmp_path / "case.toml", tmp_path / "out"
    path.write_text(dumps(document(**tune)))
    tuned = tuning.tune(path, out, force=force, pareto=pareto)
    assert json.loads(json.dumps(tuned.report)) is not None
    return int(not tuned.good), tuned.report, out, made


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """One run with a front."""
    world = World(limit=lambda seed, number, *_: 400.0)
    with pytest.MonkeyPatch.context() as patch:
        code, summary, out, made = command(patch, tmp_path_factory.mktemp("all"), world, pareto=True)
    return world, code, summary, out, made


@pytest.mark.slow
def test_tuned_gains_are_evaluated_on_members_that_the_search_did_not_use(everything):
    world, code, summary, _, made = everything
    training, validation, held_out = seeds(made.tune.budget)
    assert summary["held_out_seed"] == held_out
    judged = [numbers for kind, seed, numbers, _ in world.calls if (kind, seed) == ("metrics", held_out)]
    assert judged[:2] == [tuple(range(6))] * 2  # before and after; then by accurate steps
    assert held_out not in world.seeds("terms")
    assert {seed for kind, seed, *_ in world.calls if kind == "gradient"} == {training}
    assert validation in world.seeds("terms")
    assert code == 0
    assert summary["after"]["lost"] == 0
    assert summary["after"]["settled_rms_error_m"] < summary["before"]["settled_rms_error_m"]


@pytest.mark.slow
def test_tuned_toml_contains_the_gains_and_can_be_read(everything):
    world, _, summary, out, _ = everything
    written = tomllib.loads((out / "tuned.toml").read_text())
    tuned = [written["controller"]["position"][name] for name in ("c", "k")]
    np.testing.assert_allclose(tuned, world.best, rtol=0.05)
    assert tuned == [row["after"] for row in summary["gains"]]
    case_from(written)


@pytest.mark.slow
def test_the_front_is_in_the_report_and_has_a_picture(everything):
    _, _, summary, out, _ = everything
    assert len(summary["front"]) > 1
    assert "| lost | answer | case file |" in (out / "report.md").read_text()
    assert "## Error against voltage" in (out / "report.md").read_text()
    assert 'alt="Error against voltage;' in (out / "report.html").read_text()


def test_a_case_from_a_pipe_is_read_once(monkeypatch, tmp_path):
    """A second read would be empty, and tuned.toml would contain the gains only."""
    study(monkeypatch, World())
    monkeypatch.setattr(tuning.command, "_tune", lambda plan, *_: (plan.facts, plan.problem.case.text))
    text = dumps(document())
    facts, read = tuning.tune(piped(text), tmp_path / "out")
    assert read == text
    assert facts["case"] == tomllib.loads(text)


def test_a_file_whose_gains_could_not_be_written_is_refused_at_the_start(monkeypatch, tmp_path):
    """The error occurs before the search."""
    broken = "[plant]\nm = 1.0\nx = 1.0\n"
    monkeypatch.setattr("tuning.report.tuned.tuned", lambda *_: broken)
    with pytest.raises(ValueError, match=r"case.toml: plant.x = 1.0: unknown key"):
        command(monkeypatch, tmp_path, World())
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_an_unfinished_search_is_kept_and_only_resumed_with_resume(monkeypatch, tmp_path):
    *_, out, _ = command(monkeypatch, tmp_path, World())
    left = {path.name for path in (out / "checkpoints").glob("*.npz")}
    mine = out / "checkpoints" / "round-my-net.npz"
    mine.touch()
    with pytest.raises(ValueError, match=r"it has tuned.toml, .* of an earlier run. .* overwrite them with force=True"):
        command(monkeypatch, tmp_path, World())
    assert {path.name for path in (out / "checkpoints").glob("*.npz")} == left | {mine.name}
    command(monkeypatch, tmp_path, World(), force=True)  # it has ended: its checkpoints go
    os.utime(out / "report.json", (0, 0))  # of the search before the one whose checkpoints these are
    with pytest.raises(ValueError, match=r"not ended. Continue it with resume=True, discard it with force=True"):
        command(monkeypatch, tmp_path, World())
    (out / "report.json").unlink()
    with pytest.raises(ValueError, match=r"not ended. Continue it with resume=True, discard it with force=True"):
        command(monkeypatch, tmp_path, World())
    assert {path.name for path in (out / "checkpoints").glob("*.npz")} == left | {mine.name}
    (out / "checkpoints" / "round-99.npz").touch()
    command(monkeypatch, tmp_path, World(), force=True)
    assert {path.name for path in (out / "checkpoints").glob("*.npz")} == left | {mine.name}


def test_a_search_killed_before_its_first_checkpoint_is_resumed(monkeypatch, tmp_path):
    study(monkeypatch, World())
    path, out = tmp_path / "case.toml", tmp_path / "out"
    path.write_text(dumps(document()))
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


@pytest.mark.parametrize("status", ["lost", pytest.param("stalled", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_member_that_accurate_steps_do_not_hold_is_not_a_survivor(monkeypatch, tmp_path, status):
    """The member is one of those that are simulated again."""
    mine = (HELD_OUT, 1)
    if status == "lost":
        world = World(limit=lambda seed, number, _, accurate: 40.0 if accurate and (seed, number) == mine else math.inf)
    else:
        world = World(stalls=lambda seed, number, accurate: accurate and (seed, number) == mine)
    code, summary, *_ = command(monkeypatch, tmp_path, world)
    assert code == 1
    assert summary["step_error"]["refuted"] == ""
    assert summary["verified"] is False
    assert summary["after"]["survival"] == "not verified"
    assert {"lost": "lose 1 of 4", "stalled": "cannot decide 1 of 4"}[status] in summary["verified_reason"]
    assert summary["worst_step_error"][status] == 1


@pytest.mark.slow
def test_a_refuted_survival_is_reported_without_held_out_members(monkeypatch, tmp_path):
    world = World(limit=lambda seed, number, _, accurate: 1e-3 if accurate else math.inf)
    monkeypatch.setattr(tuning.rounds, "MOST_ROUNDS", 1)
    code, summary, out, _ = command(monkeypatch, tmp_path, world, held_out=0)
    assert code == 1
    assert "Not verified: 6 of 6 training members are held" in summary["verdict"]
    assert "NOT VERIFIED: accurate steps lose 4 of 4" in (out / "tuned.toml").read_text()
    for name in ("report.md", "report.html"):
        assert "NOT VERIFIED" in (out / name).read_text()


def test_gains_stay_within_the_documented_bounds(monkeypatch):
    """The report gives the source of each range and the bounds of each gain."""
    paths = [f"controller.{path}" for path in GAINS]
    made = study(monkeypatch, World(), gains=paths, bounds={})
    start = made.tune.space.values(made.case.cascade)
    space = made.objective.space
    c, *others = zip(space.gains, made.ranges, start, strict=True)
    assert c[0].high == c[1].most == pytest.approx(1 / (5 * 1e-4))
    assert "the cap 1/(5 T)" in c[1].source
    for gain, found, value in others:
        assert gain.high == found.most == pytest.approx(END_FACTOR * max(found.high, value))
        assert f"tuned gain at most {found.most:.3g}" in found.source
    least = np.array(space.gains_at(jnp.full(len(space), 100.0)))
    np.testing.assert_allclose(least, [gain.high for gain in space.gains], rtol=1e-9)
    beyond = study(monkeypatch, World(), {"controller": {"position": {"c": 3000.0}}}, gains=paths, bounds={})
    assert beyond.objective.space.gains[0].high == 3000.0
    words = " ".join(template("tracking").replace("#", " ").split())
    bounds = f"c is at most a fifth of the sampling rate, others {END_FACTOR:g} times the end of their range or start"
    assert bounds in words


def test_the_pictures_show_the_case_and_the_tuned_laws(monkeypatch):
    made = study(monkeypatch, World())
    tuned = made.objective.space.decode(jnp.asarray(at(made, 80.0, 40.0)), made.case.cascade)
    monkeypatch.setattr(tuning.report.folder, "nominal", lambda _, cascade: float(cascade.position.c))
    monkeypatch.setattr(tuning.report.folder.pictures, "convergence", lambda *_: b"")
    for name in ("nominal", "spectrum"):
        monkeypatch.setattr(tuning.report.folder.pictures, name, lambda runs, *_: runs)
    drawn = tuning.report.folder._pictures(made, tuned, None, None)
    wanted = {"before": float(made.case.cascade.position.c), "after": pytest.approx(80.0)}
    assert {name: drawn[f"{name}.png"] for name in wanted} == drawn["spectrum.png"] == wanted
