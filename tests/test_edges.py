"""Edges of disturbances between samples: steps end there, in every method, for every member, and with derivatives."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from profiles import thorough
from structures import METHODS

import ambjax as amb
from ambjax import signals
from ambjax.control.processor import Processor
from ambjax.numerics.records import replaced
from ambjax.simulation.edges import Edges, most_inside
from ambjax.simulation.integrate import Begin, InitialValueProblem
from ambjax.world.waveforms import edges_of, knots_of

T = 1e-4
SINE = signals.Sine(1.0, 2.0)
SOFT = amb.Cascade(inversion=amb.laws.inversion.Adaptive(2e5), processor=Processor(0.5))


def world(start, stop, **more):
    return amb.Scenario(q_z=amb.signals.Pulse(5.0, start, stop), **more)


def walked(edges, t, h, count):
    """Begin, end and length of each step."""
    place, step = edges.steps(t, h, count)
    found = []
    for n in range(count + edges.most):
        *one, place = step(jnp.int32(n), place)
        found.append([float(x) for x in one])
    return found


@pytest.mark.parametrize("at", [(), (0.3,), (0.3, 0.35), (0.2, 0.6, 0.95), (0.0, 0.4, 1.0), (-1.0, 0.5, 3.0)])
def test_equal_steps_are_divided_at_the_edges_inside(at):
    t, h, count = 2.0, 0.25, 4
    edges, tolerance = Edges(tuple(t + x for x in at), len(at)), 1e-14
    begins, ends, lengths = np.array(walked(edges, t, h, count)).T
    grid = np.unique([*np.arange(count + 1) * h, *(x for x in at if 0 < x < 1)])
    grid = np.append(grid, np.ones(count + len(at) + 1 - len(grid)))  # the last steps have length 0
    np.testing.assert_allclose(begins - t, grid[:-1], atol=tolerance)
    np.testing.assert_allclose(ends - t, grid[1:], atol=tolerance)
    np.testing.assert_allclose(lengths, np.diff(grid), atol=tolerance)


def test_steps_cover_the_whole_period_if_there_are_more_edges_than_counted():
    spans = walked(Edges((0.1, 0.3, 0.6), 1), 0.0, 0.25, 4)
    assert [float(x) for x in (spans[0][0], spans[-1][1])] == [0.0, 1.0]
    assert all(a[1] == b[0] for a, b in itertools.pairwise(spans))


# Irregular times; two of the values and two of the slopes are equal, so that these times are no edges.
RECORD = np.array([0.9, 1.037, 1.1, 1.137, 1.25, 1.33, 1.642, 1.9, 2.5])
VALUES = np.array([1.0, 3.0, 3.0, -2.0, 4.0, 4.0 + 8 * 0.08 / 0.312, 12.0 + 8 * 0.08 / 0.312, 0.5, 2.0])
HELD = amb.signals.Recorded(amb.signals.Samples(RECORD - 0.5, VALUES), held=True, start=0.5)
LINEAR = dataclasses.replace(HELD, held=False)
AREA = {  # from 1 to 2
    "held": np.sum(np.diff([1.0, *RECORD[1:8], 2.0]) * VALUES[:8]),
    "linear": np.trapezoid(np.interp(inner := np.array([1.0, *RECORD[1:8], 2.0]), RECORD, VALUES), inner),
}


@pytest.mark.parametrize("method", METHODS, ids=str)
@pytest.mark.parametrize("name", ["pulse", "held", "linear"])
def test_an_integral_is_exact_wherever_the_rate_jumps_or_has_a_kink(method, name):
    signal = {"pulse": amb.signals.Pulse(2.0, 1.137, 1.642), "held": HELD, "linear": LINEAR}[name]
    knots = knots_of(signal)
    edges = Edges(edges_of(signal), len(edges_of(signal)) + sum(len(one.times) for one in knots), knots)
    rates = lambda inputs, state: signal(inputs)  # noqa: E731
    problem = InitialValueProblem(lambda t: t, rates, 1.0, lambda state: jnp.int32(0), edges=edges)
    end = method.advance(problem, Begin(1.0, jnp.zeros(()), method.start(1.0)), 1.0)
    assert float(end.t) == 2.0
    if name == "linear" and isinstance(method, amb.solvers.Euler):
        return  # not exact for a straight line
    # A rate that is constant or linear over each step: rounding of some 10 steps, and the inset of the stages, a few
    # units in the last place of t.
    assert float(end.state) == pytest.approx(AREA.get(name, 2.0 * (1.642 - 1.137)), rel=1e-13)


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
        (amb.Scenario(q_z=signals.Ramp(1.0, 0.10001, 3e-5)), 2),  # both kinks
        (amb.Scenario(q_z=signals.Recorded(signals.Samples(0.1 + T * np.arange(9), np.arange(9.0) ** 2))), 0),
        (amb.Scenario(q_z=signals.Recorded(signals.Samples(T / 2.5 * np.arange(99), np.arange(99.0) ** 2))), 2),
        (amb.Scenario(q_z=signals.Recorded(signals.Samples(T / 2.5 * np.arange(99), np.arange(99.0)))), 1),  # straight
        (amb.Scenario(q_v=signals.Step(1.0, 0.10003), q_i=signals.Sum((SINE, signals.Step(1.0, 0.10005)))), 2),
    ],
)
def test_the_number_of_edges_inside_a_sample(scenario, most):
    assert most_inside(scenario.edges(), T, scenario.knots()) == most
    assert amb.solvers.with_method(amb.Clock(10, T), SOFT, scenario).cuts == most
    clock = replaced(amb.Clock(10, T), cuts=1)  # counted for the whole of which this is a part
    assert amb.solvers.with_method(clock, SOFT, scenario).cuts == max(most, 1)


def test_derivatives_in_the_time_of_an_edge():
    """The equation is y' = A - y from the edge on."""

    def end(start):
        rates = lambda t, y: amb.signals.Step(2.0, start)(t) - y  # noqa: E731
        problem = InitialValueProblem(lambda t: t, rates, 1.0, lambda state: jnp.int32(0), edges=Edges((start,), 1))
        return amb.solvers.RK4(20).advance(problem, Begin(1.0, jnp.zeros(()), ()), 1.0).state

    at = 1.337
    slopes = [derivative(end)(at) for derivative in (jax.jacfwd, jax.grad)]
    # RK4 in steps of 0.05: (0.05)^4 / 120 of it
    np.testing.assert_allclose(slopes, -2.0 * np.exp(at - 2.0), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("held", "sensor"), [(True, amb.sensors.Sensor(bandwidth=5e3)), thorough(False, None)])
def test_a_record_inside_samples_costs_no_accuracy(held, sensor):
    """Against 20 times as many steps. Without edges at the times of the record, the errors are 1e-9 to 1e-8 m."""
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0, 40 * T, 60))
    record = amb.signals.Recorded(amb.signals.Samples(times, rng.normal(size=60)), held=held, scale=5.0)
    scenario = amb.Scenario(q_z=record, sensor=sensor)
    clock = amb.solvers.with_method(amb.Clock(40, T), SOFT, scenario)
    assert clock.cuts > 2
    z, exact = (
        amb.rollout(SOFT, scenario, clock.with_method(amb.solvers.RK4(n * clock.method.substeps))).trajectory.rows.z
        for n in (1, 20)
    )
    assert np.abs(exact).max() > 1e-6
    # RK4 on smooth pieces: below 1e-12 m. The low-pass takes z as a cubic over each part of a sample, in both runs.
    np.testing.assert_allclose(z, exact, rtol=0, atol=1e-11)
