"""Gain schedules: interpolation, laws of every stage, gradients, tuning, the theorem and the export."""

import dataclasses
import re
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax.cases.reader import case_from
from ambjax.cases.table import Table
from ambjax.control.cascade_state import Sample
from ambjax.control.schedule import OVER
from ambjax.laws import Schedule
from ambjax.numerics.records import validate
from ambjax.theorem.conditions import constant_sigma, required
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import Reference
from tuning.problem.config import tune_from
from tuning.problem.ranges import from_unit_cube
from tuning.problem.space import tunable
from tuning.problem.tuning_problem import problem_of
from tuning.report.folder import tuned

AT, VALUES = (0.0, 1e-5, 4e-5), (100.0, 300.0, 200.0)
# A short run of a few laws, with one scheduled gain per stage.
LOOP = """
[controller.observer]
kind = "complementary"
l = {l}

[controller.position]
c = {c}  # 1/s
k = {k}

[controller.inversion]
gamma = {gamma}

[controller.current]
k_i = {k_i}

[reference]
kind = "sine"
amplitude = 1e-3
frequency = 2.0

{more}
"""
GAINS = {"l": 10.0, "c": 17.0, "k": 25.0, "gamma": 7.5e4, "k_i": 152.0}
SAMPLED = "[processor]\n"


def loop(more="", **gains):
    return case_from(tomllib.loads(LOOP.format(more=more, **{**GAINS, **gains})))


def table(*values, over="error"):
    at = ", ".join(f"{1e-5 * k:g}" for k in range(len(values)))
    return f'{{ over = "{over}", at = [{at}], values = [{", ".join(map(repr, values))}] }}'


@pytest.mark.parametrize("over", OVER)
def test_values_agree_with_numpy_interp(over):
    one, x = Schedule(VALUES, at=AT, over=over), np.linspace(-6e-5, 6e-5, 97)
    zero = np.zeros_like(x)
    z, r, r_dot = {"error": (x, zero, zero), "reference": (zero, x, zero), "reference-speed": (zero, zero, x)}[over]
    found = jax.vmap(lambda *a: one.value(a[0], Reference(*a[1:], 0.0 * a[0])))(z, r, r_dot)
    # rounding of a few products, relative to values of some hundreds
    np.testing.assert_allclose(found, np.interp(np.abs(x), AT, VALUES), rtol=1e-14)


def test_derivatives_are_exact_at_the_knots_and_zero_at_zero():
    def value(values, e):
        return Schedule(tuple(values), at=AT).value(e, Reference(*[jnp.zeros(())] * 3))

    for e, weights in ((2.5e-5, (0, 0.5, 0.5)), (0.0, (1, 0, 0)), (9e-5, (0, 0, 1))):
        # rounding of a quotient
        np.testing.assert_allclose(jax.grad(value)(jnp.array(VALUES), e), weights, atol=1e-14)
    slope = jax.grad(value, 1)
    # 200 in 1e-5 m and -100 in 3e-5 m; at 0 the magnitude has no derivative but 0, also within rounding of 0
    np.testing.assert_allclose([slope(jnp.array(VALUES), e) for e in (5e-6, -5e-6, 2e-5)], [2e7, -2e7, -1e7 / 3])
    assert slope(jnp.array(VALUES), 0.0) == 0
    assert abs(slope(jnp.array(VALUES), 1e-19)) < 1e2


def outputs(cascade, errors):
    """Outputs and rates of the laws at the motion with these errors; on a processor, those of successive samples."""
    i, r = jnp.asarray(0.01), Reference(*(jnp.asarray(x) for x in (1e-3, -4e-6, 1e-3)))
    first = Measurement(r.r + errors[0], 3e-4 + 0 * i, i)
    if cascade.processor is None:
        return cascade(first, cascade.init(first, r), r, jnp.asarray(200.0))

    def sample(state, e):
        measured = first._replace(z=r.r + e)
        command, state, _ = cascade.step(measured, state, Sample(r, 1e-4, jnp.asarray(200.0), (0 * i, 0 * i)))
        return state, command

    state = jax.tree.map(jnp.asarray, cascade.init(first))
    return jax.lax.scan(sample, state, errors)


ERRORS = jnp.array([4e-6, -1.2e-5, 2e-5])


