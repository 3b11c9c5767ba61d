"""The rounds of a study on losses that are formulas: the members they use, how they continue, what they return."""

import math

import bowl
import numpy as np
import pytest
from bowl import S_0, World, answer_of, study

import tuning.rounds
from ambjax.solvers import Slide
from tuning.problem.config import seeds
from tuning.problem.loss import TERMS
from tuning.problem.members import FEW
from tuning.rounds import MOST_HALVINGS, rounds
from tuning.validate import Validation

TRAINING, VALIDATION, HELD_OUT = 0, 1, 2
# Fingerprint of the study in a checkpoint.
TOLD = {"of": "{}"}


def seed_of(which, seed=1):
    """The seed of one of the three ensembles."""
    from ambjax.cases.tune_table import Budget

    return seeds(Budget(seed=seed))[which]


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_the_three_ensembles_have_different_seeds(seed):
    assert len({seed_of(which, seed) for which in (TRAINING, VALIDATION, HELD_OUT)}) == 3
    assert seed_of(TRAINING, seed) == seed
    # and of no other study's nearby
    assert not {seed_of(VALIDATION, seed), seed_of(HELD_OUT, seed)} & set(range(seed, seed + 1000))


def test_the_best_gains_are_found_and_no_member_is_lost(monkeypatch, tmp_path):
    world = World()
    found, gains = answer_of(monkeypatch, tmp_path, world)
    # on a bowl: as near as the search's shortest step, 1e-3, and its stall, 1e-3 of the loss, allow: sqrt(1e-3)
    np.testing.assert_allclose(gains, world.best, rtol=0.05)
    assert found.lost == 0
    assert found.error is not None
    assert found.error.resolved
    assert world.seeds("gradient") == {seed_of(TRAINING)}  # nothing else is descended
    assert seed_of(HELD_OUT) not in world.seeds("terms") | world.seeds("metrics")  # held-out members are unused


def test_the_standing_after_an_iteration_is_that_of_the_best_point(monkeypatch, tmp_path):
    events = []
    found, _ = answer_of(monkeypatch, tmp_path, World(), listen=events.append)
    standings = [event.standing for event in events if event.standing]
    assert len(standings) == len(found.history["value"])
    errors = S_0 * np.sqrt(found.history["terms"][:, TERMS.index("tracking")])
    np.testing.assert_allclose([one.error_m for one in standings], errors)
    last = standings[-1]
    assert last.members - last.held == found.history["lost"][-1]
    assert {one.name for one in last.limits} == {one.name for one in found.problem.limits}


@pytest.mark.parametrize("minutes", [1e-9, math.inf])
def test_a_search_without_time_ends_with_a_validated_answer(minutes, monkeypatch, tmp_path):
    """With no time, the first search has one iteration, and no other search follows."""
    found, _ = answer_of(monkeypatch, tmp_path, World(), minutes=minutes)
    assert found.error is not None
    assert math.isfinite(found.validation_error)
    assert (len(found.history["value"]) == 1) == math.isfinite(minutes)


def test_lost_validation_members_join_and_are_held(monkeypatch, tmp_path):
    fragile = {3, 7}

    def limit(seed, number, stressed, accurate):
        return 40.0 if seed == seed_of(VALIDATION) and number in fragile else math.inf

    world = World(limit=limit)
    found, (c, k) = answer_of(monkeypatch, tmp_path, world)
    assert ("terms", seed_of(VALIDATION), tuple(range(10)), 1) in world.calls
    assert found.lost == 0
    assert c < 40.0 < world.best[0]  # without them c = 100 is best
    assert k == pytest.approx(world.best[1], rel=0.1)
    joined = (found.members.seed == seed_of(VALIDATION)) & found.members.stressed
    assert set(found.members.member[joined].tolist()) == fragile
    # half of the extra noise of a stressed member, 1.2
    np.testing.assert_allclose(found.members.noise_factor[joined], 1.1)


