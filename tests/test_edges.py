"""Edges of disturbances between samples: steps end there, in every method, for every member, and with derivatives."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ambjax as amb
from ambjax.control.processor import Processor
from ambjax.ensemble import run_ensemble
from ambjax.simulation.edges import Edges, most_inside
from ambjax.simulation.integrate import InitialValueProblem

T = 1e-4
SOFT = amb.Cascade(inversion=amb.inversion.Adaptive(2e5), processor=Processor(0.5))


def world(start, stop, **more):
    return amb.Scenario(q_z=amb.Pulse(5.0, start, stop), **more)


@pytest.mark.parametrize("at", [(), (0.3,), (0.3, 0.35), (0.2, 0.6, 0.95), (0.0, 0.4, 1.0), (-1.0, 0.5, 3.0)])
def test_equal_steps_are_divided_at_the_edges_inside(at):
    t, h, count = 2.0, 0.25, 4
    edges, tolerance = Edges(tuple(t + x for x in at), len(at)), 1e-14
    begins, ends, lengths = np.array([edges.steps(t, h, count)(n) for n in range(count + len(at))]).T
    inside = [x for x in at if 0 < x < 1]
    grid = np.sort([*np.arange(count + 1) * h, *inside, *np.ones(len(at) - len(inside))])
    np.testing.assert_allclose(begins - t, grid[:-1], atol=tolerance)
    np.testing.assert_allclose(ends - t, grid[1:], atol=tolerance)
    np.testing.assert_allclose(lengths, np.diff(grid), atol=tolerance)


def test_steps_cover_the_whole_period_if_there_are_more_edges_than_counted():
    steps = Edges((0.1, 0.3, 0.6), 1).steps(0.0, 0.25, 4)
    spans = [steps(n)[:2] for n in range(5)]
    assert [float(x) for x in (spans[0][0], spans[-1][1])] == [0.0, 1.0]
    assert all(a[1] == b[0] for a, b in itertools.pairwise(spans))


@pytest.mark.parametrize(
    "method", [amb.Euler(3), amb.RK4(3), amb.DOP853(3), amb.Rodas3(3), amb.AdaptiveRodas3()], ids=str
)
def test_an_integral_is_exact_wherever_the_rate_jumps(method):
    pulse = amb.Pulse(2.0, 1.137, 1.642)
    rates = lambda inputs, state: pulse(inputs)  # noqa: E731
    problem = InitialValueProblem(lambda t: t, rates, 1.0, lambda state: jnp.int32(0), edges=Edges(pulse.edges(), 2))
    end = method.advance(problem, 1.0, 1.0, jnp.zeros(()), method.start(1.0))
    # a rate that is constant over each step: rounding of some 5 steps
    assert float(end.state) == pytest.approx(2.0 * (1.642 - 1.137), rel=1e-14)
    assert float(end.t) == 2.0


def spread(**values):
    """Return arrays as a scenario contains them at the ends of a spread: each number on its own axis."""
    shape = [1] * len(values)
    return {k: np.reshape(x, [*shape[:n], 2, *shape[n + 1 :]]) for n, (k, x) in enumerate(values.items())}


@pytest.mark.parametrize(
    ("scenario", "most"),
    [
        (amb.Scenario(), 0),
        (world(0.1, 0.7), 0),  # 0.7 is no whole number of periods in floating point
        (world(0.10003, 0.7), 1),
        (world(0.10003, 0.10005), 2),
        (world(-0.10003, 0.7), 0),
        (world(np.array([0.1, 0.2]), 0.7), 1),  # between them, too
        (world(**spread(start=[0.1, 0.3], stop=[0.4, 0.5])), 1),
        (world(**spread(start=[0.1, 0.3], stop=[0.2, 0.5])), 2),  # as near as one wishes
        (amb.Scenario(q_v=amb.Step(1.0, 0.10003), q_i=amb.Sum((amb.Sine(1.0, 2.0), amb.Step(1.0, 0.10005)))), 2),
    ],
)
def test_the_number_of_edges_inside_a_sample(scenario, most):
    assert most_inside(scenario, T) == most
    assert amb.with_method(amb.Clock(10, T), SOFT, scenario).cuts == most
    clock = amb.Clock(10, T, cuts=1)  # counted for the whole of which this is a part
    assert amb.with_method(clock, SOFT, scenario).cuts == max(most, 1)


def test_edges_of_several_periods():
    assert most_inside(world(0.1, 0.7), np.array([1e-4, 2e-4])) == 0
    assert most_inside(world(0.1001, 0.7), np.array([1e-4, 2e-4])) == 1


@pytest.mark.thorough
def test_edges_may_differ_between_members():
    """Each member moves as in a run of its own, also if the edges are traced."""
    starts, clock = np.array([0.002, 0.00203, 0.00217]), amb.Clock(40, T, amb.RK4(1), cuts=1)

    def z(start):
        return amb.rollout(SOFT, world(start, start + 1e-3), clock).trajectory.rows.z

    alone = [z(start) for start in starts]
    together = run_ensemble(SOFT, world(starts, starts + 1e-3), clock, fold=None, every=1).trajectory.rows.z
    # Of 1e-5 m: rounding, which grows with the unstable pole.
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-18)
    traced = jax.jit(jax.vmap(z))(starts)
    np.testing.assert_allclose(traced, alone, rtol=0, atol=1e-18)


def test_derivatives_in_the_time_of_an_edge():
    """The equation is y' = A - y from the edge on."""

    def end(start):
        rates = lambda t, y: amb.Step(2.0, start)(t) - y  # noqa: E731
        problem = InitialValueProblem(lambda t: t, rates, 1.0, lambda state: jnp.int32(0), edges=Edges((start,), 1))
        return amb.RK4(20).advance(problem, 1.0, 1.0, jnp.zeros(()), ()).state

    at = 1.337
    slopes = [derivative(end)(at) for derivative in (jax.jacfwd, jax.grad)]
    # RK4 in steps of 0.05: (0.05)^4 / 120 of it
    np.testing.assert_allclose(slopes, -2.0 * np.exp(at - 2.0), rtol=1e-7)