@pytest.mark.parametrize("more", ["", SAMPLED], ids=["continuous", "processor"])
def test_a_constant_schedule_equals_the_plain_gain(more):
    """Each stage has one scheduled gain."""
    plain, same = loop(more), loop(more, **{name: table(x, x) for name, x in GAINS.items()})
    moved = loop(more, **{name: table(x, 3 * x) for name, x in GAINS.items()})
    plain, same, moved = (
        jax.jit(outputs)(one.cascade.on_processor() if more else one.cascade, ERRORS) for one in (plain, same, moved)
    )
    # equal but for the order of a few sums in the compiled program; u is a difference of terms a hundred times larger
    for a, b in zip(*map(jax.tree.leaves, (plain, same)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)
    # the scheduled gain of each stage acts: on the observer's state, v_star, i_ref_dot and u
    (_, a), (_, b) = ((one[1], one[0]) for one in (plain, moved)) if more == "" else (plain, moved)
    assert all(np.all(x != y) for x, y in zip(a[:1] + a[3:], b[:1] + b[3:], strict=True))


def test_gradients_with_respect_to_the_knots_in_three_ways():
    gains = {"k": table(25.0, 50.0), "gamma": table(7.5e4, 9e4, over="reference-speed"), "k_i": table(152.0, 200.0)}
    leaves, tree = jax.tree.flatten(loop(**gains).cascade)
    at = [leaves.index(x) for x in (25.0, 50.0, 7.5e4, 9e4, 152.0, 200.0)]

    def loss(logs):
        moved = list(leaves)
        for place, d in zip(at, logs, strict=True):
            moved[place] = moved[place] * jnp.exp(d)
        command, _ = outputs(jax.tree.unflatten(tree, moved), ERRORS)
        return command.u**2 + command.v_star**2

    x, steps = jnp.zeros(len(at)), 1e-4 * jnp.eye(len(at))
    forward, reverse, up, down = jax.jit(
        lambda: (jax.jacfwd(loss)(x), jax.grad(loss)(x), jax.vmap(loss)(steps), jax.vmap(loss)(-steps))
    )()
    assert np.all(np.abs(forward) > 1e-6)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    # truncation of the differences: (1e-4)^2 of third derivatives of the order of the first
    np.testing.assert_allclose(forward, (up - down) / 2e-4, rtol=1e-5)


BAD = {
    '{ over = "error", at = [0.0, 1e-5], values = [1.0, 2.0], x = 1 }': "controller.position.k.x = 1: unknown key",
    '{ over = "speed", at = [0.0, 1e-5], values = [1.0, 2.0] }': 'controller.position.k.over = "speed": it must be one',
    '{ over = "error", at = 1.0, values = [1.0, 2.0] }': "controller.position.k.at = 1.0: it must be a list",
    '{ over = "error", at = [0.0], values = [1.0] }': "controller.position.k.at = [0]: it must be 2 to 50 increasing",
    '{ over = "error", at = [1e-5, 0.0], values = [1.0, 2.0] }': "controller.position.k.at = [1e-05, 0]",
    '{ over = "error", at = [0.0, nan], values = [1.0, 2.0] }': "controller.position.k.at = [0, nan]",
    '{ over = "error", at = [0.0, 1e-5], values = [1.0] }': "controller.position.k.values has 1 numbers",
    '{ over = "error", at = [0.0, 1e-5], values = [1.0, -2.0] }': "controller.position.k.values[1] = -2: it must be",
    '{ over = "error", at = [0.0, 1e-5], values = [1.0, "2"] }': 'controller.position.k.values.1 = "2"',
}


@pytest.mark.parametrize("given", BAD)
def test_bad_tables_are_refused(given):
    with pytest.raises(ValueError, match=f"^{re.escape(BAD[given])}"):
        loop(k=given)


def test_only_finite_gains_have_schedules():
    inverse = '[controller.inversion]\ni_ref = { over = "error", at = [0.0, 1e-5], values = [1.0, 2.0] }'
    with pytest.raises(ValueError, match=r"controller\.inversion\.i_ref: only a gain can have a schedule"):
        case_from(tomllib.loads(inverse))
    steep = '[processor]\n[controller.position]\np = { over = "error", at = [0.0, 1e-5], values = [1.0, inf] }'
    with pytest.raises(ValueError, match=r"controller\.position\.p\.values\[1\] = inf"):
        case_from(tomllib.loads(steep))
    law = dataclasses.replace(loop().cascade.position, k=Schedule((1.0, -2.0), at=AT[:2]))
    with pytest.raises(ValueError, match=r"position\.k\.values\[1\] = -2"):
        validate(law, "position")


SCHEDULED = GAINS | {"c": table(17.0, 20.0, 30.0), "k": table(25.0, 50.0)}
TUNED = {"gains": ["controller.position.c", "controller.position.k.1"], "members": 8, "stressed": 4}


def tuning_of(case, **more):
    return tune_from(Table(TUNED | more, "tune"), case)


def test_knots_are_tuned_like_gains():
    case = loop(SAMPLED, **SCHEDULED)
    bounds = {"controller": {"position": {"c": [1.0, 90.0], "k": {"1": [2.0, 80.0]}}}}
    space = tuning_of(case, bounds=bounds).space
    assert space.paths == [*(f"controller.position.c.{knot}" for knot in range(3)), "controller.position.k.1"]
    assert [gain.name for gain in space.gains] == ["c.0", "c.1", "c.2", "k.1"]
    assert [(gain.low, gain.high) for gain in space.gains] == [(1.0, 90.0)] * 3 + [(2.0, 80.0)]
    assert list(space.values(case.cascade)) == [17.0, 20.0, 30.0, 50.0]
    moved = space.decode(jnp.asarray(space.encode([2.0, 3.0, 4.0, 5.0])), case.cascade)
    np.testing.assert_allclose(moved.position.c.values, [2.0, 3.0, 4.0], rtol=1e-12)
    np.testing.assert_allclose(moved.position.k.values, [25.0, 5.0], rtol=1e-12)
    assert "controller.position.k.0" in tunable(case.cascade)
    assert "controller.position.k" not in tunable(case.cascade)
    with pytest.raises(ValueError, match=r"tune\.gains: 'controller\.position\.k\.2': there is no such number"):
        tuning_of(case, gains=["controller.position.k.2"])


def test_knots_are_searched_in_the_range_of_their_gain():
    plain, case = loop(SAMPLED), loop(SAMPLED, **SCHEDULED)
    problems = [
        problem_of(one, tuning_of(one, gains=gains))
        for one, gains in ((plain, ["controller.position.c", "controller.position.k"]), (case, TUNED["gains"]))
    ]
    one, many = ([(row.low, row.high, row.most) for row in problem.ranges] for problem in problems)
    assert many == [one[0]] * 3 + [one[1]]
    # the screen begins at constant gains
    points = from_unit_cube(
        problems[1].objective.space, problems[1].ranges, np.random.default_rng(0).uniform(size=(3, 4))
    )
    assert np.all(points[:, :3] == points[:, :1])
    assert np.any(points[:, 3] != points[:, 2])


@pytest.mark.parametrize("spelled", ["inline", "table"])
def test_a_tuned_file_gives_the_tuned_schedule(spelled):
    text = LOOP.format(more=SAMPLED, **SCHEDULED)
    if spelled == "table":
        text = text.replace(f"k = {SCHEDULED['k']}", "") + (
            '[controller.position.k]  # scheduled\nover = "error"\nat = [0.0, 1e-5]\n'
            "values = [\n  25.0, # first\n  50.0,\n]\n"
        )
    new = {"controller.position.c.1": 21.5, "controller.position.k.1": 33.25, "controller.current.k_i": 140.0}
    written = tuned(text, new, "case", "verdict")
    cascade = case_from(tomllib.loads(written)).cascade
    assert cascade.position.c.values == (17.0, 21.5, 30.0)
    assert cascade.position.k.values == (25.0, 33.25)
    assert cascade.current.k_i == 140.0
    assert ("# first" if spelled == "table" else "# 1/s") in written


def test_the_theorem_uses_the_smallest_value_and_requires_a_constant_sigma():
    cascade = loop(k=table(25.0, 10.0, 60.0)).cascade
    assert {one.path: one.value for one in required(cascade)}["controller.position.k"] == 10.0
    assert constant_sigma(cascade.position) == []
    (line,) = constant_sigma(loop(c=table(17.0, 34.0)).cascade.position)
    assert (line.holds, line.against) == (False, 2.0)
    assert "c constant" in line.requires
    (line,) = constant_sigma(loop(c=table(17.0, 17.0)).cascade.position)
    assert line.holds