def test_validation_members_of_large_errors_join(monkeypatch, tmp_path):
    """Below k = 20, two validation members have large errors, which no training member has."""
    rare = {3, 7}
    world = World(best=(100.0, 10.0), rare=lambda seed, number: 30.0 * (seed == seed_of(VALIDATION) and number in rare))
    monkeypatch.setattr(bowl, "RARE_FROM", -math.log(2))
    found, (_, k) = answer_of(monkeypatch, tmp_path, world)
    assert k > 15.0  # without them k = 10 is best
    assert found.validation_error < 1.5 * np.sqrt(found.history["terms"][-1][TERMS.index("tracking")])
    joined = found.members.seed == seed_of(VALIDATION)
    assert rare <= set(found.members.member[joined & ~found.members.stressed].tolist())


@pytest.mark.parametrize("limits", [{}, {"rms_u_V": 10.0}])
def test_the_answer_is_not_worse_than_the_gains_of_the_case_if_these_meet_the_limits(limits, monkeypatch, tmp_path):
    """The search ends far from the best gains, which are those of the case. Their voltage is 20 V."""
    real = tuning.rounds.first_search
    monkeypatch.setattr(tuning.rounds, "first_search", lambda course, start: real(course, start) - 2.0)
    given = {"controller": {"position": {"c": 100.0, "k": 60.0}}}
    made = study(monkeypatch, World(), given, limits=limits, iterations=1)
    found = rounds(made, np.array([100.0, 60.0]), tmp_path, TOLD, False)
    gains = np.asarray(found.problem.objective.space.gains_at(found.x))
    assert (gains == pytest.approx([100.0, 60.0])) == (not limits)


def test_an_answer_beyond_a_limit_gives_way_to_gains_of_the_case_within_it(monkeypatch, tmp_path):
    """The only search ends beyond a limit. Its time is over, as with a short budget."""
    monkeypatch.setattr(tuning.rounds, "search_within_limits", lambda course, x: (x, False))
    laws = {"controller": {"position": {"c": 90.0, "k": 60.0}}}
    made = study(monkeypatch, World(), laws, limits={"rms_u_V": 30.0}, minutes=1e-9)  # the voltage is 20 V
    found = rounds(made, np.array([90.0, 60.0]), tmp_path, TOLD, False)
    gains = np.asarray(found.problem.objective.space.gains_at(found.x))
    assert found.within
    assert gains == pytest.approx([90.0, 60.0])


def test_without_validation_there_are_no_validation_calls(monkeypatch, tmp_path):
    world = World(limit=lambda seed, number, *_: math.inf if seed == 1 else 40.0)
    found, gains = answer_of(monkeypatch, tmp_path, world, validation=0)
    np.testing.assert_allclose(gains, world.best, rtol=0.05)
    assert seed_of(VALIDATION) not in world.seeds("terms") | world.seeds("metrics") | world.seeds("gradient")
    assert found.lost == 0


@pytest.mark.parametrize(
    ("lost", "within", "errors", "best"),
    [
        # confirmed answers that lose fewer members are better, then those within the limits, then those of less error
        ((3, 1, 2), (True, False, True), (1e-3, 4e-3, 1e-3), 1),
        ((1, 1, 1), (False, True, True), (2e-3, 4e-3, 3e-3), 2),
    ],
)
def test_the_best_answer_of_all_rounds_is_returned(lost, within, errors, best, monkeypatch, tmp_path):
    """Three rounds end with losses on the validation members; searches and validations are replaced."""
    monkeypatch.setattr(tuning.rounds, "MOST_ROUNDS", 3)
    outcomes, inside = iter(zip(lost, errors, strict=True)), iter(within)

    def validated(course, x, error=None):
        count, size = next(outcomes, (9, 9.0))  # at last, the gains of the case
        return Validation(course.answer(x, error, count, size), error, np.arange(1), *np.zeros((2, 0), int))

    monkeypatch.setattr(tuning.rounds, "search_within_limits", lambda course, x: (x, next(inside)))
    monkeypatch.setattr(tuning.rounds, "validated", validated)
    found, _ = answer_of(monkeypatch, tmp_path, World())
    assert (found.lost, found.within, found.validation_error) == (lost[best], within[best], errors[best])
    assert len(found.members.member) == 6 + best  # those of its round: a lost member has joined after each earlier one
    assert next(inside, None) is None


