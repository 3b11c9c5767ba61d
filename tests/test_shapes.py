"""Leaves of a declared shape: validated, spread, batched, and read from and written to a case."""

import dataclasses
import re
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Scenario, rollout
from ambjax.cases.table import Table
from ambjax.compiler.short_compilation import compiled_quickly
from ambjax.ensemble import run_ensemble
from ambjax.ensemble.batching import map_members, size
from ambjax.ensemble.distributions import Choice
from ambjax.ensemble.paths import places
from ambjax.ensemble.spread import Spread, apply, draw
from ambjax.extend import canonical, leaf, record, validate
from ambjax.laws import inversion
from ambjax.numerics.records import part
from ambjax.numerics.shapes import map_varying, varying
from ambjax.plants import Plant
from ambjax.simulation.clock import Clock
from ambjax.solvers import RK4

CASCADE = Cascade(inversion=inversion.Adaptive(gamma=1e9, p=25e-6))
M = np.array([[3.0, 0.5, 0.0], [0.5, 2.0, 0.1], [0.0, 0.1, 1.0]])


@record
class Rotor:
    """Mass matrix, weight and rows of the magnets."""

    M: object = leaf(default=tuple(map(tuple, M)), shape="d d", unit="kg", at_least=-10, at_most=10, doc="mass matrix")
    weight: object = leaf(default=(1.0, 2.0, 3.0), shape="d", unit="N", doc="weight")
    rows: object = leaf(default=None, shape="c d", optional=True, doc="rows")
    speed: object = leaf(default=0.0, unit="rpm", doc="speed")


@record
class Machine(Plant):
    """The plant of the paper with a rotor beside it."""

    rotor: Rotor = part(default=Rotor(), doc="the rotor")


def accelerations(scenario):
    rotor = scenario.plant.rotor
    return jnp.linalg.solve(rotor.M, rotor.weight) + rotor.speed


@pytest.fixture
def case():
    return CASCADE, Scenario(plant=Machine())


def with_rotor(scenario, **changes):
    rotor = dataclasses.replace(scenario.plant.rotor, **changes)
    return dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, rotor=rotor))


def test_a_square_matrix_is_not_an_ensemble(case):
    assert not any(varying(case))
    with pytest.raises(ValueError, match="none"):
        size(case)
    wide = with_rotor(case[1], M=np.stack([M] * 4), speed=np.arange(4.0))
    assert size(wide) == 4
    first = map_varying(lambda x: x[0], wide)
    assert not any(varying(first))
    np.testing.assert_array_equal(first.plant.rotor.M, M)


def test_members_that_differ_in_one_entry_are_each_solved_alone(case):
    path = "plant.rotor.M.0.1"
    spread = Spread(((path, Choice((-0.5, 0.0, 0.7))), ("plant.rotor.speed", Choice((1.0, 2.0)))))
    values = draw(spread, *case, 3, np.arange(20), 20)
    cascade, scenario = apply(*case, values)
    found = map_members(accelerations, canonical(scenario), compiled=compiled_quickly)
    assert len(set(values[path])) == 3
    for k, b in enumerate(found):
        changed = M.copy()
        changed[0, 1] = values[path][k]
        np.testing.assert_allclose(b, np.linalg.solve(changed, [1, 2, 3]) + values["plant.rotor.speed"][k], rtol=1e-12)
    axes = jax.tree.unflatten(jax.tree.structure(scenario), [0 if varies else None for varies in varying(scenario)])
    np.testing.assert_allclose(jax.vmap(accelerations, (axes,))(scenario), found, rtol=1e-12)
    # another entry of an array that has members already
    assert places(cascade, scenario)[path].value.shape == (20,)
    _, twice = apply(cascade, scenario, {"plant.rotor.M.2.2": 4.0})
    np.testing.assert_array_equal(twice.plant.rotor.M[:, 0, 1], values[path])
    assert np.all(twice.plant.rotor.M[:, 2, 2] == 4.0)


def test_an_ensemble_of_a_plant_with_a_matrix_is_its_rollouts(case):
    clock = Clock(40, 1e-4, RK4(2))
    cascade, scenario = apply(*case, {"plant.rotor.M.0.0": np.array([1.0, 2.0]), "plant.m": np.array([0.5, 0.6])})
    ended = run_ensemble(cascade, scenario, clock, fold=None, record_every=1).trajectory.rows.z
    alone = rollout(case[0], apply(*case, {"plant.m": 0.6})[1], clock).trajectory.rows.z
    np.testing.assert_allclose(ended[1], alone, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("M", np.ones((3, 2)), "[3, 2]: it must be [d, d]"),
        ("M", np.eye(2), "[d] with d = 2 as in M"),
        ("M", 1.0, "[]: it must be [d, d]"),
        ("weight", np.ones((2, 4, 3)), "[N, d]"),
        ("rows", np.ones((2, 4)), "[2, 4]: it must be [c, d] with d = 3 as in M"),
        ("speed", np.eye(2), "[2, 2]: it must be a number, or [N] for N members"),
    ],
)
def test_a_wrong_shape_is_refused_with_its_path_and_the_shape_that_fits(case, name, value, words):
    with pytest.raises(ValueError, match=rf"^scenario\.plant\.rotor\.\w+ has .*{re.escape(words)}"):
        rollout(case[0], with_rotor(case[1], **{name: value}), Clock(2, 1e-4, RK4(2)))


def test_an_entry_out_of_range_is_refused(case):
    with pytest.raises(ValueError, match=r"plant\.rotor\.M = 0 to 50: it must be an array \[d, d\] of finite numbers"):
        validate(with_rotor(case[1], M=np.diag([1.0, 50.0, 1.0])).plant, "plant")
    with pytest.raises(ValueError, match=r"plant\.rotor\.M\.0\.3.*M\.0\.0"):
        apply(*case, {"plant.rotor.M.0.3": 1.0})


def test_a_record_with_arrays_is_read_from_a_table():
    read = Table(tomllib.loads("M = [[3, 0.5], [0.5, 2]]\nweight = [4, 5]\nspeed = 7.0"), "rotor").record(Rotor)
    assert read.speed == 7.0
    np.testing.assert_array_equal(read.M, M[:2, :2])
    np.testing.assert_array_equal(read.weight, [4.0, 5.0])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("M = [[1, 2], [3]]", "rotor.M = [[1, 2], [3]]: its rows have different lengths"),
        ("M = [[1, 2], [3, '4']]", "rotor.M.1.1 ="),
        ("M = 1.0", "rotor.M has the shape []: it must be [d, d]"),
        ("M = [[1, 2], [3, 4]]", "rotor.weight has the shape [3]: it must be [d] with d = 2 as in M"),
    ],
)
def test_a_table_with_a_wrong_array_is_refused(line, words):
    with pytest.raises(ValueError, match=f"^{re.escape(words)}"):
        Table(tomllib.loads(line), "rotor").record(Rotor)