def test_steps_that_do_not_resolve_the_answer_are_halved(monkeypatch, tmp_path):
    world = World(bias=lambda substeps: {3: 0.5, 6: 0.2, 12: 0.05}.get(substeps, 0.0))
    found, _ = answer_of(monkeypatch, tmp_path, world)
    assert found.problem.objective.clock.method == Slide(12)
    assert found.error.relative == pytest.approx(0.05)
    assert found.error.resolved
    # rollouts in the coarse steps count too
    everyone = sum(len(numbers) * points for kind, _, numbers, points in world.calls if kind == "gradient")
    assert found.problem.engine.rollouts > everyone


def test_steps_that_never_resolve_the_answer_are_reported(monkeypatch, tmp_path):
    found, _ = answer_of(monkeypatch, tmp_path, World(bias=lambda substeps: 0.5))
    assert found.error.relative == pytest.approx(0.5)
    assert not found.error.resolved
    assert not found.good
    assert found.problem.finer == 2**MOST_HALVINGS


def test_members_that_only_accurate_steps_lose_join_too(monkeypatch, tmp_path):
    """The first four training members are simulated with accurate steps, which lose one of them above c = 40."""

    def limit(seed, number, stressed, accurate):
        return 40.0 if (seed, number) == (1, 2) and (stressed or accurate) else math.inf

    found, (c, _) = answer_of(monkeypatch, tmp_path, World(limit=limit))
    assert c < 40.0
    assert 2 in found.members.member[found.members.stressed]
    assert found.error.lost == 0
    assert found.lost == 0


def test_worst_validation_members_that_only_accurate_steps_lose_refute_the_answer(monkeypatch, tmp_path):
    monkeypatch.setattr(tuning.rounds, "MOST_ROUNDS", 1)
    validation = seed_of(VALIDATION)
    world = World(limit=lambda seed, number, _, accurate: 40.0 if accurate and seed == validation else math.inf)
    found, _ = answer_of(monkeypatch, tmp_path, world)
    assert found.error.lost == found.lost == FEW
    assert not found.good


def test_a_search_that_loses_every_member_ends(monkeypatch, tmp_path):
    found, _ = answer_of(monkeypatch, tmp_path, World(limit=lambda seed, number, *_: 1e-3))
    assert found.lost == 10  # the whole validation ensemble
    assert found.error is None


def test_an_interrupted_search_is_resumed_where_it_ended(monkeypatch, tmp_path):
    """Ctrl-C interrupts the second round. The resumed search gives the gains of an uninterrupted one, bit by bit."""
    stop = False

    def limit(seed, number, stressed, accurate):
        fragile = seed == seed_of(VALIDATION) and number == 3
        if stop and fragile and world.calls[-1][0] == "gradient":
            raise KeyboardInterrupt
        return 40.0 if fragile else math.inf

    world = World(limit=limit)
    out = [tmp_path / "whole", tmp_path / "cut"]
    whole, (c, _) = answer_of(monkeypatch, out[0], world)
    assert c < 40.0
    stop = True
    _, (c, _) = answer_of(monkeypatch, out[1], world)
    assert c > 40.0  # what the first round found
    stop = False
    made = study(monkeypatch, world)
    again = rounds(made, made.tune.space.values(made.case.cascade), out[1], TOLD, True)
    assert again.lost == 0
    np.testing.assert_array_equal(again.x, whole.x)
